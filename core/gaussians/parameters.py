# SPDX-License-Identifier: GPL-3.0-or-later
"""The trained tensors with their Adam moments, which grow and shrink together under density control."""

import math
from collections.abc import Mapping
from types import ModuleType
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..render.contract import AdamGroup, DensityStats, SpacetimeTensors
from .model import SpacetimeGaussians
from .scale import Measure

BETAS = (0.9, 0.999)
EPSILON = 1e-15  # gradients of a mean loss over a picture are tiny; the usual 1e-8 would damp the step
ROW_STATE = ("gradient", "views", "radius_px")  # of density control


class Rate(NamedTuple):
    """How far one tensor steps: `rate`, times a factor per row and one per value of a row; then it is held in a range.

    With the rate 0 it stays as it is.
    """

    rate: float
    rows: Tensor | None = None
    columns: Tensor | None = None
    low: float = -math.inf
    high: float = math.inf


def _ones(means: Tensor) -> Tensor:
    return torch.ones(len(means), device=means.device)


def empty_stats(count: int, device: str = "cpu") -> DensityStats:
    """Make the accumulators that a backward pass fills."""
    gradient, radius = torch.zeros(2, count, device=device)
    return DensityStats(gradient, torch.zeros(count, dtype=torch.int32, device=device), radius)


class Parameters:
    """Spacetime Gaussians as leaf tensors, a full model's network, and Adam's two moments for each of them.

    `measure` gives the unit of length at each mean, in which steps of positions and motions are counted; `units` (N,)
    are the ones in use, `stats` what density control gathers, `paces` (N,) a factor of every row's steps (1 for all but
    those that should stay about as they are): rows of all three come and go with the Gaussians.
    """

    def __init__(
        self,
        gaussians: SpacetimeGaussians,
        network: Mapping[str, Tensor] | None = None,
        measure: Measure = _ones,
        device: str = "cpu",
    ):
        self.device = device
        arrays = {name: np.ascontiguousarray(getattr(gaussians, name), np.float32) for name in SpacetimeTensors._fields}
        self.tensors = {name: torch.from_numpy(array).to(device).requires_grad_() for name, array in arrays.items()}
        self.network = {
            name: value.detach().to(device, copy=True).requires_grad_() for name, value in (network or {}).items()
        }
        everything = {**self.tensors, **self.network}
        self.first = {name: torch.zeros_like(value) for name, value in everything.items()}
        self.second = {name: torch.zeros_like(value) for name, value in everything.items()}
        self.steps = 0
        self.measure = measure
        self.units = measure(self.tensors["means"].detach())
        self.paces = torch.ones(len(self), device=device)
        self.stats = empty_stats(len(self), device)

    def __len__(self) -> int:
        return len(self.tensors["means"])

    @property
    def spacetime(self) -> SpacetimeTensors:
        """The leaf tensors as the rasterizer takes them."""
        return SpacetimeTensors(**self.tensors)

    def to_gaussians(self) -> SpacetimeGaussians:
        """Copy the values out."""
        return SpacetimeGaussians(**{name: value.detach().cpu().numpy().copy() for name, value in self.tensors.items()})

    def step(self, rates: Mapping[str, Rate], backend: ModuleType) -> None:
        """Take one Adam step with a learning rate per tensor, and clear the gradients."""
        self.steps += 1
        groups = []
        for name, value in (*self.tensors.items(), *self.network.items()):
            gradient, value.grad, rate = value.grad, None, rates[name]
            if gradient is not None and rate.rate != 0.0:
                groups.append(AdamGroup(value.detach(), gradient, self.first[name], self.second[name], *rate))
        backend.adam(groups, *BETAS, EPSILON, self.steps)

    def refresh_units(self) -> None:
        """Measure the unit of length again where the Gaussians are now."""
        self.units = self.measure(self.tensors["means"].detach())

    def keep(self, rows: Tensor) -> None:
        """Keep only these rows (bool or index), moments included."""
        for name, value in self.tensors.items():
            self.tensors[name] = value.detach()[rows].clone().requires_grad_()
            self.first[name] = self.first[name][rows].clone()
            self.second[name] = self.second[name][rows].clone()
        self.units = self.units[rows].clone()
        self.paces = self.paces[rows].clone()
        self.stats = DensityStats(*(getattr(self.stats, name)[rows].clone() for name in ROW_STATE))

    def append(self, rows: Mapping[str, Tensor]) -> None:
        """Add rows with zero moments."""
        for name, value in self.tensors.items():
            new = rows[name].detach().to(self.device)
            self.tensors[name] = torch.cat([value.detach(), new]).requires_grad_()
            self.first[name] = torch.cat([self.first[name], torch.zeros_like(new)])
            self.second[name] = torch.cat([self.second[name], torch.zeros_like(new)])
        self.units = torch.cat([self.units, self.measure(rows["means"].detach().to(self.device))])
        stats = [getattr(self.stats, name) for name in ROW_STATE]
        added = len(rows["means"])
        self.paces = torch.cat([self.paces, self.paces.new_ones(added)])
        self.stats = DensityStats(*(torch.cat([value, value.new_zeros(added)]) for value in stats))

    def forget(self, rows: Tensor) -> None:
        """Set the moments of these rows (bool or index) to zero."""
        for name in self.tensors:
            self.first[name][rows] = 0
            self.second[name][rows] = 0

    def rows(self, rows: Tensor) -> dict[str, Tensor]:
        """Copy some rows out."""
        return {name: value.detach()[rows].clone() for name, value in self.tensors.items()}

    def state(self) -> dict[str, object]:
        """Everything `load_state` needs to go on bit for bit."""
        return {
            "tensors": {name: value.detach() for name, value in self.tensors.items()},
            "network": {name: value.detach() for name, value in self.network.items()},
            "first": self.first,
            "second": self.second,
            "steps": self.steps,
            "units": self.units,
            "paces": self.paces,
            "stats": {name: getattr(self.stats, name) for name in ROW_STATE},
        }

    @classmethod
    def from_state(cls, state: Mapping, measure: Measure = _ones, device: str = "cpu") -> "Parameters":
        """Rebuild from `state`."""

        def copied(values: Mapping[str, Tensor]) -> dict[str, Tensor]:
            return {name: value.detach().to(device, copy=True) for name, value in values.items()}

        self = cls.__new__(cls)
        self.device, self.measure, self.steps = device, measure, int(state["steps"])
        self.tensors = {name: value.requires_grad_() for name, value in copied(state["tensors"]).items()}
        self.network = {name: value.requires_grad_() for name, value in copied(state["network"]).items()}
        self.first, self.second = copied(state["first"]), copied(state["second"])
        self.units, self.paces = copied({"units": state["units"], "paces": state["paces"]}).values()
        self.stats = DensityStats(**copied(state["stats"]))
        return self
