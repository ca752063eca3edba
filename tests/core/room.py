# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures of a textured corner of a room, cast ray by ray through any lens: surfaces are known exactly."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from holoreel.core.camera import Camera, invert_rigid
from holoreel.core.capture import Capture
from numpy.typing import NDArray
from PIL import Image

Array = NDArray[np.float64]

SIZE = (400, 300)
# The planes of floor and walls: axis, its coordinate there, and the two axes along the plane. Bounded to |x| <= 6.
PLANES = ((2, 0.0, (0, 1)), (1, 3.0, (0, 2)), (0, -3.0, (1, 2)))
_TEXELS_PER_UNIT = 60.0
_LENSES = {"OPENCV": (-0.12, 0.03, 0.001, -0.001), "OPENCV_FISHEYE": (0.02, -0.005, 0.001, 0.0)}


def room_cameras(count: int = 6, model: str = "PINHOLE", size: tuple[int, int] = SIZE) -> list[Camera]:
    """Cameras on an arc that look into the corner, each a little higher than the one before, with lenses of their own."""
    width, height = size
    cameras = []
    for index in range(count):
        angle = -0.5 + 0.16 * index
        eye = (3 * np.cos(angle) + 1, -3 * np.sin(angle) - 2.5, 1.6 + 0.12 * index)
        focal = (0.42 if model == "OPENCV_FISHEYE" else 0.68 + 0.01 * index) * width
        camera = Camera.look_at(eye, (-1, 1, 0.8), width=width, height=height, fx=focal, name=f"cam{index}")
        cameras.append(replace(camera, model=model, distortion=_LENSES.get(model, ())))
    return cameras


def room_capture(folder: Path, cameras: Sequence[Camera], frames: int = 1, **fields: object) -> Capture:
    """Cast and write the pictures; a ball of its own texture stands elsewhere in every frame."""
    images = {}
    for camera in cameras:
        for frame in range(frames):
            path = folder / camera.name / f"{frame:04d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(cast(camera, frame)).save(path)
            images[camera.name, frame] = path
    by_name = {camera.name: camera for camera in cameras}
    return Capture(by_name, images, frames, source=folder, **fields)  # type: ignore[arg-type]


def cast(camera: Camera, frame: int = 0) -> NDArray[np.uint8]:
    """The picture a camera takes of the room, (H, W, 3)."""
    origins, rays = camera.rays()
    distance = np.full(len(rays), np.inf)
    color = np.full((len(rays), 3), 30.0)
    for index, (axis, place, along) in enumerate(PLANES):
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (place - origins[:, axis]) / rays[:, axis]
            hit = origins + t[:, None] * rays
            ok = (t > 0) & (t < distance) & (np.abs(hit) < 6).all(axis=1) & (hit[:, 2] > -1e-6)
        distance[ok] = t[ok]
        color[ok] = _look_up(index, hit[ok][:, along])
    center = np.array([-1.0 + 0.4 * frame, 1.0, 0.6])
    b = np.einsum("ij,ij->i", origins - center, rays)
    inside = b**2 - ((origins - center) ** 2).sum(axis=1) + 0.6**2
    t = -b - np.sqrt(np.maximum(inside, 0))
    ok = (inside > 0) & (t > 0) & (t < distance)
    local = (origins + t[:, None] * rays - center)[ok]
    color[ok] = _look_up(3, local[:, :2] * 1.5 + local[:, 2:])
    return np.clip(color + 0.5, 0, 255).astype(np.uint8).reshape(camera.height, camera.width, 3)


def distances(points: Array, frame: int = 0) -> Array:
    """How far (N, 3) points are from the nearest surface of the room, (N,)."""
    center = np.array([-1.0 + 0.4 * frame, 1.0, 0.6])
    planes = [np.abs(points[:, axis] - place) for axis, place, _ in PLANES]
    return np.minimum(np.min(planes, axis=0), np.abs(np.linalg.norm(points - center, axis=1) - 0.6))


def turned(camera: Camera, degrees: float, axis: int = 1) -> Camera:
    """The camera turned about one of its own axes: where a wrong calibration says it looks."""
    angle = np.radians(degrees)
    matrix = np.eye(4)
    a, b = [other for other in range(3) if other != axis]
    matrix[[a, b, a, b], [a, b, b, a]] = np.cos(angle), np.cos(angle), -np.sin(angle), np.sin(angle)
    return replace(camera, world_to_camera=invert_rigid(invert_rigid(camera.world_to_camera) @ matrix))


@cache
def _texture(seed: int, size: int = 512) -> Array:
    from scipy.ndimage import gaussian_filter

    random = np.random.default_rng(seed)
    layers = [gaussian_filter(random.standard_normal((size, size, 3)), (s, s, 0), mode="wrap") * s for s in (1, 2, 4, 8)]
    values = sum(layers)
    return 255 * (values - values.min()) / (values.max() - values.min())


def _look_up(seed: int, coordinates: Array) -> Array:
    from scipy.ndimage import map_coordinates

    texture = _texture(seed)
    places = (coordinates * _TEXELS_PER_UNIT).T
    return np.stack([map_coordinates(texture[..., c], places, order=1, mode="grid-wrap") for c in range(3)], axis=1)
