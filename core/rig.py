# SPDX-License-Identifier: GPL-3.0-or-later
"""Camera rigs: presets that turn a few numbers into a list of cameras, and the rule that fits them to a scene.

The world's z points up. A rig stands around a target point; its middle is seen from the target at `azimuth_degrees`
(counter-clockwise from +x, seen from above; -90 is the front) and `elevation_degrees`.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .camera import Camera, focal_from_fov
from .errors import HoloreelError

Vector = tuple[float, float, float]

MAX_CAMERAS = 1000
_DEFAULT_FOV_DEGREES = 50.0
_DEFAULT_AZIMUTH_DEGREES = -90.0
_DEFAULT_ELEVATION_DEGREES = 15.0
_GOLDEN_ANGLE_DEGREES = 180 * (3 - 5**0.5)
_MARGIN = 1.1  # of the bounds' sphere, where no camera says how far away to stand


@dataclass(frozen=True)
class RigSettings:
    """What the presets are made from. `fov_degrees` is horizontal; `rise_degrees` lifts and lowers cameras in turn."""

    cameras: int
    width: int
    height: int
    target: Vector
    radius: float
    azimuth_degrees: float
    elevation_degrees: float
    fov_degrees: float
    span_degrees: float = 50.0
    rise_degrees: float = 4.0


@dataclass(frozen=True)
class RigRequest:
    """What the user asks for; None leaves it to the scene (see `fit_to_scene`)."""

    cameras: int
    width: int
    height: int
    target: Vector | None = None
    radius: float | None = None
    azimuth_degrees: float | None = None
    elevation_degrees: float | None = None
    fov_degrees: float | None = None
    span_degrees: float = 50.0
    rise_degrees: float = 4.0


@dataclass(frozen=True)
class SceneFacts:
    """What a rig wants to know of a scene: its active camera, a point marked as target, the bounds of its meshes."""

    camera: Camera | None = None
    target: Vector | None = None
    bounds: tuple[Vector, Vector] | None = None


@dataclass(frozen=True)
class Preset:
    """A way to place cameras, and what a request says where its user does not."""

    place: Callable[[RigSettings], list[Camera]]
    span_degrees: float
    rise_degrees: float
    elevation_degrees: float | None = None  # None: the active camera's


def request(preset: str, cameras: int, width: int, height: int, **wishes: Any) -> RigRequest:
    """Return the request for a preset's rig; `wishes` are fields of `RigRequest`, and those that are None are open.

    What the preset has an opinion on is filled in. Raises `HoloreelError` where there is no such preset.
    """
    chosen = _preset(preset)
    said = {name: value for name, value in wishes.items() if value is not None}
    opinion = {key: getattr(chosen, key) for key in ("span_degrees", "rise_degrees", "elevation_degrees")}
    return RigRequest(cameras, width, height, **(opinion | said))


def fit_to_scene(request: RigRequest, scene: SceneFacts) -> RigSettings:
    """Fill in what the request leaves open.

    - target: the request's, else the point marked in the scene, else the point of the active camera's axis nearest to
      the middle of the bounds, else that middle, else the origin.
    - radius, azimuth, elevation: the place of the active camera seen from the target, else far enough to see the
      bounds' sphere, from the front, 15° up.
    - field of view: the active camera's (horizontal), else 50°.
    """
    middle, extent = _middle_and_extent(scene)
    camera = scene.camera
    target = request.target or scene.target or (_nearest_on_axis(camera, middle) if camera else middle)
    fov = request.fov_degrees
    if fov is None:
        fov = math.degrees(2 * math.atan(camera.width / 2 / camera.fx)) if camera else _DEFAULT_FOV_DEGREES
    azimuth, elevation = _DEFAULT_AZIMUTH_DEGREES, _DEFAULT_ELEVATION_DEGREES
    narrow = math.radians(fov) * min(1.0, request.height / request.width)
    radius = _MARGIN * extent / math.sin(min(narrow, math.pi) / 2)
    if camera:
        offset = camera.center - target
        radius = float(np.linalg.norm(offset))
        azimuth = math.degrees(math.atan2(offset[1], offset[0]))
        elevation = math.degrees(math.asin(np.clip(offset[2] / max(radius, 1e-12), -1, 1)))
    return RigSettings(
        cameras=request.cameras,
        width=request.width,
        height=request.height,
        target=target,
        radius=radius if request.radius is None else request.radius,
        azimuth_degrees=azimuth if request.azimuth_degrees is None else request.azimuth_degrees,
        elevation_degrees=elevation if request.elevation_degrees is None else request.elevation_degrees,
        fov_degrees=fov,
        span_degrees=request.span_degrees,
        rise_degrees=request.rise_degrees,
    )


def make_rig(preset: str, settings: RigSettings) -> list[Camera]:
    """Return the cameras of a preset, named cam00, cam01, …; raises `HoloreelError` for numbers that make no rig."""
    chosen = _preset(preset)
    if not 1 <= settings.cameras <= MAX_CAMERAS:
        raise HoloreelError(f"a rig has 1 to {MAX_CAMERAS} cameras, not {settings.cameras}.")
    if not (math.isfinite(settings.radius) and settings.radius > 1e-6):
        raise HoloreelError(
            f"the radius of a rig must be positive, not {settings.radius:g}; give --radius or a target."
        )
    if not 0 <= settings.span_degrees <= 360:
        raise HoloreelError(f"the span of a rig lies between 0 and 360 degrees, not {settings.span_degrees:g}.")
    if abs(settings.elevation_degrees) + abs(settings.rise_degrees) >= 90:
        raise HoloreelError("elevation and rise of a rig must together stay under 90 degrees; give a lower elevation.")
    return chosen.place(settings)


def arc(settings: RigSettings) -> list[Camera]:
    """Cameras evenly spaced on a frontal arc, all aimed at the target.

    cam00 stands in the middle, so that holding it out asks for interpolation; the others follow from left to right as
    the cameras see it. Neighbors stand at three elevations in turn, so that there is vertical parallax.
    """
    count, middle = settings.cameras, (settings.cameras - 1) // 2
    steps = np.linspace(-0.5, 0.5, count) if count > 1 else np.zeros(1)
    order = [middle, *(place for place in range(count) if place != middle)]
    cameras = []
    for index, place in enumerate(order):
        lift = (0, 1, -1)[(place - middle) % 3]
        azimuth = settings.azimuth_degrees + settings.span_degrees * float(steps[place])
        elevation = settings.elevation_degrees + settings.rise_degrees * lift
        cameras.append(_aimed(settings, azimuth, elevation, camera_name(index, count)))
    return cameras


def dome(settings: RigSettings) -> list[Camera]:
    """Cameras all around and above the target, all aimed at it.

    From one camera to the next the azimuth grows by the golden angle (scaled by span / 360), so that any few in a row
    look from all sides; elevations rise evenly, in steps of equal area on the sphere, by `rise_degrees` either way of
    `elevation_degrees`.
    """
    count, middle, rise = settings.cameras, settings.elevation_degrees, abs(settings.rise_degrees)
    lowest, highest = (math.sin(math.radians(middle + lift)) for lift in (-rise, rise))
    cameras = []
    for index in range(count):
        turned = index * _GOLDEN_ANGLE_DEGREES % 360 * settings.span_degrees / 360
        elevation = math.degrees(math.asin(lowest + (highest - lowest) * (index + 0.5) / count))
        cameras.append(_aimed(settings, settings.azimuth_degrees + turned, elevation, camera_name(index, count)))
    return cameras


PRESETS = {
    "arc": Preset(arc, span_degrees=50.0, rise_degrees=4.0),
    "dome": Preset(dome, span_degrees=360.0, rise_degrees=35.0, elevation_degrees=30.0),
}


def _preset(name: str) -> Preset:
    if name not in PRESETS:
        raise HoloreelError(f"there is no rig {name!r}; take one of {', '.join(PRESETS)}.")
    return PRESETS[name]


def camera_name(index: int, count: int) -> str:
    """The name of camera `index` of `count`: cam00, cam01, …"""
    return f"cam{index:0{max(2, len(str(count - 1)))}d}"


def _aimed(settings: RigSettings, azimuth_degrees: float, elevation_degrees: float, name: str) -> Camera:
    azimuth, elevation = math.radians(azimuth_degrees), math.radians(elevation_degrees)
    direction = np.array(
        [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
    )
    return Camera.look_at(
        np.asarray(settings.target) + settings.radius * direction,
        settings.target,
        width=settings.width,
        height=settings.height,
        fx=focal_from_fov(settings.fov_degrees, settings.width),
        name=name,
    )


def _middle_and_extent(scene: SceneFacts) -> tuple[Vector, float]:
    """Middle of the bounds and the radius of the sphere around them."""
    if scene.bounds is None:
        return (0.0, 0.0, 0.0), 1.0
    low, high = np.asarray(scene.bounds[0]), np.asarray(scene.bounds[1])
    middle = (low + high) / 2
    return _vector(middle), max(float(np.linalg.norm(high - low)) / 2, 1e-3)


def _nearest_on_axis(camera: Camera, point: Vector) -> Vector:
    """The point of the camera's optical axis nearest to `point`, in front of the camera."""
    forward = camera.world_to_camera[2, :3]
    depth = float(forward @ (np.asarray(point) - camera.center))
    distance = float(np.linalg.norm(np.asarray(point) - camera.center))
    return _vector(camera.center + forward * (depth if depth > 1e-3 * max(distance, 1e-6) else max(distance, 1.0)))


def _vector(values: NDArray[np.float64]) -> Vector:
    return float(values[0]), float(values[1]), float(values[2])
