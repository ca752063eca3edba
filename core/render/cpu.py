# SPDX-License-Identifier: GPL-3.0-or-later
"""The `cpu` backend: the compiled kernels as differentiable torch functions. `contract` says what they compute."""

import ctypes
import math
import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..camera import Camera
from ..errors import HoloreelError
from .checks import check_adam, check_decoder, check_gaussians, check_images, check_pinhole, check_spacetime
from .contract import ACTIVATIONS, AdamGroup, DensityStats, PictureLoss, Rendering, Rules, SpacetimeTensors, listed
from .native import (
    PARAMETERS,
    TIMINGS,
    CAdamGroup,
    CCamera,
    CDecoder,
    CGaussians,
    CGradients,
    CImageGradients,
    CImages,
    CRules,
    CTimings,
    CWarp,
    get_threads,
    load_kernels,
    set_lanes,
    set_threads,
)
from .warp import Warp

DEVICE = "cpu"

__all__ = [
    "DEVICE",
    "adam",
    "decode",
    "get_threads",
    "l1_dssim",
    "load_kernels",
    "native_lens",
    "picture_loss",
    "rasterize",
    "rasterize_spacetime",
    "set_lanes",
    "set_threads",
    "warp",
]


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
    """Render 3D Gaussians; shapes and meanings as in `contract`. Everything is computed in float32 on the CPU."""
    rules = rules or Rules()
    check_pinhole(camera)
    check_gaussians(means, quats, scales, opacities, features, background, density)
    job = _Job(camera, rules, None, density)
    arrays = (means, None, quats, None, scales, opacities, features, None, None)
    return _render(job, background, arrays)


def rasterize_spacetime(
    gaussians: SpacetimeTensors,
    time: float,
    camera: Camera,
    background: Tensor | None = None,
    rules: Rules | None = None,
    density: DensityStats | None = None,
    rows: Tensor | None = None,
) -> Rendering:
    """Render Spacetime Gaussians at `time`; shapes and meanings as in `contract`. float32 on the CPU."""
    rules = rules or Rules()
    check_pinhole(camera)
    check_spacetime(gaussians, background, density, rows)
    if rows is not None:
        rows = rows.to("cpu").contiguous()
        learning = torch.is_grad_enabled() and any(array.requires_grad for array in gaussians)
        if learning or len(rows) == 0:  # the kernels have no backward pass for a list, and an empty one has no address
            gaussians, rows = listed(gaussians, rows), None
    return _render(_Job(camera, rules, float(time), density, rows), background, tuple(gaussians))


@dataclass
class _Job:
    """What a rendering depends on beside tensors. `time` is None for 3D Gaussians."""

    camera: Camera
    rules: Rules
    time: float | None
    density: DensityStats | None
    rows: Tensor | None = None

    def c_rules(self) -> CRules:
        r = self.rules
        return CRules(
            *(r.alpha_max, r.alpha_min, r.transmittance_min, r.low_pass, r.near, r.jacobian_clamp),
            *(r.detach_motion_time, r.cull_faded),
        )

    def c_gaussians(self, arrays: tuple[Tensor | None, ...]) -> CGaussians:
        features = arrays[PARAMETERS.index("features")]
        assert features is not None
        spacetime = self.time is not None
        listed = 0 if self.rows is None else len(self.rows)
        return CGaussians(
            *(len(features), features.shape[1], spacetime, self.time or 0.0),
            *map(_address, (*arrays, self.rows)),
            listed,
        )


class _Frame:
    """What the forward pass left in the library for the backward pass; given back when nobody needs it any more."""

    def __init__(self, handle: int) -> None:
        self.handle = handle
        self.library = load_kernels()

    def __del__(self) -> None:
        self.library.holoreel_frame_free(self.handle)

    def timings(self) -> dict[str, float]:
        """Seconds per stage of the latest passes."""
        timings = CTimings()
        self.library.holoreel_frame_timings(self.handle, timings)
        return {name: getattr(timings, name) for name in TIMINGS}

    @property
    def intersections(self) -> int:
        """How many pairs of a Gaussian and a tile there are."""
        return self.library.holoreel_frame_intersections(self.handle)


class _Memory:
    """Memory of large tensors that nobody holds any more, for the next ones: fresh pages are dear."""

    SMALL, LIMIT = 1 << 14, 1 << 28  # bytes of one that is not worth it, and of all that may wait here

    def __init__(self) -> None:
        self.spare: dict[int, list[np.ndarray]] = {}
        self.bytes = 0

    def empty(self, *shape: int) -> Tensor:
        """Return a float32 tensor of any contents."""
        size = math.prod(shape)
        if 4 * size < self.SMALL:
            return torch.empty(shape)
        waiting = self.spare.get(size)
        if waiting:
            memory = waiting.pop()
            self.bytes -= memory.nbytes
        else:
            memory = np.empty(size, np.float32)
        view = memory.view()  # which the tensor holds, so its end is the tensor's
        weakref.finalize(view, self._give_back, memory).atexit = False
        return torch.from_numpy(view).reshape(shape)

    def _give_back(self, memory: np.ndarray) -> None:
        if self.bytes + memory.nbytes > self.LIMIT:  # sizes have changed, or pictures are huge
            self.spare, self.bytes = {}, 0
        if memory.nbytes <= self.LIMIT:
            self.spare.setdefault(memory.size, []).append(memory)
            self.bytes += memory.nbytes


_memory = _Memory()


def _c_camera(camera: Camera) -> CCamera:
    pose = (ctypes.c_double * 12)(*camera.world_to_camera[:3].ravel().tolist())
    return CCamera(camera.fx, camera.fy, camera.cx, camera.cy, pose, camera.width, camera.height)


def _address(tensor: Tensor | None) -> int | None:
    return None if tensor is None else tensor.data_ptr()


def _plain(tensor: Tensor | None) -> Tensor | None:
    return None if tensor is None else tensor.to("cpu", torch.float32).contiguous()


def _render(job: _Job, background: Tensor | None, arrays: tuple[Tensor | None, ...]) -> Rendering:
    arrays = tuple(_plain(array) for array in arrays)
    return Rendering(*_Rasterize.apply(job, _plain(background), *arrays))


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, job: _Job, background: Tensor | None, *arrays: Tensor | None) -> tuple[Tensor, ...]:
        channels = arrays[PARAMETERS.index("features")].shape[1]  # type: ignore[union-attr]
        height, width = job.camera.height, job.camera.width
        pictures = tuple(_memory.empty(height, width, *more) for more in ((channels,), (), ()))
        rest = _memory.empty(height, width)
        images = CImages(*map(_address, (*pictures, rest, background)))
        library = load_kernels()
        handle = library.holoreel_forward(job.c_gaussians(arrays), _c_camera(job.camera), job.c_rules(), images)
        if not handle:
            raise HoloreelError(f"The picture cannot be rendered: {library.holoreel_last_error().decode()}.")
        ctx.frame = _Frame(handle)
        ctx.job = job
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(background, *pictures, rest, *arrays)
        return pictures

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *picture_gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        background, features, alpha, depth, rest, *arrays = ctx.saved_tensors
        incoming = tuple(_plain(gradient) for gradient in picture_gradients)
        outgoing = tuple(
            _memory.empty(*array.shape) if array is not None and needed else None
            for array, needed in zip(arrays, ctx.needs_input_grad[2:], strict=True)
        )
        density = ctx.job.density
        statistics = (density.gradient, density.views, density.radius_px) if density else (None, None, None)
        library = load_kernels()
        status = library.holoreel_backward(
            ctx.frame.handle,
            ctx.job.c_gaussians(tuple(arrays)),
            _c_camera(ctx.job.camera),
            ctx.job.c_rules(),
            CImages(*map(_address, (features, alpha, depth, rest, background))),
            CImageGradients(*map(_address, incoming)),
            CGradients(*map(_address, outgoing), *map(_address, statistics)),
        )
        if status != 0:
            raise HoloreelError(f"The gradient cannot be computed: {library.holoreel_last_error().decode()}.")
        background_gradient = None
        if ctx.needs_input_grad[1] and incoming[0] is not None:
            background_gradient = torch.einsum("hwc,hw->c", incoming[0].double(), rest.double()).float()
        return None, background_gradient, *outgoing


def decode(features: Tensor, camera: Camera, hidden: Tensor, output: Tensor, activation: str) -> Tensor:
    """Turn the features of a full model's rendering into colors; shapes and meanings as in `contract`. float32."""
    check_pinhole(camera)
    check_decoder(features, camera, hidden, output, activation)
    return _Decode.apply(_plain(features), camera, _plain(hidden), _plain(output), ACTIVATIONS.index(activation))


class _Decode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features: Tensor, camera: Camera, hidden: Tensor, output: Tensor, activation: int) -> Tensor:
        image = _memory.empty(camera.height, camera.width, 3)
        decoder = CDecoder(_address(hidden), _address(output), activation, 0)
        library = load_kernels()
        if library.holoreel_decode(_c_camera(camera), decoder, _address(features), _address(image)) != 0:
            raise HoloreelError(f"The picture cannot be decoded: {library.holoreel_last_error().decode()}.")
        ctx.camera, ctx.activation = camera, activation
        ctx.save_for_backward(features, hidden, output)
        return image

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        features, hidden, output = ctx.saved_tensors
        d_features = _memory.empty(*features.shape) if ctx.needs_input_grad[0] else None
        d_hidden, d_output = torch.empty_like(hidden), torch.empty_like(output)
        incoming = _plain(gradient)  # keeps it alive during the call
        library = load_kernels()
        status = library.holoreel_decode_backward(
            _c_camera(ctx.camera),
            CDecoder(_address(hidden), _address(output), ctx.activation, 0),
            *map(_address, (features, incoming, d_features, d_hidden, d_output)),
        )
        if status != 0:
            raise HoloreelError(f"The gradient cannot be computed: {library.holoreel_last_error().decode()}.")
        return d_features, None, d_hidden, d_output, None


def native_lens(camera: Camera) -> bool:
    """Return whether the lens can be drawn as it is: pinholes alone."""
    return camera.model == "PINHOLE"


def warp(rendering: Rendering, lens: Warp, background: Tensor | None = None) -> Rendering:
    """Return what a lens sees of its pinhole's rendering; as in `contract`. float32; up to 14 channels."""
    lens.check(rendering.features)
    return Rendering(*_See.apply(lens, _plain(background), *map(_plain, rendering)))


class _See(torch.autograd.Function):
    """Colors, alpha and alpha · depth are warped in one pass; backward, only what has a gradient."""

    @staticmethod
    def forward(
        ctx: Any, lens: Warp, background: Tensor | None, color: Tensor, alpha: Tensor, depth: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        channels = color.shape[2]
        layers = _memory.empty(*alpha.shape, channels + 2)
        layers[..., :channels], layers[..., channels] = color, alpha
        torch.mul(alpha, depth, out=layers[..., channels + 1])
        seen = warp_layers(layers, lens)
        raw = seen[..., channels]
        seen_alpha = raw.clamp(0.0, 1.0)
        inverse = seen_alpha.reciprocal().masked_fill_(seen_alpha == 0.0, 0.0)
        seen_depth = seen[..., channels + 1] * inverse
        seen_color = seen[..., :channels].contiguous()
        if background is not None and not ctx.needs_input_grad[1] and not background.any():
            background = None
        if background is not None:
            seen_color.addcmul_((1.0 - seen_alpha)[..., None], background)
        ctx.lens = lens
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(background, alpha, depth, seen_alpha, seen_depth, inverse, raw == seen_alpha)
        return seen_color, seen_alpha, seen_depth

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, d_color: Tensor | None, d_alpha: Tensor | None, d_depth: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        background, alpha, depth, seen_alpha, seen_depth, inverse, unclamped = ctx.saved_tensors
        d_background = None
        if background is not None and d_color is not None:
            behind = -(d_color @ background)
            d_alpha = behind if d_alpha is None else d_alpha + behind
            if ctx.needs_input_grad[1]:
                d_background = torch.einsum("hwc,hw->c", d_color.double(), 1.0 - seen_alpha.double()).float()
        d_weighted = None
        if d_depth is not None:
            d_weighted = d_depth * inverse
            d_alpha = -d_weighted * seen_depth if d_alpha is None else d_alpha - d_weighted * seen_depth
        if d_alpha is not None:
            d_alpha = (d_alpha * unclamped)[..., None]
        parts = (d_color, d_alpha, None if d_weighted is None else d_weighted[..., None])
        given = [part for part in parts if part is not None]
        if not given:
            return (None,) * 5
        found = iter(spread_layers(torch.cat(given, dim=2), ctx.lens).split([part.shape[2] for part in given], dim=2))
        d_color, d_alpha, d_weighted = (None if part is None else next(found) for part in parts)
        d_alpha = None if d_alpha is None else d_alpha[..., 0]
        if d_weighted is not None:
            d_alpha, d_depth = d_alpha + d_weighted[..., 0] * depth, d_weighted[..., 0] * alpha
        return None, d_background, d_color, d_alpha, d_depth


def warp_layers(layers: Tensor, lens: Warp) -> Tensor:
    """Return what `lens.apply` does of a float32 picture (H', W', C) on the CPU, C 1 to 16."""
    picture = _memory.empty(*lens.valid.shape, layers.shape[2])
    library = load_kernels()
    if library.holoreel_warp(_c_warp(lens, layers.shape[2]), _address(layers), _address(picture)) != 0:
        raise HoloreelError(f"The picture cannot be warped: {library.holoreel_last_error().decode()}.")
    return picture


def spread_layers(gradient: Tensor, lens: Warp) -> Tensor:
    """Return the gradient of the layers from that of what was warped, (H, W, C)."""
    incoming = _plain(gradient)
    outgoing = _memory.empty(lens.pinhole.height, lens.pinhole.width, gradient.shape[2])
    library = load_kernels()
    described = _c_warp(lens, gradient.shape[2], _spans(lens))
    if library.holoreel_warp_backward(described, _address(incoming), _address(outgoing)) != 0:
        raise HoloreelError(f"The gradient cannot be computed: {library.holoreel_last_error().decode()}.")
    return outgoing


WARP_BLOCK = 64  # kWarpBlock in kernels/raster.hpp


def _spans(lens: Warp) -> Tensor:
    """What rows of the pinhole's picture each block of pixels looks at: found once per lens, 1/8 byte per pixel."""
    if "spans" not in lens.kept:
        height, width = lens.valid.shape
        spans = torch.empty(height, -(-width // WARP_BLOCK), 2, dtype=torch.int32)
        library = load_kernels()
        if library.holoreel_warp_spans(_c_warp(lens, 1), _address(spans)) != 0:
            raise HoloreelError(f"The picture cannot be warped: {library.holoreel_last_error().decode()}.")
        lens.kept["spans"] = spans
    return lens.kept["spans"]


def _c_warp(lens: Warp, channels: int, spans: Tensor | None = None) -> CWarp:
    height, width = lens.valid.shape
    return CWarp(
        *map(_address, (lens.places, lens.valid, spans)),
        *(width, height, lens.pinhole.width, lens.pinhole.height, channels, lens.samples),
    )


def picture_loss(image: Tensor, target: Tensor, weight_dssim: float) -> PictureLoss:
    """Return the training loss and the mean squared error of two images, as in `contract`, in float32."""
    check_images(image, target)
    plain = target.contiguous() if target.dtype == torch.uint8 else _plain(target)
    loss, squared_error = _PictureLoss.apply(_plain(image), plain, float(weight_dssim))
    return PictureLoss(loss, squared_error)


def l1_dssim(image: Tensor, target: Tensor, weight_dssim: float) -> Tensor:
    """Return the training loss of two images alone."""
    return picture_loss(image, target, weight_dssim).loss


class _PictureLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, weight: float) -> tuple[Tensor, float]:
        # The gradient comes almost for free with the value, so it is taken at once.
        gradient = _memory.empty(*image.shape) if ctx.needs_input_grad[0] else None
        loss, squared_error = ctypes.c_double(), ctypes.c_double()
        library = load_kernels()
        targets = (None, _address(target)) if target.dtype == torch.uint8 else (_address(target), None)
        status = library.holoreel_l1_dssim(
            _address(image), *targets, *image.shape, weight, loss, squared_error, _address(gradient)
        )
        if status != 0:
            raise HoloreelError(f"The loss cannot be computed: {library.holoreel_last_error().decode()}.")
        ctx.gradient = gradient
        return torch.tensor(loss.value, dtype=torch.float32), squared_error.value

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor, _: object) -> tuple[Tensor | None, None, None]:
        if ctx.gradient is None:
            return None, None, None
        return (ctx.gradient if float(gradient) == 1.0 else ctx.gradient * gradient), None, None


def adam(groups: Sequence[AdamGroup], beta1: float, beta2: float, eps: float, step: int) -> None:
    """Take one step of Adam, in place, as in `contract`."""
    check_adam(groups, step)
    kept = [(_plain(group.row_rates), _plain(group.column_rates)) for group in groups]  # alive during the call
    array = (CAdamGroup * len(groups))(
        *(
            CAdamGroup(
                *map(_address, group[:4]),
                *map(_address, rates),
                len(group.value),
                math.prod(group.value.shape[1:]),
                group.rate,
                group.low,
                group.high,
            )
            for group, rates in zip(groups, kept, strict=True)
        )
    )
    load_kernels().holoreel_adam_step(array, len(groups), beta1, beta2, eps, step)
