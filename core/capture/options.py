# SPDX-License-Identifier: GPL-3.0-or-later
"""How a capture is read. Each field is a flag of every command that takes a capture."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ..errors import HoloreelError

LayoutName = Literal["auto", "nerfstudio", "n3v", "technicolor", "immersive", "colmap", "rerf", "actorshq", "videos"]


@dataclass(frozen=True)
class CaptureOptions:
    """What to take of a capture, and how to understand it."""

    layout: LayoutName = "auto"
    """Which dataset's files lie there; auto looks."""
    frames: str = ""
    """First and last frame, both included, as 0:49, numbered as the files number them; empty takes all."""
    scale: Literal[1, 2, 4] | None = None
    """Divide the size of the pictures by this; the dataset's protocol without it (n3v and immersive 2, else 1)."""
    test_cameras: tuple[str, ...] = ()
    """Names of the cameras to hold out for testing, or none; empty holds out what the dataset's protocol does."""
    fps: float | None = None
    """Frames per second, where the files do not say so or are wrong."""
    frame_start: int | None = None
    """Number of the first frame on the timeline, instead of its number in the files."""
    calibration: Path | None = None
    """Videos: the calibration file, where it does not lie beside them as camera_array.toml or cameras_opencv.json."""
    sync_tolerance: float = 0.25
    """Videos: how far a picture may be from the moment of its frame, in frame intervals."""
    sfm: Path | None = None
    """Folder that `holoreel sfm` wrote, where it is not the folder sfm inside the capture."""

    def frame_range(self) -> range | None:
        """The frames asked for, or None for all of them."""
        if not self.frames:
            return None
        match = re.fullmatch(r"(\d{1,7})(?::(\d{1,7}))?", self.frames.strip())
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
        if first > last:
            raise HoloreelError(f"--frames {self.frames!r} is not understood: write the first and the last, as 0:49.")
        return range(first, last + 1)

    def choose_frames(self, source: Path, available: range) -> range:
        """The frames asked for, all of which must be `available`."""
        chosen = self.frame_range() or available
        if chosen.start < available.start or chosen.stop > available.stop:
            raise HoloreelError(
                f"{source} has the frames {available.start}:{available.stop - 1}, not all of --frames {self.frames}; "
                "ask for a part of them."
            )
        return chosen

    def common_frames(self, source: Path, counts: Mapping[str, int]) -> range:
        """The frames asked for, which all videos (name: number of frames) must have; without a wish, all must agree."""
        shortest = min(counts.values())
        if self.frame_range() is None and (wrong := odd_ones(counts)):
            usual = next(count for name, count in counts.items() if name not in wrong)
            raise HoloreelError(
                f"{source}: {listed({name: f'{counts[name]} frames' for name in wrong})}, "
                f"the others have {usual}; fetch the short ones again, or take what all have by --frames "
                f"0:{shortest - 1} if they start together."
            )
        return self.choose_frames(source, range(shortest))


def odd_ones(values: Mapping[str, object]) -> list[str]:
    """Return the names whose value is not the one that most have; none if all agree."""
    every = list(values.values())
    usual = max(every, key=every.count)
    return [name for name, value in values.items() if value != usual]


def listed(facts: Mapping[str, str], most: int = 3) -> str:
    """Put `name: fact` pairs into a phrase, the first few of them."""
    shown = [f"{name} has {fact}" for name, fact in list(facts.items())[:most]]
    more = len(facts) - len(shown)
    return ", ".join(shown) + (f" and {more} more differ too" if more else "")
