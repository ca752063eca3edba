# SPDX-License-Identifier: GPL-3.0-or-later
"""Measure a reel against the pictures of a capture that it was not trained on."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from .capture import Capture
from .draw import Backend, Drawing, Player
from .errors import HoloreelError
from .metrics import Scores, mean_scores, score

VERSION = 1


def evaluate(
    path: str | Path,
    capture: Capture,
    split: str = "test",
    backend: Backend = "auto",
    on_progress: Callable[[int, int], None] | None = None,
    on_picture: Callable[[str, int, Drawing], None] | None = None,
) -> dict[str, Any]:
    """Draw every picture of a split (`train`, `test` or `all`) and score it; return what `metrics.json` holds.

    `on_progress(done, total)` is called after each picture, `on_picture(camera, frame, drawing)` with each drawing;
    `frame` is the number on the timeline. Raises `HoloreelError` where the split is empty, or the reel does not cover
    the capture's frames.
    """
    player = Player(path, backend)
    views = capture.views(None if split == "all" else split)
    if not views:
        raise HoloreelError(
            f"{capture.source} has no pictures in the split '{split}': name another with --split, "
            "or make the capture with a camera held out."
        )
    moments = player.frames_of(capture)
    rows: list[tuple[str, int, Scores]] = []
    for name, index in views:
        frame = capture.frame_start + index
        drawing = player.draw(capture.cameras[name], moments[index])
        truth = capture.image(name, index, background=player.first.background).astype(np.float32) / 255.0
        rows.append((name, frame, score(drawing.image, truth)))
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
        "mean": _mean(rows),
        "cameras": {name: _mean(row for row in rows if row[0] == name) for name in dict.fromkeys(r[0] for r in rows)},
        "frames": {str(frame): _mean(row for row in rows if row[1] == frame) for frame in sorted({r[1] for r in rows})},
        "views": [{"camera": name, "frame": frame, **_rounded(scores)} for name, frame, scores in rows],
    }


def _mean(rows: Iterable[tuple[str, int, Scores]]) -> dict[str, float]:
    return _rounded(mean_scores([scores for _, _, scores in rows]))


def _rounded(scores: Scores) -> dict[str, float]:
    return {name: round(value, 6) for name, value in scores._asdict().items()}
