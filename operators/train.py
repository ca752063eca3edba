# SPDX-License-Identifier: GPL-3.0-or-later
"""Train Reel."""

import bpy

from ..addon import jobs
from ..addon.preferences import core_python, device
from ..addon.training import training
from .reporting import NeedsCore


class HOLOREEL_OT_train(NeedsCore, bpy.types.Operator):
    """From a capture to a reel, beside Blender."""

    bl_idname = "holoreel.train"
    bl_label = "Train Reel"
    bl_description = (
        "Start to train a reel as the panel Train says, in a process of its own that Blender does not wait for"
    )
    bl_options = {"REGISTER"}

    def run(self, context: bpy.types.Context) -> None:
        """Start the job."""
        settings, python = context.scene.holoreel_train, core_python()
        record = training(settings, python, device())
        job = jobs.start(record, python, import_into=context.scene if settings.import_when_done else None)
        self.report({"INFO"}, f"{job.record.title} has started; the panel Jobs shows how far it is")


register, unregister = bpy.utils.register_classes_factory((HOLOREEL_OT_train,))
