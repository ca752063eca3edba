# SPDX-License-Identifier: GPL-3.0-or-later
"""The trained tensors with their Adam moments, which grow and shrink together under density control."""

from collections.abc import Mapping
from types import ModuleType

import numpy as np
import torch
from torch import Tensor

from ..render.contract import SpacetimeTensors
from .model import SpacetimeGaussians

BETAS = (0.9, 0.999)
EPSILON = 1e-15  # gradients of a mean loss over a picture are tiny; the usual 1e-8 would damp the step


class Parameters:
    """Spacetime Gaussians as leaf tensors, and Adam's two moments for each of them."""

    def __init__(self, gaussians: SpacetimeGaussians):
        self.tensors = {
            name: torch.from_numpy(np.ascontiguousarray(getattr(gaussians, name), np.float32)).requires_grad_()
            for name in SpacetimeTensors._fields
        }
        self.first = {name: torch.zeros_like(value) for name, value in self.tensors.items()}
        self.second = {name: torch.zeros_like(value) for name, value in self.tensors.items()}
        self.steps = 0

    def __len__(self) -> int:
        return len(self.tensors["means"])

    @property
    def spacetime(self) -> SpacetimeTensors:
        """The leaf tensors as the rasterizer takes them."""
        return SpacetimeTensors(**self.tensors)

    def to_gaussians(self) -> SpacetimeGaussians:
        """Copy the values out."""
        return SpacetimeGaussians(**{name: value.detach().numpy().copy() for name, value in self.tensors.items()})

    def step(self, rates: Mapping[str, float], backend: ModuleType) -> None:
        """Take one Adam step with a learning rate per tensor, and clear the gradients."""
        self.steps += 1
        with torch.no_grad():
            for name, value in self.tensors.items():
                if value.grad is not None:
                    backend.adam_step(
                        value, value.grad, self.first[name], self.second[name], rates[name], *BETAS, EPSILON, self.steps
                    )
                    value.grad = None

    def keep(self, rows: Tensor) -> None:
        """Keep only these rows (bool or index), moments included."""
        for name, value in self.tensors.items():
            self.tensors[name] = value.detach()[rows].clone().requires_grad_()
            self.first[name] = self.first[name][rows].clone()
            self.second[name] = self.second[name][rows].clone()

    def append(self, rows: Mapping[str, Tensor]) -> None:
        """Add rows with zero moments."""
        for name, value in self.tensors.items():
            new = rows[name].detach()
            self.tensors[name] = torch.cat([value.detach(), new]).requires_grad_()
            self.first[name] = torch.cat([self.first[name], torch.zeros_like(new)])
            self.second[name] = torch.cat([self.second[name], torch.zeros_like(new)])

    def rows(self, rows: Tensor) -> dict[str, Tensor]:
        """Copy some rows out."""
        return {name: value.detach()[rows].clone() for name, value in self.tensors.items()}

    def state(self) -> dict[str, object]:
        """Everything `load_state` needs to go on bit for bit."""
        detached = {name: value.detach() for name, value in self.tensors.items()}
        return {"tensors": detached, "first": self.first, "second": self.second, "steps": self.steps}

    @classmethod
    def from_state(cls, state: Mapping) -> "Parameters":
        """Rebuild from `state`."""
        self = cls.__new__(cls)
        self.tensors = {name: value.clone().requires_grad_() for name, value in state["tensors"].items()}
        self.first = {name: value.clone() for name, value in state["first"].items()}
        self.second = {name: value.clone() for name, value in state["second"].items()}
        self.steps = int(state["steps"])
        return self
