# SPDX-License-Identifier: GPL-3.0-or-later
"""The ray march and the optimizer in plain torch, any device and precision.

The oracles of the compiled ones, written from the rules of `field` and `optimize`.
"""

import numpy as np
import torch
from torch import Tensor

from .field import DEFAULT_RULES, FieldLattice, Marched, MarchRules, Rays, check_march
from .mapping import MappingTable
from .optimize import BETAS, EPSILON, Neighbors, check_step, image_neighbors, noise_key, weights_of

_CORNERS = [(dx, dy, dz) for dx in (0, 1) for dy in (0, 1) for dz in (0, 1)]


def march(field: FieldLattice, table: Tensor, rays: Rays, rules: MarchRules = DEFAULT_RULES) -> Marched:
    """Sum the field's features along rays, in the table's precision and on its device."""
    check_march(field, table, rays)
    origins = rays.origins.to(table)
    directions = rays.directions.to(table)
    jitter = torch.full_like(origins[:, 0], 0.5) if rays.jitter is None else rays.jitter.to(table)
    local = (
        origins - torch.tensor(field.lattice.lowest, dtype=table.dtype, device=table.device)
    ) / field.lattice.spacing
    entry, leave = _span(local, directions, field.lattice.shape)
    counts = torch.ceil((leave - entry) / rules.step - jitter).clamp(min=0)
    most = int(counts.max()) if len(counts) else 0
    steps = torch.arange(most, device=table.device, dtype=table.dtype)
    distances = entry[:, None] + (steps + jitter[:, None]) * rules.step  # (N, K), in spacings
    points = local[:, None] + distances[..., None] * directions[:, None]
    rows, occupied = _interpolate(field, table, points)
    inside = occupied & (steps < counts[:, None])

    tau = rules.step * torch.nn.functional.softplus(rows[..., 0], threshold=40.0) * inside
    after = torch.exp(-tau.cumsum(1))
    before = torch.cat((torch.ones_like(after[:, :1]), after[:, :-1]), 1)
    reached = before > rules.transmittance_min  # samples beyond the one that ends a ray do not count
    weights = (before * -torch.expm1(-tau)) * reached
    transmittance = torch.exp(-(tau * reached).sum(1))
    features = torch.einsum("nk,nkc->nc", weights, rows[..., 1:])
    depth = (weights * distances).sum(1) * field.lattice.spacing
    return Marched(features, transmittance, depth)


def _span(origins: Tensor, directions: Tensor, shape: tuple[int, int, int]) -> tuple[Tensor, Tensor]:
    """Return where rays enter and leave the lattice, in spacings; entry above leave where they miss it."""
    last = torch.tensor([edge - 1 for edge in shape]).to(origins)
    along = directions.abs() < 1e-12
    safe = torch.where(along, torch.ones_like(directions), directions)
    first, second = (0 - origins) / safe, (last - origins) / safe
    missed = along & ((origins < 0) | (origins > last))
    lows = torch.minimum(first, second).masked_fill(along, -torch.inf).masked_fill(missed, torch.inf)
    highs = torch.maximum(first, second).masked_fill(along, torch.inf)
    entry, leave = lows.amax(1).clamp(min=0), highs.amin(1)
    hit = entry < leave
    return torch.where(hit, entry, 0), torch.where(hit, leave, 0)


def _interpolate(field: FieldLattice, table: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """Return the trilinear rows (..., C) at points in spacings, and whether their cell has an occupied corner."""
    lookup = torch.from_numpy(field.lookup).to(table.device).long()
    last = torch.tensor([edge - 1 for edge in field.lattice.shape], device=table.device)
    points = torch.minimum(points.clamp(min=0), last.to(table))
    cell = torch.minimum(points.long(), last - 1)
    place = points - cell
    found = torch.zeros(points.shape[:-1], dtype=torch.bool, device=table.device)
    mean = table.new_zeros(*points.shape[:-1], table.shape[1])
    for corner in _CORNERS:
        offset = torch.tensor(corner, device=table.device)
        row = lookup[tuple((cell + offset).unbind(-1))]
        weight = torch.where(offset > 0, place, 1 - place).prod(-1)
        mean = mean + weight[..., None] * torch.where(row[..., None] >= 0, table[row.clamp(min=0)], table[-1].detach())
        found |= row >= 0
    return mean, found


class TableOptimizer:
    """`optimize.TableOptimizer`, on the rows' device and in their precision."""

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
        self.rows, self.betas, self.epsilon, self.count = rows, betas, epsilon, 0
        self.mean, self.square = torch.zeros_like(rows[:-1]), torch.zeros_like(rows[:-1])
        self._previous = None if previous is None else previous.to(rows)
        self._step, self._low, self._high = (column.to(rows) for column in (step, low, high))
        self._near = torch.from_numpy(found.rows.astype(np.int64)).to(rows.device)
        self._kinds = torch.from_numpy(found.kinds.astype(np.int64)).to(rows.device)

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
        """Go one step, as the compiled optimizer does."""
        self.count += 1
        rows, total = self.rows[:-1], gradient[:-1].to(self.rows).clone()
        scale = 1.0 / (self._step * max(len(rows), 1))
        weights = torch.tensor(weights_of(spatial, seam, smooth), dtype=rows.dtype, device=rows.device)
        for near, kinds in zip(self._near.T, self._kinds.T, strict=True):
            slope = ((rows - rows[near.clamp(min=0)]) / self._step).clamp(-1, 1)
            total += scale * slope * (weights[kinds] * (near >= 0))[:, None]
        if temporal and self._previous is not None:
            total += temporal * scale * ((rows - self._previous) / self._step).clamp(-1, 1)
        b1, b2 = self.betas
        self.mean.lerp_(total, 1 - b1)
        self.square.lerp_(total.square(), 1 - b2)
        root = (self.square / (1 - b2**self.count)).sqrt() + self.epsilon
        moved = rows - rates.to(rows) / (1 - b1**self.count) * self.mean / root
        self.rows[:-1] = torch.minimum(torch.maximum(moved, self._low), self._high)


def noisy_rows(rows: Tensor, step: Tensor, seed: int) -> Tensor:
    """Return the rows with the same noise as `optimize.noisy_rows`, on their device and in their precision.

    The numbers are "lowbias32" (C. Wellons, 2018) of each value's place in the table, in 32-bit integers.
    """
    x = torch.arange(rows[:-1].numel(), device=rows.device).reshape(rows[:-1].shape)
    x = (x * 0x9E3779B9 + noise_key(seed)) & 0xFFFFFFFF
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B), (16, 1)):
        x = ((x ^ (x >> shift)) * factor) & 0xFFFFFFFF
    share = ((x >> 8).to(rows) + 0.5) / 2**24 - 0.5
    return torch.cat((rows[:-1] + step.to(rows) * share, rows[-1:]))
