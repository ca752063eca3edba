# SPDX-License-Identifier: GPL-3.0-or-later
"""The other density strategy: Gaussians as samples that wander, die and are born again where they are needed.

After Kheradmand et al., "3D Gaussian Splatting as Markov Chain Monte Carlo" (2024), with sizes measured in the run's
unit of length, so that the scene's own does not matter.
"""

import math
from functools import lru_cache

import torch
from torch import Tensor

from ..render.reference import rotation_matrices
from .config import TrainConfig
from .density import BROKEN, CAMERA, OPACITY, broken_rows, near_rows, peak_opacity, prune
from .parameters import Parameters
from .scale import SceneScale

MOST_COPIES = 50  # of one Gaussian at a time, itself included
GATE_STEEPNESS, GATE_OPACITY = 100.0, 0.005  # Gaussians more opaque than this hardly wander
OPACITY_LIMITS = (0.005, 1.0 - 1e-6)


@lru_cache(maxsize=1)
def _binomials() -> Tensor:
    """Return (copies, k) (−1)^k C(copies − 1, k) / √(k + 1), zero where k ≥ copies; float64, row 0 for one copy."""
    table = torch.zeros(MOST_COPIES, MOST_COPIES, dtype=torch.float64)
    for i in range(MOST_COPIES):
        for k in range(i + 1):
            table[i, k] = (-1) ** k * math.comb(i, k) / math.sqrt(k + 1)
    return table


def share(opacities: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """Return what opacity (N,) and scale factor (N,) `copies` (N,) of a Gaussian must have to look like one (Eq. 9).

    The copies lie in one place; together they are as opaque in the middle as one Gaussian of `opacities` (N,), and
    cover as much of a line through it.
    """
    old = opacities.double().clamp(*OPACITY_LIMITS)
    copies = copies.clamp(1, MOST_COPIES)
    new = 1.0 - (1.0 - old) ** (1.0 / copies)
    powers = new[:, None] ** torch.arange(1, MOST_COPIES + 1, dtype=torch.float64, device=new.device)
    # Sum over i = 1 … copies of row i − 1 of the table.
    cumulative = _binomials().cumsum(dim=0).to(new.device)[copies - 1]
    return new.to(opacities.dtype), (old / (cumulative * powers).sum(dim=1)).to(opacities.dtype)


def multiply(parameters: Parameters, sources: Tensor, targets: Tensor | None) -> None:
    """Put copies of the rows `sources` (M,; a row may come often) over the rows `targets` (M,), or behind all rows.

    Originals and copies share their opacity, so that the picture stays as it is; they forget their moments.
    """
    rows, counts = torch.unique(sources, return_counts=True)
    logits, scales = (parameters.tensors[name].detach() for name in ("opacity_logits", "log_scales"))
    opacity, factor = share(logits[rows].sigmoid(), counts + 1)
    logits[rows] = torch.logit(opacity.clamp(*OPACITY_LIMITS))
    scales[rows] += factor.log()[:, None]
    parameters.forget(rows)
    copies = parameters.rows(sources)
    if targets is None:
        parameters.append(copies)
        return
    for name, value in parameters.tensors.items():
        value.detach()[targets] = copies[name]
    parameters.units[targets] = parameters.units[sources]
    parameters.paces[targets] = parameters.paces[sources]
    parameters.forget(targets)


def relocate(parameters: Parameters, dead: Tensor, rng: torch.Generator) -> int:
    """Move the rows that are `dead` (N,) bool onto live ones, drawn in proportion to opacity; return how many."""
    targets = torch.nonzero(dead)[:, 0]
    live = torch.nonzero(~dead)[:, 0]
    if not len(targets) or not len(live):
        return 0
    multiply(parameters, _draw(parameters, live, len(targets), rng), targets)
    return len(targets)


def grow(parameters: Parameters, count: int, rng: torch.Generator) -> None:
    """Add `count` copies of Gaussians drawn in proportion to opacity."""
    if count > 0 and len(parameters):
        multiply(
            parameters, _draw(parameters, torch.arange(len(parameters), device=parameters.device), count, rng), None
        )


def _draw(parameters: Parameters, rows: Tensor, count: int, rng: torch.Generator) -> Tensor:
    """Draw `count` of `rows` with replacement, in proportion to opacity."""
    weights = parameters.tensors["opacity_logits"].detach()[rows].sigmoid().double().cumsum(dim=0)
    places = torch.rand(count, generator=rng, dtype=torch.float64).to(weights.device) * weights[-1]
    return rows[torch.searchsorted(weights, places).clamp(max=len(rows) - 1)]


def wander(parameters: Parameters, strength: float, rng: torch.Generator) -> None:
    """Move the means at random, in the shape of each covariance, and the less the more opaque a Gaussian is."""
    values = {name: value.detach() for name, value in parameters.tensors.items()}
    opacities = values["opacity_logits"].sigmoid()
    gate = torch.sigmoid(-GATE_STEEPNESS * (opacities - GATE_OPACITY))
    axes = rotation_matrices(values["quats"]) * values["log_scales"].exp()[:, None, :]
    noise = (
        torch.randn(values["means"].shape, generator=rng).to(parameters.device)
        * (strength * gate / parameters.units)[:, None]
    )
    step = torch.einsum("nij,nkj,nk->ni", axes, axes, noise)
    # A huge Gaussian may not leave the scene in one step.
    length = step.norm(dim=1, keepdim=True)
    limit = values["log_scales"].exp().amax(dim=1, keepdim=True)
    values["means"].add_(step * (limit / length.clamp(min=1e-30)).clamp(max=1.0))


class McmcControl:
    """Relocation instead of densification: the number grows to its limit, and nothing that can be used is deleted."""

    def __init__(self, config: TrainConfig, scene: SceneScale, times: Tensor):
        self.config, self.mcmc, self.scene, self.times = config, config.mcmc, scene, times

    def before_step(self, parameters: Parameters) -> None:
        """Add the gradients of the two weights on opacity and size."""
        logits, scales = parameters.tensors["opacity_logits"], parameters.tensors["log_scales"]
        count = max(len(parameters), 1)
        if logits.grad is not None and self.mcmc.opacity_weight:
            opacities = logits.detach().sigmoid()
            logits.grad.add_(opacities * (1 - opacities), alpha=self.mcmc.opacity_weight / count)
        if scales.grad is not None and self.mcmc.scale_weight:
            sizes = scales.detach().exp() / parameters.units[:, None]
            scales.grad.add_(sizes, alpha=self.mcmc.scale_weight / (3 * count))

    def after_step(
        self, parameters: Parameters, iteration: int, pixels: float, pace: float, rng: torch.Generator
    ) -> dict[str, int]:
        """Do what is due after an iteration; return how many Gaussians were deleted for which reason.

        `pace` is what is left of the positions' learning rate.
        """
        density, planned, lost = self.config.density, self.config.planned, {}
        last = iteration == self.config.iterations
        if iteration % self.mcmc.every == 0 or last:
            causes = {BROKEN: broken_rows(parameters)}
            if density.prune_depth > 0:
                causes[CAMERA] = near_rows(parameters, self.scene, density.prune_depth)
            if last:
                causes[OPACITY] = peak_opacity(parameters, self.times) < self.mcmc.dead_opacity
            lost = prune(parameters, causes)
            if self.mcmc.start * planned <= iteration <= self.mcmc.stop * planned and not last:
                relocate(parameters, peak_opacity(parameters, self.times) < self.mcmc.dead_opacity, rng)
                room = density.max_gaussians - len(parameters)
                grow(parameters, min(int(len(parameters) * self.mcmc.growth), room), rng)
            parameters.refresh_units()
        if not last and self.mcmc.noise:
            wander(parameters, self.mcmc.noise * pace, rng)
        return lost
