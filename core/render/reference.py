# SPDX-License-Identifier: GPL-3.0-or-later
"""The `reference` backend: the contract in plain vectorized torch, in float32 or float64, differentiated by autograd.

It is the oracle of the other backends and what runs where nothing was compiled. It works tile by tile like they do: the
tiles are taken in groups of about equal length, padded, and composited by a cumulative product.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from ..camera import Camera
from .checks import check_adam, check_decoder, check_gaussians, check_images, check_pinhole, check_spacetime
from .contract import AdamGroup, DensityStats, PictureLoss, Rendering, Rules, SpacetimeTensors, listed
from .warp import Lens, Warp, camera_of, lens_of

DEVICE = "cpu"  # where nothing says otherwise; it works wherever its arguments lie
TILE = 16
GROUP_ELEMENTS = 3_000_000  # of (Gaussian, pixel) pairs composited at once
GRAPH_ELEMENTS = 150_000_000  # beyond this many in a picture, groups are computed again in the backward pass
MIN_LOG_WIDTH = -40.0  # narrower than any time step; keeps 1 / width² finite
MIN_QUAT_NORM = 1e-12  # under this a quaternion means no rotation


class Gaussians3D(NamedTuple):
    """3D Gaussians in the world: what `rasterize` takes."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    features: Tensor


class Splats(NamedTuple):
    """Gaussians on the image, M of them, in the order of depth."""

    means: Tensor  # (M, 2) pixels
    conics: Tensor  # (M, 3) inverse covariance: xx, xy, yy
    covariances: Tensor  # (M, 3) xx, xy, yy, low pass included
    depths: Tensor  # (M,)
    opacities: Tensor  # (M,)
    features: Tensor  # (M, C)
    rows: Tensor  # (M,) which Gaussian each one is


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
    """Render 3D Gaussians; shapes and meanings as in `contract`."""
    rules = rules or Rules()
    check_pinhole(camera)
    check_gaussians(means, quats, scales, opacities, features, background, density)
    arrays = Gaussians3D(means, quats, scales, opacities, features)
    rows = drawable(arrays, rules)
    return _render(lambda chosen: Gaussians3D(*(a[chosen] for a in arrays)), rows, camera, background, rules, density)


def drawable(g: Gaussians3D, rules: Rules) -> Tensor:
    """Return the rows, (M,), that are finite and opaque enough to be seen."""
    with torch.no_grad():
        good = _finite(g.means, g.quats, g.scales, g.features) & (g.opacities >= rules.alpha_min)
        return torch.nonzero(good)[:, 0]


def rasterize_spacetime(
    gaussians: SpacetimeTensors,
    time: float,
    camera: Camera,
    background: Tensor | None = None,
    rules: Rules | None = None,
    density: DensityStats | None = None,
    rows: Tensor | None = None,
) -> Rendering:
    """Render Spacetime Gaussians at `time`; shapes and meanings as in `contract`."""
    rules = rules or Rules()
    check_pinhole(camera)
    check_spacetime(gaussians, background, density, rows)
    gaussians = listed(gaussians, rows)
    living = alive(gaussians, time, rules)

    def at_time(chosen: Tensor) -> Gaussians3D:
        return evaluate(SpacetimeTensors(*(array[chosen] for array in gaussians)), time, rules)

    return _render(at_time, living, camera, background, rules, density)


def alive(g: SpacetimeTensors, time: float, rules: Rules) -> Tensor:
    """Return the rows, (M,), that are finite and opaque enough at `time` to be seen."""
    with torch.no_grad():
        finite = _finite(g.means, g.motions, g.quats, g.omegas, g.log_scales, g.opacity_logits, g.features)
        finite &= torch.isfinite(g.trbf_centers) & ~torch.isnan(g.trbf_log_scales)
        rows = torch.nonzero(finite)[:, 0]
        opacities = _opacities(g.opacity_logits[rows], time - g.trbf_centers[rows], g.trbf_log_scales[rows])
        return rows[opacities >= rules.alpha_min]


def evaluate(g: SpacetimeTensors, time: float, rules: Rules | None = None) -> Gaussians3D:
    """Return the 3D Gaussians at `time` (Spacetime Gaussians, Eqs. 6-9)."""
    dt = time - g.trbf_centers
    moving = (dt.detach() if rules and rules.detach_motion_time else dt)[:, None]
    b = g.motions
    means = g.means + moving * (b[:, 0] + moving * (b[:, 1] + moving * b[:, 2]))
    quats = g.quats + moving * g.omegas
    opacities = _opacities(g.opacity_logits, dt, g.trbf_log_scales)
    return Gaussians3D(means, quats, g.log_scales.exp(), opacities, g.features)


def _opacities(logits: Tensor, dt: Tensor, log_widths: Tensor) -> Tensor:
    return torch.sigmoid(logits) * torch.exp(-((dt * torch.exp(-log_widths.clamp(min=MIN_LOG_WIDTH))) ** 2))


def _finite(*arrays: Tensor) -> Tensor:
    good = torch.ones(len(arrays[0]), dtype=torch.bool, device=arrays[0].device)
    for array in arrays:
        good &= torch.isfinite(array.reshape(len(array), math.prod(array.shape[1:]))).all(1)
    return good


def rotation_matrices(quats: Tensor) -> Tensor:
    """Return (N, 3, 3) rotations of (N, 4) quaternions w x y z of any length; zero length gives the identity."""
    lengths = quats.norm(dim=1, keepdim=True)
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=quats.dtype, device=quats.device)
    defined = lengths >= MIN_QUAT_NORM
    safe = torch.where(defined, quats, identity)
    w, x, y, z = (safe / safe.norm(dim=1, keepdim=True)).unbind(1)
    rows = (
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack(rows, 1).reshape(-1, 3, 3)


def project(g: Gaussians3D, rows: Tensor, camera: Camera, rules: Rules) -> Splats:
    """Project 3D Gaussians to the image (EWA splatting); keep those that can be drawn, in the order of depth."""
    pose = torch.tensor(camera.world_to_camera.tolist(), dtype=g.means.dtype, device=g.means.device)
    turn, shift = pose[:3, :3], pose[:3, 3]
    with torch.no_grad():
        z = g.means @ turn[2] + shift[2]
        front = torch.nonzero((z >= rules.near) & (z > 0))[:, 0]
    g, rows = Gaussians3D(*(array[front] for array in g)), rows[front]

    x, y, z = (g.means @ turn.T + shift).unbind(1)
    tan_x, tan_y = x / z, y / z
    margin = 0.5 * (rules.jacobian_clamp - 1)
    limits_x = [(edge * camera.width - camera.cx) / camera.fx for edge in (-margin, 1 + margin)]
    limits_y = [(edge * camera.height - camera.cy) / camera.fy for edge in (-margin, 1 + margin)]
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        (
            *(camera.fx / z, zero, -camera.fx * tan_x.clamp(*limits_x) / z),
            *(zero, camera.fy / z, -camera.fy * tan_y.clamp(*limits_y) / z),
        ),
        1,
    ).reshape(-1, 2, 3)
    spread = jacobian @ turn @ (rotation_matrices(g.quats) * g.scales[:, None, :])
    blur = rules.low_pass * torch.eye(2, dtype=z.dtype, device=z.device)
    covariance = spread @ spread.transpose(1, 2) + blur
    xx, xy, yy = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    determinant = xx * yy - xy * xy
    conics = torch.stack((yy, -xy, xx), 1) / determinant[:, None]
    means = torch.stack((camera.fx * tan_x + camera.cx, camera.fy * tan_y + camera.cy), 1)
    with torch.no_grad():
        good = (determinant > 0) & torch.isfinite(determinant) & _finite(means, conics)
        keep = torch.nonzero(good)[:, 0]
        keep = keep[torch.argsort(z[keep].to(torch.float32), stable=True)]
    arrays = (means, conics, torch.stack((xx, xy, yy), 1), z, g.opacities, g.features, rows)
    return Splats(*(array[keep] for array in arrays))


def bin_to_tiles(splats: Splats, width: int, height: int, rules: Rules) -> tuple[Tensor, Tensor]:
    """Return (tiles + 1,) offsets and the list of splats of each tile, front to back."""
    columns, tiles = -(-width // TILE), -(-width // TILE) * -(-height // TILE)
    with torch.no_grad():
        reach = 2 * torch.log(splats.opacities / rules.alpha_min)
        radii = torch.sqrt(reach[:, None].clamp(min=0) * splats.covariances[:, [0, 2]]) + 1e-3
        size = torch.tensor([width, height], dtype=radii.dtype, device=radii.device)
        first = torch.ceil(splats.means - radii - 0.5).clamp(min=0)
        last = torch.minimum(torch.floor(splats.means + radii - 0.5), size - 1)
        seen = (first <= last).all(1)
        first = torch.where(seen[:, None], first, 0).long() // TILE
        spans = torch.where(seen[:, None], torch.where(seen[:, None], last, 0).long() // TILE + 1 - first, 0)
        counts = spans.prod(1)
        splat = torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts)
        place = torch.arange(len(splat), device=counts.device) - (counts.cumsum(0) - counts)[splat]
        across = spans[splat, 0]
        tile = (first[splat, 1] + place // across) * columns + first[splat, 0] + place % across
        order = torch.argsort(tile, stable=True)
        offsets = torch.zeros(tiles + 1, dtype=torch.long, device=tile.device)
        offsets[1:] = torch.bincount(tile, minlength=tiles).cumsum(0)
        return offsets, splat[order]


def _groups(lengths: Tensor) -> Iterator[Tensor]:
    """Tiles that hold anything, in groups of about equal length, each small enough to composite at once."""
    order = torch.argsort(lengths)
    order = order[lengths[order] > 0]
    start = 0
    sizes = lengths[order].tolist()
    while start < len(sizes):
        end = start + 1
        while end < len(sizes) and (end + 1 - start) * sizes[end] * TILE * TILE <= GROUP_ELEMENTS:
            end += 1
        yield order[start:end]
        start = end


def _composite(
    means: Tensor,
    conics: Tensor,
    opacities: Tensor,
    values: Tensor,
    chosen: Tensor,
    valid: Tensor,
    origins: Tensor,
    rules: Rules,
) -> Tensor:
    """Return (tiles, pixels, channels + 1): the weighted sums of `values`, and the sum of the weights.

    `chosen` (tiles, K) are splats front to back, `valid` says which of them are real, `origins` (tiles, 2) in pixels.
    """
    line = torch.arange(TILE, device=chosen.device) + 0.5
    x = origins[:, 0, None, None] + line.repeat(TILE)
    y = origins[:, 1, None, None] + line.repeat_interleave(TILE)
    mean, conic = means[chosen], conics[chosen]
    dx, dy = x - mean[..., 0:1], y - mean[..., 1:2]
    power = -0.5 * (conic[..., 0:1] * dx * dx + conic[..., 2:3] * dy * dy) - conic[..., 1:2] * dx * dy
    alpha = (opacities[chosen][..., None] * torch.exp(power)).clamp(max=rules.alpha_max)
    alpha = torch.where((alpha >= rules.alpha_min) & valid[..., None], alpha, 0)
    after = torch.cumprod(1 - alpha, 1)
    before = torch.cat((torch.ones_like(after[:, :1]), after[:, :-1]), 1)
    # Once a Gaussian would take the transmittance under the limit, all later ones would too: the pixel is full.
    weights = torch.where(after >= rules.transmittance_min, alpha * before, 0)
    return torch.cat((torch.einsum("tkp,tkc->tpc", weights, values[chosen]), weights.sum(1)[..., None]), 2)


def composite(splats: Splats, width: int, height: int, rules: Rules) -> Tensor:
    """Return (H, W, C + 2): the sums of w feature, of w z, and of w over the Gaussians of each pixel."""
    columns, rows = -(-width // TILE), -(-height // TILE)
    offsets, lists = bin_to_tiles(splats, width, height, rules)
    lengths = offsets[1:] - offsets[:-1]
    values = torch.cat((splats.features, splats.depths[:, None]), 1)
    inputs = (splats.means, splats.conics, splats.opacities, values)
    recompute = torch.is_grad_enabled() and int(lengths.sum()) * TILE * TILE > GRAPH_ELEMENTS
    parts, places = [values.new_zeros(0, TILE * TILE, values.shape[1] + 1)], [lengths[:0]]
    for tiles in _groups(lengths):
        place = torch.arange(int(lengths[tiles].max()), device=tiles.device)
        valid = place < lengths[tiles][:, None]
        chosen = lists[torch.where(valid, offsets[tiles][:, None] + place, 0)]
        origins = torch.stack((tiles % columns, tiles // columns), 1) * TILE
        if recompute:
            part = checkpoint(_composite, *inputs, chosen, valid, origins, rules, use_reentrant=False)
        else:
            part = _composite(*inputs, chosen, valid, origins, rules)
        parts.append(part)
        places.append(tiles)
    picture = values.new_zeros(rows * columns, TILE * TILE, values.shape[1] + 1)
    picture = picture.index_copy(0, torch.cat(places), torch.cat(parts))
    picture = picture.reshape(rows, columns, TILE, TILE, -1).transpose(1, 2).reshape(rows * TILE, columns * TILE, -1)
    return picture[:height, :width]


def _render(
    gaussians_at: Callable[[Tensor], Gaussians3D],
    rows: Tensor,
    camera: Camera,
    background: Tensor | None,
    rules: Rules,
    density: DensityStats | None,
) -> Rendering:
    with torch.no_grad():  # what cannot be drawn must not come near autograd: zero times infinity is NaN
        rows = project(gaussians_at(rows), rows, camera, rules).rows
    splats = project(gaussians_at(rows), rows, camera, rules)
    if density is not None:
        _watch_density(splats, camera, rules, density)
    sums = composite(splats, camera.width, camera.height, rules)
    features, weighted_z, alpha = sums[..., :-2], sums[..., -2], sums[..., -1]
    if background is not None:
        features = features + (1 - alpha)[..., None] * background.to(features.dtype)
    covered = alpha > 0
    depth = torch.where(covered, weighted_z / torch.where(covered, alpha, 1), 0)
    return Rendering(features, alpha, depth)


def _watch_density(splats: Splats, camera: Camera, rules: Rules, density: DensityStats) -> None:
    """Let the backward pass add to `density`."""
    if not splats.means.requires_grad:
        return
    _, lists = bin_to_tiles(splats, camera.width, camera.height, rules)
    seen = torch.zeros(len(splats.rows), dtype=torch.bool, device=lists.device)
    seen[lists] = True
    rows, (xx, xy, yy) = splats.rows[seen], splats.covariances.detach()[seen].unbind(1)
    longest = 0.5 * (xx + yy) + torch.sqrt((0.5 * (xx - yy)) ** 2 + xy**2)
    radii = (3 * longest.sqrt()).to(density.radius_px.dtype)

    def add(gradient: Tensor) -> None:
        density.gradient[rows] += gradient[seen].norm(dim=1).to(density.gradient.dtype)
        density.views[rows] += 1
        density.radius_px[rows] = torch.maximum(density.radius_px[rows], radii)

    splats.means.register_hook(add)


def decode(features: Tensor, camera: Camera, hidden: Tensor, output: Tensor, activation: str) -> Tensor:
    """Turn the features of a full model's rendering into colors; shapes and meanings as in `contract`.

    Takes any lens; a pixel where it sees nothing is black.
    """
    check_decoder(features, camera, hidden, output, activation)
    origin = torch.tensor(camera.center.tolist(), dtype=features.dtype, device=features.device)
    rays = directions(camera, features)
    units = features[..., 3:] @ hidden[:, :6].T + rays @ hidden[:, 9:].T
    colors = features[..., :3] + torch.relu(units + hidden[:, 6:9] @ origin) @ output.T
    if activation != "none":
        colors = torch.sigmoid(colors) if activation == "sigmoid" else colors.clamp(0, 1)
    return colors if camera.model == "PINHOLE" else colors * rays.any(dim=2, keepdim=True)


def directions(camera: Camera, like: Tensor) -> Tensor:
    """Return (H, W, 3) unit directions in the world through all pixel centers, where and as `like` is.

    They are 0 where the lens sees nothing.
    """
    turn = torch.tensor(camera.world_to_camera[:3, :3].tolist(), dtype=like.dtype, device=like.device)
    if camera.model != "PINHOLE":
        return _lens_directions(lens_of(camera), like.device, like.dtype) @ turn
    x, y = (
        ((torch.arange(count, dtype=torch.float64) + 0.5 - center) / focal).to(like.device, like.dtype)
        for count, center, focal in (
            (camera.width, camera.cx, camera.fx),
            (camera.height, camera.cy, camera.fy),
        )
    )
    local = torch.stack((*torch.meshgrid(x, y, indexing="xy"), torch.ones_like(x).expand(len(y), len(x))), 2)
    return torch.nn.functional.normalize(local, dim=2) @ turn


@lru_cache(maxsize=64)
def _lens_directions(lens: Lens, device: torch.device, dtype: torch.dtype) -> Tensor:
    """The same in camera axes; those of the last 64 lenses are kept (12 bytes per pixel each), since they are dear."""
    camera = camera_of(lens)
    _, rays = camera.rays()
    return torch.from_numpy(np.nan_to_num(rays)).reshape(camera.height, camera.width, 3).to(device, dtype)


def native_lens(camera: Camera) -> bool:
    """Return whether the lens can be drawn as it is: pinholes alone (but `decode` takes any)."""
    return camera.model == "PINHOLE"


def warp(rendering: Rendering, lens: Warp, background: Tensor | None = None) -> Rendering:
    """Return what a lens sees of its pinhole's rendering; as in `contract`."""
    return lens.see(rendering, background)


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """Return the SSIM (C, 1, H, W) of two (H, W, C) images: 11 x 11 Gaussian window of sigma 1.5, zero padding."""
    offsets = torch.arange(-5, 6, dtype=image.dtype, device=image.device)
    line = torch.exp(-(offsets**2) / (2 * 1.5**2))
    line = line / line.sum()

    def blur(picture: Tensor) -> Tensor:
        channels = picture.permute(2, 0, 1)[:, None]
        rows = torch.nn.functional.conv2d(channels, line[None, None, None, :], padding=(0, 5))
        return torch.nn.functional.conv2d(rows, line[None, None, :, None], padding=(5, 0))

    c1, c2 = 0.01**2, 0.03**2
    x, y = blur(image), blur(target)
    xx, yy, xy = blur(image * image) - x * x, blur(target * target) - y * y, blur(image * target) - x * y
    return (2 * x * y + c1) * (2 * xy + c2) / ((x * x + y * y + c1) * (xx + yy + c2))


def picture_loss(image: Tensor, target: Tensor, weight_dssim: float) -> PictureLoss:
    """Return the training loss and the mean squared error of two images, as in `contract`."""
    check_images(image, target)
    target = target.to(image.dtype) / 255 if target.dtype == torch.uint8 else target
    difference = image - target
    loss = (1 - weight_dssim) * difference.abs().mean() + weight_dssim * (1 - ssim_map(image, target).mean())
    return PictureLoss(loss, float(difference.detach().square().mean()))


def l1_dssim(image: Tensor, target: Tensor, weight_dssim: float) -> Tensor:
    """Return the training loss of two images alone."""
    return picture_loss(image, target, weight_dssim).loss


def adam(groups: Sequence[AdamGroup], beta1: float, beta2: float, eps: float, step: int) -> None:
    """Take one step of Adam, in place, as in `contract`."""
    check_adam(groups, step)
    with torch.no_grad():
        for group in groups:
            value, gradient = group.value, group.gradient
            group.mean.mul_(beta1).add_(gradient, alpha=1 - beta1)
            group.mean_square.mul_(beta2).addcmul_(gradient, gradient, value=1 - beta2)
            spread = group.mean_square.sqrt().div_(math.sqrt(1 - beta2**step)).add_(eps)
            move = (group.mean / spread).mul_(group.rate / (1 - beta1**step))
            if group.row_rates is not None:
                move *= group.row_rates.reshape(-1, *[1] * (value.ndim - 1))
            if group.column_rates is not None:
                move *= group.column_rates.reshape(value.shape[1:])
            value.sub_(move).clamp_(group.low, group.high)
