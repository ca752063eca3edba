# SPDX-License-Identifier: GPL-3.0-or-later
"""The settings of structure from motion."""

import math
from dataclasses import asdict, dataclass
from typing import Any, Literal

from ..errors import HoloreelError

Matcher = Literal["overlap", "exhaustive", "sequential"]
Quality = Literal["low", "medium", "high"]
Lens = Literal["SIMPLE_RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE", "PINHOLE"]


@dataclass(frozen=True)
class Features:
    """How hard to look for features: see COLMAP's SIFT options."""

    max_size: int  # pixels along the longer side; larger pictures are looked at smaller
    max_features: int  # per picture
    affine: bool  # find shapes as seen from aside, and describe features over several sizes
    guided: bool  # match once more where the geometry says a partner must be


QUALITIES: dict[str, Features] = {
    "low": Features(1000, 4096, affine=False, guided=False),
    "medium": Features(2000, 8192, affine=False, guided=False),
    "high": Features(3200, 16384, affine=True, guided=True),
}
MANY_CAMERAS = 8  # from here on a point must be seen by three of them


@dataclass(frozen=True)
class SfmSettings:
    """What to triangulate, and how. Raises `HoloreelError` for values that are not possible."""

    every: int = 1
    """Do every N-th frame (0, N, 2N, ...)."""
    quality: Quality = "medium"
    """How many features to look for, and how hard: low, medium or high."""
    matcher: Matcher = "overlap"
    """Which cameras to compare: those whose views overlap, all, or neighbors in their order (sequential)."""
    max_size: int | None = None
    """Look at pictures no larger than this along the longer side, instead of what the quality says."""
    held_out: bool = False
    """Use the pictures of cameras held out for testing too: what they saw is then no longer unseen."""
    without: tuple[str, ...] = ()
    """Names of cameras to leave out."""
    min_track: int | None = None
    """How many cameras must see a point: 3, or 2 with fewer than 8 cameras."""
    max_error: float = 2.0
    """Largest mean reprojection error of a point, in pixels."""
    min_angle: float = 1.5
    """Smallest angle between the rays to a point, in degrees."""

    def __post_init__(self) -> None:
        if self.every < 1:
            raise HoloreelError(f"--every must be 1 or more, not {self.every}.")
        if self.max_size is not None and self.max_size < 100:
            raise HoloreelError(f"--max-size must be 100 pixels or more, not {self.max_size}.")
        if self.min_track is not None and self.min_track < 2:
            raise HoloreelError(f"--min-track must be 2 or more, not {self.min_track}: one ray fixes no point.")
        if not (math.isfinite(self.max_error) and self.max_error > 0):
            raise HoloreelError(f"--max-error must be a positive number of pixels, not {self.max_error:g}.")
        if not 0 < self.min_angle < 90:
            raise HoloreelError(f"--min-angle must lie between 0 and 90 degrees, not {self.min_angle:g}.")

    def track(self, cameras: int) -> int:
        """How many of `cameras` must see a point."""
        return self.min_track or (3 if cameras >= MANY_CAMERAS else 2)

    def colmap_options(self, threads: int) -> dict[str, Any]:
        """What `colmap` calls options."""
        features = QUALITIES[self.quality]
        options = asdict(features) | {"threads": threads, "min_angle_degrees": self.min_angle}
        options["max_error_px"] = self.max_error
        if self.max_size is not None:
            options["max_size"] = self.max_size
        return options


@dataclass(frozen=True)
class PoseSettings:
    """How to find the cameras of a capture that has none. Raises `HoloreelError` for values that are not possible."""

    reference: tuple[int, ...] = ()
    """Indices of the frames to find poses from; empty takes three: the first, the middle one and the last."""
    lens: Lens = "SIMPLE_RADIAL"
    """COLMAP's model of the lenses to find (SIMPLE_RADIAL is kept as OPENCV)."""
    shared_lens: bool = False
    """All cameras have the same lens."""
    refind: bool = False
    """Find the poses again, although an earlier call has found them."""
