# SPDX-License-Identifier: GPL-3.0-or-later
"""The camera that everything else speaks of.

Axes are OpenCV's (x right, y down, z forward); pixel centers lie at +0.5, so the middle of a W × H image is (W/2, H/2);
extrinsics are world-to-camera. Other conventions are converted where files are read and written, once.
"""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import HoloreelError
from .files import finite, read_json, write_json
from .lens import MODELS

Array = NDArray[np.float64]

MAX_SIZE = 1 << 16  # pixels along one side
MAX_COORDINATE = 1e15  # of a camera's place
MAX_DISTORTION = 1e6  # of one distortion parameter
BLOCK = 1 << 13  # pixels inverted at once, whose temporaries fit a processor's cache
RIGID_TOLERANCE = 1e-3  # largest entry of RᵀR − 1 that still counts as rounding


@dataclass(frozen=True, eq=False)
class Camera:
    """One calibrated camera.

    `fx fy cx cy` are in pixels; `world_to_camera` is 4 × 4 with an orthonormal rotation; `model` is COLMAP's name and
    `distortion` its parameters beyond those four, in COLMAP's order (`holoreel.core.lens`): none for PINHOLE.
    Raises `HoloreelError` naming a field that is not possible. A rotation that is off by rounding is made orthonormal.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: Array = field(default_factory=lambda: np.eye(4))
    model: str = "PINHOLE"
    name: str = ""
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        set_field = object.__setattr__  # the dataclass is frozen for everybody else
        if not isinstance(self.name, str):
            raise HoloreelError(f"camera: name must be text, not {_short(self.name)}.")
        if not isinstance(self.model, str) or self.model not in MODELS:
            raise self._error(
                "model", f"{_short(self.model)} is not supported; undistort it to one of {', '.join(MODELS)}"
            )
        set_field(self, "distortion", self._distortion())
        for key in ("width", "height"):
            set_field(self, key, self._size(key))
        for key in ("fx", "fy", "cx", "cy"):
            set_field(self, key, self._number(key))
        set_field(self, "world_to_camera", self._rigid())

    def _error(self, key: str, text: str) -> HoloreelError:
        return HoloreelError(f"camera {self.name!r}: {key} {text}." if self.name else f"camera: {key} {text}.")

    def _number(self, key: str) -> float:
        value = finite(getattr(self, key))
        if value is None:
            raise self._error(key, f"must be a finite number, not {_short(getattr(self, key))}")
        if key in ("fx", "fy") and value <= 0:
            raise self._error(key, f"must be positive, not {value!r}")
        return value

    def _size(self, key: str) -> int:
        value = self._number(key)
        if value != int(value) or not 1 <= value <= MAX_SIZE:
            raise self._error(key, f"must be a whole number of pixels from 1 to {MAX_SIZE}, not {value:g}")
        return int(value)

    def _distortion(self) -> tuple[float, ...]:
        names = MODELS[self.model].parameters
        given = self.distortion
        values = [finite(value) for value in given] if isinstance(given, list | tuple | np.ndarray) else [None]
        numbers = tuple(value for value in values if value is not None and abs(value) <= MAX_DISTORTION)
        if len(values) != len(names) or len(numbers) != len(names):
            wanted = f"{len(names)} numbers ({', '.join(names)}) up to {MAX_DISTORTION:g}" if names else "empty"
            raise self._error("distortion", f"of a {self.model} camera must be {wanted}, not {_short(given)}")
        return numbers

    def _rigid(self) -> Array:
        try:
            matrix = rigid(self.world_to_camera)
        except ValueError as error:
            raise self._error("world_to_camera", str(error)) from error
        matrix.flags.writeable = False
        return matrix

    @property
    def K(self) -> Array:
        """Intrinsics as a 3 × 3 matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def camera_to_world(self) -> Array:
        """The inverse extrinsics, 4 × 4 (exact for a rigid transform)."""
        return invert_rigid(self.world_to_camera)

    @property
    def center(self) -> Array:
        """The point all rays start from, in the world."""
        return self.camera_to_world[:3, 3]

    def project(self, points: ArrayLike) -> tuple[Array, Array]:
        """Project world points (N, 3) to pixels (N, 2) and depths (N,), the z of camera space.

        A point is in front of the camera where z > 0; pixels of others mean nothing for a PINHOLE. Pixels are NaN for
        points that a lens with distortion cannot see.
        """
        local = np.asarray(points, np.float64) @ self.world_to_camera[:3, :3].T + self.world_to_camera[:3, 3]
        plane = MODELS[self.model].to_plane(self.distortion, local)
        return plane * (self.fx, self.fy) + (self.cx, self.cy), local[:, 2]

    def unproject(self, uv: ArrayLike, z: ArrayLike) -> Array:
        """Return the world points (N, 3) at pixels `uv` (N, 2) and planar depths `z` (N,).

        NaN where the lens sees nothing at a pixel, or nothing in front of the camera (a fisheye beyond 90°).
        """
        directions = self._directions(uv)
        with np.errstate(divide="ignore", invalid="ignore"):
            along = np.where(directions[:, 2] > 0, np.asarray(z, np.float64) / directions[:, 2], np.nan)
        local = directions * along[:, None]
        return self._to_world(local) + self.center

    def rays(self, pixels: ArrayLike | None = None) -> tuple[Array, Array]:
        """Return world-space origins (N, 3) and unit directions (N, 3) through `pixels` (N, 2).

        Without `pixels`: through the centers of all pixels, row by row. Directions are NaN where the lens sees nothing.
        """
        directions = self._to_world(self._directions(self.pixel_centers() if pixels is None else pixels))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return np.broadcast_to(self.center, directions.shape).copy(), directions

    def pixel_centers(self) -> Array:
        """The centers of all pixels, (height · width, 2), row by row."""
        v, u = np.mgrid[: self.height, : self.width]
        return np.stack([u.ravel() + 0.5, v.ravel() + 0.5], axis=1)

    def _directions(self, uv: ArrayLike) -> Array:
        plane = (np.asarray(uv, np.float64) - (self.cx, self.cy)) / (self.fx, self.fy)
        from_plane = MODELS[self.model].from_plane
        blocks = [from_plane(self.distortion, plane[i : i + BLOCK]) for i in range(0, max(len(plane), 1), BLOCK)]
        return blocks[0] if len(blocks) == 1 else np.concatenate(blocks)

    def _to_world(self, directions: Array) -> Array:
        return directions @ self.world_to_camera[:3, :3]

    def require_pinhole(self, what: str) -> None:
        """Raise `HoloreelError` unless the camera is a PINHOLE, the only lens that `what` knows."""
        if self.model != "PINHOLE":
            raise self._error("model", f"is {self.model}, but {what} knows PINHOLE alone; undistort the pictures first")

    def scaled(self, width: int, height: int) -> "Camera":
        """The same camera with another resolution: it sees the same, in `width` × `height` pixels."""
        x, y = width / self.width, height / self.height
        return replace(self, width=width, height=height, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y)

    @classmethod
    def look_at(
        cls,
        eye: ArrayLike,
        target: ArrayLike,
        up: ArrayLike = (0.0, 0.0, 1.0),
        *,
        width: int,
        height: int,
        fx: float,
        fy: float | None = None,
        name: str = "",
    ) -> "Camera":
        """A camera at `eye` that has `target` in its middle and `up` upward in the picture (`fy` is `fx` unless given).

        Where the view is along `up`, world y (or x) takes its place.
        """
        eye = np.asarray(eye, np.float64)
        forward = np.asarray(target, np.float64) - eye
        length = float(np.linalg.norm(forward))
        if not length > 0:
            raise HoloreelError(f"camera {name!r}: eye and target must be two different points.")
        forward /= length
        for candidate in (up, (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)):
            right = np.cross(forward, np.asarray(candidate, np.float64))
            if np.linalg.norm(right) > 1e-6:
                break
        right /= np.linalg.norm(right)
        matrix = np.eye(4)
        matrix[:3, :3] = np.stack([right, np.cross(forward, right), forward])
        matrix[:3, 3] = -matrix[:3, :3] @ eye
        return cls(width, height, fx, fx if fy is None else fy, width / 2, height / 2, matrix, name=name)

    def to_json(self) -> dict[str, Any]:
        """Return what CAMERA.json holds: `world_to_camera` as 4 rows, `distortion` where the model has any."""
        keys = ("model", "width", "height", "fx", "fy", "cx", "cy")
        value = {key: getattr(self, key) for key in keys}
        if self.distortion:
            value["distortion"] = list(self.distortion)
        value["world_to_camera"] = self.world_to_camera.tolist()
        return value | ({"name": self.name} if self.name else {})

    @classmethod
    def from_json(cls, value: dict[str, Any], source: str | Path = "camera") -> "Camera":
        """Make a camera from `to_json`'s dictionary; errors begin with `source`."""
        needed = {"model", "width", "height", "fx", "fy", "cx", "cy", "world_to_camera"}
        model = value.get("model")
        if isinstance(model, str) and model in MODELS and MODELS[model].parameters:
            needed.add("distortion")
        if isinstance(model, str) and model not in MODELS:
            raise HoloreelError(f"{source}: model {model!r} is not supported; undistort it to {', '.join(MODELS)}.")
        if missing := sorted(needed - set(value)):
            raise HoloreelError(f"{source}: {missing[0]} is missing; a camera has {', '.join(sorted(needed))}.")
        if unknown := sorted(set(value) - needed - {"name"}):
            raise HoloreelError(f"{source}: {unknown[0]} is not a field of a {model} camera; take it out.")
        try:
            return cls(**value)
        except HoloreelError as error:
            raise HoloreelError(f"{source}: {error}") from error


def _short(value: object) -> str:
    """A value for a sentence."""
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


def focal_from_fov(fov_degrees: float, pixels: int) -> float:
    """Focal length in pixels of a pinhole whose `pixels` along one side span `fov_degrees`."""
    if not 0 < fov_degrees < 180:
        raise HoloreelError(f"a field of view must lie between 0 and 180 degrees, not {fov_degrees:g}.")
    return pixels / 2 / math.tan(math.radians(fov_degrees) / 2)


def rigid(matrix: ArrayLike) -> Array:
    """Return `matrix` as a 4 × 4 rotation and translation, rounding removed; a ValueError says what it is instead."""
    try:
        result = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError("must be 4 rows of 4 numbers") from error
    if result.shape != (4, 4):
        raise ValueError(f"must be 4 rows of 4 numbers, not of shape {result.shape}")
    if not (np.abs(result) < MAX_COORDINATE).all():
        raise ValueError(f"holds NaN, infinity or a number beyond {MAX_COORDINATE:g}")
    rotation = result[:3, :3]
    offset = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if offset > RIGID_TOLERANCE or np.linalg.det(rotation) < 0 or np.abs(result[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise ValueError("must be a rotation and a translation (no scale, shear or mirroring)")
    if offset > 1e-12:
        left, _, right = np.linalg.svd(rotation)
        result[:3, :3] = left @ right
    result[3] = (0, 0, 0, 1)
    return result


def invert_rigid(matrix: Array) -> Array:
    """Invert a 4 × 4 rigid transform."""
    inverse = np.eye(4)
    inverse[:3, :3] = matrix[:3, :3].T
    inverse[:3, 3] = -inverse[:3, :3] @ matrix[:3, 3]
    return inverse


def read_camera(path: str | Path) -> Camera:
    """Read a CAMERA.json (keys model, width, height, fx, fy, cx, cy, world_to_camera as 4 rows, name optional).

    A camera whose model is not PINHOLE also has `distortion`, a list of its parameters in COLMAP's order.
    """
    return Camera.from_json(read_json(path), path)


def write_camera(path: str | Path, camera: Camera) -> None:
    """Write a CAMERA.json, atomically."""
    write_json(path, camera.to_json())
