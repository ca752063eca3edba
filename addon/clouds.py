# SPDX-License-Identifier: GPL-3.0-or-later
"""The point clouds of Spacetime Gaussians: all segments in one, the most important points first.

A cloud lies in the .blend, or in a .blend of its own beside the reel, to which the scene's .blend links. Blender itself
loads it then, wherever the scene is opened or rendered.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import HoloreelError
from ..core.files import atomic_path
from ..core.gaussians.flat import flattened
from ..core.gaussians.importance import most_important_first
from ..core.gaussians.model import SpacetimeGaussians, concatenate
from ..core.reel import Loaded
from . import attributes
from .compat import new_point_cloud

ENDLESS = 1e9  # the last segment ends at this frame
STORED = "Holoreel Points"  # the cloud's name in a .blend beside the reel


@dataclass(frozen=True)
class Points:
    """What one point cloud holds: rows of a lite model, all or those that `order` selects, without a copy of them.

    `segments` has, for the rows of several segments, the columns of `SEGMENT_NAMES`, one number for each row.
    """

    gaussians: SpacetimeGaussians
    order: NDArray[np.int64] | None = None
    segments: dict[str, NDArray[np.float32]] | None = None

    def __len__(self) -> int:
        return len(self.gaussians if self.order is None else self.order)


def join(parts: Sequence[Loaded], detail: float = 100.0) -> Points:
    """Return the points of all segments of a reel, the most important first; `detail` percent of them."""
    models = [flattened(part.gaussians, part.decoder, part.viewpoint) for part in parts]
    order = most_important_first(models)
    order = order[: max(1, math.ceil(len(order) * detail / 100.0))]
    if len(models) == 1:
        return Points(models[0], order)
    sizes = [len(model) for model in models]
    segments = {name: np.repeat(np.float32(values), sizes) for name, values in _windows(parts).items()}
    return Points(concatenate(models), order, segments)


def _windows(parts: Sequence[Loaded]) -> dict[str, list[float]]:
    """Return when each segment is shown, in reel frames counted from 0."""
    first = [float(part.frame_start - parts[0].frame_start) for part in parts]
    frames = [float(part.frame_count) for part in parts]
    return dict(zip(attributes.SEGMENT_NAMES, (first, frames, [*first[1:], ENDLESS]), strict=True))


def new_cloud_object(context: bpy.types.Context, name: str, points: Points) -> bpy.types.Object:
    """Return a new point cloud object with these points, in the context's collection."""
    created = new_point_cloud(context, name, len(points))
    attributes.write(created.data, points.gaussians, points.order, points.segments)
    return created


def replace_points(context: bpy.types.Context, old: bpy.types.PointCloud, points: Points) -> bpy.types.PointCloud:
    """Return a new point cloud with these points, which takes the place of `old` in all objects that have it."""
    name = old.name
    carrier = new_cloud_object(context, name, points)
    new = carrier.data
    bpy.data.objects.remove(carrier)
    _replace(old, new)
    new.name = name
    return new


def library_path(source: Path, detail: float = 100.0) -> Path:
    """Return where the points of a reel lie that are not in the .blend: beside it, as `walk.reel.blend`.

    Of `detail` percent of them, as `walk.reel.25.blend`.
    """
    return source.with_name(f"{source.name}.blend" if detail >= 100.0 else f"{source.name}.{detail:g}.blend")


def store_beside(cloud: bpy.types.PointCloud, path: Path) -> bpy.types.PointCloud:
    """Write a local cloud into the .blend at `path` and link to it; return the linked one, which replaces it.

    Raises `HoloreelError` if the file cannot be written.
    """
    name = cloud.name
    _rename(cloud, STORED)
    try:
        with atomic_path(path) as temporary:
            _write(temporary, path, cloud)
    except HoloreelError:
        cloud.name = name
        raise
    for library in bpy.data.libraries:
        if Path(bpy.path.abspath(library.filepath)) == path:
            library.reload()  # other reels show the new points as well
    with bpy.data.libraries.load(str(path), link=True, relative=bpy.data.is_saved) as (_, wanted):
        wanted.pointclouds = [STORED]
    return _replace(cloud, wanted.pointclouds[0])


def store_inside(cloud: bpy.types.PointCloud, name: str) -> bpy.types.PointCloud:
    """Copy a linked cloud into the .blend; return the local one, which replaces it. Raises where it is missing."""
    problem = missing_library(cloud)
    if problem is not None:
        raise HoloreelError(f"{problem}: reload the reel.")
    local = cloud if cloud.library is None else cloud.make_local()
    local.name = name
    return local


def missing_library(cloud: bpy.types.PointCloud) -> str | None:
    """Say which file is missing that a linked cloud should come from; None if all is well."""
    if cloud.library is None or not cloud.is_missing:
        return None
    return f"{Path(bpy.path.abspath(cloud.library.filepath)).name} with the points is missing"


def _write(temporary: Path, path: Path, cloud: bpy.types.PointCloud) -> None:
    try:
        bpy.data.libraries.write(str(temporary), {cloud}, fake_user=True)
    except OSError as error:  # what Blender says of it is the reason of something else
        raise HoloreelError(
            f"{path} cannot be written: make room on its disk, allow writing there, or leave the points in this file."
        ) from error


def _rename(cloud: bpy.types.PointCloud, name: str) -> None:
    """Give a local cloud this name exactly; another local one that has it gets a number."""
    holder = bpy.data.pointclouds.get((name, None))
    if holder is not None and holder != cloud:
        holder.name = f"{name}.001"
    cloud.name = name


def _replace(old: bpy.types.PointCloud, new: bpy.types.PointCloud) -> bpy.types.PointCloud:
    old.user_remap(new)
    bpy.data.pointclouds.remove(old)
    return new
