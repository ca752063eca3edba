# SPDX-License-Identifier: GPL-3.0-or-later
"""Density control: where Gaussians are added, and which are taken away (Spacetime Gaussians, Secs. 4.3 and 5)."""

from dataclasses import dataclass

import torch
from torch import Tensor

from ..render.contract import DensityStats
from ..render.reference import rotation_matrices
from .config import DensityConfig
from .parameters import Parameters

SPLIT_SHRINK = 1.6  # the two children of a split Gaussian are this much smaller


@dataclass(frozen=True)
class SceneScale:
    """Lengths of a scene that make thresholds independent of its unit: see `measure_scene` in train.py."""

    footprint: float
    """what one pixel covers at the median depth of the seeds, in world units"""
    nearest: float
    """the smallest depth of any seed in front of a training camera"""
    centers: Tensor
    """(K, 3) centers of the training cameras"""


def empty_stats(count: int) -> DensityStats:
    """Make the accumulators that a backward pass fills."""
    return DensityStats(torch.zeros(count), torch.zeros(count, dtype=torch.int32), torch.zeros(count))


def densify(
    parameters: Parameters,
    stats: DensityStats,
    config: DensityConfig,
    scene: SceneScale,
    width: int,
    rng: torch.Generator,
) -> int:
    """Clone small and split large Gaussians whose projected mean the loss pulls at; return how many were added."""
    pull = stats.gradient / stats.views.clamp(min=1) * (0.5 * width)
    chosen = pull >= config.gradient
    room = config.max_gaussians - len(parameters)
    if room <= 0:
        return 0
    if int(chosen.sum()) > room:
        chosen = torch.zeros_like(chosen)
        chosen[pull.topk(room).indices] = True
    large = parameters.tensors["log_scales"].detach().exp().amax(dim=1) > config.split_footprints * scene.footprint
    clones = parameters.rows(chosen & ~large)
    parents = chosen & large
    children = [_child(parameters.rows(parents), rng) for _ in range(2)]
    if parents.any():
        parameters.keep(~parents)
    for rows in (clones, *children):
        parameters.append(rows)
    return int(chosen.sum())


def _child(rows: dict[str, Tensor], rng: torch.Generator) -> dict[str, Tensor]:
    """Move a Gaussian to a random place inside itself and shrink it."""
    scales = rows["log_scales"].exp()
    offset = torch.randn(scales.shape, generator=rng) * scales
    rows["means"] = rows["means"] + torch.einsum("nij,nj->ni", rotation_matrices(rows["quats"]), offset)
    rows["log_scales"] = (scales / SPLIT_SHRINK).log()
    return rows


def peak_opacity(parameters: Parameters, times: Tensor) -> Tensor:
    """Return the largest opacity (Eq. 7) that each Gaussian reaches at any of the frames' `times`, (N,)."""
    values = parameters.spacetime
    centers, widths = values.trbf_centers.detach(), values.trbf_log_scales.detach().exp()
    nearest = times[(times[None, :] - centers[:, None]).abs().argmin(dim=1)]
    return values.opacity_logits.detach().sigmoid() * torch.exp(-(((nearest - centers) / widths) ** 2))


def prune(parameters: Parameters, times: Tensor, config: DensityConfig, scene: SceneScale) -> Tensor:
    """Delete Gaussians that no frame sees, are broken or float before a camera; return the kept rows, (N,) bool."""
    means = parameters.tensors["means"].detach()
    keep = peak_opacity(parameters, times) >= config.prune_opacity
    if config.prune_depth > 0:
        keep &= torch.cdist(means, scene.centers).amin(dim=1) > config.prune_depth * scene.nearest
    for value in parameters.tensors.values():
        keep &= (
            torch.isfinite(value.detach()).flatten(1).all(dim=1) if value.dim() > 1 else torch.isfinite(value.detach())
        )
    if not bool(keep.all()):
        parameters.keep(keep)
    return keep


def reset_opacities(parameters: Parameters, cap: float) -> None:
    """Cap all opacities, so that those the pictures need must prove it again."""
    logit = torch.logit(torch.tensor(cap))
    with torch.no_grad():
        parameters.tensors["opacity_logits"].clamp_(max=float(logit))
    parameters.first["opacity_logits"].zero_()
    parameters.second["opacity_logits"].zero_()
