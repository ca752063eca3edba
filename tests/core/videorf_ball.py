# SPDX-License-Identifier: GPL-3.0-or-later
"""A ball in front of a dome of cameras: its silhouettes, its place and its colors are known exactly."""

from pathlib import Path

import numpy as np
from holoreel.core.camera import Camera
from holoreel.core.capture import Capture
from holoreel.core.images import write_png
from holoreel.core.videorf.occupancy import Lattice

CENTER = np.array([0.3, -0.2, 0.5])
RADIUS = 0.7
SIZE = 48
ASIDE = np.array([0.1, 0.05, 0])


def dome(count=12, distance=3.2, lens=False):
    """Cameras all around, looking near the ball but not at its middle."""
    cameras = {}
    for index in range(count):
        height = -0.8 + 1.6 * index / (count - 1)
        angle = 2.4 * index
        across = np.sqrt(1 - height**2)
        eye = CENTER + distance * np.array([across * np.cos(angle), across * np.sin(angle), height])
        camera = Camera.look_at(eye, CENTER + ASIDE, width=SIZE + 8, height=SIZE, fx=62, name=f"cam{index:02d}")
        if lens:
            camera = Camera(**{**vars(camera), "model": "OPENCV", "distortion": (-0.08, 0.01, 0, 0)})
        cameras[camera.name] = camera
    return cameras


def hits_of(camera, center=CENTER, radius=RADIUS):
    """Where the rays of a camera meet the ball, (H, W) bool, and in which direction of it (H, W, 3), NaN elsewhere."""
    origins, directions = camera.rays()
    to_center = center - origins
    along = (to_center * directions).sum(1)
    square = radius**2 - ((to_center**2).sum(1) - along**2)
    with np.errstate(invalid="ignore"):
        normals = (origins + directions * (along - np.sqrt(square))[:, None] - center) / radius
    shape = camera.height, camera.width
    return (square > 0).reshape(shape), normals.reshape(*shape, 3)


def alpha_of(camera, center=CENTER, radius=RADIUS):
    """Where the rays of a camera meet the ball, (H, W) bool."""
    return hits_of(camera, center, radius)[0]


def ball_capture(folder: Path, frames=1, cameras=None, centers=None, painted=False, **fields) -> Capture:
    """A ball in front of cameras, cut out by alpha.

    Red is the column, green the row, blue the camera; where it is `painted`, they are the direction from its center.
    """
    cameras = cameras or dome()
    images = {}
    for frame in range(frames):
        for index, (name, camera) in enumerate(cameras.items()):
            rows, columns = np.mgrid[: camera.height, : camera.width]
            alpha, normals = hits_of(camera, CENTER if centers is None else centers[frame])
            color = np.stack((columns, rows, np.full_like(rows, index)), -1) / 255
            if painted:
                color = np.nan_to_num(0.5 + 0.4 * normals)
            images[name, frame] = folder / name / f"{frame:04d}.png"
            write_png(images[name, frame], np.concatenate((color, alpha[..., None]), -1))
    return Capture(cameras, images, frames, source=folder / "transforms.json", **fields)


def around(edge=32, margin=5):
    """The lattice of a box around the ball."""
    return Lattice.around(CENTER - RADIUS, CENTER + RADIUS, edge, margin)


def distances(lattice):
    """How far each vertex (X, Y, Z) lies from the ball's center."""
    vertices = np.stack(np.meshgrid(*map(np.arange, lattice.shape), indexing="ij"), -1)
    return np.linalg.norm(lattice.positions(vertices) - CENTER, axis=-1)
