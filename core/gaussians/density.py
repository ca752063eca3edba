# SPDX-License-Identifier: GPL-3.0-or-later
"""Density control: where Gaussians are added, and which are taken away (Spacetime Gaussians, Secs. 4.3 and 5)."""

from collections.abc import Iterable, Mapping

import numpy as np
import torch
from torch import Tensor

from ..render.reference import rotation_matrices
from .config import DensityConfig, TrainConfig
from .parameters import Parameters
from .scale import SceneScale

OPACITY, CAMERA, BOX, BROKEN = "too transparent", "too near to a camera", "outside the seeds' box", "not finite"
SETTINGS = {
    OPACITY: "lower --density.prune-opacity",
    CAMERA: "lower --density.prune-depth",
    BOX: "leave --density.prune-box-at away",
    BROKEN: "lower the learning rates (--rates.means first)",
}  # what to change where Gaussians are lost for a reason


def densify(
    parameters: Parameters, config: DensityConfig, pixels: float, rng: torch.Generator, room: int | None = None
) -> int:
    """Clone small and split large Gaussians whose projected mean the loss pulls at; return how many were added.

    `pixels` is half the width of a picture (times the pictures of a step, whose loss is their mean). The statistics
    are those of `parameters.stats` and start anew.
    """
    stats = parameters.stats
    pull = stats.gradient / stats.views.clamp(min=1) * pixels
    chosen = pull >= config.gradient
    room = config.max_gaussians - len(parameters) if room is None else room
    if room <= 0:
        chosen = torch.zeros_like(chosen)
    elif int(chosen.sum()) > room:
        chosen = torch.zeros_like(chosen)
        chosen[pull.topk(room).indices] = True
    large = parameters.tensors["log_scales"].detach().exp().amax(dim=1) > config.split_size * parameters.units
    clones = parameters.rows(chosen & ~large)
    parents = chosen & large
    children = [_child(parameters.rows(parents), config.split_shrink, rng) for _ in range(2)]
    if parents.any():
        parameters.keep(~parents)
    for rows in (clones, *children):
        if config.random_centers:
            rows["trbf_centers"] = torch.rand(rows["trbf_centers"].shape, generator=rng)
        parameters.append(rows)
    for value in (parameters.stats.gradient, parameters.stats.views, parameters.stats.radius_px):
        value.zero_()
    return int(chosen.sum())


def _child(rows: dict[str, Tensor], shrink: float, rng: torch.Generator) -> dict[str, Tensor]:
    """Move a Gaussian to a random place inside itself and shrink it."""
    scales = rows["log_scales"].exp()
    offset = torch.randn(scales.shape, generator=rng).to(scales.device) * scales
    rows["means"] = rows["means"] + torch.einsum("nij,nj->ni", rotation_matrices(rows["quats"]), offset)
    rows["log_scales"] = (scales / shrink).log()
    return rows


def peak_opacity(parameters: Parameters, times: Tensor) -> Tensor:
    """Return the largest opacity (Eq. 7) that each Gaussian reaches at any of the frames' `times`, (N,)."""
    values = parameters.spacetime
    centers, widths = values.trbf_centers.detach(), values.trbf_log_scales.detach().exp()
    # Frames are in order: the nearest is one of the two that the center lies between.
    after = torch.searchsorted(times, centers.contiguous()).clamp(1, max(len(times) - 1, 1)) if len(times) > 1 else 0
    ends = (times[after - 1], times[after]) if len(times) > 1 else (times[:1], times[:1])
    gap = torch.minimum(*((end - centers).abs() for end in ends))
    return values.opacity_logits.detach().sigmoid() * torch.exp(-((gap / widths) ** 2))


def broken_rows(parameters: Parameters) -> Tensor:
    """Return which Gaussians have a parameter that is not finite, (N,) bool."""
    broken = torch.zeros(len(parameters), dtype=torch.bool, device=parameters.device)
    for value in parameters.tensors.values():
        broken |= ~torch.isfinite(value.detach().reshape(len(value), -1)).all(dim=1)
    return broken


def near_rows(parameters: Parameters, scene: SceneScale, part: float) -> Tensor:
    """Return which Gaussians are nearer to a training camera than a `part` of the nearest seed, (N,) bool."""
    distance = torch.cdist(parameters.tensors["means"].detach(), scene.centers).amin(dim=1)
    return distance <= part * scene.nearest


def outside_rows(parameters: Parameters, scene: SceneScale) -> Tensor:
    """Return which Gaussians lie outside the box of the seeds, (N,) bool."""
    means = parameters.tensors["means"].detach()
    return ((means < scene.box[0]) | (means > scene.box[1])).any(dim=1)


def prune(parameters: Parameters, causes: Mapping[str, Tensor]) -> dict[str, int]:
    """Delete the rows that any cause names (masks (N,)); return how many each took, the first one that names a row."""
    gone = torch.zeros(len(parameters), dtype=torch.bool, device=parameters.device)
    counts = {}
    for cause, rows in causes.items():
        counts[cause] = int((rows & ~gone).sum())
        gone |= rows
    if bool(gone.any()):
        parameters.keep(~gone)
    return counts


def reset_opacities(parameters: Parameters, cap: float) -> None:
    """Cap all opacities, so that those the pictures need must prove it again."""
    logit = torch.logit(torch.tensor(cap))
    with torch.no_grad():
        parameters.tensors["opacity_logits"].clamp_(max=float(logit))
    parameters.first["opacity_logits"].zero_()
    parameters.second["opacity_logits"].zero_()


def moments(parts: Iterable[float], iterations: int) -> frozenset[int]:
    """Return the iterations at these parts of a run."""
    return frozenset(round(part * iterations) for part in parts)


class DensityControl:
    """The paper's strategy: a quota of densifications, steady pruning, and resets of the opacities."""

    def __init__(self, config: TrainConfig, scene: SceneScale, times: Tensor):
        self.config, self.density, self.scene, self.times = config, config.density, scene, times
        density, planned = config.density, config.planned
        events = np.linspace(density.start, density.stop, density.events) if density.events else ()
        self.densify_at = moments(events, planned)
        self.reset_at = moments(density.reset_at, planned)
        self.box_at = moments(density.prune_box_at, planned)

    def before_step(self, parameters: Parameters) -> None:
        """Nothing is added to the loss."""

    def after_step(
        self, parameters: Parameters, iteration: int, pixels: float, pace: float, rng: torch.Generator
    ) -> dict[str, int]:
        """Do what is due after an iteration; return how many Gaussians were deleted for which reason.

        `pixels` as for `densify`; `pace` is what is left of the positions' learning rate.
        """
        density, lost = self.density, {}
        if iteration in self.densify_at:
            densify(parameters, density, pixels, rng)
        if iteration % density.prune_every == 0 or iteration in self.box_at or iteration == self.config.iterations:
            causes = {BROKEN: broken_rows(parameters)}
            if iteration <= density.prune_stop * self.config.planned:
                causes[OPACITY] = peak_opacity(parameters, self.times) < density.prune_opacity
            if density.prune_depth > 0:
                causes[CAMERA] = near_rows(parameters, self.scene, density.prune_depth)
            if iteration in self.box_at:
                causes[BOX] = outside_rows(parameters, self.scene)
            lost = prune(parameters, causes)
            parameters.refresh_units()
        if iteration in self.reset_at:
            reset_opacities(parameters, density.reset_opacity)
        return lost
