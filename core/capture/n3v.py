# SPDX-License-Identifier: GPL-3.0-or-later
"""Neural 3D Video (https://github.com/facebookresearch/Neural_3D_Video): cam??.mp4 and poses_bounds.npy.

poses_bounds.npy is LLFF's: one row of 17 numbers per camera, in the order of the videos' names. The first 15 are a
3 × 5 matrix, row by row: camera-to-world axes (down, right, backward), the center, and (height, width, focal length);
then the nearest and the farthest depth. Principal points are in the middle. The authors hold cam00 out, at half
resolution.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera, invert_rigid, rigid
from ..errors import HoloreelError
from ..files import atomic_path
from .capture import Capture
from .export import Export, numbered, pinhole, write_videos
from .options import CaptureOptions
from .video_set import find_videos, probe_all, video_capture

FILE_NAME = "poses_bounds.npy"
_VIDEO = re.compile(r"cam\d+")
_MAX_CAMERAS = 10_000


def matches(path: Path) -> bool:
    """Whether poses_bounds.npy lies in the folder."""
    return (path / FILE_NAME).is_file()


def read(path: Path, options: CaptureOptions) -> Capture:
    """Read the folder of a scene."""
    file = path / FILE_NAME
    poses = read_poses(file)
    videos = {name: video for name, video in find_videos(path).items() if _VIDEO.fullmatch(name)}
    if len(poses) != len(videos):
        raise HoloreelError(
            f"{file} has {len(poses)} cameras, but there are {len(videos)} videos cam??.mp4 "
            f"({', '.join(list(videos)[:30]) or 'none'}); fetch the missing ones, or move the others away."
        )
    facts = probe_all(videos)
    cameras = {}
    for row, (name, found) in enumerate(facts.items()):
        try:
            camera = camera_of(poses[row])
        except (HoloreelError, ValueError) as error:
            raise HoloreelError(f"{file}: row {row} ({name}): {str(error).rstrip('.')}; fetch it again.") from error
        if abs(camera.width * found.height - camera.height * found.width) > max(found.width, found.height):
            raise HoloreelError(
                f"{file}: row {row} is of {camera.width}x{camera.height}, but {videos[name].name} is "
                f"{found.width}x{found.height}; fetch the file that belongs to these videos."
            )
        cameras[name] = camera.scaled(found.width, found.height)
    return video_capture(file, cameras, videos, options, facts)


def read_poses(file: Path) -> NDArray[np.float64]:
    """Read the table, (cameras, 17); its shape is checked before anything is allocated, nothing is unpickled."""
    try:
        table = np.load(file, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # the parser of its header raises what it likes
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise HoloreelError(f"{file} cannot be read as an array of numbers ({reason}): fetch it again.") from error
    if table.ndim != 2 or table.shape[1] != 17 or not 1 <= table.shape[0] <= _MAX_CAMERAS or table.dtype.kind != "f":
        raise HoloreelError(f"{file} must hold rows of 17 numbers, not {table.dtype} {table.shape}: fetch it again.")
    return np.array(table, np.float64)


def camera_of(row: NDArray[np.float64]) -> Camera:
    """Return the camera of one row; a ValueError or `HoloreelError` where it is none."""
    matrix = row[:15].reshape(3, 5)
    pose = np.eye(4)
    down, right, backward, center = matrix[:, :4].T
    pose[:3] = np.stack([right, down, -backward, center], axis=1)
    height, width, focal = matrix[:, 4]
    return Camera(width, height, focal, focal, width / 2, height / 2, invert_rigid(rigid(pose)))


def row_of(camera: Camera, near: float, far: float) -> NDArray[np.float64]:
    """Return the row of one camera; the inverse of `camera_of`."""
    right, down, forward, center = camera.camera_to_world[:3].T
    matrix = np.stack([down, right, -forward, center, (camera.height, camera.width, camera.fx)], axis=1)
    return np.concatenate([matrix.ravel(), (near, far)])


def target(camera: Camera) -> Camera:
    """The nearest camera that the layout can describe: centered, with square pixels and no distortion."""
    return replace(pinhole(camera), fy=camera.fx, cx=camera.width / 2, cy=camera.height / 2)


def names(capture: Capture) -> dict[str, str]:
    """Return what each camera is called: cam00 is the held-out one."""
    count = len(capture.cameras)
    digits = max(2, len(str(count - 1)))
    return numbered(capture, [f"cam{i:0{digits}d}" for i in range(count)], ())


def write(capture: Capture, path: Path, export: Export) -> None:
    """Write cam00.mp4 (the held-out camera), cam01.mp4, … and poses_bounds.npy into `path`."""
    files = names(capture)
    lenses = export.lenses(capture)
    targets = {name: target(lenses[name]) for name in files}
    write_videos(capture, targets, {name: path / f"{file}.mp4" for name, file in files.items()}, export)
    rows = np.stack([row_of(camera, *_bounds(capture, camera)) for camera in targets.values()])
    with atomic_path(path / FILE_NAME) as temporary:
        np.save(temporary, rows)


def _bounds(capture: Capture, camera: Camera) -> tuple[float, float]:
    """The depths between which the camera sees seed points of the first frame; zeros where it sees none."""
    points = capture.seed_points(0).xyz
    if not len(points):
        return 0.0, 0.0
    pixels, depth = camera.project(points)
    seen = (depth > 0) & (pixels > 0).all(axis=1) & (pixels < (camera.width, camera.height)).all(axis=1)
    return (float(depth[seen].min()), float(depth[seen].max())) if seen.any() else (0.0, 0.0)
