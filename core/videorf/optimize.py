# SPDX-License-Identifier: GPL-3.0-or-later
"""Training a table of rows: Adam with the losses of Eqs. 5-6 added on, and the noise that stands for rounding."""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .mapping import BLOCK, MappingTable
from .march import plain_tensor
from .native import CStep, call

BETAS = (0.9, 0.99)  # of Adam's moments; a frame has few hundred iterations
EPSILON = 1e-10  # Adam's; the gradient of L_spatial alone, on vertices no ray meets, is about 1e-8


INSIDE, SEAM, SPACE = 0, 1, 2  # kinds of pairs: in a block of the image, across the border of two, in the lattice


class Neighbors(NamedTuple):
    """What the N rows are to be like: `rows` (N, K; int32), -1 where there is none, and the `kinds` (N, K; uint8) of
    these pairs.

    Every pair is named from both sides.
    """

    rows: NDArray[np.int32]
    kinds: NDArray[np.uint8]


def image_neighbors(mapping: MappingTable) -> Neighbors:
    """Return the neighbors in the feature image: left, right, up and down."""
    ranks = np.full(mapping.size[0] * mapping.size[1], -1, np.int32)
    ranks[mapping.pixels] = np.arange(mapping.count, dtype=np.int32)
    found = _around(ranks.reshape(mapping.size))[mapping.pixels]
    row, column = np.divmod(mapping.pixels, mapping.size[1])
    seam = np.stack([edge for at in (row, column) for edge in (at % BLOCK == 0, at % BLOCK == BLOCK - 1)], -1)
    return Neighbors(np.ascontiguousarray(found), np.where(seam & (found >= 0), SEAM, INSIDE).astype(np.uint8))


def lattice_neighbors(lookup: NDArray[np.int32]) -> Neighbors:
    """Return the up to six neighbors in space of a lattice's vertices (`lookup` as `field.FieldLattice` has it)."""
    flat = lookup.ravel()
    occupied = np.flatnonzero(flat >= 0)
    order = occupied[np.argsort(flat[occupied])]
    found = np.ascontiguousarray(_around(lookup)[order])
    return Neighbors(found, np.full(found.shape, SPACE, np.uint8))


def joined(first: Neighbors, second: Neighbors) -> Neighbors:
    """Return the neighbors of both, of the same rows."""
    return Neighbors(np.hstack((first.rows, second.rows)), np.hstack((first.kinds, second.kinds)))


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

    `neighbors` says which rows are to be alike (a mapping table stands for those in its image, L_spatial's). `rows`
    (N + 1, C; float32) are the raw rows and the row of empty vertices, which never changes. `step` (C) is the
    quantizer's, `low` and `high` (C) hold the rows in range, `previous` (N, C) is the frame before, or None at the
    first one of a group.
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
        found = image_neighbors(neighbors) if isinstance(neighbors, MappingTable) else neighbors
        check_step(found, rows, previous)
        count, sides = found.rows.shape
        if sides > 16 or (found.rows < -1).any() or (found.rows >= count).any():
            raise ValueError("a row has at most 16 neighbors, and they are rows of the table")
        if rows.dtype != torch.float32 or not rows.is_contiguous() or rows.device.type != "cpu":
            raise ValueError("the rows must be float32, on the processor and without gaps: they change in place")
        self.rows, self.betas, self.epsilon, self.count = rows, betas, epsilon, 0
        self.mean, self.square = torch.zeros_like(rows[:-1]), torch.zeros_like(rows[:-1])
        self._previous = None if previous is None else plain_tensor(previous)
        self._near = np.where(found.rows >= 0, found.rows, np.arange(count, dtype=np.int32)[:, None])
        self._kinds = np.ascontiguousarray(found.kinds, np.uint8)
        self._columns = [plain_tensor(column).expand(rows.shape[1]).contiguous() for column in (step, low, high)]

    @torch.no_grad()
    def step(
        self,
        gradient: Tensor,
        rates: Tensor,
        spatial: float = 0.0,
        temporal: float = 0.0,
        seam: float = 1.0,
        smooth: float = 0.0,
    ) -> None:
        """Go one step with the gradient (N + 1, C) of the other losses and a learning rate per channel (C).

        `spatial`, `temporal` and `seam` weigh the losses of `losses.spatial_loss` and `temporal_loss`, `smooth` the
        same sum as L_spatial's over pairs in the lattice. The bits do not depend on the number of threads.
        """
        if gradient.shape != self.rows.shape:
            raise ValueError(f"the gradient is {tuple(gradient.shape)}, the rows {tuple(self.rows.shape)}")
        self.count += 1
        gradient, rates = plain_tensor(gradient), plain_tensor(rates).expand(self.rows.shape[1]).contiguous()
        step, low, high = self._columns
        tensors = (self.rows, self.mean, self.square, gradient, self._previous)
        request = CStep(
            len(self.rows) - 1,
            self.count,
            self.rows.shape[1],
            self._near.shape[1],
            *(None if tensor is None else tensor.data_ptr() for tensor in tensors),
            self._near.ctypes.data,
            self._kinds.ctypes.data,
            *(column.data_ptr() for column in (step, rates, low, high)),
            weights_of(spatial, seam, smooth),
            *(temporal, *self.betas, self.epsilon),
        )
        call("videorf_optimize", request)


def weights_of(spatial: float, seam: float, smooth: float) -> tuple[float, float, float, float]:
    """Return the weight of each kind of pair."""
    return spatial, spatial * seam, smooth, 0.0


def check_step(neighbors: Neighbors, rows: Tensor, previous: Tensor | None) -> None:
    """Raise ValueError where an optimizer's parts do not go together."""
    if rows.ndim != 2 or len(rows) != len(neighbors.rows) + 1:
        raise ValueError(f"the rows are {tuple(rows.shape)}, the neighbors those of {len(neighbors.rows)}")
    if neighbors.kinds.shape != neighbors.rows.shape or (neighbors.kinds > SPACE).any():
        raise ValueError("every neighbor has a kind")
    if previous is not None and previous.shape != rows[:-1].shape:
        raise ValueError(f"the rows before are {tuple(previous.shape)}, not {tuple(rows[:-1].shape)}")


def noisy_rows(rows: Tensor, step: Tensor, seed: int, out: Tensor | None = None) -> Tensor:
    """Return rows (N + 1, C) with uniform noise of one quantizer step (C): what training sees of the rounding to come.

    The last row, that of empty vertices, gets none. The noise hangs on `seed` alone, not on the number of threads.
    `out` (float32, without gaps) is filled if given.
    """
    rows = plain_tensor(rows.detach())
    out = torch.empty_like(rows) if out is None else out
    if out.shape != rows.shape or out.dtype != torch.float32 or not out.is_contiguous():
        raise ValueError(f"the noisy rows need {tuple(rows.shape)} numbers, float32 and without gaps")
    step = plain_tensor(step).expand(rows.shape[1]).contiguous()
    count, channels = len(rows) - 1, rows.shape[1]
    call("videorf_add_noise", rows.data_ptr(), count, channels, step.data_ptr(), noise_key(seed), out.data_ptr())
    out[-1] = rows[-1]
    return out


def noise_key(seed: int) -> int:
    """Return 32 bits that hang on all of a seed's: seeds next to each other give noise that is not alike."""
    return int(np.random.SeedSequence(seed).generate_state(1)[0])
