# SPDX-License-Identifier: GPL-3.0-or-later
"""Key Reel Frames."""

import bpy

from ..addon.reels import modifier_of
from ..addon.retime import key_reel_frames
from ..core.errors import HoloreelError


class HOLOREEL_OT_key_reel_frames(bpy.types.Operator):
    """From speed to keys."""

    bl_idname = "holoreel.key_reel_frames"
    bl_label = "Key Reel Frames"
    bl_description = (
        "Switch Retime on and key Reel Frame so that the active reel plays as it does now; bend the keys in the Graph "
        "Editor to speed up and slow down. Keys of Speed are added up frame by frame"
    )
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only for reels of this file."""
        cls.poll_message_set("Choose a reel that is not linked from another file")
        return modifier_of(context.object) is not None and context.object.library is None

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Insert the keys."""
        try:
            count = key_reel_frames(context.scene, context.object)
        except HoloreelError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"Retime is on, Reel Frame has {count} keys")
        return {"FINISHED"}


register, unregister = bpy.utils.register_classes_factory((HOLOREEL_OT_key_reel_frames,))
