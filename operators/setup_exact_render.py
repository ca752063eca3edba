# SPDX-License-Identifier: GPL-3.0-or-later
"""Set Up Exact Render."""

import bpy

from ..addon.exact import setup_exact_render


class HOLOREEL_OT_setup_exact_render(bpy.types.Operator):
    """The preset for pictures that match the rasterizer's."""

    bl_idname = "holoreel.setup_exact_render"
    bl_label = "Set Up Exact Render"
    bl_description = (
        "Set up Cycles and EEVEE so that the look Splats gives the pictures the reel was trained to give: "
        "one sample per pixel, nothing random, view transform Raw, transparent film, display-referred colors"
    )
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Change the scene, its active camera and its reels."""
        setup_exact_render(context.scene)
        self.report({"INFO"}, "View transform Raw, one sample per pixel, display-referred colors")
        return {"FINISHED"}


def register() -> None:
    """Register the operator."""
    bpy.utils.register_class(HOLOREEL_OT_setup_exact_render)


def unregister() -> None:
    """Take it out again."""
    bpy.utils.unregister_class(HOLOREEL_OT_setup_exact_render)
