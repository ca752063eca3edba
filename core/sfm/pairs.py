# SPDX-License-Identifier: GPL-3.0-or-later
"""Which cameras to compare with each other."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from .settings import Matcher

ALL_PAIRS_UP_TO = 8  # cameras; comparing them all costs little
NEIGHBORS = 10  # per camera, of those whose views overlap most
SEQUENCE = 5  # neighbors before and after in the order of the cameras

_GRID = 7  # rays per side of a picture
_MIN_OVERLAP = 0.1
_MAX_ANGLE_DEGREES = 75.0  # features seen from farther aside do not match
_DEPTHS = 2.0 ** np.arange(-3, 5)  # in units of the rig's size


def choose_pairs(cameras: Sequence[Camera], matcher: Matcher) -> list[tuple[int, int]]:
    """Return pairs of indices (a, b), a < b, in order.

    `overlap` takes all pairs of up to 8 cameras; of more, each camera's 10 neighbors whose views share most with it.
    """
    count = len(cameras)
    if matcher == "sequential":
        return [(a, b) for a, b in combinations(range(count), 2) if b - a <= SEQUENCE]
    if matcher == "exhaustive" or count <= ALL_PAIRS_UP_TO:
        return list(combinations(range(count), 2))
    shares = overlaps(cameras)
    pairs = set()
    for a in range(count):
        best = np.argsort(-shares[a], kind="stable")[:NEIGHBORS]
        pairs |= {(min(a, int(b)), max(a, int(b))) for b in best if shares[a, b] >= _MIN_OVERLAP}
    return sorted(pairs)


def overlaps(cameras: Sequence[Camera]) -> NDArray[np.float64]:
    """How much of what one camera sees another sees too, (C, C) in [0, 1], symmetric, zero on the diagonal.

    How deep the scene is, is not known: what counts is the depth at which two cameras share most, from an eighth of the
    rig's size to sixteen times that. Points that two cameras see from very different sides do not count.
    """
    count = len(cameras)
    centers = np.array([camera.center for camera in cameras])
    size = float(np.linalg.norm(np.ptp(centers, axis=0))) or 1.0
    seen = np.zeros((count, count))
    for a, camera in enumerate(cameras):
        origins, directions = camera.rays(_grid(camera))
        points = (origins[:, None] + directions[:, None] * (size * _DEPTHS)[:, None]).reshape(-1, 3)
        for b, other in enumerate(cameras):
            if a != b:
                visible = _visible(other, points) & _similar(points, centers[a], centers[b])
                seen[a, b] = visible.reshape(-1, len(_DEPTHS)).mean(axis=0).max()
    return np.minimum(seen, seen.T)


def _grid(camera: Camera) -> NDArray[np.float64]:
    steps = (np.arange(_GRID) + 0.5) / _GRID
    u, v = np.meshgrid(steps * camera.width, steps * camera.height)
    return np.stack([u.ravel(), v.ravel()], axis=1)


def _visible(camera: Camera, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    uv, z = camera.project(points)
    inside = (uv >= 0).all(axis=1) & (uv[:, 0] <= camera.width) & (uv[:, 1] <= camera.height)
    return np.asarray(inside & (z > 0))


def _similar(points: NDArray[np.float64], a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether the directions to two centers differ little enough."""
    to_a, to_b = a - points, b - points
    lengths = np.linalg.norm(to_a, axis=1) * np.linalg.norm(to_b, axis=1)
    cosine = np.einsum("ij,ij->i", to_a, to_b) / np.maximum(lengths, 1e-300)
    return np.asarray(cosine >= np.cos(np.radians(_MAX_ANGLE_DEGREES)))
