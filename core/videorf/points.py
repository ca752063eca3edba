# SPDX-License-Identifier: GPL-3.0-or-later
"""A frame of a VideoRF as colored points: one for each vertex that can be seen. Needs numpy only.

The network gives a color for a direction; a point has one color for all of them, their mean. The directions are those
from given eyes, as the training cameras', or, where none are given, evenly spread over the sphere.
"""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..plyfile import write_vertices
from .mapping import MappingTable
from .occupancy import GAMMA, Lattice, opacity
from .shading import Shading

SPHERE = 32  # directions where no eyes are given


class FieldPoints(NamedTuple):
    """N points: places in the world, display-referred colors, and densities.

    `density` is the extinction per unit of the world: what a ray loses over a length s there is 1 - exp(-density s).
    """

    xyz: NDArray[np.float32]  # (N, 3)
    rgb: NDArray[np.uint8]  # (N, 3)
    density: NDArray[np.float32]  # (N)


def field_points(
    lattice: Lattice,
    table: MappingTable,
    rows: NDArray[np.float32],
    shading: Shading,
    eyes: NDArray | None = None,
    gamma: float = GAMMA,
) -> FieldPoints:
    """Return the points of a frame's rows (N, C): the vertices whose opacity over one spacing exceeds `gamma`.

    `eyes` (K, 3) are the places from which colors are taken; without, they are taken from all around.
    """
    kept = opacity(rows[:, 0].astype(np.float64)) > gamma
    vertices, rows = table.vertices[kept], rows[kept]
    places = lattice.positions(vertices)
    density = np.logaddexp(0.0, rows[:, 0].astype(np.float64)) / lattice.spacing
    colors = np.rint(255 * _mean_colors(shading, rows[:, 1:], places, eyes)).astype(np.uint8)
    return FieldPoints(places.astype(np.float32), colors, density.astype(np.float32))


def _mean_colors(
    shading: Shading, features: NDArray[np.float32], places: NDArray[np.float64], eyes: NDArray | None
) -> NDArray[np.float64]:
    total = np.zeros((len(features), 3))
    if shading.shape.frequencies is None:  # the color does not hang on the direction
        return shading(features, np.zeros_like(places))
    ways = -sphere(SPHERE) if eyes is None else np.asarray(eyes, np.float64)
    for way in ways:
        directions = np.broadcast_to(way, places.shape) if eyes is None else places - way
        length = np.linalg.norm(directions, axis=1, keepdims=True)
        total += shading(features, directions / np.maximum(length, 1e-12))
    return total / len(ways)


def sphere(count: int) -> NDArray[np.float64]:
    """Return unit vectors (count, 3) evenly spread over the sphere, along a spiral of golden angles."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.arange(count) * math.pi * (3 - math.sqrt(5))
    radius = np.sqrt(1 - z * z)
    return np.stack((radius * np.cos(angle), radius * np.sin(angle), z), 1)


def write_field_points(path: str | Path, points: FieldPoints) -> None:
    """Write a PLY with x y z (float), red green blue (uchar) and density (float), atomically."""
    kinds = {"x": "f4", "y": "f4", "z": "f4", "red": "u1", "green": "u1", "blue": "u1", "density": "f4"}
    columns = (*points.xyz.T, *points.rgb.T, points.density)
    table = np.empty(len(points.xyz), list(kinds.items()))
    for name, column in zip(kinds, columns, strict=True):
        table[name] = column
    write_vertices(path, table)
