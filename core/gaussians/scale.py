# SPDX-License-Identifier: GPL-3.0-or-later
"""Lengths of a scene, so that neither its unit nor how its cameras stand matters to a setting."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from ..camera import Camera
from ..capture import Capture
from ..errors import HoloreelError

Measure = Callable[[Tensor], Tensor]  # means (N, 3) -> (N,) lengths

NEAREST = 0.001  # points nearer than this part of those that a camera sees are strays
SAMPLE = 50_000  # points are enough to measure a scene


@dataclass(frozen=True)
class SceneScale:
    """What the training cameras say about lengths. Cones stand for what cameras see, so that any lens will do."""

    footprint: float
    """what one pixel covers at the seeds, the median, in world units"""
    nearest: float
    """the smallest distance of any seed to a training camera that sees it"""
    centers: Tensor
    """(K, 3) centers of the training cameras"""
    extent: float
    """1.1 times the largest distance of a training camera from the middle of them all, as the authors measure"""
    box: Tensor
    """(2, 3) lowest and highest corner of the seeds"""
    axes: Tensor
    """(K, 3) where the cameras look, unit vectors"""
    cosines: Tensor
    """(K,) cosine of the angle between a camera's axis and the corner of its picture"""
    focals: Tensor
    """(K,) focal lengths in pixels"""

    def to(self, device: str) -> "SceneScale":
        """Return the same with its tensors on a device."""
        return replace(
            self,
            centers=self.centers.to(device),
            box=self.box.to(device),
            axes=self.axes.to(device),
            cosines=self.cosines.to(device),
            focals=self.focals.to(device),
        )

    def footprints(self, means: Tensor) -> Tensor:
        """Return what one pixel of the nearest camera that sees it covers at each of `means` (N, 3), (N,).

        Where no camera looks, the nearest one counts.
        """
        best = torch.full((len(means),), math.inf, device=means.device)
        seen_best = best.clone()
        for center, axis, cosine, focal in zip(self.centers, self.axes, self.cosines, self.focals, strict=True):
            offset = means - center
            distance = offset.norm(dim=1)
            seen = offset @ axis >= cosine * distance
            best = torch.minimum(best, distance / focal)
            seen_best = torch.minimum(seen_best, torch.where(seen, distance / focal, math.inf))
        smallest = 0.1 * self.nearest / float(self.focals.max())
        return torch.where(seen_best.isfinite(), seen_best, best).clamp(min=smallest)

    def extents(self, means: Tensor) -> Tensor:
        """Return the extent of the cameras for each of `means` (N, 3), (N,)."""
        return torch.full((len(means),), self.extent, device=means.device)


def measure_scene(capture: Capture, points: ArrayLike) -> SceneScale:
    """Measure a scene with the training cameras of a capture and its seed points (N, 3); there must be one of each.

    Raises `HoloreelError` where no camera sees a point.
    """
    xyz = np.asarray(points, np.float64)
    sample = xyz[:: -(-len(xyz) // SAMPLE)]
    cameras = [capture.cameras[name] for name in capture.camera_names("train")]
    centers = np.stack([camera.center for camera in cameras])
    axes = np.stack([camera.world_to_camera[2, :3] for camera in cameras])
    cosines = np.array([_cone(camera) for camera in cameras])
    focals = np.array([math.sqrt(camera.fx * camera.fy) for camera in cameras])
    footprints, nearest = [], math.inf
    for center, axis, cosine, focal in zip(centers, axes, cosines, focals, strict=True):
        distance = np.linalg.norm(sample - center, axis=1)
        seen = distance[(sample - center) @ axis >= cosine * distance]
        if len(seen):
            footprints.append(np.median(seen) / focal)
            nearest = min(nearest, float(np.quantile(seen, NEAREST)))
    if not footprints:
        raise HoloreelError(
            f"{capture.source}: no training camera sees any of the capture's seed points; "
            "check that points and cameras share one world."
        )
    spread = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
    footprint = float(np.median(footprints))
    return SceneScale(
        footprint=footprint,
        nearest=nearest,
        centers=_tensor(centers),
        # Cameras in one place say nothing about lengths; how far they see does.
        extent=1.1 * spread if spread > nearest * 1e-3 else footprint * float(np.median(focals)),
        box=_tensor(np.stack([xyz.min(axis=0), xyz.max(axis=0)])),
        axes=_tensor(axes),
        cosines=_tensor(cosines),
        focals=_tensor(focals),
    )


def _cone(camera: Camera) -> float:
    """Return the cosine of the widest angle to the camera's axis in its picture, −1 where that cannot be said."""
    right, bottom = camera.width, camera.height
    border = [(x * right / 2, y * bottom / 2) for x in (0, 1, 2) for y in (0, 1, 2)]
    with np.errstate(invalid="ignore", over="ignore"):
        cosines = camera.rays(border)[1] @ camera.world_to_camera[2, :3]
    return float(cosines.min()) if np.isfinite(cosines).all() else -1.0


def _tensor(array: NDArray[np.float64]) -> Tensor:
    return torch.tensor(array, dtype=torch.float32)
