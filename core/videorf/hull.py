# SPDX-License-Identifier: GPL-3.0-or-later
"""The visual hull: the vertices of a lattice that no camera's mask rules out."""

from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..errors import HoloreelError
from .occupancy import Lattice, Occupancy

if TYPE_CHECKING:
    from .views import FrameViews

REACH = 1.75  # spacings: no corner of a cell lies farther from a point in it than √3
BLOCK = 1 << 14  # vertices projected at once, whose temporaries fit a processor's cache
MIN_CAMERAS = 3  # that must see a vertex: where fewer look, nothing is carved and nothing is known


@dataclass(frozen=True)
class SeenMask:
    """Which pixels (H, W; bool) of a camera show the subject in one frame."""

    camera: Camera
    mask: NDArray[np.bool_]


def visual_hull(views: "FrameViews", lattice: Lattice, misses: int = 0, reach: float = REACH) -> Occupancy:
    """Return which vertices (X, Y, Z) may hold the subject of a frame.

    A vertex may where the mask of every camera that sees it, but for `misses` of them, is set within `reach` spacings
    of it, as the camera sees that length. With the default, all corners of every cell that holds a part of the subject
    are in, however thin that part. A camera does not judge what lies outside of its picture; where fewer than three
    cameras see a vertex (or fewer than all, of three or less), it is out.

    Raises `HoloreelError` where nothing is left.
    """
    found = carve(views.masks.values(), lattice, misses, reach)
    if found.any():
        return found
    blind = [name for name, seen in views.masks.items() if not seen.mask.any()]
    cause = f" (the masks of {', '.join(blind)} are empty)" if len(blind) > misses else ""
    raise HoloreelError(
        f"The masks of frame {views.number} leave no room for the subject in the box {np.round(lattice.lowest, 3)} to "
        f"{np.round(lattice.highest, 3)}{cause}: mend the subject's bounds, the calibration or the masks, or let some "
        "masks miss it."
    )


def carve(seen: Collection[SeenMask], lattice: Lattice, misses: int = 0, reach: float = REACH) -> Occupancy:
    """Return what `visual_hull` does, for masks by themselves; nothing may be left."""
    if misses < 0 or reach < 0:
        raise ValueError("misses and reach must be 0 or more")
    alive = np.arange(np.prod(lattice.shape))  # vertices that may still be in: each camera looks at no others
    failed = np.zeros(len(alive), np.int32)
    watched = np.zeros(len(alive), np.int32)
    for one in seen:
        inside, near = _judge(one, lattice, alive, reach)
        watched += inside
        failed += inside & ~near
        kept = failed <= misses
        alive, failed, watched = alive[kept], failed[kept], watched[kept]
    hull = np.zeros(lattice.shape, bool)
    hull.ravel()[alive[watched >= min(MIN_CAMERAS, len(seen))]] = True
    return hull


def _judge(
    seen: SeenMask, lattice: Lattice, vertices: NDArray[np.int64], reach: float
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return of each vertex whether the camera sees it, and whether the mask is set within `reach` spacings of it."""
    from scipy.ndimage import distance_transform_edt

    camera, mask = seen.camera, seen.mask
    # The distance to the middle of the nearest pixel that is set; half a diagonal more on both sides.
    distance = distance_transform_edt(~mask) if mask.any() else np.full(mask.shape, np.inf)
    length = reach * lattice.spacing * max(camera.fx, camera.fy)
    inside, near = np.zeros((2, len(vertices)), bool)
    for start in range(0, len(vertices), BLOCK):
        part = slice(start, start + BLOCK)
        pixels, depth = camera.project(lattice.positions(np.stack(np.unravel_index(vertices[part], lattice.shape), 1)))
        with np.errstate(invalid="ignore"):
            place = np.floor(pixels)
            visible = (depth > 0) & ((place >= 0) & (place < (camera.width, camera.height))).all(1)  # not for NaN
        column, row = place[visible].astype(int).T
        inside[part] = visible
        near[part][visible] = distance[row, column] <= length / depth[visible] + 1.5
    return inside, near
