# SPDX-License-Identifier: GPL-3.0-or-later
"""The channels of a feature image as tiles of one gray picture, the luma of the video. Needs numpy only."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import HoloreelError

MACROBLOCK = 16  # pixels: tiles end where the codec's blocks end


@dataclass(frozen=True)
class Profile:
    """Which videos a kind of player decodes: so many tiles, none larger than `edge` pixels."""

    columns: int
    rows: int
    edge: int


# `universal` fits hardware decoders of H.264 level 4.0 at 30 frames a second, `quality` those of level 5.0.
PROFILES = {"universal": Profile(4, 2, 512), "quality": Profile(4, 4, 512)}


@dataclass(frozen=True)
class Tiling:
    """Channel c of an image (height, width, channels) lies in row c // columns and column c % columns of tiles."""

    channels: int
    height: int
    width: int
    columns: int
    rows: int

    def __post_init__(self) -> None:
        if not 2 <= self.channels <= self.columns * self.rows <= 16 or min(self.columns, self.rows) < 1:
            raise HoloreelError(
                f"{self.channels} channels do not fit into {self.columns} x {self.rows} tiles: take the profile "
                f"'quality'."
            )
        if not all(0 < edge <= 2048 and edge % MACROBLOCK == 0 for edge in (self.height, self.width)):
            raise HoloreelError(
                f"A tile of {self.width} x {self.height} pixels cannot be coded: take multiples of {MACROBLOCK} up to "
                f"2048."
            )

    @property
    def picture(self) -> tuple[int, int]:
        """The (height, width) of the luma."""
        return self.rows * self.height, self.columns * self.width

    def pack(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the luma of a feature image (height, width, channels); tiles to spare are 0."""
        if image.shape != (self.height, self.width, self.channels):
            raise ValueError(f"the image is {image.shape}, not {(self.height, self.width, self.channels)}")
        spare = self.columns * self.rows - self.channels
        tiles = np.pad(image, ((0, 0), (0, 0), (0, spare))).reshape(self.height, self.width, self.rows, self.columns)
        return np.ascontiguousarray(tiles.transpose(2, 0, 3, 1)).reshape(self.picture)

    def unpack(self, luma: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the feature image (height, width, channels) of a luma."""
        if luma.shape != self.picture:
            raise ValueError(f"the luma is {luma.shape}, not {self.picture}")
        tiles = luma.reshape(self.rows, self.height, self.columns, self.width).transpose(1, 3, 0, 2)
        return np.ascontiguousarray(tiles.reshape(self.height, self.width, -1)[..., : self.channels])


def tiling_of(profile: str, channels: int, height: int, width: int) -> Tiling:
    """Return the tiling of a profile. Raises `HoloreelError` where the profile is unknown or has no room."""
    if profile not in PROFILES:
        raise HoloreelError(f"The profile '{profile}' is unknown: take one of {', '.join(PROFILES)}.")
    limits = PROFILES[profile]
    if max(height, width) > limits.edge:
        raise HoloreelError(
            f"The profile '{profile}' takes images up to {limits.edge} x {limits.edge} pixels, not {width} x {height}: "
            f"take a "
            "smaller image."
        )
    return Tiling(channels, height, width, limits.columns, limits.rows)
