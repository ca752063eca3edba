# SPDX-License-Identifier: GPL-3.0-or-later
"""EWA splatting in plain numpy (float64), written from its definition: what the look Splats is measured against."""

from dataclasses import dataclass

import numpy as np
from holoreel.core.gaussians.model import EvaluatedGaussians
from numpy.typing import NDArray

ALPHA_MAX, ALPHA_MIN, STOP, LOW_PASS, NEAR, CLAMP = 0.99, 1 / 255, 1e-4, 0.3, 0.2, 1.3


@dataclass
class View:
    """A pinhole camera: pixels, focal lengths and principal point in pixels, world-to-camera (OpenCV axes)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: NDArray[np.float64]


def rotations(quats: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (N, 3, 3) from unit quaternions w x y z."""
    w, x, y, z = quats.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)


def place(
    gaussians: EvaluatedGaussians, world: NDArray[np.float64] | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return centers (N, 3) and square roots of covariances (N, 3, 3) in the world that an object's matrix leads to."""
    world = np.eye(4) if world is None else world
    spreads = rotations(gaussians.quats.astype(np.float64)) * gaussians.scales.astype(np.float64)[:, None, :]
    return gaussians.means.astype(np.float64) @ world[:3, :3].T + world[:3, 3], world[:3, :3] @ spreads


def splat(
    gaussians: EvaluatedGaussians, view: View, stop: float = STOP, world: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Return premultiplied RGBA (H, W, 4) of the visible Gaussians over nothing; `world` may scale and shear them."""
    alive = gaussians.take(gaussians.alive)
    rotation, translation = view.world_to_camera[:3, :3], view.world_to_camera[:3, 3]
    centers, spreads = place(alive, world)
    places = centers @ rotation.T + translation
    near = NEAR * (1.0 if world is None else np.cbrt(np.abs(np.linalg.det(world[:3, :3]))))
    columns, rows = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    color, through = np.zeros((view.height, view.width, 3)), np.ones((view.height, view.width))
    stopped = np.zeros_like(through, dtype=bool)
    margin = 0.5 * (CLAMP - 1.0)  # around the picture, wherever the principal point lies
    limits_x = [(edge * view.width - view.cx) / view.fx for edge in (-margin, 1.0 + margin)]
    limits_y = [(edge * view.height - view.cy) / view.fy for edge in (-margin, 1.0 + margin)]
    for index in np.argsort(places[:, 2], kind="stable"):
        x, y, z = places[index]
        if z < near:
            continue
        slope_x, slope_y = np.clip(x / z, *limits_x), np.clip(y / z, *limits_y)
        jacobian = np.array([[view.fx / z, 0, -view.fx * slope_x / z], [0, view.fy / z, -view.fy * slope_y / z]])
        spread = jacobian @ rotation @ spreads[index]
        conic = np.linalg.inv(spread @ spread.T + LOW_PASS * np.eye(2))
        dx, dy = columns - (view.fx * x / z + view.cx), rows - (view.fy * y / z + view.cy)
        power = conic[0, 0] * dx * dx + 2 * conic[0, 1] * dx * dy + conic[1, 1] * dy * dy
        alpha = np.minimum(ALPHA_MAX, alive.opacities[index] * np.exp(-0.5 * power))
        alpha = np.where((alpha < ALPHA_MIN) | stopped, 0.0, alpha)
        stopped |= (alpha > 0) & (through * (1 - alpha) < stop)
        alpha[stopped] = 0.0
        color += (through * alpha)[..., None] * alive.features[index, :3]
        through *= 1 - alpha
    return np.concatenate([color, 1 - through[..., None]], axis=-1)


def trace(
    gaussians: EvaluatedGaussians,
    origins: NDArray[np.float64],
    directions: NDArray[np.float64],
    world: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Return premultiplied RGBA (rays, 4): each Gaussian counts with its greatest value along the ray.

    Compositing is by where that is. Gaussians whose greatest value lies behind a ray's origin do not count for it.
    """
    alive = gaussians.take(gaussians.alive)
    centers, spreads = place(alive, world)
    alphas, distances = np.zeros((len(alive), len(origins))), np.zeros((len(alive), len(origins)))
    for index, inverse in enumerate(np.linalg.inv(spreads)):
        start, step = (origins - centers[index]) @ inverse.T, directions @ inverse.T
        distances[index] = -np.sum(start * step, axis=1) / np.sum(step * step, axis=1)
        nearest = start + distances[index][:, None] * step
        value = alive.opacities[index] * np.exp(-0.5 * np.sum(nearest * nearest, axis=1))
        alphas[index] = np.where((value < ALPHA_MIN) | (distances[index] < 0), 0.0, np.minimum(ALPHA_MAX, value))
    order = np.argsort(distances, axis=0)
    alphas = np.take_along_axis(alphas, order, axis=0)
    through = np.cumprod(np.concatenate([np.ones((1, len(origins))), 1 - alphas]), axis=0)
    colors = alive.features[:, :3].astype(np.float64)[order]
    color = np.sum((through[:-1] * alphas)[..., None] * colors, axis=0)
    return np.concatenate([color, 1 - through[-1][:, None]], axis=1)


def psnr(picture: NDArray, truth: NDArray) -> float:
    """Return the peak signal-to-noise ratio in dB, for a peak of 1."""
    error = np.mean(np.square(picture.astype(np.float64) - truth))
    return float("inf") if error == 0 else -10.0 * float(np.log10(error))
