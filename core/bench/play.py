# SPDX-License-Identifier: GPL-3.0-or-later
"""How fast a player plays its file: every frame in order, as one camera sees it."""

import statistics
import time
from typing import Any

from ..camera import Camera
from ..draw import Player
from ..gaussians.player import GaussianPlayer
from ..videorf.player import FramePlayer, VideoPlayer
from .render import LISTED, NOT_CULLED, measure_player


def measure_play(player: Player, camera: Camera) -> dict[str, Any]:
    """Return `width`, `height`, `frames`, `fps`, a `sentence` that says it, and what else is known of the kind."""
    if isinstance(player, GaussianPlayer):
        return _gaussians(player, camera)
    if isinstance(player, VideoPlayer):
        player.source.forget()
    seconds: list[float] = []
    parts: dict[str, list[float]] = {}
    for index in range(player.frame_count):
        start = time.perf_counter()
        player.draw(camera, float(player.frame_start + index))
        seconds.append(time.perf_counter() - start)
        if isinstance(player, FramePlayer):
            for name, value in player.seconds.items():
                parts.setdefault(name, []).append(value)
    fps = 1.0 / statistics.median(seconds)
    split = {name: round(1000 * statistics.median(values), 2) for name, values in parts.items()}
    text = ", ".join(f"{name} {value:.1f} ms" for name, value in split.items())
    return {
        "width": camera.width,
        "height": camera.height,
        "frames": player.frame_count,
        "fps": fps,
        "milliseconds": split,
        "sentence": f"{fps:.1f} frames per second at {camera.width}x{camera.height}"
        + (f": {text} of a frame in the middle." if text else "."),
    }


def _gaussians(player: GaussianPlayer, camera: Camera) -> dict[str, Any]:
    result = measure_player(player, camera)
    played, plain = result.speeds[LISTED], result.speeds[NOT_CULLED]
    return result.as_dict() | {
        "fps": played.fps,
        "sentence": f"{played.fps:.1f} frames per second at {result.width}x{result.height}; by the authors' protocol, "
        f"which leaves out no Gaussian, {plain.authors_fps:.1f}.",
    }
