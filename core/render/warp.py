# SPDX-License-Identifier: GPL-3.0-or-later
"""Lenses with distortion, drawn by rasterizers that know pinholes alone: warp a pinhole's picture (paper, Sec. 5.1).

A virtual pinhole at the same place looks the same way and covers what the real lens sees. Its picture is sampled where
the rays through the real pixels meet it: each real pixel is the mean of n x n bicubic samples, placed by a smooth map
of one position per pixel. Everything is linear in the picture, hence differentiable, on any device.
"""

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from ..camera import MAX_SIZE, Camera
from ..errors import HoloreelError
from .contract import Rendering

RESOLUTION = 1.0  # of the virtual picture's middle, in pixels per pixel of the real one
MAX_AREA = 4.0  # of the virtual picture, in areas of the real one: the paper's "twice the size"
MAX_FIELD_DEGREES = 150.0  # what the virtual pinhole covers at most, across and down
SAMPLES = (
    2  # n, where the virtual picture is finer than the real one; elsewhere 1 is near enough, in a quarter the time
)
_FINER = 1.75  # virtual pixels per real pixel, along one side, from which on it counts as finer
_MARGIN = 3  # virtual pixels around what is seen, for the bicubic kernel and rounding


@dataclass(frozen=True, eq=False)
class Warp:
    """How one camera's pictures come from those of its virtual pinhole.

    `apply` and `see` are the plain torch way; on the CPU, the compiled kernels do the same.
    """

    pinhole: Camera
    valid: Tensor  # (H, W) bool, on the CPU: where the real lens sees something that the pinhole covers
    samples: int  # n
    places: Tensor  # (H + 2, W + 2, 2): pixel of the virtual picture, for real pixels and one around the border
    kept: dict[Any, Any] = field(default_factory=dict)  # what was derived from the places, for the next picture

    def apply(self, image: Tensor) -> Tensor:
        """Warp (H', W', C), drawn by `pinhole`, to the real lens's (H, W, C); 0 where `valid` is false."""
        camera = self.pinhole
        self.check(image)
        places, valid = self._at(image.device)
        grid = places.to(image.dtype) * (2.0 / image.new_tensor([camera.width, camera.height])) - 1.0
        grid = _refined(grid, self.samples)
        picture = functional.grid_sample(
            image.permute(2, 0, 1)[None], grid[None], "bicubic", "zeros", align_corners=False
        )
        if self.samples > 1:
            picture = functional.avg_pool2d(picture, self.samples)
        return picture[0].permute(1, 2, 0) * valid[..., None]

    def see(self, rendering: Rendering, background: Tensor | None = None) -> Rendering:
        """Warp a rendering over black: `warp` of the `contract`, in plain torch."""
        color, alpha, depth = rendering
        # Depth is a mean weighted by alpha: both parts of the fraction are warped.
        layers = self.apply(torch.cat([color, alpha[..., None], (alpha * depth)[..., None]], dim=2))
        color, alpha, weighted = layers[..., :-2], layers[..., -2].clamp(0.0, 1.0), layers[..., -1]
        seen = alpha > 0.0
        depth = torch.where(seen, weighted / torch.where(seen, alpha, 1.0), 0.0)
        if background is not None:
            color = color + (1.0 - alpha)[..., None] * background.to(color.device)
        return Rendering(color, alpha, depth)

    def check(self, image: Tensor) -> None:
        """Raise ValueError unless the image is as large as `pinhole` draws it."""
        camera = self.pinhole
        if image.ndim != 3 or image.shape[:2] != (camera.height, camera.width):
            raise ValueError(f"image has shape {tuple(image.shape)}, not ({camera.height}, {camera.width}, C)")

    def _at(self, device: torch.device) -> tuple[Tensor, Tensor]:
        if device not in self.kept:
            self.kept[device] = self.places.to(device), self.valid.to(device)
        return self.kept[device]


def lens_warp(camera: Camera) -> Warp:
    """Return the warp of a camera; those of the last 64 lenses are kept (8 bytes per pixel each).

    Raises `HoloreelError` for a lens that sees nothing.
    """
    warp = _lens_warp(lens_of(camera))
    return replace(warp, pinhole=replace(warp.pinhole, world_to_camera=camera.world_to_camera, name=camera.name))


class Lens(NamedTuple):
    """A camera without its place, as a key."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: str
    distortion: tuple[float, ...]


def lens_of(camera: Camera) -> Lens:
    """Return what all cameras with the same lens share."""
    return Lens(*(getattr(camera, name) for name in Lens._fields))


def camera_of(lens: Lens) -> Camera:
    """Return the camera with this lens that stands at the origin."""
    return Camera(**lens._asdict())


@lru_cache(maxsize=64)
def _lens_warp(lens: Lens) -> Warp:
    return make_warp(camera_of(lens))


def make_warp(real: Camera, resolution: float = RESOLUTION, samples: int = SAMPLES) -> Warp:
    """Return the warp of a camera that stands at the origin, with a virtual picture of a given resolution."""
    slopes = _slopes(real)  # (H + 2, W + 2, 2) of rays, x/z and y/z
    limit = math.tan(math.radians(MAX_FIELD_DEGREES) / 2)
    covered = (np.abs(slopes) <= limit).all(axis=2)  # NaN is not
    # Sampling inside a pixel takes its neighbors' rays too.
    valid = np.asarray(sliding_window_view(covered, (3, 3)).all(axis=(2, 3)))
    if not valid.any():
        raise HoloreelError(f"camera {real.name!r}: its {real.model} lens sees nothing; check its distortion.")
    seen = slopes[covered]
    pinhole = _pinhole(real, seen.min(axis=0), seen.max(axis=0), resolution)
    places = slopes * (pinhole.fx, pinhole.fy) + (pinhole.cx, pinhole.cy)
    finest = _finest(places, valid)
    places[~covered] = -8.0
    return Warp(
        pinhole,
        torch.from_numpy(valid),
        samples if finest > _FINER else 1,
        torch.from_numpy(places.astype(np.float32)),
    )


def _slopes(camera: Camera) -> NDArray[np.float64]:
    """x/z and y/z of the rays through all pixel centers and those one pixel beyond the border; NaN where none is."""
    v, u = np.mgrid[-1 : camera.height + 1, -1 : camera.width + 1] + 0.5
    _, rays = replace(camera, world_to_camera=np.eye(4)).rays(np.stack([u.ravel(), v.ravel()], axis=1))
    with np.errstate(divide="ignore", invalid="ignore"):
        slopes = np.where(rays[:, 2:] > 0, rays[:, :2] / rays[:, 2:], np.nan)
    return slopes.reshape(camera.height + 2, camera.width + 2, 2)


def _pinhole(real: Camera, low: NDArray[np.float64], high: NDArray[np.float64], resolution: float) -> Camera:
    """The pinhole that covers slopes from `low` to `high`: as fine as asked for, but of no more than MAX_AREA."""
    focal = np.array([real.fx, real.fy])
    middle = np.array([real.cx, real.cy])
    extent = (high - low) * focal
    size = np.array([real.width, real.height])
    resolution = min(resolution, math.sqrt(MAX_AREA * float(size.prod()) / float(extent.prod())))
    focal = focal * resolution
    # The principal points of both pictures lie at the same place inside a pixel, so that no lens is no change.
    corner = np.floor(low * focal + middle) - _MARGIN
    width, height = (min(math.ceil(side) + _MARGIN, MAX_SIZE) for side in high * focal + middle - corner)
    fx, fy, cx, cy = (float(value) for value in (*focal, *(middle - corner)))
    return Camera(width, height, fx, fy, cx, cy)


def _finest(places: NDArray[np.float64], valid: NDArray[np.bool_]) -> float:
    """How many virtual pixels a real pixel spans along its longer side, at the 90th percentile."""
    across = np.linalg.norm(places[1:-1, 2:] - places[1:-1, :-2], axis=2)[valid] / 2
    down = np.linalg.norm(places[2:, 1:-1] - places[:-2, 1:-1], axis=2)[valid] / 2
    return float(np.quantile(np.maximum(across, down), 0.9))


def _refined(grid: Tensor, n: int) -> Tensor:
    """Interpolate (H + 2, W + 2, 2) positions at pixel centers to (n H, n W, 2), those of n x n parts of the pixels."""
    if n == 1:
        return grid[1:-1, 1:-1]
    fine = functional.interpolate(grid.permute(2, 0, 1)[None], scale_factor=n, mode="bilinear", align_corners=False)
    return fine[0].permute(1, 2, 0)[n:-n, n:-n]
