# SPDX-License-Identifier: GPL-3.0-or-later
"""Hand the pictures of a frame (or a few) to COLMAP in a child process, and read what it found."""

import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..capture import Capture, Points
from ..capture.images import composite
from ..child import run_child
from ..errors import HoloreelError
from ..files import write_json

Pixels = NDArray[np.uint8]
Pairs = list[tuple[int, int]]

_GRAY = (0.5, 0.5, 0.5)  # behind pictures with alpha; features are looked for on what is solid


@dataclass(frozen=True)
class Found:
    """What COLMAP found with C cameras: see `colmap` for the arrays."""

    keypoints: list[NDArray[np.float32]]  # per camera, (n, 2) pixels
    matches: dict[tuple[int, int], NDArray[np.int64]]  # by pair of cameras: (m, 2) keypoint indices
    xyz: NDArray[np.float64]  # (N, 3)
    error: NDArray[np.float64]  # (N,) pixels
    offsets: NDArray[np.int64]  # (N + 1,)
    camera: NDArray[np.int64]  # (M,)
    keypoint: NDArray[np.int64]  # (M,)
    arrays: dict[str, NDArray[Any]]  # all of them by name, with those that `reconstruct` adds
    version: str  # of pycolmap

    @property
    def track_lengths(self) -> NDArray[np.int64]:
        """How many cameras see each point, (N,)."""
        return np.diff(self.offsets)


class Workers:
    """The child processes of one run, which all end together."""

    def __init__(self) -> None:
        self._kills: set[Callable[[], None]] = set()
        self._lock = threading.Lock()
        self._stopped = False

    def stop(self) -> None:
        """End all children and let no more begin."""
        with self._lock:
            self._stopped = True
            for kill in self._kills:
                kill()

    def run(self, job: dict[str, Any], folder: Path) -> Found:
        """Do `job` in a child that works in `folder`; raises `HoloreelError` where COLMAP cannot do it."""
        job_file, out = folder / "job.json", folder / "result.npz"
        write_json(job_file, job | {"work": str(folder / "work"), "out": str(out)})
        (folder / "work").mkdir(exist_ok=True)
        command = [sys.executable, "-m", "holoreel.core.sfm.child", str(job_file)]
        mine: list[Callable[[], None]] = []
        try:
            ending = run_child(command, log=folder / "colmap.log", on_start=lambda kill: self._add(kill, mine))
        except OSError as error:
            raise HoloreelError(f"{command[0]} cannot be run in {folder} ({error.strerror or error}).") from error
        finally:
            with self._lock:
                self._kills.difference_update(mine)
        result = ending.result("COLMAP")
        return _read(out, len(job["cameras"]), result["pycolmap"])

    def _add(self, kill: Callable[[], None], mine: list[Callable[[], None]]) -> None:
        with self._lock:
            if self._stopped:
                raise HoloreelError("structure from motion was stopped.")
            self._kills.add(kill)
            mine.append(kill)


def camera_job(camera: Camera, lens: int, *, known: bool = True) -> dict[str, Any]:
    """What `colmap` calls a camera."""
    params = [camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion]
    return {
        "model": camera.model,
        "width": camera.width,
        "height": camera.height,
        "params": params,
        "lens": lens,
        "known": known,
    }


def put_pictures(
    capture: Capture, names: Sequence[str], frame: int, folder: Path
) -> tuple[list[str | None], list[Pixels | None], bool]:
    """Write the pictures of one frame into `folder`/pictures, and masks of those with alpha into `folder`/masks.

    Returns per camera of `names` the file name, the pixels (H, W, 3) (None where the capture lacks the picture), and
    whether there are masks.
    """
    files: list[str | None] = []
    pictures: list[Pixels | None] = []
    masked = False
    for index, name in enumerate(names):
        if (name, frame) not in capture.images:
            files.append(None)
            pictures.append(None)
            continue
        pixels = capture.image(name, frame)
        file = f"{frame:06d}_{index:04d}.png"
        if pixels.shape[2] == 4:
            masked = True
            _write(folder / "masks" / f"{file}.png", np.where(pixels[..., 3] >= 128, 255, 0).astype(np.uint8))
            pixels = composite(pixels, _GRAY)
        _write(folder / "pictures" / file, pixels)
        files.append(file)
        pictures.append(pixels)
    return files, pictures, masked


def _write(path: Path, pixels: Pixels) -> None:
    """Write a PNG that is read once."""
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, compress_level=1)


def mean_colors(found: Found, pictures: Sequence[Pixels | None]) -> NDArray[np.uint8]:
    """The mean color of all observations of each point, (N, 3), between pixels as bilinear filtering has it."""
    colors = np.zeros((len(found.camera), 3))
    for index, picture in enumerate(pictures):
        rows = found.camera == index
        if picture is not None and rows.any():
            colors[rows] = _bilinear(picture, found.keypoints[index][found.keypoint[rows]])
    sums = np.add.reduceat(colors, found.offsets[:-1]) if len(found.xyz) else colors[:0]
    return np.rint(sums / np.maximum(found.track_lengths, 1)[:, None]).astype(np.uint8)


def _bilinear(picture: Pixels, uv: NDArray[np.floating]) -> NDArray[np.float64]:
    height, width = picture.shape[:2]
    x = np.clip(uv[:, 0] - 0.5, 0, width - 1)
    y = np.clip(uv[:, 1] - 0.5, 0, height - 1)
    left, top = np.minimum(x.astype(int), max(width - 2, 0)), np.minimum(y.astype(int), max(height - 2, 0))
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    s, t = (x - left)[:, None], (y - top)[:, None]
    upper = picture[top, left] * (1 - s) + picture[top, right] * s
    lower = picture[bottom, left] * (1 - s) + picture[bottom, right] * s
    return np.asarray(upper * (1 - t) + lower * t)


def _read(path: Path, cameras: int, version: str) -> Found:
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    with suppress(OSError):
        path.unlink()
    pairs = [(int(a), int(b)) for a, b in arrays["pairs"]]
    return Found(
        keypoints=[arrays[f"keypoints_{index}"] for index in range(cameras)],
        matches={pair: arrays[f"matches_{index}"] for index, pair in enumerate(pairs)},
        xyz=arrays.get("xyz", np.empty((0, 3))),
        error=arrays.get("error", np.empty(0)),
        offsets=arrays.get("offsets", np.zeros(1, np.int64)),
        camera=arrays.get("camera", np.empty(0, np.int64)),
        keypoint=arrays.get("keypoint", np.empty(0, np.int64)),
        arrays=arrays,
        version=version,
    )


def good_points(found: Found, pictures: Sequence[Pixels | None], min_track: int, max_error: float) -> "Selection":
    """Choose the points that enough cameras see, that fit, and that are finite; with their colors."""
    xyz = found.xyz.astype(np.float32)
    good = np.isfinite(xyz).all(axis=1) & (found.error <= max_error) & (found.track_lengths >= min_track)
    points = Points(xyz[good], mean_colors(found, pictures)[good])
    return Selection(points, found.error[good], found.track_lengths[good])


@dataclass(frozen=True)
class Selection:
    """Points worth keeping, with their mean reprojection errors in pixels and the numbers of their cameras."""

    points: Points
    error: NDArray[np.float64]
    track_lengths: NDArray[np.int64]
