# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's fisheye cameras as numbers, and what they mean as a `Camera`. Needs numpy only, no bpy.

A point at the angle θ from the axis lands at the distance r from the picture's middle, as in Cycles:

    EQUIDISTANT   r = θ / fov of the picture's width across and of its height down, whatever the sensor
    EQUISOLID     r = 2 lens sin(θ / 2) mm on the sensor
    POLYNOMIAL    θ = −(k0 + k1 r + k2 r² + k3 r³ + k4 r⁴), r in mm on the sensor

The sensor spans the picture as a perspective camera's does (`camera_blender`); shifts are shares of the width and of
the height. As an OPENCV_FISHEYE, r / f = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸), fitted where it is not exact.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .camera import Camera
from .camera_blender import BlenderCamera
from .errors import HoloreelError
from .lens import fisheye_limit

Array = NDArray[np.float64]

EQUIDISTANT, EQUISOLID, POLYNOMIAL = "FISHEYE_EQUIDISTANT", "FISHEYE_EQUISOLID", "FISHEYE_LENS_POLYNOMIAL"
KINDS = (EQUIDISTANT, EQUISOLID, POLYNOMIAL)
TOLERANCE_PX = 0.1  # how far the fit may be off
NO_TERMS: tuple[float, ...] = (0.0,) * 4
_SAMPLES = 512


@dataclass(frozen=True)
class Fisheye:
    """The lens of a fisheye camera: one of `KINDS`, `fov` in radians, `lens` in mm, `polynomial` k0 to k4."""

    kind: str
    fov: float
    lens: float = 10.5
    polynomial: tuple[float, ...] = (0.0,) * 5


def fisheye_camera(settings: BlenderCamera, fisheye: Fisheye) -> Camera:
    """Return a fisheye camera as a `Camera`; of `settings`, everything but `lens` counts.

    Raises `HoloreelError` where the lens cannot be one, or is none that OPENCV_FISHEYE can follow.
    """
    plain = replace(settings, lens=1.0, shift_x=0.0, shift_y=0.0).to_camera()  # its focal lengths are pixels per mm
    width, height = plain.width, plain.height
    cx, cy = width * (0.5 - settings.shift_x), height * (0.5 + settings.shift_y)
    if not 0 < fisheye.fov <= 2 * math.pi:
        raise _error(settings, f"has the field of view {math.degrees(fisheye.fov):g}°, not one up to 360°")
    if fisheye.kind == EQUIDISTANT:
        focal, terms = (width / fisheye.fov, height / fisheye.fov), NO_TERMS
    else:
        reach = math.hypot(max(abs(cx), abs(width - cx)) / plain.fx, max(abs(cy), abs(height - cy)) / plain.fy)
        theta, radius = _curve(settings, fisheye, reach)
        scale, terms = _fit(settings, theta, radius, TOLERANCE_PX / max(plain.fx, plain.fy))
        focal = scale * plain.fx, scale * plain.fy
    return replace(plain, fx=focal[0], fy=focal[1], cx=cx, cy=cy, model="OPENCV_FISHEYE", distortion=terms)


def _curve(settings: BlenderCamera, fisheye: Fisheye, reach: float) -> tuple[Array, Array]:
    """Sample angles and distances in mm, as far as the picture and the field of view go."""
    if fisheye.kind == EQUISOLID:
        if not fisheye.lens > 0:
            raise _error(settings, "has a fisheye lens without length")
        theta = np.linspace(0, min(fisheye.fov / 2, 2 * math.asin(min(reach / (2 * fisheye.lens), 1.0))), _SAMPLES)
        return theta, 2 * fisheye.lens * np.sin(theta / 2)
    radius = np.linspace(0, reach, _SAMPLES)
    theta = -np.polynomial.polynomial.polyval(radius, np.array(fisheye.polynomial))
    if abs(theta[0]) > 1e-3:
        raise _error(settings, "has a fisheye polynomial with a K0 that is not 0")
    seen = (theta <= fisheye.fov / 2) & np.concatenate([[True], np.diff(theta) > 0])
    count = len(seen) if seen.all() else int(np.argmin(seen))
    if count < _SAMPLES // 16:
        raise _error(settings, "has a fisheye polynomial that sees next to nothing (K1 should be negative)")
    return theta[:count], radius[:count]


def _fit(settings: BlenderCamera, theta: Array, radius: Array, tolerance: float) -> tuple[float, tuple[float, ...]]:
    """Return f and k1 to k4 with radius = f θ (1 + k1 θ² + ...), at most `tolerance` off."""
    powers = theta[:, None] ** np.arange(1, 10, 2)
    sizes = np.abs(powers).max(axis=0)
    found = np.linalg.lstsq(powers / sizes, radius, rcond=None)[0] / sizes
    off = float(np.abs(powers @ found - radius).max())
    terms = tuple(float(value) for value in found[1:] / found[0]) if found[0] > 0 else (math.nan,)
    if not found[0] > 0 or off > tolerance or fisheye_limit(terms) < theta[-1]:
        raise _error(settings, "has a fisheye lens that no OPENCV_FISHEYE follows to a tenth of a pixel")
    return float(found[0]), terms


def _error(settings: BlenderCamera, text: str) -> HoloreelError:
    return HoloreelError(f"camera '{settings.name}' {text}; change its lens.")
