# SPDX-License-Identifier: GPL-3.0-or-later
"""Calibrations in OpenCV's words: caliscope's camera_array.toml, and the same as cameras_opencv.json.

Both list cameras with a size, a matrix K, distortion (k1 k2 p1 p2, then k3, then k4 k5 k6; or k1 k2 k3 k4 of a
fisheye), and world-to-camera R and t. OpenCV's pixel centers are whole numbers, so 0.5 is added to the principal point.
"""

import json
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..camera import Camera
from ..errors import HoloreelError
from ..files import atomic_path
from .rotations import matrix_from_vector

FILE_NAMES = ("camera_array.toml", "cameras_opencv.json")
_MAX_BYTES = 1 << 24
_MAX_CAMERAS = 10_000
_KEYS = {"K": ("K", "matrix"), "dist": ("dist", "distortions"), "R": ("R", "rotation"), "t": ("t", "translation"),
         "size": ("size",)}  # fmt: skip


@dataclass(frozen=True)
class Calibrated:
    """One entry: what the file calls the camera, the stem of its video where the file says so, and the camera."""

    label: str
    stem: str | None
    camera: Camera


def find_calibration(folder: Path) -> Path | None:
    """Return the calibration beside the videos, or None."""
    return next((folder / name for name in FILE_NAMES if (folder / name).is_file()), None)


def read_calibration(file: Path) -> list[Calibrated]:
    """Read a .toml or .json; raises `HoloreelError` naming camera and field."""
    entries = _entries(file)
    if not 1 <= len(entries) <= _MAX_CAMERAS:
        raise HoloreelError(f"{file} describes no cameras; export the calibration again.")
    return [_calibrated(file, label, entry) for label, entry in entries]


def _entries(file: Path) -> list[tuple[str, dict[str, Any]]]:
    """The cameras of a file with their labels; those that it says to ignore are left out."""
    try:
        if file.stat().st_size > _MAX_BYTES:
            raise HoloreelError(f"{file} is larger than {_MAX_BYTES >> 20} MiB: this is no calibration.")
        text = file.read_text(encoding="utf-8")
        value = tomllib.loads(text) if file.suffix.lower() == ".toml" else json.loads(text)
    except OSError as error:
        raise HoloreelError(f"{file} cannot be read ({error.strerror or error}): check the path.") from error
    except (ValueError, RecursionError) as error:
        raise HoloreelError(f"{file} is damaged ({error}): export the calibration again.") from error
    cameras = value.get("cameras", value) if isinstance(value, dict) else value
    if isinstance(cameras, dict):
        labeled = list(cameras.items())
    elif isinstance(cameras, list):
        labeled = [(str(e.get("name", i)) if isinstance(e, dict) else str(i), e) for i, e in enumerate(cameras)]
    else:
        raise HoloreelError(f"{file}: cameras must be a list or a table; export the calibration again.")
    return [(label, entry) for label, entry in labeled if isinstance(entry, dict) and not entry.get("ignore")]


def _calibrated(file: Path, label: str, entry: dict[str, Any]) -> Calibrated:
    where = f"{file}: camera {label}"
    size = _array(where, entry, "size", (2,))
    matrix = _array(where, entry, "K", (3, 3))
    rotation = _array(where, entry, "R", (3, 3), (3,))
    pose = np.eye(4)
    pose[:3, 3] = _array(where, entry, "t", (3,))
    if abs(matrix[0, 1]) > 1e-3 * abs(matrix[0, 0]):
        raise HoloreelError(f"{where}: K has a skew of {matrix[0, 1]:g}; calibrate without skew.")
    model, distortion = _distortion(where, entry)
    video = entry.get("video")
    try:
        pose[:3, :3] = matrix_from_vector(rotation) if rotation.ndim == 1 else rotation
        camera = Camera(
            size[0], size[1], matrix[0, 0], matrix[1, 1], matrix[0, 2] + 0.5, matrix[1, 2] + 0.5,
            pose, model=model, distortion=distortion,
        )  # fmt: skip
    except (HoloreelError, ValueError) as error:
        raise HoloreelError(f"{where}: {str(error).rstrip('.')}; calibrate it again.") from error
    return Calibrated(label, Path(video).stem if isinstance(video, str) else None, camera)


def _array(where: str, entry: dict[str, Any], key: str, *shapes: tuple[int, ...]) -> np.ndarray:
    value = next((entry[name] for name in _KEYS[key] if name in entry), None)
    if value is None:
        raise HoloreelError(f"{where} has no {' or '.join(_KEYS[key])}; calibrate it, or let the file ignore it.")
    try:
        array = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.array(np.nan)
    if array.shape not in shapes or not np.isfinite(array).all():
        raise HoloreelError(
            f"{where}: {key} must be {' or '.join('x'.join(map(str, shape)) for shape in shapes)} finite numbers, "
            f"not {str(value)[:60]}; export the calibration again."
        )
    return array


def _distortion(where: str, entry: dict[str, Any]) -> tuple[str, tuple[float, ...]]:
    """Return the lens model that has the given coefficients."""
    given = _array(where, entry, "dist", *[(count,) for count in (0, 4, 5, 8, 12, 14)]).tolist()
    if entry.get("fisheye"):
        if len(given) != 4:
            raise HoloreelError(f"{where}: a fisheye has 4 distortion coefficients, not {len(given)}.")
        return "OPENCV_FISHEYE", tuple(given)
    if not any(given):
        return "PINHOLE", ()
    if any(given[8:]):
        raise HoloreelError(f"{where}: thin prism and tilt terms are not supported; calibrate with 8 or fewer terms.")
    return ("OPENCV", tuple(given)) if len(given) == 4 else ("FULL_OPENCV", tuple((given + [0.0] * 8)[:8]))


def write_calibration(file: Path, cameras: dict[str, Camera]) -> None:
    """Write cameras_opencv.json: each camera by its name, which is also its video's."""
    entries = []
    for name, camera in cameras.items():
        given = list(camera.distortion)
        while camera.model == "FULL_OPENCV" and len(given) > 5 and given[-1] == 0:
            given.pop()
        entry = {
            "name": name,
            "size": [camera.width, camera.height],
            "K": (camera.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]).tolist(),
            "dist": given if len(given) in (0, 4, 5) else list(camera.distortion),
            "R": camera.world_to_camera[:3, :3].tolist(),
            "t": camera.world_to_camera[:3, 3].tolist(),
        }
        entries.append(entry | ({"fisheye": True} if camera.model == "OPENCV_FISHEYE" else {}))
    value = {"convention": "OpenCV: x_camera = R x_world + t, pixel centers at whole numbers", "cameras": entries}
    with atomic_path(file) as temporary:
        temporary.write_text(json.dumps(value, indent=1, allow_nan=False) + "\n", encoding="utf-8")
