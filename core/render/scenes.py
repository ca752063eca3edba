# SPDX-License-Identifier: GPL-3.0-or-later
"""Random Spacetime Gaussians with the statistics of a trained model, to measure and to test the rasterizers with."""

import numpy as np
import torch

from ..camera import Camera
from .contract import SpacetimeTensors


def random_scene(
    count: int, width: int, height: int, channels: int, median_radius_px: float = 3.0, seed: int = 0
) -> tuple[SpacetimeTensors, Camera]:
    """Return `count` Gaussians all over the picture and a little beyond it, and the camera that sees them.

    The 3 sigma radius of the longest axis is log-normal around `median_radius_px` (sigma 0.9), the other axes are
    shorter; depths are 2 to 20; most are on at any time in [0, 1). The camera is at the origin.
    """
    rng = np.random.default_rng(seed)
    focal = 0.9 * width
    z = np.exp(rng.uniform(np.log(2), np.log(20), count))
    x = rng.uniform(-0.55, 0.55, count) * width / focal * z
    y = rng.uniform(-0.55, 0.55, count) * height / focal * z
    radius_px = np.minimum(median_radius_px * np.exp(0.9 * rng.standard_normal(count)), 0.2 * width)
    flatness = -np.abs(rng.normal(0, 0.7, (count, 3)))
    flatness[:, 0] = 0
    arrays = dict(
        means=np.stack((x, y, z), 1),
        motions=rng.normal(0, 0.05, (count, 3, 3)) * z[:, None, None] * 0.2,
        quats=rng.standard_normal((count, 4)),
        omegas=rng.normal(0, 0.2, (count, 4)),
        log_scales=np.log(radius_px / 3 * z / focal)[:, None] + flatness,
        opacity_logits=rng.normal(0.3, 1.6, count),
        features=rng.uniform(0, 1, (count, channels)),
        trbf_centers=rng.uniform(0, 1, count),
        trbf_log_scales=rng.normal(1.0, 0.5, count),
    )
    tensors = SpacetimeTensors(**{name: torch.tensor(array, dtype=torch.float32) for name, array in arrays.items()})
    return tensors, Camera(width, height, focal, focal, width / 2, height / 2)
