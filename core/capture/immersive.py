# SPDX-License-Identifier: GPL-3.0-or-later
"""Google Immersive light field video (Broxton et al., 2020): models.json and one fisheye video per camera.

models.json is a list of objects: name (the video is NAME.mp4), width, height, focal_length, principal_point (x, y),
radial_distortion (the first two are k1 and k2 of OpenCV's fisheye), orientation (a rotation vector, world-to-camera),
position (the center). The authors hold camera_0001 out, at half resolution.
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..camera import Camera
from ..errors import HoloreelError
from ..files import MAX_JSON_BYTES, finite
from .capture import Capture
from .export import Export, numbered, write_text, write_videos
from .options import CaptureOptions
from .rotations import matrix_from_vector, vector_from_matrix
from .video_set import check_pairs, find_videos, video_capture

FILE_NAME = "models.json"
HELD_OUT = "camera_0001"
_MAX_CAMERAS = 10_000
_MAX_NUMBER = 1e15


def matches(path: Path) -> bool:
    """Whether models.json lies in the folder."""
    return (path / FILE_NAME).is_file()


def read(path: Path, options: CaptureOptions) -> Capture:
    """Read the folder of a scene as fisheye cameras."""
    file = path / FILE_NAME
    cameras: dict[str, Camera] = {}
    for index, entry in enumerate(_entries(file)):
        camera = _camera(file, index, entry)
        if camera.name in cameras:
            raise HoloreelError(f"{file}: [{index}].name {camera.name!r} is there twice; fetch it again.")
        cameras[camera.name] = camera
    videos = find_videos(path)
    check_pairs(file, list(cameras), videos)
    return video_capture(file, {name: cameras[name] for name in videos}, videos, options)


def _entries(file: Path) -> list[Any]:
    try:
        if file.stat().st_size > MAX_JSON_BYTES:
            raise HoloreelError(f"{file} is larger than {MAX_JSON_BYTES >> 20} MiB: this is no file of cameras.")
        entries = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise HoloreelError(f"{file} cannot be read ({error.strerror or error}): fetch it again.") from error
    except (ValueError, RecursionError) as error:
        raise HoloreelError(f"{file} is not valid JSON ({error}): fetch it again.") from error
    if not isinstance(entries, list) or not 1 <= len(entries) <= _MAX_CAMERAS:
        raise HoloreelError(f"{file} must be a list of 1 to {_MAX_CAMERAS} cameras: fetch it again.")
    return entries


def _camera(file: Path, index: int, entry: Any) -> Camera:
    where = f"{file}: [{index}]"
    if not isinstance(entry, dict) or not isinstance(entry.get("name"), str) or not entry["name"]:
        raise HoloreelError(f"{where}.name is missing: fetch it again.")
    if entry.get("projection_type", "fisheye") != "fisheye":
        raise HoloreelError(f"{where}.projection_type must be fisheye, not {entry['projection_type']!r}.")

    def numbers(key: str, least: int, default: list[float] | None = None) -> list[float]:
        value = entry.get(key, default)
        values = [finite(part) for part in (value if isinstance(value, list) else [value])]
        if len(values) < least or any(part is None or abs(part) > _MAX_NUMBER for part in values):
            raise HoloreelError(f"{where}.{key} must be {least} finite numbers, not {str(value)[:60]}: fetch it again.")
        return [float(part) for part in values if part is not None]

    (focal,), (width,), (height,) = numbers("focal_length", 1)[:1], numbers("width", 1)[:1], numbers("height", 1)[:1]
    cx, cy = numbers("principal_point", 2)[:2]
    k1, k2 = numbers("radial_distortion", 2)[:2]
    (aspect,) = numbers("pixel_aspect_ratio", 1, [1.0])[:1]
    orientation, position = numbers("orientation", 3)[:3], numbers("position", 3)[:3]
    matrix = np.eye(4)
    try:
        matrix[:3, :3] = matrix_from_vector(orientation)
        matrix[:3, 3] = -matrix[:3, :3] @ position
        return Camera(
            width,  # type: ignore[arg-type]  # checked to be whole by Camera
            height,  # type: ignore[arg-type]
            focal,
            focal * aspect,
            cx,
            cy,
            matrix,
            model="OPENCV_FISHEYE",
            name=entry["name"],
            distortion=(k1, k2, 0.0, 0.0),
        )
    except (HoloreelError, ValueError) as error:
        raise HoloreelError(f"{where}: {str(error).rstrip('.')}: fetch it again.") from error


def target(camera: Camera) -> Camera:
    """The fisheye that the layout can describe: `camera` itself, or an equidistant one that sees no more than it.

    Its focal length lets the corners of both pictures see the same; between them a fisheye of that focal length never
    sees more than a perspective camera does.
    """
    if camera.model == "OPENCV_FISHEYE" and not any(camera.distortion[2:]):
        return camera
    local = replace(camera, world_to_camera=np.eye(4))
    corners = np.array([(0, 0), (camera.width, 0), (0, camera.height), (camera.width, camera.height)], np.float64)
    _, directions = local.rays(corners)
    angles = np.arctan2(np.linalg.norm(directions[:, :2], axis=1), directions[:, 2])
    focal = float((np.linalg.norm(corners - (camera.cx, camera.cy), axis=1) / angles).max())
    return replace(camera, model="OPENCV_FISHEYE", distortion=(0.0,) * 4, fx=focal, fy=focal)


def names(capture: Capture) -> dict[str, str]:
    """Return what each camera is called: camera_0001 is the held-out one."""
    return numbered(capture, [f"camera_{i:04d}" for i in range(1, len(capture.cameras) + 1)], (HELD_OUT,))


def write(capture: Capture, path: Path, export: Export) -> None:
    """Write camera_0001.mp4 (the held-out camera), camera_0002.mp4, … and models.json into `path`."""
    files = names(capture)
    lenses = export.lenses(capture)
    targets = {name: target(lenses[name]) for name in files}
    write_videos(capture, targets, {name: path / f"{file}.mp4" for name, file in files.items()}, export)
    entries = [_entry(files[name], camera) for name, camera in targets.items()]
    write_text(path / FILE_NAME, json.dumps(entries, indent=1, allow_nan=False) + "\n")


def _entry(name: str, camera: Camera) -> dict[str, Any]:
    return {
        "name": name,
        "projection_type": "fisheye",
        "width": camera.width,
        "height": camera.height,
        "focal_length": camera.fx,
        "pixel_aspect_ratio": camera.fy / camera.fx,
        "principal_point": [camera.cx, camera.cy],
        "radial_distortion": list(camera.distortion[:2]),
        "orientation": vector_from_matrix(camera.world_to_camera[:3, :3]).tolist(),
        "position": camera.center.tolist(),
    }
