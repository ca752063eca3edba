# SPDX-License-Identifier: GPL-3.0-or-later
"""Cameras of a capture that has none: full structure from motion from a few frames, and a world to put them in.

A reconstruction is known up to where it lies, how it is turned and how large it is. Here

    up      world z is up: most nearly perpendicular to the cameras' horizontal axes (a camera on a tripod does not
            roll), and where these say little (all cameras look the same way), the mean of their vertical axes;
    forward the mean viewing direction goes along world +y, as far as it is level;
    scale   the median distance from a camera to a point it sees is 5;
    origin  the median of the points.

The 5 leaves the scene well beyond the renderer's near plane of 0.2.
"""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..capture import Capture, videos
from ..capture.calibration import find_calibration
from ..capture.layouts import LAYOUTS, find_layout, finish
from ..capture.options import CaptureOptions
from ..capture.sfm_result import has_result, read_result, with_cameras
from ..errors import HoloreelError
from ..files import read_json
from ..render.native import available_cores
from .jobs import Found, Workers, put_pictures
from .pairs import choose_pairs
from .run import chosen_cameras
from .settings import PoseSettings, SfmSettings

Array = NDArray[np.float64]
OnMessage = Callable[[str], None]

TYPICAL_DISTANCE = 5.0
_FOCAL_GUESS = 0.9  # of the longer side: 58 degrees
_LEVEL_WEIGHT = 1e-4  # how much the cameras' vertical axes count against their horizontal ones
_PARAMETERS = {"SIMPLE_RADIAL": 4, "PINHOLE": 4, "OPENCV": 8, "OPENCV_FISHEYE": 8, "FULL_OPENCV": 12}


@dataclass(frozen=True)
class Opened:
    """A capture whose cameras are known."""

    capture: Capture
    posed_here: bool = False
    normalization: dict[str, Any] | None = None


def open_capture(
    path: Path,
    folder: Path,
    settings: SfmSettings,
    poses: PoseSettings,
    options: CaptureOptions,
    on_message: OnMessage | None = None,
) -> Opened:
    """Read a capture; where it has no poses, take those that `folder` holds from an earlier call, or find them."""
    # Points do not depend on the size of pictures or on numbers on the timeline, so these stay as the files have them.
    options = replace(options, scale=options.scale or 1, frame_start=None)
    layout = LAYOUTS[find_layout(path, options)]
    if layout is not LAYOUTS["videos"] or _calibrated(path, options):
        return Opened(finish(layout.read(path, options), options, layout))
    capture = videos.read_unposed(path, options)
    if has_result(folder) and not poses.refind and (before := read_result(folder)).posed_here:
        if on_message:
            on_message(f"{before.path}: the poses found before are kept; --refind finds them again.")
        cameras, normalization = list(before.cameras.values()), read_json(before.path).get("normalization")
    else:
        found = find_poses(capture, settings, poses)
        cameras, normalization = found.cameras, found.normalization
        lost = [name for name in capture.cameras if name not in {camera.name for camera in cameras}]
        if lost and on_message:
            on_message(
                f"warning: cameras {', '.join(lost)} could not be placed, for want of matches with the others; let "
                "their views overlap more (20 to 30 degrees between neighbors), or take --quality high."
            )
    return Opened(finish(with_cameras(capture, cameras), options, layout), True, normalization)


@dataclass(frozen=True)
class FoundPoses:
    """Cameras that could be placed, in order, in the world described above."""

    cameras: list[Camera]
    normalization: dict[str, Any]


def find_poses(capture: Capture, settings: SfmSettings, poses: PoseSettings) -> FoundPoses:
    """Find poses and lenses of the cameras of `capture` (whose own are not looked at) from its reference frames.

    All cameras are used, held out or not: a picture cannot be compared with a view whose camera is not known. Raises
    `HoloreelError` where fewer than two cameras can be placed.
    """
    names = [name for name in capture.cameras if name not in settings.without]
    chosen_cameras(capture, settings)  # checks the names
    cameras = [_guess(capture.cameras[name], poses.lens) for name in names]
    with tempfile.TemporaryDirectory(prefix="holoreel-sfm-") as temporary:
        folder = Path(temporary)
        files, masked = [], False
        for frame in _reference_frames(capture, poses):
            of_frame, _, masks = put_pictures(capture, names, frame, folder)
            files.append(of_frame)
            masked |= masks
        job = {
            "task": "reconstruct",
            "frames": files,
            "pictures": str(folder / "pictures"),
            "masks": str(folder / "masks") if masked else None,
            "cameras": [guess | {"lens": 0 if poses.shared_lens else lens} for lens, guess in enumerate(cameras)],
            "pairs": choose_pairs([capture.cameras[name] for name in names], _blind(settings)),
            "options": settings.colmap_options(available_cores()),
        }
        _check_shared(capture, names, poses)
        found = Workers().run(job, folder)
    return _normalized(_cameras(capture, names, found, poses.lens), found, capture.source)


def _calibrated(path: Path, options: CaptureOptions) -> bool:
    return options.calibration is not None or find_calibration(path) is not None


def _blind(settings: SfmSettings) -> Any:
    """The matcher for cameras whose views are not known."""
    return "sequential" if settings.matcher == "sequential" else "exhaustive"


def _reference_frames(capture: Capture, poses: PoseSettings) -> list[int]:
    frames = poses.reference or (0, capture.frame_count // 2, capture.frame_count - 1)
    if wrong := [frame for frame in frames if not 0 <= frame < capture.frame_count]:
        raise HoloreelError(f"--reference {wrong[0]}: {capture.source} has the frames 0 to {capture.frame_count - 1}.")
    return list(dict.fromkeys(frames))


def _check_shared(capture: Capture, names: Sequence[str], poses: PoseSettings) -> None:
    sizes = {(capture.cameras[name].width, capture.cameras[name].height) for name in names}
    if poses.shared_lens and len(sizes) > 1:
        raise HoloreelError(f"{capture.source}: --shared-lens needs pictures of one size, there are {len(sizes)}.")


def _guess(camera: Camera, lens: str) -> dict[str, Any]:
    """A lens to begin with."""
    focal = _FOCAL_GUESS * max(camera.width, camera.height)
    first = [focal] if lens == "SIMPLE_RADIAL" else [focal, focal]
    params = [*first, camera.width / 2, camera.height / 2]
    params += [0.0] * (_PARAMETERS[lens] - len(params))
    return {"model": lens, "width": camera.width, "height": camera.height, "params": params, "known": False}


def _cameras(capture: Capture, names: Sequence[str], found: Found, lens: str) -> list[Camera]:
    registered = found.arrays.get("registered", np.zeros(len(names), bool))
    if registered.sum() < 2:
        matches = sum(len(pair) for pair in found.matches.values())
        raise HoloreelError(
            f"{capture.source}: the cameras could not be placed ({len(names)} cameras, {matches} matches among them): "
            "let neighbors' views overlap more, choose sharp --reference frames with much texture, or take "
            "--quality high; or calibrate the cameras."
        )
    cameras = []
    for index in np.flatnonzero(registered).tolist():
        old = capture.cameras[names[index]]
        params = found.arrays["params"][index].tolist()
        if lens == "SIMPLE_RADIAL":
            focal, *center, k1 = params
            model, params = "OPENCV", [focal, focal, *center, k1, 0.0, 0.0, 0.0]
        else:
            model = lens
        fx, fy, cx, cy, *distortion = params
        pose = found.arrays["poses"][index]
        camera = Camera(old.width, old.height, fx, fy, cx, cy, pose, model, names[index], tuple(distortion))
        cameras.append(camera)
    return cameras


def _normalized(cameras: list[Camera], found: Found, source: Path) -> FoundPoses:
    """Put cameras into the world described above."""
    sees = found.camera  # observations name cameras by their place in the job, which may be more than were placed
    placed = np.flatnonzero(found.arrays["registered"])
    centers = np.zeros((len(found.arrays["registered"]), 3))
    centers[placed] = [camera.center for camera in cameras]
    point = np.repeat(np.arange(len(found.xyz)), found.track_lengths)
    distance = float(np.median(np.linalg.norm(found.xyz[point] - centers[sees], axis=1)))
    if not (np.isfinite(distance) and distance > 0):
        raise HoloreelError(f"{source}: the cameras could not be placed; choose other --reference frames.")
    rotation = upright([camera.world_to_camera[:3, :3] for camera in cameras])
    scale, origin = TYPICAL_DISTANCE / distance, np.median(found.xyz, axis=0)
    moved = [replace(camera, world_to_camera=_moved(camera, rotation, scale, origin)) for camera in cameras]
    normalization = {
        "up": "perpendicular to the cameras' horizontal axes",
        "scale": f"median distance from a camera to a point it sees is {TYPICAL_DISTANCE:g}",
        "origin": "median of the points",
        "reprojection_error_px": round(float(found.error.mean()), 4),
        "points": len(found.xyz),
    }
    return FoundPoses(moved, normalization)


def _moved(camera: Camera, rotation: Array, scale: float, origin: Array) -> Array:
    """The pose of a camera in the world x' = scale · rotation · (x − origin)."""
    matrix = np.eye(4)
    matrix[:3, :3] = camera.world_to_camera[:3, :3] @ rotation.T
    matrix[:3, 3] = -matrix[:3, :3] @ (scale * rotation @ (camera.center - origin))
    return matrix


def upright(rotations: Sequence[Array]) -> Array:
    """The rotation into a world whose z is up, from the cameras' world-to-camera rotations (3, 3)."""
    axes = np.array(rotations)
    right, upward = axes[:, 0], -axes[:, 1]
    mean = upward.mean(axis=0)
    cost = right.T @ right - _LEVEL_WEIGHT * len(axes) * np.outer(mean, mean)
    up = np.linalg.eigh(cost)[1][:, 0]
    up *= np.sign(up @ mean) or 1.0
    forward = axes[:, 2].sum(axis=0)
    forward -= (forward @ up) * up
    if np.linalg.norm(forward) < 1e-6 * len(axes):  # cameras all around: any direction will do
        forward = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    forward /= np.linalg.norm(forward)
    return np.stack([np.cross(forward, up), forward, up])
