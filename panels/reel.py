# SPDX-License-Identifier: GPL-3.0-or-later
"""The tab "Holoreel" in the sidebar of the 3D viewport: the active reel."""

import bpy

from ..addon.compat import draw_input, input_names
from ..addon.reels import INFO, modifier_of, source_of, summary, timeline_of
from ..addon.reload import is_field, problem_of
from ..addon.texts import draw_text, letters_in
from ..core.errors import HoloreelError
from ..operators.import_reel import HOLOREEL_OT_import_reel
from ..operators.reload_reel import (
    HOLOREEL_OT_relink_reel,
    HOLOREEL_OT_reload_reel,
    HOLOREEL_OT_store_beside,
    HOLOREEL_OT_store_inside,
)
from ..operators.retime import HOLOREEL_OT_key_reel_frames


class _ReelPanel:
    """What all panels share."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Holoreel"


class SubPanel(_ReelPanel):
    """A panel that is there if the active object is a reel."""

    bl_parent_id = "HOLOREEL_PT_reel"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only for reels."""
        return modifier_of(context.object) is not None

    def inputs(self, context: bpy.types.Context, *names: str) -> None:
        """Draw inputs of the active reel, one below the other; reels of older files may lack some."""
        self.layout.use_property_split = True
        modifier = modifier_of(context.object)
        there = input_names(modifier.node_group)
        for name in names:
            if name in there:
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
            problem = problem_of(context.object)
            if problem is not None:
                draw_text(self.layout, problem, letters_in(context.region), "ERROR")
                row = self.layout.row(align=True)
                row.operator(HOLOREEL_OT_reload_reel.bl_idname, text="Reload", icon="FILE_REFRESH")
                row.operator(HOLOREEL_OT_relink_reel.bl_idname, text="Relink", icon="FILE_FOLDER")
        self.layout.operator(HOLOREEL_OT_import_reel.bl_idname, icon="IMPORT")


class HOLOREEL_PT_timeline(SubPanel, bpy.types.Panel):
    """How the scene's frames become the reel's time."""

    bl_label = "Timeline"
    bl_order = 1

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the mapping."""
        retimed = timeline_of(context.object).retime
        self.inputs(context, "Retime")
        self.inputs(context, *(["Reel Frame"] if retimed else ["Start Frame", "Speed", "Offset"]))
        if not retimed:
            self.layout.operator(HOLOREEL_OT_key_reel_frames.bl_idname, icon="GRAPH")
        self.inputs(context, "First Frame", "Last Frame", "Repeat")
        if context.object.get(INFO, {}).get("segments", 1) == 1:
            self.inputs(context, "Frame Count")


class HOLOREEL_PT_detail(SubPanel, bpy.types.Panel):
    """How much of the reel is shown."""

    bl_label = "Detail"
    bl_order = 3
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only for reels whose points are sorted."""
        modifier = modifier_of(context.object)
        return modifier is not None and "Viewport Detail" in input_names(modifier.node_group)

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the percentages, and whether speeds are worked out."""
        self.inputs(context, "Viewport Detail", "Render Detail", "Motion Blur")


class HOLOREEL_PT_info(SubPanel, bpy.types.Panel):
    """Where the reel comes from."""

    bl_label = "Info"
    bl_order = 9
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        """Draw source, size and what was found on import."""
        played = context.object
        info = played.get(INFO)
        if info is None:
            self.layout.label(text="Made by a script")
            return
        column = self.layout.column(align=True)
        self._source(column, context)
        column.label(text=summary(played).partition(": ")[2])
        if info.get("segments", 1) > 1:
            column.label(text=f"{info['segments']} segments")
        for sentence in filter(None, info["report"].split("\n")):
            draw_text(column, sentence, letters_in(context.region), "INFO")
        row = self.layout.row(align=True)
        row.operator(HOLOREEL_OT_reload_reel.bl_idname, text="Reload", icon="FILE_REFRESH")
        row.operator(HOLOREEL_OT_relink_reel.bl_idname, text="Relink", icon="FILE_FOLDER")
        if not is_field(played):
            linked = played.data.library is not None
            store = HOLOREEL_OT_store_inside if linked else HOLOREEL_OT_store_beside
            self.layout.operator(store.bl_idname, icon="PACKAGE" if linked else "UGLYPACKAGE")

    def _source(self, column: bpy.types.UILayout, context: bpy.types.Context) -> None:
        try:
            text, icon = str(source_of(context.object)), "FILE"
        except HoloreelError as error:
            text, icon = str(error), "ERROR"
        draw_text(column, text, letters_in(context.region), icon)


CLASSES = (HOLOREEL_PT_reel, HOLOREEL_PT_timeline, HOLOREEL_PT_detail, HOLOREEL_PT_info)

register, unregister = bpy.utils.register_classes_factory(CLASSES)
