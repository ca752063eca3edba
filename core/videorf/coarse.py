# SPDX-License-Identifier: GPL-3.0-or-later
"""The coarse field of one frame: a dense grid of raw density and color (Sec. 4.1)."""

import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from ..errors import HoloreelError
from ..files import atomic_path
from .occupancy import GAMMA, WEIGHT_SHARE, Lattice, Occupancy, occupied
from .quantize import EMPTY_DENSITY

UNKNOWN_COLOR = 0.5  # of vertices that were not trained

Grid = NDArray[np.float32]


@dataclass(frozen=True)
class Coarse:
    """What the coarse stage knows of a frame, per vertex of `lattice`.

    `density` (X, Y, Z) is raw: softplus(density) is what one spacing of this lattice absorbs. `color` (X, Y, Z, 3) lies
    in 0..1. `weights` (X, Y, Z) is what the training rays see of each vertex: the sum of their samples' weights.
    Vertices outside of the hull hold `EMPTY_DENSITY`, gray and 0.
    """

    lattice: Lattice
    density: Grid
    color: Grid
    weights: Grid

    def resampled(self, lattice: Lattice) -> "Coarse":
        """Return the same field on another lattice, with densities that absorb as much over the same length.

        Values are trilinear means, vertices beyond this lattice are empty.
        """
        raw = resample(self.density, self.lattice, lattice, EMPTY_DENSITY)
        density = rescaled(raw, lattice.spacing / self.lattice.spacing)
        color = resample(self.color, self.lattice, lattice, UNKNOWN_COLOR)
        return Coarse(lattice, density, color, resample(self.weights, self.lattice, lattice, 0.0))

    def write(self, path: str | Path) -> None:
        """Write the field as a compressed NPZ, atomically."""
        place = np.array([*self.lattice.lowest, self.lattice.spacing])
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, place=place, density=self.density, color=self.color, weights=self.weights)


def rescaled(density: NDArray, ratio: float) -> Grid:
    """Return raw densities of spacings `ratio` times as long: softplus of them is `ratio` times what it was."""
    absorbed = ratio * np.logaddexp(0.0, np.asarray(density, np.float64))
    return (absorbed + np.log(-np.expm1(-absorbed))).astype(np.float32)  # the inverse of softplus, for small and large


def resample(values: NDArray, source: Lattice, target: Lattice, fill: float) -> Grid:
    """Return the trilinear means of `values` (X, Y, Z, ...) of one lattice at the vertices of another, `fill` beyond.

    Both lattices have the world's axes, so that the mean is one of means along each axis.
    """
    result = np.asarray(values, np.float32)
    for axis in range(3):
        count = source.shape[axis]
        place = target.lowest[axis] + target.spacing * np.arange(target.shape[axis]) - source.lowest[axis]
        place /= source.spacing
        cell = np.clip(np.floor(place), 0, count - 2).astype(int)
        part = (place - cell).astype(np.float32).reshape(-1, *[1] * (result.ndim - 1 - axis))
        mean = np.take(result, cell, axis) * (1 - part) + np.take(result, cell + 1, axis) * part
        beyond = (place < -1e-6) | (place > count - 1 + 1e-6)
        np.moveaxis(mean, axis, 0)[beyond] = fill
        result = mean
    return np.ascontiguousarray(result)


def occupancy_of(
    coarse: Coarse, fine: Lattice, hull: Occupancy | None, gamma: float = GAMMA, share: float = WEIGHT_SHARE
) -> Occupancy:
    """Return the occupancy O of a frame on the fine lattice: what `occupied` says of its coarse field.

    `hull` is that of the fine lattice, or None. Raises `HoloreelError` where nothing is occupied.
    """
    field = coarse.resampled(fine)
    found = occupied(field.density, gamma, field.weights, share, hull)
    if not found.any():
        raise HoloreelError(
            f"The coarse field has no vertex of an opacity above {gamma:g}: lower gamma, or train the coarse stage "
            "for more iterations."
        )
    return found


def read_coarse(path: str | Path) -> Coarse:
    """Read what `Coarse.write` wrote. Raises `HoloreelError` where the file is missing, damaged or no such field."""
    path = Path(path)
    try:
        with zipfile.ZipFile(path) as archive:
            shapes = {name: _header(archive, name) for name in ("place", "density", "color", "weights")}
            grid = shapes["density"][0]
            wanted = {"place": (4,), "density": grid, "color": (*grid, 3), "weights": grid}
            for name, shape in wanted.items():
                if shapes[name] != (shape, np.float64 if name == "place" else np.float32):
                    raise ValueError(f"its {name} is {shapes[name][0]} of {shapes[name][1]}")
            place = _array(archive, "place").tolist()
            if len(grid) != 3:
                raise ValueError(f"its density is {grid}")
            lattice = Lattice((grid[0], grid[1], grid[2]), (place[0], place[1], place[2]), place[3])
            arrays = [_array(archive, name) for name in ("density", "color", "weights")]
    except (OSError, ValueError, KeyError, EOFError, NotImplementedError, zipfile.BadZipFile, zlib.error) as error:
        raise HoloreelError(f"{path} is no coarse field ({error}): delete it and train it again.") from error
    if not all(np.isfinite(array).all() for array in arrays):
        raise HoloreelError(f"{path} holds values that are not finite: delete it and train it again.")
    return Coarse(lattice, *arrays)


def _header(archive: zipfile.ZipFile, name: str) -> tuple[tuple[int, ...], np.dtype]:
    with archive.open(f"{name}.npy") as file:
        if npy.read_magic(file) != (1, 0):
            raise ValueError(f"its {name} is of another version")
        shape, _, kind = npy.read_array_header_1_0(file)
    return shape, kind


def _array(archive: zipfile.ZipFile, name: str) -> NDArray:
    with archive.open(f"{name}.npy") as file:
        return np.asarray(npy.read_array(file, allow_pickle=False))
