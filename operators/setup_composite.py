# SPDX-License-Identifier: GPL-3.0-or-later
"""Set Up Composite."""

import bpy

from ..addon.composite import setup_composite
from ..core.errors import HoloreelError


class HOLOREEL_OT_setup_composite(bpy.types.Operator):
    """Reels by the Holoreel engine, the rest by the scene's own."""

    bl_idname = "holoreel.setup_composite"
    bl_label = "Set Up Composite"
    bl_description = (
        "Let the Holoreel engine draw the reels exactly, and Cycles or EEVEE everything else; the compositor merges "
        "both by depth. The reels get a scene of their own and are hidden from this scene's renders. Do it again after "
        "importing more reels or changing the format"
    )
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Set up the scene, its twin and the compositor."""
        try:
            made = setup_composite(context.scene, context.view_layer)
        except HoloreelError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"The reels are rendered in scene '{made.name}' and merged by depth")
        return {"FINISHED"}


def register() -> None:
    """Register the operator."""
    bpy.utils.register_class(HOLOREEL_OT_setup_composite)


def unregister() -> None:
    """Take it out again."""
    bpy.utils.unregister_class(HOLOREEL_OT_setup_composite)
