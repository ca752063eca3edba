# SPDX-License-Identifier: GPL-3.0-or-later
"""Make Native Splats."""

import bpy

from ..addon.compat import has_native_splats
from ..addon.native import new_native_splats
from ..addon.reels import modifier_of
from ..core.errors import HoloreelError


class HOLOREEL_OT_make_native_splats(bpy.types.Operator):
    """A moment of the active reel for Blender's own renderer of splats."""

    bl_idname = "holoreel.make_native_splats"
    bl_label = "Make Native Splats"
    bl_description = (
        "Add an object of Blender's own Gaussian splats with what the active reel shows at this frame; it does not "
        "play. Needs Blender 5.3"
    )
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only for reels, where Blender has such splats."""
        if not has_native_splats():
            cls.poll_message_set("Needs Blender 5.3, which has Gaussian splats of its own")
            return False
        if context.mode != "OBJECT" or modifier_of(context.object) is None:
            cls.poll_message_set("Select a reel first, in Object Mode")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Add the object."""
        try:
            created = new_native_splats(context, context.object)
        except HoloreelError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"{len(created.data.points):,} splats")
        return {"FINISHED"}


register, unregister = bpy.utils.register_classes_factory((HOLOREEL_OT_make_native_splats,))
