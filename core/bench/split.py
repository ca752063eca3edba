# SPDX-License-Identifier: GPL-3.0-or-later
"""Where the time of a played VideoRF frame goes: decode, unpack, render, and the rest (the paper's Table 2)."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, get_args

from ..camera import Camera
from ..draw import Quality
from ..render import Backend
from ..videorf.player import VideoPlayer
from .ablation import as_text
from .play import measure_play

PARTS = ("decode", "unpack", "draw")  # as the player calls what the table does: decode, unpack, render


@dataclass(frozen=True)
class Split:
    """Milliseconds per frame, means over all frames of several passes.

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


def measure_splits(reel: Path, camera: Camera, rung: int | str | None = None, backend: Backend = "auto") -> list[Split]:
    """Play all frames in order as a camera sees them, in every quality."""
    return [measure_split(reel, camera, rung, quality, backend) for quality in get_args(Quality)]


def measure_split(
    reel: Path, camera: Camera, rung: int | str | None = None, quality: Quality = "full", backend: Backend = "auto"
) -> Split:
    """Play all frames in order as a camera sees them."""
    player = VideoPlayer(reel, rung, quality, backend)
    played = measure_play(player, camera)
    decode, unpack, render = (played["milliseconds"].get(name, 0.0) for name in PARTS)
    rest = max(1000 / played["fps"] - decode - unpack - render, 0.0)
    return Split(camera.width, camera.height, player.facts()["rung"], quality, decode, unpack, render, rest)


def table(splits: Sequence[Split]) -> list[tuple[str, ...]]:
    """Return the table of several qualities."""
    columns = ("decode", "unpack", "render", "rest", "fps", "overlapped_fps")
    heading = ("quality", "decode ms", "unpack ms", "render ms", "rest ms", "FPS", "FPS, decoding beside")
    return [heading, *((split.quality, *(f"{getattr(split, name):.1f}" for name in columns)) for split in splits)]


def title(splits: Sequence[Split]) -> str:
    """Return what stands over the table."""
    return f"Playing rung {splits[0].rung} at {splits[0].width}x{splits[0].height}"


def describe(splits: Sequence[Split]) -> str:
    """Return the table as it is printed."""
    return f"{title(splits)}\n{as_text(table(splits))}"
