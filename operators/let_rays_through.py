# SPDX-License-Identifier: GPL-3.0-or-later
"""Let Rays Through."""

import bpy

from ..addon.exact import let_rays_through


class HOLOREEL_OT_let_rays_through(bpy.types.Operator):
    """The one setting of Cycles without which no reel looks right."""

    bl_idname = "holoreel.let_rays_through"
    bl_label = "Let Rays Through"
    bl_description = (
        "Let the rays of Cycles pass through as many splats as they meet (Max and Min Transparent Bounces 1024); "
        "everything else in the scene stays as it is"
    )
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Change the scene's two limits."""
        let_rays_through(context.scene)
        return {"FINISHED"}


register, unregister = bpy.utils.register_classes_factory((HOLOREEL_OT_let_rays_through,))
