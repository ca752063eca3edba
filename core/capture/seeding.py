# SPDX-License-Identifier: GPL-3.0-or-later
"""Seed points from pictures with depth: pixels taken at random, put back where the camera saw them."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from .points import Points


def seeds_from_depth(
    camera: Camera, picture: NDArray[np.uint8], depth: NDArray[np.float32], count: int, rng: np.random.Generator
) -> Points:
    """Unproject up to `count` pixels of a picture (H, W, 3 or 4) with planar `depth` (H, W), no pixel twice.

    Pixels without a finite depth (infinity is the background) or with an alpha under one half are left out.
    """
    solid = np.isfinite(depth) & (depth > 0)
    if picture.shape[2] == 4:
        solid &= picture[..., 3] >= 128
    rows, columns = np.nonzero(solid)
    chosen = rng.permutation(len(rows))[:count]
    rows, columns = rows[chosen], columns[chosen]
    xyz = camera.unproject(np.stack([columns + 0.5, rows + 0.5], axis=1), depth[rows, columns])
    return Points(xyz.astype(np.float32), picture[rows, columns, :3].copy())


def merge_points(parts: Iterable[Points]) -> Points:
    """Put several sets of points into one."""
    every = [*parts, Points(np.empty((0, 3), np.float32), np.empty((0, 3), np.uint8))]
    return Points(np.concatenate([part.xyz for part in every]), np.concatenate([part.rgb for part in every]))
