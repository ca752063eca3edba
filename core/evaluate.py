# SPDX-License-Identifier: GPL-3.0-or-later
"""Measure a reel against the pictures of a capture that it was not trained on."""

import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .capture import Capture
from .capture.capture import Triple
from .capture.images import composite
from .capture.layouts import Protocol, protocol_of
from .draw import Drawing, Player, open_player
from .errors import HoloreelError
from .gaussians.decoder import Activation
from .lpips import Lpips
from .metrics import PSNR_MAX, bounding_box, score, subject_scores
from .render import Backend

VERSION = 1
PAPER_FRAMES = 300  # the paper gives sizes per 300 frames, and per frame
LPIPS_LEAST = 32  # pixels a side that the networks' layers leave something of
DECIBELS = ("psnr", "psnr_mask")  # measures that are logarithms of a mean squared error

OnProgress = Callable[[int, int], None]
OnPicture = Callable[[str, int, Drawing], None]


class Measured(NamedTuple):
    """What one picture scores: `camera`, `frame` on the timeline, and the measures by name."""

    camera: str
    frame: int
    scores: dict[str, float]


def evaluate(
    path: str | Path,
    capture: Capture,
    split: str = "test",
    backend: Backend = "auto",
    on_progress: OnProgress | None = None,
    on_picture: OnPicture | None = None,
    decoder_output: Activation | None = None,
    lpips: Sequence[Lpips] = (),
) -> dict[str, Any]:
    """Measure a file as `evaluate_player` does; `decoder_output` is as in `core.reel.load_gaussians`."""
    player = open_player(path, backend, decoder_output=decoder_output)
    return evaluate_player(player, capture, split, on_progress, on_picture, lpips)


def evaluate_player(
    player: Player,
    capture: Capture,
    split: str = "test",
    on_progress: OnProgress | None = None,
    on_picture: OnPicture | None = None,
    lpips: Sequence[Lpips] = (),
    protocol: Protocol | None = None,
) -> dict[str, Any]:
    """Draw every picture of a split (`train`, `test` or `all`) and score it; return what `metrics.json` holds.

    Drawings are measured as floats clipped to [0, 1], against the capture's 8-bit pictures / 255. Pixels that the
    player cannot reach do not count; for LPIPS and the measures of a subject, which have no mask, they are taken from
    the truth. Where every picture of the capture tells its subject apart, the measures of `metrics.subject_scores` are
    added, and what shows a subject alone is compared with it alone, over the reel's background.

    `on_progress(done, total)` is called after each picture, `on_picture(camera, frame, drawing)` with each drawing;
    `frame` is the number on the timeline. `lpips` is as `core.lpips.load_lpips` returns it. A `protocol` says which of
    the views to draw, and over what a subject alone is compared. Raises `HoloreelError` where the split is empty, or
    the reel does not cover the capture's frames.
    """
    views = capture.views(None if split == "all" else split)
    if protocol and protocol.views:
        wanted = set(protocol.views(capture))
        views = [view for view in views if view in wanted]
    another = protocol.background if protocol and player.subject_alone else None
    background = another or player.background
    if not views:
        raise HoloreelError(
            f"{capture.source} has no pictures in the split '{split}': name another with --split, "
            "or make the capture with a camera held out."
        )
    moments, masked = player.frames_of(capture), capture.masked
    rows: list[Measured] = []
    for name, index in views:
        frame = capture.frame_start + index
        drawing = player.draw(capture.cameras[name], moments[index], another)
        truth, mask = _truth(player, capture, name, index, masked, background)
        rows.append(Measured(name, frame, _scores(player, capture, name, drawing, truth, mask, lpips)))
        if on_picture:
            on_picture(name, frame, drawing)
        if on_progress:
            on_progress(len(rows), len(views))
    cameras = list(dict.fromkeys(row.camera for row in rows))
    return {
        "version": VERSION,
        "reel": player.path.name,
        "capture": capture.name,
        "split": split,
        "backend": player.backend_name,
        **player.facts(),
        "precision": "float drawings, 8-bit truth",
        **_protocol(player, capture, split, protocol, background),
        "size": sizes(player),
        **({"lpips_input": lpips[0].input_range} if lpips else {}),
        "mean": _mean(rows),
        "pooled": _pooled(rows),
        "cameras": {name: _mean(r for r in rows if r.camera == name) for name in cameras},
        "pooled_cameras": {name: _pooled(r for r in rows if r.camera == name) for name in cameras},
        "frames": {str(frame): _mean(r for r in rows if r.frame == frame) for frame in sorted({r.frame for r in rows})},
        "views": [{"camera": row.camera, "frame": row.frame, **_rounded(row.scores)} for row in rows],
    }


def _truth(
    player: Player, capture: Capture, name: str, index: int, masked: bool, background: Triple
) -> tuple[NDArray[np.float32], NDArray[np.bool_] | None]:
    """Return the picture (H, W, 3) that should have been drawn, and where its subject is (H, W) if that is known."""
    rgba = capture.rgba(name, index) if masked else None
    if rgba is not None and player.subject_alone:
        picture = composite(rgba, background)
    else:
        picture = capture.image(name, index, background=background)
    return picture.astype(np.float32) / 255.0, None if rgba is None else rgba[..., 3] > 0


def _protocol(
    player: Player, capture: Capture, split: str, asked: Protocol | None, background: Triple
) -> dict[str, Any]:
    """Return which dataset's protocol was kept, asked for or not, if any: its name, cameras, measures, background."""
    kept = asked
    if kept is None and split == "test" and player.subject_alone:
        kept = protocol_of(capture)
        if kept and (kept.views or kept.background not in (None, tuple(background))):
            kept = None
    if kept is None:
        return {}
    facts = {"name": kept.name, "measures": kept.measures, "background": kept.background}
    return {"protocol": facts | {"held_out": capture.camera_names("test")}}


def _scores(
    player: Player,
    capture: Capture,
    name: str,
    drawing: Drawing,
    truth: NDArray[np.float32],
    mask: NDArray[np.bool_] | None,
    lpips: Sequence[Lpips],
) -> dict[str, float]:
    reach = player.reach(capture.cameras[name])
    shown = drawing.image if reach is None else np.where(reach[..., None], drawing.image, truth)
    scores = score(drawing.image, truth, reach)._asdict()
    if mask is not None:
        scores |= subject_scores(shown, truth, mask if reach is None else mask & reach)
    scores |= {measure.name: measure(shown, truth) for measure in lpips}
    if lpips and mask is not None and mask.any():
        box = bounding_box(mask)
        if min(truth[box].shape[:2]) >= LPIPS_LEAST:
            scores |= {f"{measure.name}_crop": measure(shown[box], truth[box]) for measure in lpips}
    return scores


def sizes(player: Player) -> dict[str, float]:
    """Return the bytes that all a player needs takes on disk: in total, per frame, and per 300 frames.

    A bare file does not know its frames: those that are assumed count.
    """
    total = player.size()
    per_frame = total / player.frame_count
    return {
        "bytes": total,
        "bytes_per_frame": round(per_frame, 1),
        f"bytes_per_{PAPER_FRAMES}_frames": round(per_frame * PAPER_FRAMES),
    }


def _mean(rows: Iterable[Measured]) -> dict[str, float]:
    """Return the mean of each measure over the pictures that have it; decibels are averaged as they are."""
    every = [row.scores for row in rows]
    names = dict.fromkeys(name for scores in every for name in scores)
    return _rounded({name: float(np.mean([scores[name] for scores in every if name in scores])) for name in names})


def _pooled(rows: Iterable[Measured]) -> dict[str, float]:
    """Return the decibels of the mean squared error over all pictures, each with the same weight."""
    every = [row.scores for row in rows]
    errors = {name: [10.0 ** (-scores[name] / 10) for scores in every if name in scores] for name in DECIBELS}
    return _rounded(
        {name: min(-10.0 * math.log10(float(np.mean(part))), PSNR_MAX) for name, part in errors.items() if part}
    )


def _rounded(scores: dict[str, float]) -> dict[str, float]:
    return {name: round(value, 6) for name, value in scores.items()}
