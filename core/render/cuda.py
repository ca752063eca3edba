# SPDX-License-Identifier: GPL-3.0-or-later
"""The `cuda` backend: the contract on an NVIDIA GPU, by gsplat (https://github.com/nerfstudio-project/gsplat).

Arguments may lie anywhere; they are brought to the GPU, and pictures are left there. What is on the GPU already is not
copied, so whoever keeps model, pictures and density statistics there (`DEVICE`) never waits for a transfer.

gsplat has rules of its own, whatever `Rules` says: alpha is capped at 0.999 instead of 0.99; a pixel skips alphas under
1/255, and is full before the Gaussian that would take its transmittance to 1e-4 or less; the Jacobian is held with a
margin of 0.15. So pictures differ from the other backends' where Gaussians are nearly opaque. `tests/core/
test_render_cards.py` holds them to `reference` with the cap of 0.999.

Lenses with distortion are drawn as they are where gsplat sees all that they see (`native_lens`): Gaussians are
projected by the unscented transform and weighed in space, along the rays of the pixels. Depth then carries no gradient
of the Gaussians' z, and the statistics of density come from the gradient of their means.
"""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..camera import Camera
from ..errors import HoloreelError
from . import cpu, reference
from .checks import check_decoder, check_gaussians, check_pinhole, check_spacetime
from .contract import AdamGroup, DensityStats, PictureLoss, Rendering, Rules, SpacetimeTensors, listed
from .reference import Gaussians3D
from .warp import Lens, Warp, camera_of, lens_of

DEVICE = "cuda"
REMEDY = "install Holoreel with `pip install -e '.[cuda]'` beside a torch for CUDA and its compiler, nvcc"


def load_kernels() -> None:
    """Make sure that gsplat can run. Raises HoloreelError with what is missing."""
    if not torch.cuda.is_available():
        raise HoloreelError(
            "torch sees no NVIDIA GPU, which the cuda backend needs: take --backend cpu, or " + REMEDY + "."
        )
    try:
        from gsplat.cuda._backend import _C
    except ImportError as error:
        raise HoloreelError(f"gsplat, which draws on the GPU, cannot be loaded ({error}): {REMEDY}.") from error
    if _C is None:
        raise HoloreelError(f"gsplat's kernels, which draw on the GPU, cannot be compiled: {REMEDY}.")


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    camera: Camera,
    background: Tensor | None = None,
    rules: Rules | None = None,
    density: DensityStats | None = None,
) -> Rendering:
    """Render 3D Gaussians; shapes and meanings as in `contract`, float32 on the GPU."""
    rules = rules or Rules()
    _check_lens(camera)
    check_gaussians(means, quats, scales, opacities, features, background, density)
    everything = Gaussians3D(*map(_there, (means, quats, scales, opacities, features)))
    rows = reference.drawable(everything, rules)
    return _render(Gaussians3D(*(array[rows] for array in everything)), rows, camera, background, rules, density)


def rasterize_spacetime(
    gaussians: SpacetimeTensors,
    time: float,
    camera: Camera,
    background: Tensor | None = None,
    rules: Rules | None = None,
    density: DensityStats | None = None,
    rows: Tensor | None = None,
) -> Rendering:
    """Render Spacetime Gaussians at `time`; shapes and meanings as in `contract`, float32 on the GPU."""
    rules = rules or Rules()
    _check_lens(camera)
    check_spacetime(gaussians, background, density, rows)
    everything = listed(SpacetimeTensors(*map(_there, gaussians)), rows)
    living = reference.alive(everything, time, rules)
    chosen = SpacetimeTensors(*(array[living] for array in everything))
    return _render(reference.evaluate(chosen, time, rules), living, camera, background, rules, density)


def decode(features: Tensor, camera: Camera, hidden: Tensor, output: Tensor, activation: str) -> Tensor:
    """Turn the features of a full model's rendering into colors; shapes and meanings as in `contract`."""
    check_decoder(features, camera, hidden, output, activation)
    return reference.decode(_there(features), camera, _there(hidden), _there(output), activation)


def native_lens(camera: Camera) -> bool:
    """Return whether gsplat draws all that the lens sees: PINHOLE, and most OPENCV, FULL_OPENCV and OPENCV_FISHEYE."""
    return camera.model == "PINHOLE" or _gsplat_sees_all(lens_of(camera))


MIN_RADIAL = 0.8  # gsplat draws no Gaussian that Brown's radial factor takes nearer to the center than this
MARGIN = 0.99  # of gsplat's limits, that may be used


@lru_cache(maxsize=1024)
def _gsplat_sees_all(lens: Lens) -> bool:
    """Whether no pixel lies beyond what gsplat's camera models map (`Cameras.cuh` of gsplat 1.5.3)."""
    camera = camera_of(lens)
    across, down = (np.linspace(0.0, side, 33) for side in (camera.width, camera.height))
    _, rays = camera.rays(np.stack(np.meshgrid(across, down), axis=2).reshape(-1, 2))
    x, y, z = rays.T
    if not np.isfinite(rays).all() or (z <= 0).any():
        return False
    radius = np.hypot(x, y)
    if camera.model == "OPENCV_FISHEYE":
        # The farthest corner, taken as if the lens were equidistant, is as far as angles go.
        corner = math.hypot(max(camera.cx, camera.width - camera.cx), max(camera.cy, camera.height - camera.cy))
        return float(np.arctan2(radius, z).max()) <= MARGIN * min(corner / min(camera.fx, camera.fy), math.pi / 2)
    above, below = (np.array(factors) for factors in _brown_factors(camera))
    powers = (radius / z)[:, None] ** np.array([2, 4, 6])
    return float(((1.0 + powers @ above) / (1.0 + powers @ below)).min()) >= MIN_RADIAL / MARGIN


def _brown_factors(camera: Camera) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """k1 k2 k3 and k4 k5 k6 of an OPENCV or FULL_OPENCV camera."""
    k1, k2, _, _, k3, k4, k5, k6 = (*camera.distortion, 0.0, 0.0, 0.0, 0.0)[:8]
    return (k1, k2, k3), (k4, k5, k6)


def _check_lens(camera: Camera) -> None:
    if not native_lens(camera):
        check_pinhole(camera)


def warp(rendering: Rendering, lens: Warp, background: Tensor | None = None) -> Rendering:
    """Return what a lens sees of its pinhole's rendering; as in `contract`."""
    return lens.see(Rendering(*map(_there, rendering)), background)


def picture_loss(image: Tensor, target: Tensor, weight_dssim: float) -> PictureLoss:
    """Return the training loss and the mean squared error of two images, as in `contract`."""
    return reference.picture_loss(image, target.to(image.device, non_blocking=True), weight_dssim)


def l1_dssim(image: Tensor, target: Tensor, weight_dssim: float) -> Tensor:
    """Return the training loss of two images alone."""
    return picture_loss(image, target, weight_dssim).loss


def adam(groups: Sequence[AdamGroup], beta1: float, beta2: float, eps: float, step: int) -> None:
    """Take one step of Adam, in place, as in `contract`: on the GPU, or by the CPU's kernels what lies there.

    gsplat's SelectiveAdam, which steps only what a picture saw, has no bias correction and so is another optimizer.
    """
    here = [group for group in groups if group.value.device.type == "cpu"]
    if here:
        cpu.adam(here, beta1, beta2, eps, step)
    reference.adam([group for group in groups if group.value.device.type != "cpu"], beta1, beta2, eps, step)


def _there(tensor: Tensor) -> Tensor:
    return tensor.to(DEVICE, torch.float32)


def camera_arguments(camera: Camera, like: Tensor) -> dict[str, Any]:
    """Return what gsplat is told of a camera."""

    def placed(values: Any) -> Tensor:
        return torch.tensor([values], dtype=like.dtype, device=like.device)

    told: dict[str, Any] = {
        "viewmats": placed(camera.world_to_camera.tolist()),
        "Ks": placed(camera.K.tolist()),
        "width": camera.width,
        "height": camera.height,
    }
    if camera.model == "PINHOLE":
        return told
    told |= {"with_ut": True, "with_eval3d": True}
    if camera.model == "OPENCV_FISHEYE":
        return told | {"camera_model": "fisheye", "radial_coeffs": placed(camera.distortion)}
    above, below = _brown_factors(camera)
    coefficients = {"radial_coeffs": placed(above + below), "tangential_coeffs": placed(camera.distortion[2:4])}
    return told | {"camera_model": "pinhole"} | coefficients


def gaussian_arguments(g: Gaussians3D) -> dict[str, Tensor]:
    """Return what gsplat is told of Gaussians; it does not know that a zero quaternion means no rotation."""
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=g.quats.dtype, device=g.quats.device)
    turned = g.quats.norm(dim=1, keepdim=True) >= reference.MIN_QUAT_NORM
    quats = torch.where(turned, g.quats, identity)
    return {"means": g.means, "quats": quats, "scales": g.scales, "opacities": g.opacities, "colors": g.features}


def _render(
    gaussians: Gaussians3D,
    rows: Tensor,
    camera: Camera,
    background: Tensor | None,
    rules: Rules,
    density: DensityStats | None,
) -> Rendering:
    from gsplat import rasterization

    pictures, alpha, seen = rasterization(
        **gaussian_arguments(gaussians),
        **camera_arguments(camera, gaussians.means),
        near_plane=rules.near,
        eps2d=rules.low_pass,
        backgrounds=None if background is None else _there(background)[None],
        render_mode="RGB+ED",
        # Rows were chosen already, so few fall outside the picture: packing them would cost more than it saves.
        packed=False,
    )
    if density is not None:
        if seen["means2d"].requires_grad:
            _watch_density(seen, seen["means2d"], lambda gradient: gradient[0], rows, density)
        elif gaussians.means.requires_grad:  # the unscented transform passes none
            _watch_density(seen, gaussians.means, _to_pixels(gaussians.means.detach(), camera), rows, density)
    return Rendering(pictures[0, ..., :-1], alpha[0, ..., 0], pictures[0, ..., -1])


def _to_pixels(means: Tensor, camera: Camera) -> Callable[[Tensor], Tensor]:
    """Return what turns the gradient of means in space to one in pixels: across the ray, as long as in the middle."""
    offsets = means - torch.tensor(camera.center.tolist(), dtype=means.dtype, device=means.device)
    distances = offsets.norm(dim=1, keepdim=True)
    rays = offsets / distances
    focal = math.sqrt(camera.fx * camera.fy)

    def turn(gradient: Tensor) -> Tensor:
        across = gradient - (gradient * rays).sum(dim=1, keepdim=True) * rays
        return across * distances / focal

    return turn


def _watch_density(
    seen: dict[str, Any],
    watched: Tensor,
    to_pixels: Callable[[Tensor], Tensor],
    rows: Tensor,
    density: DensityStats,
) -> None:
    """Let the backward pass add to `density`, wherever that lies, what it finds at `watched`."""
    drawn = (seen["radii"][0] > 0).all(dim=1)
    xx, xy, yy = seen["conics"].detach()[0][drawn].unbind(1)  # of the inverse covariance
    determinant = xx * yy - xy * xy
    longest = (0.5 * (xx + yy) + torch.sqrt((0.5 * (xx - yy)) ** 2 + xy**2)) / determinant
    place = density.gradient.device
    which, radii = rows[drawn].to(place), (3.0 * longest.sqrt()).to(place)

    def add(gradient: Tensor) -> None:
        density.gradient[which] += to_pixels(gradient)[drawn].norm(dim=1).to(place)
        density.views[which] += 1
        density.radius_px[which] = torch.maximum(density.radius_px[which], radii)

    watched.register_hook(add)
