# SPDX-License-Identifier: GPL-3.0-or-later
"""COLMAP's sparse models: cameras, images and points3D as .bin or .txt (https://colmap.github.io/format.html).

Poses are world-to-camera, quaternions w x y z, pixel centers at +0.5: our conventions. Numbers are little-endian.
"""

import struct
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..errors import HoloreelError
from ..files import atomic_path
from .points import Points
from .rotations import matrix_from_quaternion, quaternion_from_matrix

MAX_FILE_BYTES = 4 * 2**30
MAX_IMAGES = 1_000_000
_MAX_NAME_BYTES = 1024


@dataclass(frozen=True)
class _Model:
    """One of COLMAP's camera models: its number in .bin, its parameters in order, our model that it is a case of."""

    number: int
    parameters: tuple[str, ...]
    ours: str


MODELS = {
    "SIMPLE_PINHOLE": _Model(0, ("f", "cx", "cy"), "PINHOLE"),
    "PINHOLE": _Model(1, ("fx", "fy", "cx", "cy"), "PINHOLE"),
    "SIMPLE_RADIAL": _Model(2, ("f", "cx", "cy", "k1"), "OPENCV"),
    "RADIAL": _Model(3, ("f", "cx", "cy", "k1", "k2"), "OPENCV"),
    "OPENCV": _Model(4, ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"), "OPENCV"),
    "OPENCV_FISHEYE": _Model(5, ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"), "OPENCV_FISHEYE"),
    "FULL_OPENCV": _Model(
        6, ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), "FULL_OPENCV"
    ),
    "SIMPLE_RADIAL_FISHEYE": _Model(8, ("f", "cx", "cy", "k1"), "OPENCV_FISHEYE"),
    "RADIAL_FISHEYE": _Model(9, ("f", "cx", "cy", "k1", "k2"), "OPENCV_FISHEYE"),
}  # fmt: skip
_BY_NUMBER = {model.number: name for name, model in MODELS.items()}
_INTRINSICS = ("f", "fx", "fy", "cx", "cy")
_DISTORTION = {name: MODELS[name].parameters[4:] for name in ("PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE")}


@dataclass(frozen=True)
class _Lens:
    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclass(frozen=True)
class _Pose:
    quaternion: tuple[float, ...]
    translation: tuple[float, ...]
    lens: int
    name: str


def find_model(folder: Path) -> Path | None:
    """Return the folder below `folder` that holds a model: sparse/0, sparse, or itself; None without one."""
    for candidate in (folder / "sparse" / "0", folder / "sparse", folder):
        if any((candidate / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt")):
            return candidate
    return None


def points_file(model: Path) -> Path | None:
    """Return the model's file of points, or None."""
    found = [model / f"points3D{suffix}" for suffix in (".bin", ".txt") if (model / f"points3D{suffix}").is_file()]
    return found[0] if found else None


def read_cameras(model: Path) -> dict[str, Camera]:
    """Read the posed camera of every image, by the image's name in the file and in its order.

    Raises `HoloreelError` for a model that is not whole, or whose lens has no equal among ours.
    """
    binary = (model / "cameras.bin").is_file()
    suffix = ".bin" if binary else ".txt"
    lens_file, image_file = model / f"cameras{suffix}", model / f"images{suffix}"
    lenses = (_read_lenses_bin if binary else _read_lenses_txt)(lens_file)
    cameras: dict[str, Camera] = {}
    for pose in (_read_poses_bin if binary else _read_poses_txt)(image_file):
        if pose.lens not in lenses:
            raise HoloreelError(f"{image_file}: {pose.name} has camera {pose.lens}, which {lens_file.name} lacks.")
        if pose.name in cameras:
            raise HoloreelError(f"{image_file}: {pose.name} is there twice; export the model again.")
        parts = PurePosixPath(pose.name.replace("\\", "/"))
        if not parts.name or parts.is_absolute() or ".." in parts.parts:
            raise HoloreelError(f"{image_file}: {pose.name!r} is no name of a picture below the folder of images.")
        try:
            cameras[pose.name] = _camera(pose, lenses[pose.lens])
        except (HoloreelError, ValueError) as error:
            raise HoloreelError(f"{image_file}: {pose.name}: {str(error).rstrip('.')}; export it again.") from error
    if not cameras:
        raise HoloreelError(f"{image_file} holds no images; export a model with posed images.")
    return cameras


def _camera(pose: _Pose, lens: _Lens) -> Camera:
    model = MODELS[lens.model]
    values = dict(zip(model.parameters, lens.parameters, strict=True))
    matrix = np.eye(4)
    matrix[:3, :3] = matrix_from_quaternion(pose.quaternion)
    matrix[:3, 3] = pose.translation
    return Camera(
        lens.width,
        lens.height,
        values.get("fx", values.get("f", 0.0)),
        values.get("fy", values.get("f", 0.0)),
        values["cx"],
        values["cy"],
        matrix,
        model=model.ours,
        name=pose.name,
        distortion=tuple(values.get(key, 0.0) for key in _DISTORTION[model.ours]),
    )


class _Cursor:
    """Reads numbers from the bytes of one file, and says so where the file ends too early."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.at = path, _bytes(path), 0

    def take(self, layout: str) -> tuple:
        try:
            values = struct.unpack_from("<" + layout, self.data, self.at)
        except struct.error as error:
            raise self.short() from error
        self.at += struct.calcsize("<" + layout)
        return values

    def count(self, least: int, most: int | None = None) -> int:
        """Read how many records of at least `least` bytes follow."""
        (number,) = self.take("Q")
        if number * least > len(self.data) - self.at or (most is not None and number > most):
            raise HoloreelError(f"{self.path} counts {number} entries, more than it can hold; fetch a whole copy.")
        return number

    def skip(self, size: int) -> None:
        self.at += size
        if self.at > len(self.data):
            raise self.short()

    def text(self) -> str:
        end = self.data.find(b"\0", self.at, self.at + _MAX_NAME_BYTES)
        if end < 0:
            raise HoloreelError(f"{self.path}: the name at byte {self.at} has no end; fetch a whole copy.")
        text = self.data[self.at : end].decode("utf-8", "replace")
        self.at = end + 1
        return text

    def short(self) -> HoloreelError:
        return HoloreelError(f"{self.path} ends at byte {len(self.data)} within an entry; fetch a whole copy.")


def _bytes(path: Path) -> bytes:
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise HoloreelError(f"{path} is larger than {MAX_FILE_BYTES >> 30} GiB: this is no model of COLMAP.")
        return path.read_bytes()
    except OSError as error:
        raise HoloreelError(f"{path} cannot be read ({error.strerror or error}): export the model again.") from error


def _lens(path: Path, name: str | None, width: int, height: int, parameters: tuple[float, ...]) -> _Lens:
    if name not in MODELS:
        raise HoloreelError(
            f"{path}: camera model {name} is not supported; undistort the pictures, or use {', '.join(MODELS)}."
        )
    if len(parameters) != len(MODELS[name].parameters):
        raise HoloreelError(f"{path}: {name} has {len(MODELS[name].parameters)} parameters, not {len(parameters)}.")
    return _Lens(name, width, height, parameters)


def _read_lenses_bin(path: Path) -> dict[int, _Lens]:
    cursor = _Cursor(path)
    lenses = {}
    for _ in range(cursor.count(24, MAX_IMAGES)):
        number, model, width, height = cursor.take("iiQQ")
        name = _BY_NUMBER.get(model)
        size = len(MODELS[name].parameters) if name else 0
        lenses[number] = _lens(path, name or f"number {model}", width, height, cursor.take(f"{size}d"))
    return lenses


def _read_poses_bin(path: Path) -> list[_Pose]:
    cursor = _Cursor(path)
    poses = []
    for _ in range(cursor.count(73, MAX_IMAGES)):
        values = cursor.take("I7dI")
        poses.append(_Pose(values[1:5], values[5:8], values[8], cursor.text()))
        cursor.skip(cursor.count(24) * 24)  # where the image saw points
    return poses


def _lines(path: Path) -> list[list[str]]:
    """The words of each line that is no comment; empty lines stay, because images.txt has lines in pairs."""
    text = _bytes(path).decode("utf-8", "replace")
    return [line.split() for line in text.splitlines() if not line.startswith("#")]


def _read_lenses_txt(path: Path) -> dict[int, _Lens]:
    lenses = {}
    for words in filter(None, _lines(path)):
        try:
            number, width, height = int(words[0]), int(words[2]), int(words[3])
            lenses[number] = _lens(path, words[1], width, height, tuple(map(float, words[4:])))
        except (ValueError, IndexError) as error:
            raise _bad_line(path, words, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS") from error
    return lenses


def _read_poses_txt(path: Path) -> list[_Pose]:
    poses = []
    lines = _lines(path)
    while lines and not lines[0]:
        lines.pop(0)
    for words in filter(None, lines[::2]):
        try:
            numbers = tuple(map(float, words[1:8]))
            poses.append(_Pose(numbers[:4], numbers[4:7], int(words[8]), " ".join(words[9:])))
        except (ValueError, IndexError) as error:
            raise _bad_line(path, words, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME") from error
    return poses


def _bad_line(path: Path, words: list[str], expected: str) -> HoloreelError:
    return HoloreelError(f"{path}: the line {' '.join(words)[:60]!r} is not {expected}; export the model again.")


def read_points3d(path: Path) -> Points:
    """Read points3D.bin or points3D.txt; points that are not finite are refused."""
    xyz, rgb = (_read_points_bin if path.suffix == ".bin" else _read_points_txt)(path)
    if not np.isfinite(xyz).all():
        raise HoloreelError(f"{path}: a point is NaN or infinite; export the model again.")
    return Points(xyz.astype(np.float32), rgb)


def _read_points_bin(path: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    cursor = _Cursor(path)
    count = cursor.count(51)
    xyz, rgb = np.empty((count, 3)), np.empty((count, 3), np.uint8)
    for index in range(count):
        values = cursor.take("Q3d3BdQ")
        xyz[index], rgb[index] = values[1:4], values[4:7]
        cursor.skip(min(values[8], len(cursor.data)) * 8)  # the track: which images saw the point
    return xyz, rgb


def _read_points_txt(path: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    rows = []
    for words in filter(None, _lines(path)):
        try:
            rows.append([float(word) for word in words[1:7]])
            if len(rows[-1]) != 6 or not all(0 <= color <= 255 for color in rows[-1][3:]):
                raise ValueError("colors are 0 to 255")
        except ValueError as error:
            raise _bad_line(path, words, "POINT3D_ID X Y Z R G B ERROR TRACK") from error
    table = np.array(rows).reshape(-1, 6)
    return table[:, :3], table[:, 3:].astype(np.uint8)


def write_model(folder: Path, cameras: dict[str, Camera], points: Points, suffix: str = ".bin") -> None:
    """Write cameras (by image name; one COLMAP camera each), images and points3D, as .bin or .txt, each atomically."""
    binary = suffix == ".bin"
    rows = [(number, name, camera) for number, (name, camera) in enumerate(cameras.items(), start=1)]
    files = {
        "cameras": [_lens_row(number, camera) for number, _, camera in rows],
        "images": [_pose_row(number, name, camera) for number, name, camera in rows],
        "points3D": [
            (index, *map(float, xyz), *map(int, rgb), 0.0)
            for index, (xyz, rgb) in enumerate(zip(points.xyz, points.rgb, strict=True), start=1)
        ],
    }
    packers = {"cameras": _pack_lens, "images": _pack_pose, "points3D": _pack_point}
    for name, table in files.items():
        with atomic_path(folder / f"{name}{suffix}") as temporary:
            if binary:
                temporary.write_bytes(struct.pack("<Q", len(table)) + b"".join(map(packers[name], table)))
            else:
                after = "\n\n" if name == "images" else "\n"  # the second line of an image: no points
                temporary.write_text("".join(" ".join(map(str, row)) + after for row in table), encoding="utf-8")


def _lens_row(number: int, camera: Camera) -> tuple:
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
    return (number, camera.model, camera.width, camera.height, *intrinsics, *camera.distortion)


def _pose_row(number: int, name: str, camera: Camera) -> tuple:
    matrix = camera.world_to_camera
    quaternion = quaternion_from_matrix(matrix[:3, :3]).tolist()
    return (number, *quaternion, *matrix[:3, 3].tolist(), number, name)


def _pack_lens(row: tuple) -> bytes:
    number, model, width, height, *parameters = row
    return struct.pack(f"<iiQQ{len(parameters)}d", number, MODELS[model].number, width, height, *parameters)


def _pack_pose(row: tuple) -> bytes:
    return struct.pack("<I7dI", *row[:9]) + row[9].encode() + b"\0" + struct.pack("<Q", 0)


def _pack_point(row: tuple) -> bytes:
    return struct.pack("<Q3d3BdQ", *row, 0)
