# SPDX-License-Identifier: GPL-3.0-or-later
"""Rotations as files write them: quaternions w x y z and rotation vectors (axis times angle in radians)."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_MAX = 1e9  # of a number in a rotation: what is larger is damage


def matrix_from_quaternion(quaternion: ArrayLike) -> Array:
    """Return the 3 × 3 rotation of w x y z, normalized first; a ValueError where it is zero or not finite."""
    q = np.asarray(quaternion, np.float64)
    if q.shape != (4,) or not 1e-9 < np.abs(q).max() < _MAX:
        raise ValueError("is no rotation: a quaternion is 4 finite numbers, not all zero")
    w, *axis = q / np.linalg.norm(q)
    return _expand(float(w), np.asarray(axis))


def quaternion_from_matrix(matrix: ArrayLike) -> Array:
    """Return w x y z (w ≥ 0) of a 3 × 3 rotation: the best eigenvector of its 4 × 4 form (Bar-Itzhack, 2000)."""
    r = np.asarray(matrix, np.float64)
    trace = float(np.trace(r))
    form = np.empty((4, 4))
    form[0, 0] = trace
    form[0, 1:] = form[1:, 0] = (r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1])
    form[1:, 1:] = r + r.T - trace * np.eye(3)
    quaternion = np.linalg.eigh(form)[1][:, -1]
    return -quaternion if quaternion[0] < 0 else quaternion


def matrix_from_vector(vector: ArrayLike) -> Array:
    """Return the 3 × 3 rotation about `vector` by its length; a ValueError where it is not finite."""
    v = np.asarray(vector, np.float64)
    if v.shape != (3,) or not np.abs(v).max() < _MAX:
        raise ValueError("is no rotation: a rotation vector is 3 finite numbers")
    half = float(np.linalg.norm(v)) / 2
    return _expand(float(np.cos(half)), v * float(np.sinc(half / np.pi) / 2))


def vector_from_matrix(matrix: ArrayLike) -> Array:
    """Return the rotation vector (length 0 to π) of a 3 × 3 rotation."""
    w, *axis = quaternion_from_matrix(matrix)
    sine = float(np.linalg.norm(axis))
    return np.asarray(axis) * (2 * np.arctan2(sine, w) / sine if sine > 0 else 2.0)


def _expand(w: float, v: Array) -> Array:
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + 2 * (w * cross + cross @ cross)
