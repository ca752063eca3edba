# SPDX-License-Identifier: GPL-3.0-or-later
"""Lens models: from camera space to the plane that fx, fy, cx, cy turn into pixels, and back.

Names, parameters and formulas are COLMAP's (https://colmap.github.io/cameras.html), which are OpenCV's. Every model is
invertible where it says that it sees something: a polynomial that turns back at some angle ends there, and points
beyond it (which the formula alone would fold back into the picture) come out as NaN.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.polynomial import Polynomial, polynomial
from numpy.typing import NDArray

Array = NDArray[np.float64]
Parameters = tuple[float, ...]

_STEPS = 400  # of an iteration; it takes about 6, but halves brackets of 1e100 for points beside the camera
_RESIDUAL = 1e-12  # of the plane, relative to 1 + the distance from its middle: no more is a solution
_ENOUGH = 1e-14  # the same: no less is sought


@dataclass(frozen=True)
class LensModel:
    """How one camera model maps camera space to the plane (before fx, fy, cx, cy) and back; NaN where it cannot."""

    parameters: tuple[str, ...]  # names, in COLMAP's order
    to_plane: Callable[[Parameters, Array], Array]  # points (N, 3) -> (N, 2)
    from_plane: Callable[[Parameters, Array], Array]  # (N, 2) -> directions (N, 3) of any positive length


def _pinhole_to_plane(_parameters: Parameters, points: Array) -> Array:
    with np.errstate(divide="ignore", invalid="ignore"):
        return points[:, :2] / points[:, 2:]


def _pinhole_from_plane(_parameters: Parameters, plane: Array) -> Array:
    return np.concatenate([plane, np.ones((len(plane), 1))], axis=1)


# Brown's model, with s = x² + y² and g = (1 + k1 s + k2 s² + k3 s³) / (1 + k4 s + k5 s² + k6 s³):
#     x' = x g + 2 p1 x y + p2 (s + 2 x²)        y' = y g + p1 (s + 2 y²) + 2 p2 x y


def _brown_polynomials(k: Parameters) -> tuple[Array, Array]:
    """Numerator and denominator of g in s, ascending; `k` is (k1 k2 p1 p2) or (k1 k2 p1 p2 k3 k4 k5 k6)."""
    k3, k4, k5, k6 = k[4:] or (0.0,) * 4
    return np.array([1.0, k[0], k[1], k3]), np.array([1.0, k4, k5, k6])


@lru_cache(maxsize=1024)
def brown_limit(k: Parameters) -> float:
    """The radius on the plane z = 1 within which Brown's map cannot fold.

    Its Jacobian is symmetric; where it is positive definite on a disk, the map is the gradient of a convex function
    there and hence one to one. Along and across the radius, its diagonal is f' = d(r g)/dr and g, to which
    p = |(p1, p2)| adds no less than -6 r p and -2 r p; off the diagonal are no more than 2 r p. Gershgorin's circles
    stay positive where f' > 8 r p and g > 4 r p.
    """
    r = Polynomial([0.0, 1.0])
    top, bottom = (Polynomial(coefficients)(r * r) for coefficients in _brown_polynomials(k))
    p = math.hypot(k[2], k[3])
    slope = (r * top).deriv() * bottom - r * top * bottom.deriv() - 8 * p * r * bottom * bottom
    return min(_first_root(slope), _first_root(top - 4 * p * r * bottom), _first_root(bottom))


def _first_root(one_at_zero: Polynomial) -> float:
    """The smallest positive root of a polynomial that is 1 at 0; infinity where it has none.

    Roots are sought for 1/x, whose polynomial has the leading coefficient 1, however small the others are.
    """
    roots = np.roots(one_at_zero.coef)
    real = roots.real[(np.abs(roots.imag) <= 1e-7 * np.abs(roots)) & (roots.real > 1e-12)]
    return float(1 / real.max()) if len(real) else math.inf


def _brown(k: Parameters, x: Array, y: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Map (x, y); return both coordinates and the symmetric Jacobian's entries xx, xy, yy."""
    top, bottom = _brown_polynomials(k)
    p1, p2 = k[2:4]
    s = x * x + y * y
    n, d = polynomial.polyval(s, top), polynomial.polyval(s, bottom)
    g = n / d
    slope = (polynomial.polyval(s, polynomial.polyder(top)) - g * polynomial.polyval(s, polynomial.polyder(bottom))) / d
    xy = x * y
    return (
        x * g + 2 * p1 * xy + p2 * (s + 2 * x * x),
        y * g + p1 * (s + 2 * y * y) + 2 * p2 * xy,
        g + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x,
        2 * xy * slope + 2 * p1 * x + 2 * p2 * y,
        g + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x,
    )


def _brown_to_plane(k: Parameters, points: Array) -> Array:
    with np.errstate(all="ignore"):
        x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
        plane = np.stack(_brown(k, x, y)[:2], axis=1)
        plane[~((points[:, 2] > 0) & (np.hypot(x, y) < brown_limit(k)))] = np.nan
    return plane


def _brown_from_plane(k: Parameters, plane: Array) -> Array:
    """Invert the radial part by itself, then all of it by Newton's method with step halving."""
    limit = brown_limit(k)
    top, bottom = _brown_polynomials(k)
    top_slope, bottom_slope = polynomial.polyder(top), polynomial.polyder(bottom)

    def radial(r: Array) -> tuple[Array, Array]:
        s = r * r
        n, d = polynomial.polyval(s, top), polynomial.polyval(s, bottom)
        g = n / d
        return r * g, g + 2 * s * (polynomial.polyval(s, top_slope) - g * polynomial.polyval(s, bottom_slope)) / d

    with np.errstate(all="ignore"):
        radius = np.hypot(plane[:, 0], plane[:, 1])
        start = _invert_increasing(radial, radius, limit, 1e-6)
        start = np.where(np.isnan(start), limit * (1 - 1e-6), start)  # the tangential part may bring it back
        found = plane * np.where(radius > 0, start / radius, 1.0)[:, None]
        todo = np.arange(len(plane))
        for _ in range(_STEPS):
            better = _brown_step(k, plane[todo], found[todo], limit)
            moved = (better != found[todo]).any(axis=1)
            found[todo] = better
            todo = todo[moved]
            if not len(todo):
                break
        u, v, *_rest = _brown(k, found[:, 0], found[:, 1])
        error = np.hypot(u - plane[:, 0], v - plane[:, 1])
        good = (error <= _RESIDUAL * (1 + radius)) & (np.hypot(found[:, 0], found[:, 1]) < limit)
    directions = np.concatenate([found, np.ones((len(found), 1))], axis=1)
    directions[~good] = np.nan
    return directions


def _brown_step(k: Parameters, plane: Array, found: Array, limit: float) -> Array:
    """One step of Newton's method towards `plane`, halved until it is nearer; no step where none helps."""
    u, v, xx, xy, yy = _brown(k, found[:, 0], found[:, 1])
    du, dv = plane[:, 0] - u, plane[:, 1] - v
    step = np.stack([yy * du - xy * dv, xx * dv - xy * du], axis=1) / (xx * yy - xy * xy)[:, None]
    error = np.hypot(du, dv)
    step[~(error > _ENOUGH * (1 + np.hypot(plane[:, 0], plane[:, 1])))] = 0.0
    for _ in range(6):
        x, y = (found + step).T
        u, v, *_rest = _brown(k, x, y)
        worse = ~((np.hypot(plane[:, 0] - u, plane[:, 1] - v) < error) & (np.hypot(x, y) < limit))
        if not (worse & step.any(axis=1)).any():
            return found + step
        step[worse] /= 2
    step[worse] = 0.0
    return found + step


# OpenCV's fisheye, with the angle θ from the axis: θ' = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸), and the plane's point
# lies at the distance θ' from its middle, in the direction of (x, y).


@lru_cache(maxsize=1024)
def fisheye_limit(k: Parameters) -> float:
    """The angle from the axis, in radians and at most π, up to which θ' grows."""
    theta = Polynomial([0.0, 1.0])
    return min(math.pi, _first_root((theta * Polynomial([1.0, *k])(theta * theta)).deriv()))


def _fisheye(k: Parameters, theta: Array) -> tuple[Array, Array]:
    """Return θ' and its derivative."""
    s = theta * theta
    slope = np.array([1.0, *((2 * i + 3) * c for i, c in enumerate(k))])
    return theta * polynomial.polyval(s, np.array([1.0, *k])), polynomial.polyval(s, slope)


def _fisheye_to_plane(k: Parameters, points: Array) -> Array:
    radius = np.hypot(points[:, 0], points[:, 1])
    theta = np.arctan2(radius, points[:, 2])
    with np.errstate(all="ignore"):
        # On the axis itself (x, y) / z is the limit, and exactly 0.
        factor = np.where(radius > 0, _fisheye(k, theta)[0] / radius, 1 / np.abs(points[:, 2]))
        plane = points[:, :2] * factor[:, None]
    plane[~(theta < fisheye_limit(k)) | ~(points != 0).any(axis=1)] = np.nan
    return plane


def _fisheye_from_plane(k: Parameters, plane: Array) -> Array:
    radius = np.hypot(plane[:, 0], plane[:, 1])
    with np.errstate(all="ignore"):
        theta = _invert_increasing(lambda angle: _fisheye(k, angle), radius, fisheye_limit(k))
        factor = np.where(radius > 0, np.sin(theta) / radius, 1.0)
    return np.concatenate([plane * factor[:, None], np.cos(theta)[:, None]], axis=1)


def _invert_increasing(
    function: Callable[[Array], tuple[Array, Array]], target: Array, limit: float, tolerance: float = 2e-16
) -> Array:
    """Solve function(x) = target ≥ 0 for x in [0, limit); NaN beyond.

    Newton's steps inside a bracket that shrinks; the bracket is halved where they leave it or shorten too slowly (from
    far out on a high power they come back by a seventh at a time). `function` returns values and derivatives, is 0 at
    0 and grows up to the limit, or to a pole there. `tolerance` is relative, of x.
    """
    low, high = np.zeros_like(target), np.full_like(target, limit)
    if math.isinf(limit):
        high = np.maximum(1.0, 2 * target)
        for _ in range(_STEPS):
            short = function(high)[0] < target
            if not short.any():
                break
            high[short] *= 2
    ceiling = function(high)[0]
    inside = (target < ceiling) | ~(ceiling > 0)  # rounding puts a pole's own value on either side of it
    result = np.full_like(target, np.nan)
    todo = np.flatnonzero(inside)
    target, low, high = target[todo], low[todo], high[todo]
    x = np.minimum(target, (low + high) / 2)
    step = high.copy()
    for _ in range(_STEPS):
        value, slope = function(x)
        low, high = np.where(value <= target, x, low), np.where(value >= target, x, high)
        following = x - (value - target) / slope
        fast = (following >= low) & (following <= high) & (np.abs(following - x) <= step / 2)
        following = np.where(fast, following, (low + high) / 2)
        step = np.abs(following - x)
        more = step > tolerance * x
        result[todo] = following
        todo, target, low, high = todo[more], target[more], low[more], high[more]
        x, step = following[more], step[more]
        if not len(todo):
            break
    return result


MODELS: dict[str, LensModel] = {
    "PINHOLE": LensModel((), _pinhole_to_plane, _pinhole_from_plane),
    "OPENCV": LensModel(("k1", "k2", "p1", "p2"), _brown_to_plane, _brown_from_plane),
    "FULL_OPENCV": LensModel(("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), _brown_to_plane, _brown_from_plane),
    "OPENCV_FISHEYE": LensModel(("k1", "k2", "k3", "k4"), _fisheye_to_plane, _fisheye_from_plane),
}
