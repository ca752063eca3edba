# SPDX-License-Identifier: GPL-3.0-or-later
"""A radiance field kept as a table: what the march, compiled or in torch, takes and gives.

The table (R, C) has a row [raw density, features] for every occupied vertex of a lattice, and a last row for all
others; a lookup says which row a vertex has. Both marches follow the same rules:

- Sample k of a ray lies (k + jitter) · step spacings behind the point where the ray enters the lattice.
- A sample is the trilinear mean of the raw rows at the corners of its cell; cells without an occupied corner are empty.
- Its density absorbs alpha = 1 - exp(-step · softplus(density)): activation comes after interpolation.
- A ray ends after the sample that leaves it a transmittance of `transmittance_min` or less.
"""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .occupancy import Lattice


class FieldLattice(NamedTuple):
    """`lookup` (X, Y, Z; int32) is the table's row of each vertex, -1 where it is empty; the table has `rows` rows."""

    lattice: Lattice
    lookup: NDArray[np.int32]
    rows: int


class Rays(NamedTuple):
    """Origins and unit directions (N, 3) in the world; `jitter` (N) in [0, 1), or None for the middle, 1/2."""

    origins: Tensor
    directions: Tensor
    jitter: Tensor | None = None


class MarchRules(NamedTuple):
    """`step` in spacings of the lattice; the transmittance that ends a ray."""

    step: float = 0.5
    transmittance_min: float = 1e-4


DEFAULT_RULES = MarchRules()


class Marched(NamedTuple):
    """Sums along N rays: `features` (N, C - 1), `transmittance` (N) left at the end, `depth` (N).

    `depth` is the sum of weight times distance from the origin, in the world's unit: divided by 1 - transmittance it is
    the mean distance. All three carry gradient to the table.
    """

    features: Tensor
    transmittance: Tensor
    depth: Tensor

    @property
    def alpha(self) -> Tensor:
        """What the rays lost on their way (N)."""
        return 1.0 - self.transmittance


def check_march(field: FieldLattice, table: Tensor, rays: Rays) -> None:
    """Raise ValueError where shapes do not go together."""
    if tuple(field.lookup.shape) != field.lattice.shape:
        raise ValueError(f"the lookup is {field.lookup.shape}, the lattice {field.lattice.shape}")
    if table.ndim != 2 or table.shape[0] != field.rows or not 2 <= table.shape[1] <= 16:
        raise ValueError(f"the table is {tuple(table.shape)}, not ({field.rows}, 2 to 16)")
    if rays.origins.ndim != 2 or rays.origins.shape[1] != 3 or rays.origins.shape != rays.directions.shape:
        raise ValueError("origins and directions must both be (N, 3)")
    if rays.jitter is not None and rays.jitter.shape != rays.origins.shape[:1]:
        raise ValueError("jitter must be (N,)")
    if torch.is_tensor(table) and not table.is_floating_point():
        raise ValueError("the table must hold floating-point numbers")
