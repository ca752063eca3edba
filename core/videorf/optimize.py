# SPDX-License-Identifier: GPL-3.0-or-later
"""Training a table of rows: Adam with the losses of Eqs. 5-6 added on, and the noise that stands for rounding."""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .mapping import BLOCK, MappingTable

BETAS = (0.9, 0.99)  # of Adam's moments; a frame has few hundred iterations
EPSILON = 1e-10  # Adam's; the gradient of L_spatial alone, on vertices no ray meets, is about 1e-8


class Neighbors(NamedTuple):
    """What L_spatial compares the N rows with: `rows` (N, K; int32), -1 where there is none.

    Every pair is named from both sides. `seam` (N, K; bool) says which pairs lie across the border of two blocks of the
    image.
    """

    rows: NDArray[np.int32]
    seam: NDArray[np.bool_]


def image_neighbors(mapping: MappingTable) -> Neighbors:
    """Return the neighbors in the feature image: left, right, up and down."""
    ranks = np.full(mapping.size[0] * mapping.size[1], -1, np.int32)
    ranks[mapping.pixels] = np.arange(mapping.count, dtype=np.int32)
    found = _around(ranks.reshape(mapping.size))[mapping.pixels]
    row, column = np.divmod(mapping.pixels, mapping.size[1])
    seam = np.stack([edge for at in (row, column) for edge in (at % BLOCK == 0, at % BLOCK == BLOCK - 1)], -1)
    return Neighbors(np.ascontiguousarray(found), seam & (found >= 0))


def lattice_neighbors(lookup: NDArray[np.int32]) -> Neighbors:
    """Return the up to six neighbors in space of a lattice's vertices (`lookup` as `field.FieldLattice` has it)."""
    flat = lookup.ravel()
    occupied = np.flatnonzero(flat >= 0)
    order = occupied[np.argsort(flat[occupied])]
    found = np.ascontiguousarray(_around(lookup)[order])
    return Neighbors(found, np.zeros(found.shape, bool))


def _around(ranks: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return what lies before and after each element of an array along each axis, (size, 2 · axes), -1 outside."""
    padded = np.pad(ranks, 1, constant_values=-1)
    sides = []
    for axis in range(ranks.ndim):
        for shift in (0, 2):
            window = tuple(
                slice(s, s + n)
                for s, n in zip([shift if a == axis else 1 for a in range(ranks.ndim)], ranks.shape, strict=True)
            )
            sides.append(padded[window].ravel())
    return np.stack(sides, -1)


class TableOptimizer:
    """Adam on a table's rows, in place, with L_spatial and L_temporal in the same step.

    `neighbors` says what L_spatial compares (a mapping table stands for those in its image). `rows` (N + 1, C; float32)
    are the raw rows and the row of empty vertices, which never changes. `step` (C) is the quantizer's, `low` and `high`
    (C) hold the rows in range, `previous` (N, C) is the frame before, or None at the first one of a group.
    """

    def __init__(
        self,
        neighbors: MappingTable | Neighbors,
        rows: Tensor,
        step: Tensor,
        low: Tensor,
        high: Tensor,
        previous: Tensor | None = None,
        betas: tuple[float, float] = BETAS,
        epsilon: float = EPSILON,
    ) -> None:
        self.neighbors = image_neighbors(neighbors) if isinstance(neighbors, MappingTable) else neighbors
        if rows.ndim != 2 or len(rows) != len(self.neighbors.rows) + 1:
            raise ValueError(f"the rows are {tuple(rows.shape)}, the neighbors those of {len(self.neighbors.rows)}")
        if previous is not None and previous.shape != rows[:-1].shape:
            raise ValueError(f"the rows before are {tuple(previous.shape)}, not {tuple(rows[:-1].shape)}")
        self.rows, self.step_size, self.low, self.high, self.previous = rows, step, low, high, previous
        self.betas, self.epsilon = betas, epsilon
        self.mean, self.square = torch.zeros_like(rows[:-1]), torch.zeros_like(rows[:-1])
        self.count = 0

    @torch.no_grad()
    def step(
        self, gradient: Tensor, rates: Tensor, spatial: float = 0.0, temporal: float = 0.0, seam: float = 1.0
    ) -> None:
        """Go one step with the gradient (N + 1, C) of the other losses and a learning rate per channel (C).

        `spatial`, `temporal` and `seam` weigh the losses of `losses.spatial_loss` and `temporal_loss`.
        """
        self.count += 1
        rows, total = self.rows[:-1], gradient[:-1].clone()
        scale = 1.0 / (self.step_size * max(len(rows), 1))
        if spatial:
            for side, across in zip(self.neighbors.rows.T, self.neighbors.seam.T, strict=True):
                near = torch.from_numpy(side.astype(np.int64)).to(rows.device)
                weight = torch.from_numpy(np.where(across, seam, 1.0) * (side >= 0)).to(rows)
                slope = ((rows - rows[near.clamp(min=0)]) / self.step_size).clamp(-1, 1)
                total += spatial * scale * slope * weight[:, None]
        if temporal and self.previous is not None:
            total += temporal * scale * ((rows - self.previous) / self.step_size).clamp(-1, 1)
        b1, b2 = self.betas
        self.mean.lerp_(total, 1 - b1)
        self.square.lerp_(total.square(), 1 - b2)
        root = (self.square / (1 - b2**self.count)).sqrt() + self.epsilon
        moved = rows - rates / (1 - b1**self.count) * self.mean / root
        self.rows[:-1] = torch.minimum(torch.maximum(moved, self.low), self.high)


def noisy_rows(rows: Tensor, step: Tensor, seed: int, out: Tensor | None = None) -> Tensor:
    """Return rows (N + 1, C) with uniform noise of one quantizer step (C): what training sees of the rounding to come.

    The last row, that of empty vertices, gets none. The noise hangs on `seed` alone. `out` is filled if given.
    """
    generator = torch.Generator().manual_seed(seed)
    noise = (torch.rand(rows.shape, generator=generator) - 0.5) * step
    noise[-1] = 0
    out = torch.empty_like(rows) if out is None else out
    return torch.add(rows, noise, out=out)
