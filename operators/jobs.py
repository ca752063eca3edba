# SPDX-License-Identifier: GPL-3.0-or-later
"""Stop, resume, import, remove: what can be done with a job."""

import sys
from pathlib import Path

import bpy

from ..addon import jobs
from ..addon.preferences import core_python
from ..core.errors import HoloreelError
from ..core.jobs import Job, State
from .reporting import Reporting


class _OfJob(Reporting):
    """An operator on one job: the one that is named, or the newest that it suits."""

    bl_options = {"REGISTER"}
    nothing = ""

    job: bpy.props.StringProperty(
        name="Job",
        description="Name of the job's folder; empty takes the newest that this suits",
        options={"SKIP_SAVE"},
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only where there is a job that it suits."""
        if any(cls.suits(job) for job in jobs.known()):
            return True
        cls.poll_message_set(cls.nothing)
        return False

    def chosen(self) -> Job:
        """Return the job."""
        if self.job:
            return jobs.find(self.job)
        return next(job for job in jobs.known() if type(self).suits(job))


class HOLOREEL_OT_stop_job(_OfJob, bpy.types.Operator):
    """The end of a job, sooner or later."""

    bl_idname = "holoreel.stop_job"
    bl_label = "Stop Job"
    bl_description = "Stop the job as soon as it has written a checkpoint, so that it can be resumed"
    suits = staticmethod(lambda job: job.state.alive)
    nothing = "no job is running"

    at_once: bpy.props.BoolProperty(
        name="At Once", description="Do not wait for a checkpoint: what came after the last one is lost"
    )

    def run(self, context: bpy.types.Context) -> None:
        """Ask the job to stop."""
        job = self.chosen()
        job.stop(self.at_once)
        job.look()


class HOLOREEL_OT_resume_job(_OfJob, bpy.types.Operator):
    """Another go."""

    bl_idname = "holoreel.resume_job"
    bl_label = "Resume Job"
    bl_description = "Run the job again, from its checkpoint where there is one"
    suits = staticmethod(lambda job: job.state in (State.STOPPED, State.FAILED))
    nothing = "no job was stopped or has failed"

    def run(self, context: bpy.types.Context) -> None:
        """Start it again; an environment is made by the Python that began it, all else runs in the environment."""
        job = self.chosen()
        jobs.resume(job, Path(sys.executable) if job.record.kind == "environment" else core_python())


class HOLOREEL_OT_import_result(_OfJob, bpy.types.Operator):
    """The reel that was trained."""

    bl_idname = "holoreel.import_result"
    bl_label = "Import Result"
    bl_description = "Import the reel that the job has trained"
    bl_options = {"REGISTER", "UNDO"}
    suits = staticmethod(lambda job: job.record.kind == "train" and job.state is State.DONE)
    nothing = "no training is done"

    def run(self, context: bpy.types.Context) -> None:
        """Import it into the active scene."""
        if context.mode != "OBJECT":
            raise HoloreelError("a reel is imported in Object Mode: leave the mode you are in first.")
        imported = jobs.take_reel(context, self.chosen())
        for chosen in context.selected_objects:
            chosen.select_set(False)
        imported.select_set(True)
        context.view_layer.objects.active = imported


class HOLOREEL_OT_remove_job(_OfJob, bpy.types.Operator):
    """One job less in the list."""

    bl_idname = "holoreel.remove_job"
    bl_label = "Remove Job"
    bl_description = "Take the job out of the list and delete its log; what it has made stays"
    suits = staticmethod(lambda job: not job.state.alive)
    nothing = "no job has ended"

    def run(self, context: bpy.types.Context) -> None:
        """Forget it."""
        jobs.remove(self.chosen())


class HOLOREEL_OT_refresh_jobs(Reporting, bpy.types.Operator):
    """Jobs of other sessions."""

    bl_idname = "holoreel.refresh_jobs"
    bl_label = "Refresh Jobs"
    bl_description = "Look into the log folder for jobs that another Blender has started"
    bl_options = {"REGISTER"}

    def run(self, context: bpy.types.Context) -> None:
        """Look for them; the list fills in the next moments."""
        jobs.scan()


CLASSES = (
    HOLOREEL_OT_stop_job,
    HOLOREEL_OT_resume_job,
    HOLOREEL_OT_import_result,
    HOLOREEL_OT_remove_job,
    HOLOREEL_OT_refresh_jobs,
)

register, unregister = bpy.utils.register_classes_factory(CLASSES)
