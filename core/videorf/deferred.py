# SPDX-License-Identifier: GPL-3.0-or-later
"""The deferred shading network Φ in torch, to be trained; its formula and its file are in `shading`."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .shading import Shading, ShadingShape


class DeferredShading(torch.nn.Module):
    """Φ for features (..., h) and unit directions (..., 3): colors (..., 3) in 0 ... 1 (Eqs. 2-3)."""

    def __init__(self, shape: ShadingShape, generator: torch.Generator | None = None) -> None:
        """Start from He's initialization with biases 0, the last layer from a tenth of it: gray, with all gradients
        alive.
        """
        super().__init__()
        self.shape = shape
        self.layers = torch.nn.ModuleList(torch.nn.Linear(inputs, outputs) for outputs, inputs in shape.layers)
        with torch.no_grad():
            for layer in self._linears():
                scale = (0.1 if layer is self.layers[-1] else 1.0) * (2.0 / layer.in_features) ** 0.5
                layer.weight.copy_(torch.randn(layer.weight.shape, generator=generator) * scale)
                layer.bias.zero_()

    def _linears(self) -> list[torch.nn.Linear]:
        return [layer for layer in self.layers if isinstance(layer, torch.nn.Linear)]

    def forward(self, features: Tensor, directions: Tensor) -> Tensor:
        """Return the colors of summed features."""
        values = torch.cat((features, self.encode(directions)), -1)
        *hidden, last = self._linears()
        for layer in hidden:
            values = torch.relu(layer(values))
        return torch.sigmoid(last(values))

    def encode(self, directions: Tensor) -> Tensor:
        """Return PE(d)."""
        if self.shape.frequencies is None:
            return directions[..., :0]
        waves = [wave(directions * 2.0**k) for k in range(self.shape.frequencies) for wave in (torch.sin, torch.cos)]
        return torch.cat((directions, *waves), -1)

    def numbers(self) -> Shading:
        """Return the weights as they are now."""
        layers = [(_copied(layer.weight), _copied(layer.bias)) for layer in self._linears()]
        return Shading(self.shape, tuple(layers))

    @classmethod
    def of(cls, shading: Shading) -> "DeferredShading":
        """Return the network of given weights."""
        network = cls(shading.shape)
        with torch.no_grad():
            for layer, (matrix, bias) in zip(network._linears(), shading.layers, strict=True):
                layer.weight.copy_(torch.from_numpy(matrix))
                layer.bias.copy_(torch.from_numpy(bias))
        return network


def _copied(part: Tensor) -> NDArray[np.float32]:
    return part.detach().cpu().float().numpy().copy()


def composite(colors: Tensor, transmittance: Tensor, background: Tensor | float) -> Tensor:
    """Return (1 - T) colors + T background for colors (..., 3) and transmittance (...)."""
    left = transmittance[..., None]
    return (1.0 - left) * colors + left * background
