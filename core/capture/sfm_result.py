# SPDX-License-Identifier: GPL-3.0-or-later
"""What `holoreel sfm` leaves beside a capture: a folder with sfm.json and one PLY of points per frame.

sfm.json is an object with the keys

    version             1
    frame_start         the timeline number of frame index 0
    frame_count         how many frames the capture had
    posed               whether the poses came from here ("sfm") or with the capture ("capture")
    cameras             the cameras the points were triangulated with (core/camera.py's JSON), names included
    frames              per frame done: index, file, points, reprojection_error_px, track_length, seconds, key
    settings, calibration, normalization, software, seconds     for the reader of the file

Points are in the world of the cameras. A later capture of the same recording may hold fewer frames, other sizes of the
pictures, or undistorted ones: frames are matched by their number on the timeline. Needs numpy only.
"""

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..camera import Camera
from ..errors import HoloreelError
from ..files import read_json
from .capture import MAX_FRAMES, Capture

FOLDER = "sfm"
FILE_NAME = "sfm.json"
VERSION = 1

_MAX_CAMERAS = 10_000
_POSE_TOLERANCE = 1e-4  # of the cameras' distance from each other, and of a rotation's entries
_POINTS = re.compile(r"points_\d{1,9}\.ply")


@dataclass(frozen=True)
class SfmResult:
    """The part of sfm.json that others use, checked."""

    path: Path  # of sfm.json
    cameras: dict[str, Camera]
    posed_here: bool
    frame_start: int
    frame_count: int
    points: dict[int, Path]  # by frame index; frames without a point are left out


def has_result(folder: str | Path) -> bool:
    """Whether `folder` holds a result of `holoreel sfm`."""
    return os.path.isfile(Path(folder) / FILE_NAME)


def read_result(folder: str | Path) -> SfmResult:
    """Read FOLDER/sfm.json; raises `HoloreelError` naming file, field and remedy."""
    path = Path(folder) / FILE_NAME
    meta = read_json(path)
    if meta.get("version") != VERSION:
        raise HoloreelError(f"{path}: version must be {VERSION}; run `holoreel sfm` again.")
    cameras = meta.get("cameras")
    if not isinstance(cameras, list) or not 1 <= len(cameras) <= _MAX_CAMERAS:
        raise _broken(path, "cameras must be a list of cameras")
    by_name: dict[str, Camera] = {}
    for index, value in enumerate(cameras):
        if not isinstance(value, dict):
            raise _broken(path, f"cameras[{index}] must be an object")
        camera = Camera.from_json(value, f"{path}: cameras[{index}]")
        if not camera.name or camera.name in by_name:
            raise _broken(path, f"cameras[{index}].name must be a name of its own")
        by_name[camera.name] = camera
    if meta.get("posed") not in ("sfm", "capture"):
        raise _broken(path, "posed must be 'sfm' or 'capture'")
    start: Any = meta.get("frame_start")
    count: Any = meta.get("frame_count")
    if not _whole(start) or not _whole(count) or not 1 <= count <= MAX_FRAMES:
        raise _broken(path, "frame_start and frame_count must be whole numbers")
    points = _points(path, meta.get("frames"), count)
    return SfmResult(path, by_name, meta["posed"] == "sfm", start, count, points)


def attach(capture: Capture, folder: str | Path) -> Capture:
    """Return `capture` with the points in `folder` as its seeds, and the cameras found there if it had none.

    Cameras that were found take the place of the capture's; those that could not be registered go, with their
    pictures. Raises `HoloreelError` where the result is damaged or was made with other poses.
    """
    result = read_result(folder)
    if result.posed_here:
        capture = with_cameras(capture, result.cameras.values())
    else:
        _same_poses(capture, result)
    offset = result.frame_start - capture.frame_start
    seeds = {index + offset: path for index, path in result.points.items()}
    seeds = {index: path for index, path in seeds.items() if 0 <= index < capture.frame_count}
    if not seeds:
        raise HoloreelError(
            f"{result.path}: it has points of none of the capture's frames {capture.frame_start} to "
            f"{capture.frame_start + capture.frame_count - 1}; run `holoreel sfm` for them."
        )
    return replace(capture, seeds=seeds)


def with_cameras(capture: Capture, cameras: Iterable[Camera]) -> Capture:
    """Return `capture` seen by `cameras`, matched by name and brought to the size of its pictures.

    Cameras of the capture that are not among them go, with their pictures.
    """
    known = {camera.name: camera for camera in cameras}
    kept = {name: known[name].scaled(old.width, old.height) for name, old in capture.cameras.items() if name in known}
    if not kept:
        raise HoloreelError(
            f"{capture.source}: none of its cameras ({', '.join(list(capture.cameras)[:5])}) is among those that "
            f"`holoreel sfm` found ({', '.join(list(known)[:5])}); run it again for this capture."
        )
    return replace(
        capture,
        cameras=kept,
        images={view: media for view, media in capture.images.items() if view[0] in kept},
        depths={view: path for view, path in capture.depths.items() if view[0] in kept},
        splits={name: split for name, split in capture.splits.items() if name in kept},
    )


def _points(path: Path, frames: Any, count: int) -> dict[int, Path]:
    if not isinstance(frames, list) or len(frames) > count:
        raise _broken(path, "frames must be a list of at most frame_count frames")
    points: dict[int, Path] = {}
    for place, frame in enumerate(frames):
        if not isinstance(frame, dict) or not _whole(frame.get("index")) or not 0 <= frame["index"] < count:
            raise _broken(path, f"frames[{place}].index must be a frame of the capture")
        if not isinstance(frame.get("file"), str) or not _POINTS.fullmatch(frame["file"]):
            raise _broken(path, f"frames[{place}].file must be a name like points_0000.ply")
        if not _whole(frame.get("points")) or frame["points"] < 0:
            raise _broken(path, f"frames[{place}].points must be a number of points")
        if frame["points"]:
            points[frame["index"]] = path.parent / frame["file"]
    missing = [file for file in points.values() if not os.path.isfile(file)]
    if missing:
        raise HoloreelError(f"{path}: {missing[0]} is missing; run `holoreel sfm` again.")
    return points


def _same_poses(capture: Capture, result: SfmResult) -> None:
    """Points triangulated with other poses would lie beside what the cameras see."""
    common = [name for name in capture.cameras if name in result.cameras]
    poses = [(capture.cameras[name].world_to_camera, result.cameras[name].world_to_camera) for name in common]
    centers = np.array([result.cameras[name].center for name in common])
    reach = float(np.ptp(centers, axis=0).max()) if common else 0.0
    scale = np.array([1.0, 1.0, 1.0, reach or 1.0]) * _POSE_TOLERANCE
    wrong = [name for name, (now, then) in zip(common, poses, strict=True) if (np.abs(now - then) > scale).any()]
    if wrong or not common:
        what = f"camera {wrong[0]!r} stood elsewhere" if wrong else "it knows none of the capture's cameras"
        raise HoloreelError(f"{result.path}: {what} when it was made; run `holoreel sfm` again, or remove the folder.")


def _whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and abs(value) <= 2**31


def _broken(path: Path, text: str) -> HoloreelError:
    return HoloreelError(f"{path}: {text}; run `holoreel sfm` again.")
