# SPDX-License-Identifier: GPL-3.0-or-later
"""A camera path no camera of the capture stood on."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera


def common_target(cameras: Sequence[Camera]) -> NDArray[np.float64]:
    """Return the point nearest to the optical axes of all cameras, in the least-squares sense, (3,).

    Where the axes are parallel, it is the middle of the points that lie as far ahead as the cameras stand apart.
    """
    normal, right_side = np.zeros((3, 3)), np.zeros(3)
    for camera in cameras:
        axis = camera.world_to_camera[2, :3]
        across = np.eye(3) - np.outer(axis, axis)
        normal += across
        right_side += across @ camera.center
    if np.linalg.cond(normal) < 1e6:
        return np.linalg.solve(normal, right_side).astype(np.float64)
    centers = np.stack([camera.center for camera in cameras])
    ahead = max(float(np.linalg.norm(np.ptp(centers, axis=0))), 1.0)
    return np.mean([camera.center + ahead * camera.world_to_camera[2, :3] for camera in cameras], axis=0)


def orbit(cameras: Sequence[Camera], count: int, swing: float = 0.7, rise_degrees: float = 3.0) -> list[Camera]:
    """Return `count` cameras on a closed ellipse around where the first one stands, all looking at the common target.

    `swing` is the ellipse's half width as a part of the angle the capture spans to either side.
    """
    target, first = common_target(cameras), cameras[0]
    angles = [_azimuth(camera.center - target) for camera in cameras]
    middle = angles[0]
    reach = max(abs(math.remainder(angle - middle, math.tau)) for angle in angles)
    offset = first.center - target
    radius, elevation = float(np.linalg.norm(offset)), math.asin(np.clip(offset[2] / np.linalg.norm(offset), -1, 1))
    path = []
    for index in range(count):
        phase = math.tau * index / count
        azimuth = middle + swing * reach * math.sin(phase)
        height = elevation + math.radians(rise_degrees) * (1 - math.cos(phase)) / 2
        direction = np.array(
            [math.cos(azimuth) * math.cos(height), math.sin(azimuth) * math.cos(height), math.sin(height)]
        )
        path.append(
            Camera.look_at(
                target + radius * direction,
                target,
                width=first.width,
                height=first.height,
                fx=first.fx,
                fy=first.fy,
                name=f"moving{index:03d}",
            )
        )
    return path


def _azimuth(offset: NDArray[np.float64]) -> float:
    return math.atan2(offset[1], offset[0])
