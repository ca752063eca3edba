# SPDX-License-Identifier: GPL-3.0-or-later
"""Shapes and types of what the backends are given, so that a mistake is named before memory is touched."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ..camera import Camera
from .contract import ACTIVATIONS, AdamGroup, DensityStats, SpacetimeTensors

MAX_CHANNELS = 16


def check_gaussians(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    background: Tensor | None,
    density: DensityStats | None,
) -> None:
    """Raise ValueError unless the arguments of `rasterize` have the shapes of the contract."""
    count = len(means)
    _check_shapes(
        means=(means, (count, 3)),
        quats=(quats, (count, 4)),
        scales=(scales, (count, 3)),
        opacities=(opacities, (count,)),
    )
    _check_rest(count, features, background, density)


def check_spacetime(
    gaussians: SpacetimeTensors, background: Tensor | None, density: DensityStats | None, rows: Tensor | None = None
) -> None:
    """Raise ValueError unless the arguments of `rasterize_spacetime` have the shapes of the contract."""
    g, count = gaussians, len(gaussians.means)
    _check_shapes(
        means=(g.means, (count, 3)),
        motions=(g.motions, (count, 3, 3)),
        quats=(g.quats, (count, 4)),
        omegas=(g.omegas, (count, 4)),
        log_scales=(g.log_scales, (count, 3)),
        opacity_logits=(g.opacity_logits, (count,)),
        trbf_centers=(g.trbf_centers, (count,)),
        trbf_log_scales=(g.trbf_log_scales, (count,)),
    )
    _check_rest(count, g.features, background, density)
    if rows is None:
        return
    if rows.ndim != 1 or rows.dtype != torch.int32:
        raise ValueError(f"rows must be an int32 list, not {rows.dtype} of shape {tuple(rows.shape)}")
    if density is not None:
        raise ValueError("density counts all rows: it cannot be had of a list of them")


def check_images(image: Tensor, target: Tensor) -> None:
    """Raise ValueError unless both are (H, W, C), of one size and not empty; the target may be of bytes."""
    if image.ndim != 3 or image.numel() == 0:
        raise ValueError(f"image has shape {tuple(image.shape)}, not (H, W, C)")
    _check_shapes(target=(target, tuple(image.shape)))
    if not target.dtype.is_floating_point and target.dtype != torch.uint8:
        raise ValueError(f"target is of {target.dtype}, not of floats or torch.uint8")


def check_adam(groups: Sequence[AdamGroup], step: int) -> None:
    """Raise ValueError unless the arguments of `adam` are as the contract says."""
    if step < 1:
        raise ValueError("adam counts steps from 1")
    for group in groups:
        value = group.value
        for name in ("value", "gradient", "mean", "mean_square"):
            tensor: Tensor = getattr(group, name)
            if tensor.shape != value.shape or tensor.dtype != torch.float32 or not tensor.is_contiguous():
                raise ValueError(f"adam: {name} must be contiguous, float32 and of shape {tuple(value.shape)}")
        if group.row_rates is not None:
            _check_shapes(row_rates=(group.row_rates, tuple(value.shape[:1])))
        if group.column_rates is not None:
            _check_shapes(column_rates=(group.column_rates, (math.prod(value.shape[1:]),)))


def check_decoder(features: Tensor, camera: Camera, hidden: Tensor, output: Tensor, activation: str) -> None:
    """Raise ValueError unless the arguments of `decode` are as the contract says, whatever the lens."""
    _check_shapes(
        features=(features, (camera.height, camera.width, 9)), hidden=(hidden, (6, 12)), output=(output, (3, 6))
    )
    if activation not in ACTIVATIONS:
        raise ValueError(f"activation is {activation!r}, not one of {', '.join(ACTIVATIONS)}")


def check_pinhole(camera: Camera) -> None:
    """Raise ValueError unless the camera's rays are those of a pinhole."""
    if camera.model != "PINHOLE":
        raise ValueError(f"the backends draw PINHOLE cameras, not {camera.model}; core.render.view warps for others")


def _check_shapes(**expected: tuple[Tensor, tuple[int, ...]]) -> None:
    for name, (tensor, shape) in expected.items():
        if tuple(tensor.shape) != shape:
            raise ValueError(f"{name} has shape {tuple(tensor.shape)}, not {shape}")


def _check_rest(count: int, features: Tensor, background: Tensor | None, density: DensityStats | None) -> None:
    if features.ndim != 2 or len(features) != count or not 1 <= features.shape[1] <= MAX_CHANNELS:
        raise ValueError(f"features has shape {tuple(features.shape)}, not ({count}, 1 to {MAX_CHANNELS})")
    if background is not None:
        _check_shapes(background=(background, (features.shape[1],)))
    if density is not None:
        for name, dtype in (("gradient", torch.float32), ("views", torch.int32), ("radius_px", torch.float32)):
            tensor = getattr(density, name)
            _check_shapes(**{f"density.{name}": (tensor, (count,))})
            if tensor.dtype != dtype or not tensor.is_contiguous() or tensor.device != features.device:
                raise ValueError(f"density.{name} must be a contiguous {dtype} tensor, where the Gaussians are")
