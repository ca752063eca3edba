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
    """Yield the evaluated object and the world matrix of every reel that the dependency graph shows, once each.

    What a reel's nodes make of it (points, quads) is listed by Blender as more of the same object.
    """
    seen: set[tuple[str, bytes]] = set()
    for instance in depsgraph.object_instances:
        played = instance.object
        if not instance.show_self or reels.modifier_of(played) is None:
            continue
        matrix = np.array(instance.matrix_world, np.float64)
        key = (played.original.name_full, np.round(matrix, 5).tobytes())
        if key not in seen:
            seen.add(key)
            yield played, matrix


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
