# SPDX-License-Identifier: GPL-3.0-or-later
"""From a scene to what the worker draws: which reels, at which of their frames, seen by which camera."""

from collections.abc import Iterator
from dataclasses import replace

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.camera import Camera
from ..core.errors import HoloreelError
from ..core.reel import VIDEORF
from ..core.worker.protocol import Layer, Shot
from . import reels

SHEAR_TOLERANCE = 1e-4  # of an object's axes; Blender's matrices are float32
REEL, COLOR = "REEL", "COLOR"
LINEAR, DISPLAY = "LINEAR", "DISPLAY"

Array = NDArray[np.float64]


def shot_of(
    depsgraph: bpy.types.Depsgraph,
    camera: Camera,
    *,
    region: tuple[int, int, int, int] | None = None,
    transparent: bool | None = None,
    quality: str | None = None,
) -> Shot | None:
    """Return the picture that `camera` sees of a scene at its current frame; None where there is no reel in it.

    Raises `HoloreelError` for a reel whose file is gone, or whose object is stretched or mirrored.
    """
    scene = depsgraph.scene
    layers = tuple(layers_of(depsgraph, camera))
    if not layers:
        return None
    settings = scene.holoreel_engine
    return Shot(
        layers,
        region=region,
        transparent=scene.render.film_transparent if transparent is None else transparent,
        background=tuple(settings.background_color) if settings.background == COLOR else None,
        linear=settings.color == LINEAR,
        quality=quality or settings.quality.lower(),
        along_rays=camera.model != "PINHOLE",
    )


def layers_of(depsgraph: bpy.types.Depsgraph, camera: Camera) -> Iterator[Layer]:
    """Yield a layer for every reel that is rendered, instances included."""
    frame = depsgraph.scene.frame_current_final
    for played, matrix in shown_reels(depsgraph):
        scale, seen_by = in_reel_space(camera, matrix, played.name)
        timeline = reels.timeline_of(played)
        info = played.original.get(reels.INFO) or {}
        is_field = info.get("kind") == VIDEORF
        yield Layer(
            reels.source_of(played.original),
            float(timeline.whole_frame(frame) if is_field else timeline.reel_frame(frame)),
            timeline.frame_count,
            seen_by,
            scale,
            info.get("rung") if is_field else None,
        )


def shown_reels(depsgraph: bpy.types.Depsgraph) -> Iterator[tuple[bpy.types.Object, Array]]:
    """Yield the evaluated object and the world matrix of every reel that the dependency graph shows.

    Instances are those of collections, nested ones included. `Depsgraph.object_instances` would not do: it lists every
    instance that the nodes of a reel's look make as a reel of its own.
    """
    for shown in depsgraph.objects:
        yield from _reels_of(shown.original, np.eye(4), depsgraph)


def _reels_of(
    shown: bpy.types.Object, place: Array, depsgraph: bpy.types.Depsgraph
) -> Iterator[tuple[bpy.types.Object, Array]]:
    evaluated = shown.evaluated_get(depsgraph)
    matrix = place @ np.array(evaluated.matrix_world, np.float64)
    if reels.modifier_of(shown) is not None:
        yield evaluated, matrix
    if shown.instance_type == "COLLECTION" and shown.instance_collection is not None:
        moved = np.eye(4)
        moved[:3, 3] = -np.array(shown.instance_collection.instance_offset)
        for member in _members(shown.instance_collection, depsgraph.mode):
            yield from _reels_of(member, matrix @ moved, depsgraph)


def _members(collection: bpy.types.Collection, mode: str) -> Iterator[bpy.types.Object]:
    """Yield the objects of a collection and of those in it that are not hidden from the viewport or from renders."""
    hidden = "hide_render" if mode == "RENDER" else "hide_viewport"
    yield from (member for member in collection.objects if not getattr(member, hidden))
    for child in collection.children:
        if not getattr(child, hidden):
            yield from _members(child, mode)


def in_reel_space(camera: Camera, matrix_world: Array, name: str) -> tuple[float, Camera]:
    """Return an object's scale, and the camera as it stands in the object's own space.

    Raises `HoloreelError` unless the object's matrix is a rotation, a translation and a uniform scale.
    """
    axes = matrix_world[:3, :3]
    scale = float(np.cbrt(np.linalg.det(axes)))
    if not np.isfinite(matrix_world).all() or abs(scale) < 1e-12:
        raise HoloreelError(f"Reel '{name}' has no size: give its scale a value other than 0.")
    if scale < 0 or np.abs(axes.T @ axes / scale**2 - np.eye(3)).max() > SHEAR_TOLERANCE:
        raise HoloreelError(
            f"Reel '{name}' is stretched, sheared or mirrored, which the Holoreel engine does not draw: give it and "
            "its parents the same positive scale on all axes."
        )
    left, _, right = np.linalg.svd(axes)
    placed = np.eye(4)
    placed[:3, :3] = left @ right
    placed[:3, 3] = matrix_world[:3, 3]
    seen = camera.world_to_camera @ placed
    seen[:3, 3] /= scale
    return scale, replace(camera, world_to_camera=seen)
