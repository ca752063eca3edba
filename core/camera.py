# SPDX-License-Identifier: GPL-3.0-or-later
"""The camera that everything else speaks of.

Axes are OpenCV's (x right, y down, z forward); pixel centers lie at +0.5, so the middle of a W × H image is (W/2, H/2);
extrinsics are world-to-camera. Other conventions are converted where files are read and written, once.
"""

import json
import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import HoloreelError

MODELS = ("PINHOLE",)


@dataclass(frozen=True)
class Camera:
    """One calibrated camera.

    `fx fy cx cy` are in pixels; `world_to_camera` is 4 × 4 with an orthonormal rotation; `model` is COLMAP's name.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    model: str = "PINHOLE"
    name: str = ""

    @property
    def K(self) -> NDArray[np.float64]:
        """Intrinsics as a 3 × 3 matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def camera_to_world(self) -> NDArray[np.float64]:
        """The inverse extrinsics, 4 × 4 (exact for a rigid transform)."""
        rotation = self.world_to_camera[:3, :3].T
        pose = np.eye(4)
        pose[:3, :3] = rotation
        pose[:3, 3] = -rotation @ self.world_to_camera[:3, 3]
        return pose

    @property
    def center(self) -> NDArray[np.float64]:
        """The point all rays start from, in the world."""
        return self.camera_to_world[:3, 3]
