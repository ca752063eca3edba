# SPDX-License-Identifier: GPL-3.0-or-later
"""`holoreel bench videorf --scene CAPTURE --out DIR`: quality over bytes of VideoRF, and what its parts bring."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tqdm import tqdm

from ..bench.curves import text, write_results
from ..bench.split import Split, measure_splits
from ..bench.variants import FIGURE_7, VARIANTS
from ..bench.videorf import run_videorf
from ..capture import read_capture
from ..errors import HoloreelError
from ..machine import machine
from ..videorf.config import PRESETS, VideoConfig
from .bench import parse_size
from .train import preset_in


def prepare(arguments: list[str]) -> Callable[..., None]:
    """Return the command with the settings of the preset that the arguments name as defaults."""
    preset = preset_in(arguments) or "standard"
    if preset not in PRESETS:
        raise HoloreelError(f"--preset {preset}: no such preset; take one of {', '.join(PRESETS)}.")

    def run(
        what: Annotated[Literal["videorf"], tyro.conf.Positional],
        scene: Path,
        out: Path = Path("build/videorf"),
        rows: tuple[str, ...] = FIGURE_7,
        speed: bool = True,
        size: str = "320x180",
        preset: str = preset,
        config: Annotated[VideoConfig, tyro.conf.arg(name="")] = PRESETS[preset],
    ) -> None:
        """Train the method and variants of it, write each in rungs, and print what they take at equal quality.

        Measured on the views held out, from what a player decodes; everything it fetches counts. A call that was
        stopped goes on; finished rows are kept.

        Args:
            what: Quality over bytes of VideoRF.
            scene: Folder of a capture with masks and a camera held out.
            out: Folder for trainings, rows, videorf.json, curves.svg and index.html.
            rows: Which rows, beside the full method; two joined by a plus are both at once, as superblocks+av1. The
                rows of the paper's Fig. 7 without it; `all` is everything there is.
            speed: Also print where the time of a played frame goes.
            size: Pictures of that, as WIDTHxHEIGHT.
            preset: Settings to start from; the flags below change them.
            config: The preset's settings.
        """
        names = [variant.key for variant in VARIANTS] if rows == ("all",) else list(rows)
        pixels = parse_size(size)
        with tqdm(dynamic_ncols=True, bar_format="{desc} {n_fmt}/{total_fmt} |{bar}| {elapsed}") as bar:

            def show(doing: str, done: int, total: int) -> None:
                bar.set_description(doing, refresh=False)
                bar.n, bar.total = done, total
                bar.refresh()

            found = run_videorf(scene, out, config, names, show)
        capture = read_capture(scene)
        splits: list[Split] = []
        if speed:
            camera = capture.cameras[capture.camera_names("test")[0]].scaled(*pixels)
            splits = measure_splits(out / "rows" / "full" / "row.reel", camera)
        print(text(found, splits))
        print(write_results(out, capture, found, splits, machine()))

    return run
