# SPDX-License-Identifier: GPL-3.0-or-later
"""The panel Train: from a capture to a reel."""

import bpy

from ..operators.train import HOLOREEL_OT_train
from .sidebar import Sidebar


class HOLOREEL_PT_train(Sidebar, bpy.types.Panel):
    """What to train."""

    bl_idname = "HOLOREEL_PT_train"
    bl_label = "Train"
    bl_order = 11

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the settings and the button."""
        layout, settings = self.layout, context.scene.holoreel_train
        layout.use_property_split, layout.use_property_decorate = True, False
        layout.prop(settings, "capture")
        layout.prop(settings, "out")
        layout.prop(settings, "method")
        layout.prop(settings, "stg_preset" if settings.method == "stg" else "videorf_preset")
        layout.prop(settings, "all_frames")
        if not settings.all_frames:
            layout.prop(settings, "first_frame")
            layout.prop(settings, "last_frame")
        layout.prop(settings, "options")
        column = layout.column()
        for name in ("go_on", "overwrite", "import_when_done"):
            column.prop(settings, name)
        layout.operator(HOLOREEL_OT_train.bl_idname, icon="PLAY")


register, unregister = bpy.utils.register_classes_factory((HOLOREEL_PT_train,))
