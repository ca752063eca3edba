# SPDX-License-Identifier: GPL-3.0-or-later
"""Where the time of a played VideoRF frame goes: decode, unpack, render, and the rest (the paper's Table 2)."""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np

from ..camera import Camera
from ..draw import Quality
from ..render import Backend
from ..videorf.player import VideoPlayer

PASSES = 3
PARTS = {"decode": "decode", "unpack": "unpack", "draw": "render"}  # the player's names, and the table's


@dataclass(frozen=True)
class Split:
    """Milliseconds per frame, means over all frames of the quickest of several passes, each by a player that is new.

    `rest` is what remains of the whole: above all a group's lattice, made ready once per group.
    """

    width: int
    height: int
    rung: str
    quality: Quality
    decode: float
    unpack: float
    render: float
    rest: float

    @property
    def fps(self) -> float:
        """Frames per second, one after the other."""
        return 1000 / (self.decode + self.unpack + self.render + self.rest)

    @property
    def overlapped_fps(self) -> float:
        """Frames per second where one thread decodes the next frame: the rule that the paper's Table 2 obeys."""
        return 1000 / (max(self.decode, self.render) + self.unpack + self.rest)

    def as_dict(self) -> dict[str, Any]:
        """Return the figures for JSON."""
        return asdict(self) | {"fps": self.fps, "overlapped_fps": self.overlapped_fps}


def measure_splits(
    reel: Path, camera: Camera, rung: int | str | None = None, backend: Backend = "auto", passes: int = PASSES
) -> list[Split]:
    """Play all frames in order as a camera sees them, in every quality."""
    return [measure_split(reel, camera, rung, quality, backend, passes) for quality in get_args(Quality)]


def measure_split(
    reel: Path,
    camera: Camera,
    rung: int | str | None = None,
    quality: Quality = "full",
    backend: Backend = "auto",
    passes: int = PASSES,
) -> Split:
    """Play all frames in order as a camera sees them."""
    first = VideoPlayer(reel, rung, quality, backend)
    first.draw(camera, 0.0)  # loads libraries
    best = min((_play(VideoPlayer(reel, rung, quality, backend), camera) for _ in range(passes)), key=sum)
    return Split(camera.width, camera.height, first.facts()["rung"], quality, *best)


def _play(player: VideoPlayer, camera: Camera) -> list[float]:
    rows = []
    for index in range(player.frame_count):
        start = time.perf_counter()
        player.draw(camera, float(player.frame_start + index))
        whole = time.perf_counter() - start
        parts = [player.seconds.get(name, 0.0) for name in PARTS]
        rows.append([*parts, whole - sum(parts)])
    return (1000 * np.mean(rows, axis=0)).tolist()


def table(splits: Sequence[Split]) -> list[tuple[str, ...]]:
    """Return the table of several qualities."""
    columns = ("decode", "unpack", "render", "rest", "fps", "overlapped_fps")
    heading = ("quality", "decode ms", "unpack ms", "render ms", "rest ms", "FPS", "FPS, decoding beside")
    return [heading, *((split.quality, *(f"{getattr(split, name):.1f}" for name in columns)) for split in splits)]
