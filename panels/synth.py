# SPDX-License-Identifier: GPL-3.0-or-later
"""The panel Synthesize: from this scene to a capture."""

import bpy

from ..operators.synth import HOLOREEL_OT_synthesize
from .sidebar import Sidebar


class HOLOREEL_PT_synth(Sidebar, bpy.types.Panel):
    """What to film, and how."""

    bl_idname = "HOLOREEL_PT_synth"
    bl_label = "Synthesize"
    bl_order = 10

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the settings and the button."""
        layout, settings = self.layout, context.scene.holoreel_synth
        layout.use_property_split, layout.use_property_decorate = True, False
        for name in ("out", "rig", "cameras", "size", "samples", "scene_range"):
            layout.prop(settings, name)
        if not settings.scene_range:
            layout.prop(settings, "first_frame")
            layout.prop(settings, "last_frame")
        for name in ("transparent", "depth", "options"):
            layout.prop(settings, name)
        layout.operator(HOLOREEL_OT_synthesize.bl_idname, icon="CAMERA_DATA")


register, unregister = bpy.utils.register_classes_factory((HOLOREEL_PT_synth,))
