# SPDX-License-Identifier: GPL-3.0-or-later
"""`holoreel train stg CAPTURE --out REEL`: train Spacetime Gaussians."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tqdm import tqdm

from ..capture import read_capture
from ..errors import HoloreelError
from ..gaussians.config import PRESETS, TrainConfig
from ..gaussians.run import RunPaths, train_reel
from ..gaussians.train import Progress
from ..render import get_backend


def prepare(arguments: list[str]) -> Callable[..., None]:
    """Return the command with the defaults of the preset that the arguments name."""
    preset = "lite"
    for index, argument in enumerate(arguments):
        if argument == "--preset" and index + 1 < len(arguments):
            preset = arguments[index + 1]
        elif argument.startswith("--preset="):
            preset = argument.partition("=")[2]
    if preset not in PRESETS:
        raise HoloreelError(f"--preset {preset}: no such preset; take one of {', '.join(PRESETS)}.")

    def run(
        method: tyro.conf.Positional[Literal["stg"]],
        capture: tyro.conf.Positional[Path],
        /,
        out: Path,
        preset: str = preset,
        resume: bool = False,
        backend: Literal["auto", "cpu", "reference"] = "auto",
        config: Annotated[TrainConfig, tyro.conf.arg(name="")] = PRESETS[preset],
    ) -> None:
        """Train a reel from a capture. Ctrl-C leaves a checkpoint beside the reel.

        Args:
            method: what to train: stg, Spacetime Gaussians.
            capture: folder with transforms.json, or that file.
            out: the reel to write, NAME.reel.
            preset: settings to start from; the flags below change them.
            resume: go on from the checkpoint of a stopped run.
            backend: which rasterizer.
            config: the preset's settings.
        """
        train(capture, out, resume, backend, config)

    return run


def train(
    capture: Path, out: Path, resume: bool, backend: Literal["auto", "cpu", "reference"], config: TrainConfig
) -> None:
    """Train with a progress line on the terminal."""
    with tqdm(total=config.iterations, unit="it", dynamic_ncols=True, desc="train") as bar:

        def show(progress: Progress) -> None:
            bar.n = progress.iteration
            bar.set_postfix(
                loss=f"{progress.loss:.4f}", psnr=f"{progress.psnr:.2f}", gaussians=progress.gaussians, refresh=True
            )

        try:
            trainer = train_reel(read_capture(capture), out, config, get_backend(backend), show, resume)
        except KeyboardInterrupt:
            bar.close()
            print(f"checkpoint: {RunPaths(out).checkpoint} (go on with --resume)")
            raise
    print(f"{out}: {len(trainer.parameters)} Gaussians in {trainer.seconds:.0f} s")
