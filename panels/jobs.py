# SPDX-License-Identifier: GPL-3.0-or-later
"""The panel Jobs: what is being trained, synthesized and installed."""

import bpy

from ..addon import jobs, previews
from ..addon.texts import draw_text, letters_in
from ..core.jobs import Job, State
from ..core.status import Status, preview_path
from ..operators.jobs import (
    HOLOREEL_OT_import_result,
    HOLOREEL_OT_refresh_jobs,
    HOLOREEL_OT_remove_job,
    HOLOREEL_OT_resume_job,
    HOLOREEL_OT_stop_job,
)
from .sidebar import Sidebar

SHOWN = 8  # jobs, newest first
PREVIEW_SCALE = 9.0
_ICONS = {
    State.RUNNING: "PLAY",
    State.STOPPING: "SORTTIME",
    State.DONE: "CHECKMARK",
    State.STOPPED: "PAUSE",
    State.FAILED: "ERROR",
}


class HOLOREEL_PT_jobs(Sidebar, bpy.types.Panel):
    """All jobs, newest first."""

    bl_idname = "HOLOREEL_PT_jobs"
    bl_label = "Jobs"
    bl_order = 12

    def draw(self, context: bpy.types.Context) -> None:
        """Draw a box for each job."""
        known = jobs.known()
        for job in known[:SHOWN]:
            _draw_job(self.layout.box().column(), job, letters_in(context.region))
        if not known:
            self.layout.label(text="No jobs", icon="INFO")
        if len(known) > SHOWN:
            self.layout.label(text=f"and {len(known) - SHOWN} older ones")
        self.layout.operator(HOLOREEL_OT_refresh_jobs.bl_idname, icon="FILE_REFRESH")


def _draw_job(column: bpy.types.UILayout, job: Job, letters: int) -> None:
    """Draw what a job is, how far it is, and what can be done with it, in lines of so many letters."""
    column.label(text=f"{job.record.title}: {job.state.value}", icon=_ICONS[job.state])
    if job.state.alive:
        column.progress(factor=job.status.share, text=progress_text(job.status))
    if icon := previews.icon(job.name, job.status.previews, preview_path(job.status_file)):
        column.template_icon(icon_value=icon, scale=PREVIEW_SCALE)
    if job.status.figures:
        draw_text(column, ", ".join(f"{name} {text}" for name, text in job.status.figures.items()), letters)
    if job.message:
        draw_text(column, job.message, letters, "ERROR")
    _draw_buttons(column.row(align=True), job)


def _draw_buttons(row: bpy.types.UILayout, job: Job) -> None:
    if job.state.alive:
        stopping = job.state is State.STOPPING
        stop = row.operator(HOLOREEL_OT_stop_job.bl_idname, text="Stop at Once" if stopping else "Stop", icon="CANCEL")
        stop.job, stop.at_once = job.name, stopping
    else:
        if job.state is not State.DONE:
            row.operator(HOLOREEL_OT_resume_job.bl_idname, text="Resume", icon="PLAY").job = job.name
        elif job.record.kind == "train":
            row.operator(HOLOREEL_OT_import_result.bl_idname, text="Import", icon="IMPORT").job = job.name
        elif job.record.kind == "synth":
            train = row.operator("wm.context_set_string", text="Train from This", icon="FORWARD")
            train.data_path, train.value = "scene.holoreel_train.capture", job.record.result
        row.operator(HOLOREEL_OT_remove_job.bl_idname, text="", icon="TRASH").job = job.name
    row.operator("wm.path_open", text="", icon="TEXT").filepath = str(job.log)


def progress_text(status: Status) -> str:
    """Say in a few words how far a job is."""
    if not status.total:
        return status.stage
    left = f", {time_text(status.seconds_left)} left" if status.seconds_left is not None else ""
    return f"{status.stage} {status.share:.0%}{left}"


def time_text(seconds: float) -> str:
    """Return a time as people say it, to two places."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"


register, unregister = bpy.utils.register_classes_factory((HOLOREEL_PT_jobs,))
