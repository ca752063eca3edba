# SPDX-License-Identifier: GPL-3.0-or-later
"""Reels as Blender objects."""

import bpy

from ..core.gaussians.model import SpacetimeGaussians
from . import attributes
from .compat import input_path, new_point_cloud, set_input
from .nodes import reel as reel_group
from .timeline import Timeline

MODIFIER = "Holoreel"


def create_reel_object(
    context: bpy.types.Context, name: str, gaussians: SpacetimeGaussians, timeline: Timeline
) -> bpy.types.Object:
    """Return a new point cloud object that plays `gaussians` by `timeline`."""
    reel = new_point_cloud(context, name, len(gaussians))
    attributes.write(reel.data, gaussians)
    modifier = reel.modifiers.new(MODIFIER, "NODES")
    modifier.node_group = reel_group.reel()
    set_timeline(reel, timeline)
    _follow_resolution(reel)
    return reel


def modifier_of(reel: bpy.types.Object | None) -> bpy.types.NodesModifier | None:
    """Return the modifier that plays a reel, or None if the object is no reel."""
    if reel is None:
        return None
    for modifier in reel.modifiers:
        group = modifier.node_group if modifier.type == "NODES" else None
        if group is not None and str(group.get("holoreel", "")).startswith("Holoreel Reel "):
            return modifier
    return None


def set_timeline(reel: bpy.types.Object, timeline: Timeline) -> None:
    """Set the mapping of the scene's frames to the reel's time."""
    modifier = modifier_of(reel)
    for name, value in {
        "Start Frame": timeline.start,
        "Speed": timeline.speed,
        "Offset": timeline.offset,
        "First Frame": timeline.first,
        "Last Frame": timeline.last_frame,
        "Frame Count": timeline.frame_count,
        "Repeat": timeline.repeat,
    }.items():
        set_input(modifier, name, value)


def _follow_resolution(reel: bpy.types.Object) -> None:
    """Drive the look's picture size by the resolution of whatever scene the reel is in."""
    modifier = modifier_of(reel)
    for name, side in (("Render Width", "x"), ("Render Height", "y")):
        driver = reel.driver_add(input_path(modifier, name)).driver
        driver.type = "SCRIPTED"
        for variable_name, path in (
            ("pixels", f"render.resolution_{side}"),
            ("percent", "render.resolution_percentage"),
        ):
            variable = driver.variables.new()
            variable.name = variable_name
            variable.type = "CONTEXT_PROP"
            variable.targets[0].context_property = "ACTIVE_SCENE"
            variable.targets[0].data_path = path
        driver.expression = "floor(pixels * percent / 100)"
