# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's camera settings as numbers, and what they mean as a `Camera`. Needs numpy only, no bpy.

Blender's cameras have OpenGL axes (x right, y up, looking along -z). With aspect = pixel_aspect_y / pixel_aspect_x, and
viewfac the number of pixels that the sensor spans (W for a horizontal fit, H · aspect for a vertical one):

    fx = lens / sensor · viewfac       cx = W/2 − shift_x · viewfac
    fy = fx / aspect                   cy = H/2 + shift_y · viewfac / aspect

The sensor is `sensor_height` for the fit VERTICAL alone; AUTO takes `sensor_width` along the longer side.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .camera import Camera, invert_rigid
from .errors import HoloreelError

Array = NDArray[np.float64]

_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL camera axes in OpenCV's, and back
_SHEAR_TOLERANCE = 5e-6  # Blender's matrices are float32
_MIN_LENS = 1.0  # mm; Blender takes nothing shorter


@dataclass(frozen=True)
class BlenderCamera:
    """The settings of one perspective camera and of the scene's format that decide where a point lands.

    Lengths of lens and sensor are in mm; `matrix_world` (4 × 4) may have scale, which does not count, as in Blender.
    """

    lens: float
    resolution_x: int
    resolution_y: int
    sensor_width: float = 36.0
    sensor_height: float = 24.0
    sensor_fit: str = "AUTO"
    shift_x: float = 0.0
    shift_y: float = 0.0
    resolution_percentage: int = 100
    pixel_aspect_x: float = 1.0
    pixel_aspect_y: float = 1.0
    matrix_world: Array = field(default_factory=lambda: np.eye(4))
    name: str = ""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the rendered picture: scaled by the percentage and cut to whole pixels."""
        percentage = self.resolution_percentage
        return max(self.resolution_x * percentage // 100, 1), max(self.resolution_y * percentage // 100, 1)

    def to_camera(self) -> Camera:
        """Return the same view as a `Camera`; raises `HoloreelError` for mirrored or sheared cameras."""
        width, height = self.size
        aspect = self.pixel_aspect_y / self.pixel_aspect_x
        fit = self.sensor_fit
        if fit == "AUTO":
            fit = "HORIZONTAL" if width * self.pixel_aspect_x >= height * self.pixel_aspect_y else "VERTICAL"
        viewfac = width if fit == "HORIZONTAL" else height * aspect
        fx = self.lens / (self.sensor_height if self.sensor_fit == "VERTICAL" else self.sensor_width) * viewfac
        return Camera(
            width=width,
            height=height,
            fx=fx,
            fy=fx / aspect,
            cx=width / 2 - self.shift_x * viewfac,
            cy=height / 2 + self.shift_y * viewfac / aspect,
            world_to_camera=invert_rigid(_pose(self.matrix_world, self.name) @ _FLIP),
            name=self.name,
        )

    @classmethod
    def from_camera(cls, camera: Camera, sensor_width: float = 36.0) -> "BlenderCamera":
        """Return settings that render exactly what a PINHOLE `camera` sees.

        The fit is horizontal; where `sensor_width` would need a lens under Blender's 1 mm, the sensor grows instead.
        """
        camera.require_pinhole("Blender")
        lens = camera.fx * sensor_width / camera.width
        if lens < _MIN_LENS:
            lens, sensor_width = _MIN_LENS, sensor_width * _MIN_LENS / lens
        aspect = camera.fx / camera.fy
        return cls(
            lens=lens,
            resolution_x=camera.width,
            resolution_y=camera.height,
            sensor_width=sensor_width,
            sensor_fit="HORIZONTAL",
            shift_x=(camera.width / 2 - camera.cx) / camera.width,
            shift_y=(camera.cy - camera.height / 2) * aspect / camera.width,
            pixel_aspect_x=max(1.0, 1 / aspect),  # Blender takes no aspect under 1
            pixel_aspect_y=max(1.0, aspect),
            matrix_world=camera.camera_to_world @ _FLIP,
            name=camera.name,
        )


def _pose(matrix_world: ArrayLike, name: str) -> Array:
    """Return the rigid camera-to-world matrix that Blender renders from: the axes' lengths do not count."""
    matrix = np.array(matrix_world, np.float64)
    lengths = np.linalg.norm(matrix[:3, :3], axis=0)
    if not np.isfinite(matrix).all() or not lengths.all():
        raise HoloreelError(f"camera {name!r}: its world matrix has a zero scale or NaN; clear its scale.")
    matrix[:3, :3] /= lengths
    axes = matrix[:3, :3]
    if np.abs(axes.T @ axes - np.eye(3)).max() > _SHEAR_TOLERANCE:
        raise HoloreelError(f"camera {name!r} is sheared by its parent's scale; clear the parent's scale.")
    if np.linalg.det(axes) < 0:
        raise HoloreelError(
            f"camera {name!r} is mirrored by a negative scale; make the scale of it or its parent positive."
        )
    left, _, right = np.linalg.svd(axes)
    matrix[:3, :3] = left @ right
    return matrix


def camera_from_projection(view: ArrayLike, window: ArrayLike, width: int, height: int) -> Camera:
    """Return what a viewport of `width` × `height` pixels sees, from its OpenGL matrices (4 × 4), world to view and
    view to clip space; the latter must be a perspective one."""
    window, flipped = np.array(window, np.float64), _FLIP @ np.array(view, np.float64)
    return Camera(
        width=width,
        height=height,
        fx=window[0, 0] * width / 2,
        fy=window[1, 1] * height / 2,
        cx=(1 - window[0, 2]) * width / 2,
        cy=(1 + window[1, 2]) * height / 2,
        world_to_camera=flipped,
    )
