# SPDX-License-Identifier: GPL-3.0-or-later
"""The ray march in plain torch, any device and precision: the oracle of the compiled one, written from `field`'s
rules.
"""

import torch
from torch import Tensor

from .field import DEFAULT_RULES, FieldLattice, Marched, MarchRules, Rays, check_march

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
