# SPDX-License-Identifier: GPL-3.0-or-later
"""Guided sampling: new Gaussians along rays through what is still wrong (Spacetime Gaussians, Sec. 4.4).

Density control grows Gaussians beside others; it cannot reach places where the seeds left a hole. These functions
find the patches with the largest errors, ask the coarse depth of the Gaussians how far a ray should reach, and put
Gaussians along the ray. Those that are not needed turn transparent and are pruned.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from .config import GuidedConfig
from .model import SpacetimeGaussians

Floats = NDArray[np.float32]

OPAQUE = 0.5  # where a pixel lets more light through, its depth says nothing
FAR_SHARE = 0.98  # of a picture's depths: farther out lie strays
SIGMA_PATCHES = 0.25  # standard deviation of a new Gaussian, in patches


@dataclass(frozen=True)
class Patches:
    """P patches of one picture: `centers` (P, 2) in pixels, mean `errors` (P,), mean `colors` of the truth (P, 3).

    `sparse` (P,) says which of them few seeds fall into: where Gaussians are missing, not where they are hard to fit.
    """

    centers: NDArray[np.float64]
    errors: Floats
    colors: Floats
    sparse: NDArray[np.bool_]

    def take(self, rows: NDArray[np.int64]) -> "Patches":
        """Return some of the patches."""
        return Patches(self.centers[rows], self.errors[rows], self.colors[rows], self.sparse[rows])


def measure_patches(picture: Floats, truth: Floats, size: int, valid: NDArray[np.bool_] | None = None) -> Patches:
    """Average the absolute error of a picture (H, W, 3) over patches of `size` × `size` pixels.

    Patches that do not fit into the picture, or hold a pixel that is not `valid` (H, W), are left out. All count as
    sparse: `with_seeds` knows better.
    """
    rows, columns = picture.shape[0] // size, picture.shape[1] // size
    error = _blocks(np.abs(picture - truth).mean(axis=2, keepdims=True), rows, columns, size)[:, 0]
    colors = _blocks(truth, rows, columns, size)
    v, u = np.mgrid[:rows, :columns]
    centers = (np.stack([u.ravel(), v.ravel()], axis=1) + 0.5) * size
    sparse = np.ones(len(centers), dtype=bool)
    patches = Patches(centers, error.astype(np.float32), colors.astype(np.float32), sparse)
    if valid is None:
        return patches
    whole = _blocks(valid[..., None].astype(np.float32), rows, columns, size)[:, 0] == 1.0
    return patches.take(np.flatnonzero(whole))


def _blocks(image: NDArray, rows: int, columns: int, size: int) -> NDArray:
    """Return the means (rows · columns, C) of the blocks of an image (H, W, C)."""
    whole = image[: rows * size, : columns * size]
    return whole.reshape(rows, size, columns, size, -1).mean(axis=(1, 3)).reshape(rows * columns, -1)


def with_seeds(patches: Patches, size: int, camera: Camera, seeds: Floats, share: float) -> Patches:
    """Call those patches sparse into which fewer `seeds` (N, 3) fall than a `share` of the mean of all patches."""
    uv, depth = camera.project(seeds)
    seen = uv[(depth > 0) & np.isfinite(uv).all(axis=1)]
    cells = np.floor(seen / size).astype(np.int64)
    rows, columns = camera.height // size + 1, camera.width // size + 1
    inside = (cells >= 0).all(axis=1) & (cells < (columns, rows)).all(axis=1)
    counts = np.zeros((rows, columns))
    np.add.at(counts, (cells[inside, 1], cells[inside, 0]), 1.0)
    column, row = np.floor(patches.centers / size).astype(np.int64).T
    own = counts[row, column]
    return replace(patches, sparse=own < share * own.mean() if own.any() else np.ones(len(own), dtype=bool))


def worst_patches(pictures: Sequence[Patches], share: float, contrast: float) -> list[Patches]:
    """Return, picture by picture, the sparse patches with the largest errors.

    They are at most a `share` of all patches, and their error is at least `contrast` times that of the median patch.
    """
    errors = np.concatenate([patches.errors for patches in pictures])
    if not len(errors):
        return list(pictures)
    chosen = np.concatenate([patches.sparse for patches in pictures])
    chosen &= (errors >= contrast * np.median(errors)) & (errors > 0)
    order = np.argsort(np.where(chosen, -errors, 0.0), kind="stable")
    chosen[order[math.ceil(share * len(errors)) :]] = False
    starts = np.cumsum([0, *(len(patches) for patches in (p.errors for p in pictures))])
    return [
        patches.take(np.flatnonzero(chosen[start : start + len(patches.errors)]))
        for patches, start in zip(pictures, starts, strict=False)
    ]


def depth_range(depth: Floats, alpha: Floats, near: float, far: float) -> tuple[float, float] | None:
    """Return how near and how far rays should reach, from a camera's coarse depth map and alpha, both (H, W).

    From `near` to `far` times the farthest depth that the camera sees; None where it sees none. What seeds leave out
    lies as far as what they show or farther, and whatever is put before that hangs in the air for other cameras.
    """
    known = depth[(alpha >= OPAQUE) & np.isfinite(depth) & (depth > 0)]
    if not len(known):
        return None
    farthest = float(np.quantile(known, FAR_SHARE))
    return near * farthest, far * farthest


def sample_rays(
    camera: Camera,
    patches: Patches,
    size: int,
    reach: tuple[float, float],
    config: GuidedConfig,
    rng: np.random.Generator,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return points (P · samples, 3) along the rays through the patches' centers, and their sizes (P · samples,).

    Depths lie between both ends of `reach`, one in each of stretches that grow with the depth as a picture's resolution
    falls: uniform in its logarithm. Centers are off by a little noise. A size is the standard deviation that covers the
    patch.
    """
    near, far = reach
    count = len(patches.errors)
    steps = (np.arange(config.samples) + rng.random((count, config.samples))) / config.samples
    depths = (near * (far / near) ** steps).ravel()
    pixels = np.repeat(patches.centers, config.samples, axis=0)
    pixels = pixels + rng.normal(0.0, config.noise * size, pixels.shape)
    points = camera.unproject(pixels, depths)
    focal = math.sqrt(camera.fx * camera.fy)
    return points, SIGMA_PATCHES * size * depths / focal


def new_gaussians(
    points: NDArray[np.float64],
    sizes: NDArray[np.float64],
    colors: Floats,
    time: float,
    width: float,
    opacity: float,
) -> SpacetimeGaussians:
    """Return lite Gaussians at `points` (N, 3) that stand still, centered at a `time` with a temporal `width`."""
    count = len(points)
    return SpacetimeGaussians(
        means=points.astype(np.float32),
        motions=np.zeros((count, 3, 3), np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        omegas=np.zeros((count, 4), np.float32),
        log_scales=np.repeat(np.log(sizes)[:, None], 3, axis=1).astype(np.float32),
        opacity_logits=np.full(count, math.log(opacity / (1.0 - opacity)), np.float32),
        features=colors.astype(np.float32),
        trbf_centers=np.full(count, time, np.float32),
        trbf_log_scales=np.full(count, math.log(width), np.float32),
    )


class Stability:
    """Tells when the loss no longer falls: its mean over a window is hardly less than over the window before."""

    def __init__(self, window: int, tolerance: float):
        self.window, self.tolerance = max(window, 1), tolerance
        self.total, self.count, self.before = 0.0, 0, math.inf

    def add(self, loss: float) -> bool:
        """Take in the loss of one iteration; return whether a window ended in which it was stable."""
        self.total, self.count = self.total + loss, self.count + 1
        if self.count < self.window:
            return False
        mean, before = self.total / self.count, self.before
        self.total, self.count, self.before = 0.0, 0, mean
        return math.isfinite(before) and mean >= (1.0 - self.tolerance) * before

    def reset(self) -> None:
        """Begin anew: something has changed the loss."""
        self.total, self.count, self.before = 0.0, 0, math.inf

    def state(self) -> list[float]:
        """What `load_state` needs."""
        return [self.total, float(self.count), self.before]

    def load_state(self, state: Sequence[float]) -> None:
        """Go on where `state` was taken."""
        self.total, self.count, self.before = float(state[0]), int(state[1]), float(state[2])
