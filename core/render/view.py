# SPDX-License-Identifier: GPL-3.0-or-later
"""What a camera sees of Spacetime Gaussians: any lens, lite and full models. Trainer and player draw with it."""

from types import ModuleType
from typing import NamedTuple

import torch
from torch import Tensor

from ..camera import Camera
from ..gaussians.decoder import Decoder
from .contract import DensityStats, Rendering, Rules, SpacetimeTensors, listed


class DecoderTensors(NamedTuple):
    """A full model's network (`core.gaussians.decoder`) as tensors: `hidden` (6, 12) and `output` (3, 6)."""

    hidden: Tensor
    output: Tensor
    activation: str


def decoder_tensors(decoder: Decoder) -> DecoderTensors:
    """Return a decoder's weights as tensors."""
    return DecoderTensors(torch.from_numpy(decoder.hidden), torch.from_numpy(decoder.output), decoder.activation)


def render_view(
    backend: ModuleType,
    gaussians: SpacetimeTensors,
    time: float,
    camera: Camera,
    background: Tensor | None = None,
    decoder: DecoderTensors | None = None,
    rules: Rules | None = None,
    density: DensityStats | None = None,
    rows: Tensor | None = None,
) -> Rendering:
    """Draw Gaussians at a normalized time through any lens; `backend` as `core.render.get_backend` returns it.

    `gaussians.features` have 3 columns, or 9 with a `decoder`; the rendering's `features` are colors (H, W, 3) either
    way, with what `contract` says of `alpha` and `depth`. `background` (3,) lies behind a lite model, black if None; a
    full model is drawn over zeros, because its decoder colors every pixel, and `background` is ignored. A lens with
    distortion is drawn as it is where the backend can (`native_lens`, unless `Rules.warp_lenses`), else by a virtual
    pinhole and warped (`warp`). `rows` are the only ones drawn (`lifetimes`), without
    `density`. Differentiable like the backends.
    """
    if rows is not None and decoder is not None:  # the time feature of the others would cost more than is saved
        gaussians, rows = listed(gaussians, rows), None
    if decoder is not None:
        gaussians, background = _with_time(gaussians, time, rules), None
    warped = camera.model != "PINHOLE" and bool(rules and rules.warp_lenses)
    if not warped and backend.native_lens(camera):
        rendering = backend.rasterize_spacetime(gaussians, time, camera, background, rules, density, rows)
        return rendering if decoder is None else _decoded(backend, rendering, camera, decoder)

    from .warp import lens_warp

    warp = lens_warp(camera)
    rendering = backend.rasterize_spacetime(gaussians, time, warp.pinhole, None, rules, density, rows)
    if decoder is not None:
        rendering = _decoded(backend, rendering, warp.pinhole, decoder)
    return backend.warp(rendering, warp, background)


def _with_time(gaussians: SpacetimeTensors, time: float, rules: Rules | None) -> SpacetimeTensors:
    """Multiply the time feature by t - μ^τ (Eq. 10)."""
    dt = time - gaussians.trbf_centers
    if rules and rules.detach_motion_time:
        dt = dt.detach()
    features = gaussians.features
    return gaussians._replace(features=torch.cat([features[:, :6], features[:, 6:] * dt[:, None]], dim=1))


def _decoded(backend: ModuleType, rendering: Rendering, camera: Camera, decoder: DecoderTensors) -> Rendering:
    return rendering._replace(
        features=backend.decode(rendering.features, camera, decoder.hidden, decoder.output, decoder.activation)
    )
