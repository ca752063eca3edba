# SPDX-License-Identifier: GPL-3.0-or-later
"""Synthesize Capture."""

import bpy

from ..addon import jobs
from ..addon.preferences import core_python
from ..addon.synthesis import save_copy, synthesis
from .reporting import NeedsCore


class HOLOREEL_OT_synthesize(NeedsCore, bpy.types.Operator):
    """From a scene to a capture, beside Blender."""

    bl_idname = "holoreel.synthesize"
    bl_label = "Synthesize Capture"
    bl_description = (
        "Start to film a copy of this file with a rig of cameras as the panel Synthesize says, in a Blender of its own "
        "that this one does not wait for"
    )
    bl_options = {"REGISTER"}

    def run(self, context: bpy.types.Context) -> None:
        """Save the copy and start the job."""
        python = core_python()
        record = synthesis(context.scene.holoreel_synth, context.scene, python)
        job = jobs.start(record, python, prepare=save_copy)
        self.report({"INFO"}, f"{job.record.title} has started; the panel Jobs shows how far it is")


register, unregister = bpy.utils.register_classes_factory((HOLOREEL_OT_synthesize,))
