# SPDX-License-Identifier: GPL-3.0-or-later
"""Add Crop Box."""

import bpy

from ..addon.crop import add_crop_box
from ..addon.nodes.crop import KEEP, MODES, OFF
from ..addon.reels import modifier_of


class HOLOREEL_OT_add_crop_box(bpy.types.Operator):
    """An Empty that crops the active reel."""

    bl_idname = "holoreel.add_crop_box"
    bl_label = "Add Crop Box"
    bl_description = (
        "Add a box around the middle of the active reel; only what lies inside is shown, or only what lies outside. "
        "Move, turn and scale the box as you like"
    )
    bl_options = {"REGISTER", "UNDO"}

    mode: bpy.props.EnumProperty(
        name="Crop",
        description="What to show of what lies inside the box",
        items=[(name, name, tip) for name, tip in MODES.items() if name != OFF],
        default=KEEP,
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only for reels, in Object Mode."""
        if context.mode != "OBJECT":
            cls.poll_message_set("Crop boxes are added in Object Mode")
            return False
        if modifier_of(context.object) is None:
            cls.poll_message_set("Select a reel first")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Add the box and select it alone."""
        box = add_crop_box(context.object, self.mode)
        for chosen in context.selected_objects:
            chosen.select_set(False)
        box.select_set(True)
        return {"FINISHED"}


register, unregister = bpy.utils.register_classes_factory((HOLOREEL_OT_add_crop_box,))
