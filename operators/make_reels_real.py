# SPDX-License-Identifier: GPL-3.0-or-later
"""Make Reels Real."""

import bpy

from ..addon.instances import instancers_of, make_real


class HOLOREEL_OT_make_reels_real(bpy.types.Operator):
    """Objects instead of instances."""

    bl_idname = "holoreel.make_reels_real"
    bl_label = "Make Reels Real"
    bl_description = (
        "Turn the reels that the selected objects instance into objects of their own, which share their points: the "
        "splats of each then face the camera"
    )
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only where something selected instances something, in Object Mode."""
        if context.mode != "OBJECT" or not instancers_of(context):
            cls.poll_message_set("Select an instance of a collection, in Object Mode")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Make the objects and select them."""
        created = make_real(context, instancers_of(context))
        if not created:
            self.report({"WARNING"}, "No reels are instanced by what is selected")
            return {"CANCELLED"}
        for real in created:
            real.select_set(True)
        self.report({"INFO"}, f"{len(created)} reels made real")
        return {"FINISHED"}


register, unregister = bpy.utils.register_classes_factory((HOLOREEL_OT_make_reels_real,))
