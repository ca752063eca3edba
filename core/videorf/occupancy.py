# SPDX-License-Identifier: GPL-3.0-or-later
"""The lattice that holds a subject, and which of its vertices are occupied (Sec. 4.1). Needs numpy only.

An occupancy is a bool array (X, Y, Z), one value per *vertex*. A *cell* lies between eight vertices and is occupied
where any of them is: a sample in another cell sees nothing.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import HoloreelError

MAX_EDGE = 256  # the mapping image stores a vertex as three bytes
GAMMA = 0.05  # opacity over one spacing above which a vertex is occupied
WEIGHT_SHARE = 0.97  # of what all rays see, held by the vertices that are kept

Occupancy = NDArray[np.bool_]


@dataclass(frozen=True)
class Lattice:
    """Vertices `lowest + spacing * (i, j, k)` in the world, `shape` of them along each axis; cells are cubes."""

    shape: tuple[int, int, int]
    lowest: tuple[float, float, float]
    spacing: float

    def __post_init__(self) -> None:
        if len(self.shape) != 3 or not all(2 <= edge <= MAX_EDGE for edge in self.shape):
            raise HoloreelError(
                f"A lattice of {' x '.join(map(str, self.shape))} vertices cannot be stored: "
                f"take 2 to {MAX_EDGE} along each axis."
            )
        if len(self.lowest) != 3 or not all(map(math.isfinite, self.lowest)) or not 0 < self.spacing < math.inf:
            raise HoloreelError("The corner or the spacing of the lattice is not finite: check the subject's bounds.")

    @classmethod
    def around(cls, low: NDArray, high: NDArray, edge: int, margin: int = 2) -> "Lattice":
        """Return the lattice of `edge` vertices along the longest side of a box, `margin` vertices of it beyond each
        face.

        Raises `HoloreelError` where the box is empty or not finite, or `edge` leaves no vertex inside.
        """
        low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
        longest = float((high - low).max(initial=0.0))
        if not (np.isfinite(low).all() and np.isfinite(high).all() and (high > low).all()):
            raise HoloreelError(f"The bounds {low.tolist()} to {high.tolist()} hold no volume: give the subject's box.")
        if edge - 2 * margin < 2:
            raise HoloreelError(f"A lattice of {edge} vertices leaves no room for the subject: take more.")
        spacing = longest / (edge - 1 - 2 * margin)
        shape = np.minimum(np.ceil((high - low) / spacing - 1e-6).astype(int) + 1 + 2 * margin, edge)
        lowest = (low + high) / 2 - (shape - 1) / 2 * spacing
        return cls(tuple(shape.tolist()), tuple(lowest.tolist()), spacing)

    @property
    def highest(self) -> tuple[float, float, float]:
        """The position of the last vertex."""
        x, y, z = (low + (edge - 1) * self.spacing for low, edge in zip(self.lowest, self.shape, strict=True))
        return x, y, z

    def positions(self, vertices: NDArray) -> NDArray[np.float64]:
        """Return where vertices (..., 3) of whole or broken numbers lie in the world."""
        return np.asarray(self.lowest) + self.spacing * np.asarray(vertices, np.float64)


def opacity(density: NDArray, step: float = 1.0) -> NDArray:
    """Return what raw densities absorb over `step` spacings: 1 - exp(-step softplus(density))."""
    return -np.expm1(-step * np.logaddexp(0.0, density))


def dilate(occupancy: Occupancy) -> Occupancy:
    """Add the 26 neighbors of every occupied vertex: the ring around a surface must be trainable, too."""
    grown = occupancy
    for axis in range(3):
        before = np.moveaxis(grown, axis, 0)
        after = before.copy()
        after[1:] |= before[:-1]
        after[:-1] |= before[1:]
        grown = np.moveaxis(after, 0, axis)
    return np.ascontiguousarray(grown)


def occupied(
    density: NDArray,
    gamma: float = GAMMA,
    weights: NDArray | None = None,
    share: float = WEIGHT_SHARE,
    hull: Occupancy | None = None,
) -> Occupancy:
    """Return the occupancy O of one frame from its raw densities (X, Y, Z).

    A vertex counts where its opacity over one spacing exceeds `gamma`, and then its neighbors do. With `weights` (X, Y,
    Z), what all rays see of each vertex, only the heaviest vertices that together hold `share` of it count: the
    threshold alone keeps an interior that nobody sees. With `hull`, nothing outside of it counts.
    """
    if not 0 < gamma < 1 or not 0 < share <= 1:
        raise HoloreelError(f"gamma {gamma:g} or share {share:g} is out of range: both lie in 0 to 1.")
    seen = opacity(np.asarray(density, np.float64)) > gamma
    if weights is not None:
        seen &= heaviest(weights, share)
    grown = dilate(seen)
    return grown if hull is None else grown & hull


def heaviest(weights: NDArray, share: float) -> Occupancy:
    """Return the fewest vertices that hold `share` of the sum of `weights`; of equals, those that come first."""
    flat = np.asarray(weights, np.float64).ravel()
    order = np.argsort(-flat, kind="stable")
    before = np.concatenate(([0.0], np.cumsum(flat[order])))
    kept = np.zeros(flat.size, bool)
    kept[order] = (before[:-1] < share * before[-1]) & (flat[order] > 0)
    return kept.reshape(weights.shape)


def cells(occupancy: Occupancy) -> Occupancy:
    """Return which cells (X-1, Y-1, Z-1) have an occupied corner."""
    found = occupancy
    for axis in range(3):
        moved = np.moveaxis(found, axis, 0)
        found = np.moveaxis(moved[1:] | moved[:-1], 0, axis)
    return np.ascontiguousarray(found)


def coarser(found: Occupancy, factor: int) -> Occupancy:
    """Return which blocks of `factor`³ cells hold an occupied one; the last block of an axis may be cut."""
    padded = np.pad(found, [(0, -edge % factor) for edge in found.shape])
    x, y, z = (edge // factor for edge in padded.shape)
    blocks = padded.reshape(x, factor, y, factor, z, factor).any((1, 3, 5))
    return np.asarray(blocks)
