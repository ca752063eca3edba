# SPDX-License-Identifier: GPL-3.0-or-later
"""Colored points, the seeds of a training, as ordinary PLY files: x y z (float), red green blue (uchar)."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import HoloreelError
from ..plyfile import read_vertices, write_vertices

_AXES = ("x", "y", "z")
_COLORS = ("red", "green", "blue")


@dataclass(frozen=True)
class Points:
    """N points in world space and their display-referred colors."""

    xyz: NDArray[np.float32]  # (N, 3)
    rgb: NDArray[np.uint8]  # (N, 3)

    def __len__(self) -> int:
        return len(self.xyz)


def read_points(path: str | Path) -> Points:
    """Read a PLY of points, or COLMAP's points3D.bin or .txt; points without colors come out middle gray.

    Refuses positions that are not finite.
    """
    path = Path(path)
    if path.name in ("points3D.bin", "points3D.txt"):
        from .colmap_model import read_points3d  # which needs `Points`

        return read_points3d(path)
    table = read_vertices(path)
    names = table.dtype.names or ()
    if missing := [name for name in _AXES if name not in names]:
        raise HoloreelError(f"{path}: the property '{missing[0]}' is missing; points need x, y and z.")
    xyz = np.stack([table[name].astype(np.float32) for name in _AXES], axis=1)
    if not np.isfinite(xyz).all():
        raise HoloreelError(f"{path}: x, y or z of a point is NaN or infinite; take those points out.")
    if not all(name in names for name in _COLORS):
        return Points(xyz, np.full(xyz.shape, 128, np.uint8))
    if any(table.dtype[name] != np.uint8 for name in _COLORS):
        raise HoloreelError(f"{path}: red, green and blue must be of the type uchar; export it with 8-bit colors.")
    return Points(xyz, np.stack([table[name] for name in _COLORS], axis=1))


def write_points(path: str | Path, points: Points) -> None:
    """Write `points` as binary PLY, atomically."""
    table = np.empty(len(points), [(name, "f4") for name in _AXES] + [(name, "u1") for name in _COLORS])
    for axis, (name, color) in enumerate(zip(_AXES, _COLORS, strict=True)):
        table[name], table[color] = points.xyz[:, axis], points.rgb[:, axis]
    write_vertices(path, table)
