# SPDX-License-Identifier: GPL-3.0-or-later
"""`holoreel train stg CAPTURE --out REEL`: train Spacetime Gaussians."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tqdm import tqdm

from ..capture import CaptureOptions, read_capture
from ..gaussians.config import PRESETS as PRESETS
from ..gaussians.config import TrainConfig
from ..gaussians.run import RunPaths, train_reel
from ..gaussians.train import Progress
from ..render import Backend, get_backend
from ..status import StatusWriter

DEFAULT = "lite"


def command(preset: str) -> Callable[..., None]:
    """Return the command with a preset's settings as defaults."""

    def run(
        method: tyro.conf.Positional[Literal["stg"]],
        capture: tyro.conf.Positional[Path],
        /,
        out: Path,
        preset: str = preset,
        resume: bool = False,
        backend: Backend = "auto",
        status: Path | None = None,
        options: Annotated[CaptureOptions, tyro.conf.arg(name="")] = CaptureOptions(),  # noqa: B008
        config: Annotated[TrainConfig, tyro.conf.arg(name="")] = PRESETS[preset],
    ) -> None:
        """Train a reel from a capture. Ctrl-C leaves a checkpoint beside the reel.

        Args:
            method: what to train: stg, Spacetime Gaussians.
            capture: folder of a capture in any layout that `holoreel info` knows.
            out: the reel to write, NAME.reel.
            preset: settings to start from; the flags below change them.
            resume: go on from the checkpoint of a stopped run.
            backend: which rasterizer.
            status: JSON file that says how far the run is, for programs that look in; a preview lies beside it. Then
                there is no progress line.
            options: how the capture is read.
            config: the preset's settings.
        """
        train(capture, options, out, resume, backend, StatusWriter(status), config)

    return run


def train(
    folder: Path,
    options: CaptureOptions,
    out: Path,
    resume: bool,
    backend: Backend,
    status: StatusWriter,
    config: TrainConfig,
) -> None:
    """Train, with a progress line on the terminal unless there is a status file."""
    capture = read_capture(folder, options)
    for note in capture.notes:
        print(note)
    with tqdm(unit="it", dynamic_ncols=True, desc="train", disable=status.path is not None) as bar:

        def show(progress: Progress) -> None:
            done, total = progress.iteration, progress.iterations
            bar.n, bar.total = done, total
            bar.set_postfix(
                loss=f"{progress.loss:.4f}", psnr=f"{progress.psnr:.2f}", gaussians=progress.gaussians, refresh=True
            )
            figures = {
                "loss": f"{progress.loss:.4f}",
                "PSNR": f"{progress.psnr:.2f} dB",
                "Gaussians": f"{progress.gaussians:,}",
            }
            status.tell("train", done, total, progress.seconds_left, figures, progress.preview)

        try:
            trained = train_reel(capture, out, config, get_backend(backend), show, resume)
        except KeyboardInterrupt:
            bar.close()
            print(f"checkpoint: {RunPaths(out).checkpoint} (go on with --resume)")
            raise
    segments = len(trained.reel.segments)
    print(
        f"{out}: {trained.gaussians} Gaussians{f' in {segments} segments' if segments > 1 else ''}, "
        f"trained in {trained.seconds:.0f} s"
    )
