# SPDX-License-Identifier: GPL-3.0-or-later
"""Reload, Relink, Store in This File, Store Beside the Reel: imported reels and their files."""

from collections.abc import Callable
from pathlib import Path

import bpy
from bpy_extras.io_utils import ImportHelper

from ..addon import reload
from ..addon.reels import modifier_of
from ..core.errors import HoloreelError
from .import_reel import ENDINGS


class _ReelOperator:
    """What is done to the active reel, in Object Mode."""

    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only for reels, in Object Mode."""
        cls.poll_message_set("Choose a reel, in Object Mode")
        return context.mode == "OBJECT" and modifier_of(context.object) is not None

    def attempt(self, deed: Callable[[], list[str] | None], done: str) -> set[str]:
        """Do it; report the sentences that it returns, or why it was refused."""
        try:
            sentences = deed() or []
        except HoloreelError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        for sentence in sentences:
            self.report({"WARNING"}, sentence)
        self.report({"INFO"}, done)
        return {"FINISHED"}


class _GaussiansOperator(_ReelOperator):
    """What is done to Spacetime Gaussians, whose points may lie in the .blend or beside the reel."""

    wanted_linked = False  # whether the points lie outside the .blend before

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only for imported Gaussians whose points are not there already."""
        if not super().poll(context):
            return False
        if reload.is_field(context.object):
            cls.poll_message_set("The movie of a VideoRF always lies beside its reel")
            return False
        cls.poll_message_set("The points lie there already")
        return (context.object.data.library is not None) == cls.wanted_linked


class HOLOREEL_OT_reload_reel(_ReelOperator, bpy.types.Operator):
    """Read the file again."""

    bl_idname = "holoreel.reload_reel"
    bl_label = "Reload Reel"
    bl_description = "Read the active reel's file again; its timeline, its look and where it is stay as they are"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Replace the points."""
        return self.attempt(lambda: reload.reload_reel(context, context.object), f"Reloaded {context.object.name}")


class HOLOREEL_OT_relink_reel(_ReelOperator, bpy.types.Operator, ImportHelper):
    """Choose another file."""

    bl_idname = "holoreel.relink_reel"
    bl_label = "Relink Reel"
    bl_description = "Choose the file of the active reel anew, if it was moved or replaced, and read it"

    filename_ext = ".reel"
    filter_glob: bpy.props.StringProperty(default=";".join(f"*{ending}" for ending in ENDINGS), options={"HIDDEN"})

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Read the chosen file into the object."""
        path = Path(self.filepath)
        return self.attempt(lambda: reload.relink_reel(context, context.object, path), f"Relinked to {path.name}")


class HOLOREEL_OT_store_beside(_GaussiansOperator, bpy.types.Operator):
    """Move the points out of the .blend."""

    bl_idname = "holoreel.store_beside"
    bl_label = "Store Beside the Reel"
    bl_description = (
        "Keep the active reel's points in a .blend beside its file, to which this file links, so that this file stays "
        "small; Blender loads them by itself, also on a render farm"
    )

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Write the points and link to them."""
        return self.attempt(lambda: reload.store_beside(context.object), "Stored beside the reel")


class HOLOREEL_OT_store_inside(_GaussiansOperator, bpy.types.Operator):
    """Take the points into the .blend."""

    bl_idname = "holoreel.store_inside"
    bl_label = "Store in This File"
    bl_description = "Keep the active reel's points in this .blend, which then needs the reel no more"
    wanted_linked = True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Copy the points."""
        return self.attempt(lambda: reload.store_inside(context.object), "Stored in this file")


CLASSES = (HOLOREEL_OT_reload_reel, HOLOREEL_OT_relink_reel, HOLOREEL_OT_store_beside, HOLOREEL_OT_store_inside)

register, unregister = bpy.utils.register_classes_factory(CLASSES)
