# SPDX-License-Identifier: GPL-3.0-or-later
"""How fast a player plays its file: every frame in order, as one camera sees it."""

import time
from collections import Counter
from typing import Any

from ..camera import Camera
from ..draw import Player
from ..gaussians.player import GaussianPlayer
from ..videorf.player import FramePlayer, VideoPlayer
from .render import LISTED, NOT_CULLED, measure_player

PASSES = 3  # over all frames; decoders work ahead, so that only the mean over many frames means something


def measure_play(player: Player, camera: Camera) -> dict[str, Any]:
    """Return `width`, `height`, `frames`, `fps`, a `sentence` that says it, and what else is known of the kind."""
    if isinstance(player, GaussianPlayer):
        return _gaussians(player, camera)
    start = float(player.frame_start)
    player.draw(camera, start)  # loads libraries
    whole, parts = 0.0, Counter[str]()
    for _ in range(PASSES):
        if isinstance(player, VideoPlayer):
            player.source.forget()
        for index in range(player.frame_count):
            began = time.perf_counter()
            player.draw(camera, start + index)
            whole += time.perf_counter() - began
            if isinstance(player, FramePlayer):
                parts.update(player.seconds)
    drawn = PASSES * player.frame_count
    fps = drawn / whole
    split = {name: round(1000 * seconds / drawn, 2) for name, seconds in parts.items()}
    text = ", ".join(f"{name} {value:.1f} ms" for name, value in split.items())
    return {
        "width": camera.width,
        "height": camera.height,
        "frames": player.frame_count,
        "fps": fps,
        "milliseconds": split,
        "sentence": f"{fps:.1f} frames per second at {camera.width}x{camera.height}" + (f": {text}." if text else "."),
    }


def _gaussians(player: GaussianPlayer, camera: Camera) -> dict[str, Any]:
    result = measure_player(player, camera)
    played, plain = result.speeds[LISTED], result.speeds[NOT_CULLED]
    return result.as_dict() | {
        "fps": played.fps,
        "sentence": f"{played.fps:.1f} frames per second at {result.width}x{result.height}; by the authors' protocol, "
        f"which leaves out no Gaussian, {plain.authors_fps:.1f}.",
    }
