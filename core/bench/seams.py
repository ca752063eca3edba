# SPDX-License-Identifier: GPL-3.0-or-later
"""What the hand-over from one segment of a reel to the next looks like, on views that were not trained on."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..capture import Capture
from ..errors import HoloreelError
from ..files import write_json
from ..gaussians.player import GaussianPlayer
from ..images import write_png
from ..metrics import psnr
from ..render import Backend

NEAR = 2  # frames on either side of a boundary that count as near it
STILL = 2.0 / 255.0  # a pixel of the truth that changes less than this between two frames stands still


@dataclass(frozen=True)
class Seam:
    """One boundary: `frame` is the first one of the later segment, on the timeline."""

    frame: int
    near_psnr: float  # mean over the frames within NEAR of the boundary, dB
    segment_psnr: float  # mean over both segments that meet here, dB
    pop: float  # mean change of still pixels at the boundary, in 1/255
    flicker: float  # the same, median over the frames inside the two segments


@dataclass(frozen=True)
class Seams:
    """The seams of a reel, and its middle column over time: (height, frames, 3), drawn and true."""

    seams: list[Seam]
    drawn: NDArray[np.float32]
    truth: NDArray[np.float32]


def measure_seams(path: Path, capture: Capture, camera: str | None = None, backend: Backend = "auto") -> Seams:
    """Draw all frames as one held-out camera sees them (`camera`, or the first of the test split), and compare.

    Raises `HoloreelError` where the reel is of one piece, or no camera is held out.
    """
    player = GaussianPlayer(path, backend)
    reel = player.first.reel
    if reel is None or len(reel.segments) < 2:
        raise HoloreelError(f"{path} has one segment, and so no seam: give a reel that was trained with --segment.")
    names = [camera] if camera else capture.camera_names("test")
    if not names or names[0] not in capture.cameras:
        raise HoloreelError(f"{capture.source} has no such camera held out: name one with --camera.")
    name, moments = names[0], player.frames_of(capture)
    scores, columns, truths, changes = [], [], [], []
    before: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None
    for index, frame in enumerate(moments):
        image = player.draw(capture.cameras[name], frame).image.clip(0.0, 1.0)
        truth = capture.image(name, index, background=player.first.background).astype(np.float32) / 255.0
        scores.append(psnr(image, truth))
        middle = truth.shape[1] // 2
        columns.append(image[:, middle])
        truths.append(truth[:, middle])
        if before:
            still = np.abs(truth - before[1]).max(axis=2) < STILL
            changes.append(float(np.abs(image - before[0])[still].mean()) * 255.0 if still.any() else 0.0)
        before = image, truth
    starts = [segment.frame_start - capture.frame_start for segment in reel.segments]
    seams = [
        _seam(capture.frame_start, scores, changes, first, start, end)
        for first, start, end in zip(starts, starts[1:], [*starts[2:], len(moments)], strict=False)
    ]
    return Seams(seams, np.stack(columns, axis=1), np.stack(truths, axis=1))


def _seam(frame_start: int, scores: list[float], changes: list[float], first: int, start: int, end: int) -> Seam:
    """`changes[j]` lies between the frames j and j + 1; the segments are frames first..start-1 and start..end-1."""
    inside = [changes[j] for j in range(first, end - 1) if j != start - 1]
    return Seam(
        frame_start + start,
        float(np.mean(scores[max(start - NEAR, first) : min(start + NEAR, end)])),
        float(np.mean(scores[first:end])),
        changes[start - 1],
        float(np.median(inside)) if inside else 0.0,
    )


def report_seams(seams: Seams) -> str:
    """Return the table that is printed."""
    lines = ["first frame | PSNR near, of both segments, difference | still pixels change at the seam, inside (1/255)"]
    for seam in seams.seams:
        psnrs = f"{seam.near_psnr:9.2f} {seam.segment_psnr:17.2f} {seam.near_psnr - seam.segment_psnr:11.2f}"
        lines.append(f"{seam.frame:11d} | {psnrs} | {seam.pop:31.3f} {seam.flicker:7.3f}")
    return "\n".join(lines)


def write_seams(seams: Seams, folder: Path) -> Path:
    """Write seams.json and slice.png: the height-time slice, drawn above true, eight pixels a frame; return the PNG."""
    write_json(folder / "seams.json", {"seams": [vars(seam) for seam in seams.seams]})
    pictures = np.concatenate([seams.drawn, np.ones_like(seams.drawn[:4]), seams.truth])
    write_png(folder / "slice.png", np.repeat(pictures, 8, axis=1))
    return folder / "slice.png"
