# SPDX-License-Identifier: GPL-3.0-or-later
"""Splats that face the 3D viewport's own view.

Nodes cannot ask for it, so a camera object that is in no scene stands where the viewport looks from, and the group
"Holoreel View" asks for that. When a viewport is drawn whose view has changed, a timer moves the camera, and the reels
follow. Nothing is written while views stay, or while a viewport looks through a camera: playback costs nothing.

Of several viewports, the one whose view changed last counts.
"""

import math
from dataclasses import dataclass, replace

import bpy
from bpy.app.handlers import persistent
from mathutils import Matrix, Vector

from .compat import get_input, input_names
from .nodes.library import find
from .nodes.show import HULL, SPLATS
from .nodes.view import SCALE_NODE, SWITCH_NODE, VIEW_GROUP, VIEW_VERSION
from .reels import modifier_of

NAME = "Holoreel View"
SENSOR_MM = 36.0
BEHIND = 500.0  # how far behind the view of an orthographic viewport its camera stands, so that all lies before it
PLAIN_SHADING = ("WIREFRAME", "SOLID")


@dataclass(frozen=True)
class Looking:
    """What one viewport shows: its view and window matrix (column by column), width in pixels, and shading.

    `view` is empty where it looks through a camera.
    """

    view: tuple[float, ...]
    window: tuple[float, ...]
    width_px: int
    is_perspective: bool
    is_plain: bool


def looking(space: bpy.types.SpaceView3D, region: bpy.types.Region, view3d: bpy.types.RegionView3D) -> Looking:
    """Return what a region of a viewport shows."""
    is_plain = space.shading.type in PLAIN_SHADING
    if view3d.view_perspective == "CAMERA":
        return Looking((), (), 0, True, is_plain)
    view, window = (
        tuple(value for row in matrix for value in row) for matrix in (view3d.view_matrix, view3d.window_matrix)
    )
    return Looking(view, window, region.width, view3d.is_perspective, is_plain)


def face(scene: bpy.types.Scene, seen: Looking) -> bool:
    """Move the camera that reels follow to a viewport's view; return whether there is a group that follows."""
    group = find(bpy.data.node_groups, VIEW_GROUP, VIEW_VERSION)
    if group is None:
        return False
    camera = _camera(group)
    if not seen.view:
        _say(camera, False, seen.is_plain, 1.0)
        return True
    pose = _matrix(seen.view).inverted()
    location, rotation, _ = pose.decompose()
    if not seen.is_perspective:
        location = location + rotation @ Vector((0.0, 0.0, BEHIND))
    camera.location, camera.rotation_quaternion = location, rotation
    _say(camera, True, seen.is_plain, _set_lens(camera.data, scene, seen))
    return True


def _set_lens(data: bpy.types.Camera, scene: bpy.types.Scene, seen: Looking) -> float:
    """Choose the lens whose pictures, of the scene's shape, contain what the viewport shows.

    Return how large the viewport's pixels are beside those of such a picture.
    """
    render = scene.render
    width, height = (
        max(math.floor(side * render.resolution_percentage / 100), 1)
        for side in (render.resolution_x, render.resolution_y)
    )
    shown = 1.0 / seen.window[0], 1.0 / seen.window[5]  # half of what is seen at depth 1, or anywhere if orthographic
    half_width = max(shown[0], shown[1] * width / height)
    data.sensor_fit, data.sensor_width = "HORIZONTAL", SENSOR_MM
    if seen.is_perspective:
        data.type, data.lens = "PERSP", SENSOR_MM / 2 / half_width
    else:
        data.type, data.ortho_scale = "ORTHO", 2 * half_width
    return shown[0] / half_width * width / max(seen.width_px, 1)


def _say(camera: bpy.types.Object, is_free: bool, is_plain: bool, pixel_scale: float) -> None:
    """Write what the group "Holoreel View" reads, if it is news."""
    scale = Vector((1.0 + is_free, 1.0 + is_plain, pixel_scale))
    if camera.scale != scale:
        camera.scale = scale


def _camera(group: bpy.types.NodeTree) -> bpy.types.Object:
    """Return the camera that the group follows; make it where there is none."""
    places = [group.nodes[SWITCH_NODE].inputs["True"], group.nodes[SCALE_NODE].inputs["Object"]]
    camera = places[0].default_value
    if camera is None:
        camera = bpy.data.objects.new(NAME, bpy.data.cameras.new(NAME))
        camera.rotation_mode = "QUATERNION"
    for place in places:
        if place.default_value != camera:
            place.default_value = camera
    return camera


def _matrix(values: tuple[float, ...]) -> Matrix:
    return Matrix([values[row * 4 : row * 4 + 4] for row in range(4)])


# --- What tells that a view has changed -----------------------------------------------------------------------------

_seen: dict[int, Looking] = {}  # by region
_changed: list[Looking] = []  # the view to face next, if any


def _drawn() -> None:
    """Note, before a viewport is drawn, whether what it shows is new; nothing may be written here."""
    context = bpy.context
    region, view3d = context.region, context.region_data
    if region is None or view3d is None or not bpy.data.pointclouds:
        return
    now, key = looking(context.space_data, region, view3d), region.as_pointer()
    if _seen.get(key) == now:
        return
    _seen[key] = now
    _changed[:] = [now]
    if not bpy.app.timers.is_registered(_follow):
        bpy.app.timers.register(_follow, first_interval=0.0)


def _follow() -> None:
    """Face the view that changed last, if a reel shows splats; hulls must know of its shading alone."""
    if not _changed:
        return
    seen = _changed.pop()
    looks = {_look(candidate) for candidate in bpy.context.view_layer.objects}
    if SPLATS in looks:
        face(bpy.context.scene, seen)
    elif HULL in looks:
        face(bpy.context.scene, replace(seen, view=(), window=()))


def _look(candidate: bpy.types.Object) -> str | None:
    modifier = modifier_of(candidate)
    if modifier is None or "Look" not in input_names(modifier.node_group):
        return None
    return get_input(modifier, "Look")


@persistent
def _forget(*_: object) -> None:
    """After undo or loading, views are noted anew."""
    _seen.clear()


_handle: object = None
_FORGETTING = ("undo_post", "redo_post", "load_post")


def register() -> None:
    """Watch the viewports."""
    global _handle
    _handle = bpy.types.SpaceView3D.draw_handler_add(_drawn, (), "WINDOW", "PRE_VIEW")
    for name in _FORGETTING:
        getattr(bpy.app.handlers, name).append(_forget)


def unregister() -> None:
    """Watch them no more."""
    global _handle
    for name in _FORGETTING:
        getattr(bpy.app.handlers, name).remove(_forget)
    bpy.types.SpaceView3D.draw_handler_remove(_handle, "WINDOW")
    _handle = None
    if bpy.app.timers.is_registered(_follow):
        bpy.app.timers.unregister(_follow)
    _seen.clear()
    _changed.clear()
