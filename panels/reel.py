# SPDX-License-Identifier: GPL-3.0-or-later
"""The tab "Holoreel" in the sidebar of the 3D viewport: the active reel."""

import bpy

from ..addon.compat import draw_input, get_input
from ..addon.nodes.reel import LINEAR, POINTS
from ..addon.reels import INFO, modifier_of
from ..operators.import_reel import HOLOREEL_OT_import_reel
from ..operators.setup_exact_render import HOLOREEL_OT_setup_exact_render


class _ReelPanel:
    """What all panels share."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Holoreel"


class _SubPanel(_ReelPanel):
    """A panel that is there if the active object is a reel."""

    bl_parent_id = "HOLOREEL_PT_reel"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only for reels."""
        return modifier_of(context.object) is not None

    def inputs(self, context: bpy.types.Context, *names: str) -> None:
        """Draw inputs of the active reel, one below the other."""
        self.layout.use_property_split = True
        modifier = modifier_of(context.object)
        for name in names:
            draw_input(self.layout, modifier, name)


class HOLOREEL_PT_reel(_ReelPanel, bpy.types.Panel):
    """The active reel, or how to get one."""

    bl_idname = "HOLOREEL_PT_reel"
    bl_label = "Reel"

    def draw(self, context: bpy.types.Context) -> None:
        """Name the reel."""
        if modifier_of(context.object) is None:
            self.layout.label(text="The active object is no reel", icon="INFO")
        else:
            self.layout.prop(context.object, "name", text="", icon="POINTCLOUD_DATA")
        self.layout.operator(HOLOREEL_OT_import_reel.bl_idname, icon="IMPORT")


class HOLOREEL_PT_timeline(_SubPanel, bpy.types.Panel):
    """How the scene's frames become the reel's time."""

    bl_label = "Timeline"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the mapping."""
        self.inputs(context, "Start Frame", "Speed", "Offset", "First Frame", "Last Frame", "Frame Count", "Repeat")


class HOLOREEL_PT_look(_SubPanel, bpy.types.Panel):
    """How the reel is shown."""

    bl_label = "Look"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the look, its own settings, and the color mode."""
        self.inputs(context, "Look", "Color")
        modifier = modifier_of(context.object)
        if get_input(modifier, "Color") != LINEAR and context.scene.view_settings.view_transform != "Raw":
            self.layout.label(text="Exact only with the view transform Raw", icon="ERROR")
        if get_input(modifier, "Look") == POINTS:
            self.inputs(context, "Point Size", "Hide Fainter Than")
            return
        self.inputs(context, "Low Pass", "Near")
        if context.scene.camera is None:
            self.layout.label(text="Splats face the active camera: add one", icon="ERROR")
        elif context.scene.camera.data.type == "PANO":
            self.layout.label(text="Splats are for perspective cameras: take Points", icon="ERROR")
        self.layout.operator(HOLOREEL_OT_setup_exact_render.bl_idname, icon="RENDER_STILL")


class HOLOREEL_PT_info(_SubPanel, bpy.types.Panel):
    """Where the reel comes from."""

    bl_label = "Info"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        """Draw source, size and what was found on import."""
        info = context.object.get(INFO)
        if info is None:
            self.layout.label(text="Made by a script")
            return
        column = self.layout.column(align=True)
        column.label(text=info["source"], icon="FILE")
        column.label(text=f"{info['gaussians']:,} Gaussians")
        column.label(text=f"{info['frame_count']} frames at {info['fps']:g} per second")
        for sentence in filter(None, info["report"].split("\n")):
            column.label(text=sentence, icon="INFO")


CLASSES = (HOLOREEL_PT_reel, HOLOREEL_PT_timeline, HOLOREEL_PT_look, HOLOREEL_PT_info)

register, unregister = bpy.utils.register_classes_factory(CLASSES)
