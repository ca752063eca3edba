# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures of one lens seen through another at the same place: a fisheye from a perspective picture, and back."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera


def same_lens(first: Camera, second: Camera) -> bool:
    """Whether two cameras show the same at every pixel, apart from where they stand."""
    keys = ("model", "width", "height", "fx", "fy", "cx", "cy", "distortion")
    return all(getattr(first, key) == getattr(second, key) for key in keys)


@dataclass(frozen=True)
class LensMap:
    """Where in the source's picture each pixel of the target's lies."""

    corner: NDArray[np.int32]  # (height, width, 2): column and row of the upper left of four source pixels
    weight: NDArray[np.float32]  # (height, width, 2): how far toward the right and the lower ones
    seen: NDArray[np.bool_]  # (height, width): whether the source saw it at all

    def apply(self, picture: NDArray[np.uint8], unseen: int = 0) -> NDArray[np.uint8]:
        """Resample (H, W, C) bilinearly; `unseen` in all channels where the source saw nothing."""
        column, row = self.corner[..., 0], self.corner[..., 1]
        right, down = self.weight[..., 0, None], self.weight[..., 1, None]
        upper = picture[row, column] * (1 - right) + picture[row, column + 1] * right
        lower = picture[row + 1, column] * (1 - right) + picture[row + 1, column + 1] * right
        mixed = upper * (1 - down) + lower * down
        return np.where(self.seen[..., None], np.rint(mixed), unseen).astype(np.uint8)


def lens_map(source: Camera, target: Camera) -> LensMap:
    """Prepare to show pictures of `source` as `target` would have taken them; where they stand does not matter."""
    here = np.eye(4)
    _, directions = replace(target, world_to_camera=here).rays()
    pixels, depth = replace(source, world_to_camera=here).project(directions)
    size = np.array([source.width, source.height])
    with np.errstate(invalid="ignore"):
        ahead = (depth > 0) | (source.model != "PINHOLE")  # other lenses answer NaN to what they cannot see
        seen = ahead & (pixels >= 0).all(axis=1) & (pixels <= size).all(axis=1)
    place = np.clip(np.where(seen[:, None], pixels - 0.5, 0.0), 0, size - 1)
    corner = np.minimum(place.astype(np.int32), np.maximum(size - 2, 0).astype(np.int32))
    shape = (target.height, target.width)
    return LensMap(
        corner.reshape(*shape, 2), (place - corner).astype(np.float32).reshape(*shape, 2), seen.reshape(shape)
    )
