# SPDX-License-Identifier: GPL-3.0-or-later
"""Set Up Holoreel Engine."""

import bpy

from ..addon.engine import setup_engine
from ..addon.engine_settings import ENGINE


class HOLOREEL_OT_setup_engine(bpy.types.Operator):
    """The preset for pictures that are those of `holoreel render`."""

    bl_idname = "holoreel.setup_engine"
    bl_label = "Set Up Holoreel Engine"
    bl_description = (
        "Render with the Holoreel engine, which draws reels alone and exactly: full models with their decoder, "
        "VideoRFs by marching rays, fisheye cameras. Sets the view transform Standard and takes dithering out"
    )
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Change the scene."""
        setup_engine(context.scene)
        self.report({"INFO"}, f"Render engine {ENGINE.capitalize()}, view transform Standard, no dithering")
        return {"FINISHED"}


def register() -> None:
    """Register the operator."""
    bpy.utils.register_class(HOLOREEL_OT_setup_engine)


def unregister() -> None:
    """Take it out again."""
    bpy.utils.unregister_class(HOLOREEL_OT_setup_engine)
