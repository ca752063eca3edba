# SPDX-License-Identifier: GPL-3.0-or-later
"""Measure a reel against the pictures of a capture that it was not trained on."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .camera import Camera
from .capture import Capture
from .draw import Backend, Drawing, Player
from .errors import HoloreelError
from .gaussians.decoder import Activation, decoder_path
from .lpips import Lpips
from .metrics import score
from .reel import Loaded

VERSION = 1
PAPER_FRAMES = 300  # the paper gives sizes per 300 frames, and per frame


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
    on_progress: Callable[[int, int], None] | None = None,
    on_picture: Callable[[str, int, Drawing], None] | None = None,
    decoder_output: Activation | None = None,
    lpips: Sequence[Lpips] = (),
) -> dict[str, Any]:
    """Draw every picture of a split (`train`, `test` or `all`) and score it; return what `metrics.json` holds.

    Drawings are measured as floats clipped to [0, 1], against the capture's 8-bit pictures / 255. Pixels of a distorted
    lens that its warp cannot reach do not count; for LPIPS, which has no mask, they are taken from the truth.
    `on_progress(done, total)` is called after each picture, `on_picture(camera, frame, drawing)` with each drawing;
    `frame` is the number on the timeline. `decoder_output` is as in `core.reel.load_gaussians`, `lpips` as
    `core.lpips.load_lpips` returns it. Raises `HoloreelError` where the split is empty, or the reel does not cover the
    capture's frames.
    """
    player = Player(path, backend, decoder_output)
    views = capture.views(None if split == "all" else split)
    if not views:
        raise HoloreelError(
            f"{capture.source} has no pictures in the split '{split}': name another with --split, "
            "or make the capture with a camera held out."
        )
    moments = player.frames_of(capture)
    rows: list[Measured] = []
    for name, index in views:
        frame = capture.frame_start + index
        drawing = player.draw(capture.cameras[name], moments[index])
        truth = capture.image(name, index, background=player.first.background).astype(np.float32) / 255.0
        mask = valid_pixels(capture.cameras[name])
        scores = score(drawing.image, truth, mask)._asdict()
        shown = drawing.image if mask is None else np.where(mask[..., None], drawing.image, truth)
        scores |= {measure.name: measure(shown, truth) for measure in lpips}
        rows.append(Measured(name, frame, scores))
        if on_picture:
            on_picture(name, frame, drawing)
        if on_progress:
            on_progress(len(rows), len(views))
    return {
        "version": VERSION,
        "reel": player.path.name,
        "capture": capture.source.resolve().parent.name,
        "split": split,
        "backend": player.backend.__name__.rpartition(".")[2],
        "gaussians": len(player.first.gaussians),
        "precision": "float drawings, 8-bit truth",
        "size": model_size(player.first),
        **({"lpips_input": lpips[0].input_range} if lpips else {}),
        "mean": _mean(rows),
        "cameras": {name: _mean(r for r in rows if r.camera == name) for name in dict.fromkeys(r.camera for r in rows)},
        "frames": {str(frame): _mean(r for r in rows if r.frame == frame) for frame in sorted({r.frame for r in rows})},
        "views": [{"camera": row.camera, "frame": row.frame, **_rounded(row.scores)} for row in rows],
    }


def valid_pixels(camera: Camera) -> NDArray[np.bool_] | None:
    """Return the pixels (H, W) that a rendering of this camera can reach; None where it reaches all."""
    if camera.model == "PINHOLE":
        return None
    from .render.warp import lens_warp

    return lens_warp(camera).valid.numpy()


def model_size(loaded: Loaded) -> dict[str, float]:
    """Return the bytes that all Gaussians and decoders take on disk: in total, per frame, and per 300 frames.

    A bare file's decoder counts too. A bare file does not know its frames: those that are assumed count.
    """
    if loaded.reel:
        reel = loaded.reel
        files = [reel.payload(index) for index in range(len(reel.segments))]
        files += [file for index in range(len(reel.segments)) if (file := reel.decoder(index))]
        frames = reel.frame_count
    else:
        files, frames = [loaded.path], loaded.frame_count
        if loaded.decoder:
            ours = decoder_path(loaded.path)
            files.append(ours if ours.is_file() else loaded.path.with_suffix(".pt"))
    total = sum(file.stat().st_size for file in set(files))
    per_frame = total / frames
    return {
        "bytes": total,
        "bytes_per_frame": round(per_frame, 1),
        f"bytes_per_{PAPER_FRAMES}_frames": round(per_frame * PAPER_FRAMES),
    }


def _mean(rows: Iterable[Measured]) -> dict[str, float]:
    every = [row.scores for row in rows]
    return _rounded({name: float(np.mean([scores[name] for scores in every])) for name in every[0]})


def _rounded(scores: dict[str, float]) -> dict[str, float]:
    return {name: round(value, 6) for name, value in scores.items()}
