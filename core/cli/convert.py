# SPDX-License-Identifier: GPL-3.0-or-later
"""`holoreel convert CAPTURE --out DIR --to LAYOUT`: write a capture in another dataset's layout."""

import sys
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tqdm import tqdm

from ..capture import CaptureOptions, read_capture
from ..capture.convert import convert
from ..capture.export import Export
from ..errors import HoloreelError


def run(
    capture: tyro.conf.Positional[Path],
    /,
    out: Path,
    to: Literal["nerfstudio", "colmap", "n3v", "technicolor", "immersive", "rerf", "actorshq", "videos"],
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    rectify: float | None = None,
    options: Annotated[CaptureOptions, tyro.conf.arg(name="")] = CaptureOptions(),  # noqa: B008
) -> None:
    """Write a capture in another layout: videos become PNG pictures, or pictures videos, as the layout has them.

    A call that was stopped goes on when it is repeated.

    Args:
        capture: folder of a capture in any layout, or a transforms.json.
        out: the folder to make.
        to: the layout to write.
        background: color (0 to 1) behind transparent pictures, where the layout has no transparency.
        rectify: make pinholes of lenses with distortion, with this share of the focal length.
        options: how the capture is read.
    """
    if rectify is not None and not 0.05 <= rectify <= 2:
        raise HoloreelError(f"--rectify {rectify:g} must be 0.05 to 2, as a share of the focal length.")
    recording = read_capture(capture, options)
    for note in recording.notes:
        print(note)
    settings = {key: str(value) if isinstance(value, Path) else value for key, value in vars(options).items()}
    job = {
        "capture": str(capture.absolute()),
        "options": settings | {"test_cameras": list(options.test_cameras)},
        "background": list(background),
        "rectify": rectify,
    }
    with tqdm(unit="picture", dynamic_ncols=True, desc="convert", disable=not sys.stderr.isatty()) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        notes = convert(recording, to, out, job, Export(background, show, rectify))
    for note in notes:
        print(f"note: {note}")
    print(f"{out}: {len(recording.cameras)} cameras x {recording.frame_count} frames as {to}")
