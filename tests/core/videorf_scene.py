# SPDX-License-Identifier: GPL-3.0-or-later
"""A subject whose pictures have a formula: a ball with colored octants that rolls along x, seen by a ring of cameras."""

from pathlib import Path

import numpy as np
from holoreel.core.camera import Camera
from holoreel.core.capture import Capture
from holoreel.core.images import picture_path, write_png
from numpy.typing import NDArray

RADIUS = 0.5
BOUNDS = ((-0.6, -0.6, -0.6), (0.9, 0.6, 0.6))


def ball_center(frame: int) -> NDArray[np.float64]:
    """Where the ball is."""
    return np.array([0.1 * frame, 0.0, 0.0])


def ball_picture(camera: Camera, frame: int, samples: int = 3) -> NDArray[np.float64]:
    """Return the picture (H, W, 4; straight alpha; 0..1) of the ball, averaged over `samples`² rays per pixel."""
    offsets = (np.arange(samples) + 0.5) / samples - 0.5
    total = np.zeros((camera.height * camera.width, 4))
    for dx in offsets:
        for dy in offsets:
            origins, directions = camera.rays(camera.pixel_centers() + [dx, dy])
            to_center = origins - ball_center(frame)
            along = -(to_center * directions).sum(1)
            inside = RADIUS**2 - (to_center**2).sum(1) + along**2
            hit = inside > 0
            points = to_center + (along - np.sqrt(np.maximum(inside, 0)))[:, None] * directions
            colors = np.where(points > 0, 0.9, 0.15)
            total += np.concatenate((colors, np.ones((len(hit), 1))), 1) * hit[:, None]
    alpha = total[:, 3:] / samples**2
    straight = total[:, :3] / np.maximum(total[:, 3:], 1)
    return np.concatenate((straight, alpha), 1).reshape(camera.height, camera.width, 4)


def ball_capture(folder: Path, frames: int = 3, cameras: int = 8, size: int = 40) -> Capture:
    """Write the pictures of a rolling ball and return their capture; the last camera is held out."""
    made: dict[str, Camera] = {}
    for index in range(cameras):
        angle = 2 * np.pi * index / (cameras - 1)
        eye = 2.5 * np.array([np.cos(angle), np.sin(angle), 0.5 * (-1) ** index])
        if index == cameras - 1:
            eye = np.array([1.5, 1.6, 1.2])
        name = f"cam{index:02d}"
        made[name] = Camera.look_at(eye, (0.15, 0.0, 0.0), width=size, height=size, fx=1.4 * size, name=name)
    images = {}
    for name, camera in made.items():
        for frame in range(frames):
            images[name, frame] = picture_path(folder / "pictures", name, frame)
            write_png(images[name, frame], ball_picture(camera, frame))
    splits = {f"cam{cameras - 1:02d}": "test"}
    return Capture(made, images, frames, splits, fps=24.0, frame_start=101, source=folder / "a.json", bounds=BOUNDS)
