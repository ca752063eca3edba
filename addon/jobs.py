# SPDX-License-Identifier: GPL-3.0-or-later
"""The jobs this Blender knows of, and the timer that keeps an eye on them.

A job is a process of its own (`core.jobs`): it outlives the .blend that was open when it was started, and Blender too;
whatever Blender looks into the log folder next takes it up again. `tick` is all that ever runs here: it opens a few
small files for each job that is running, and nothing for those that have ended. Timers do not run in background mode:
call `tick` there.
"""

import secrets
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import bpy

from ..core.errors import HoloreelError
from ..core.jobs import Job, JobRecord, State, begin, job_folders, open_job
from . import preferences, previews
from .environment import child_environment
from .reels import import_reel

PENDING = "holoreel_pending"  # custom property of a scene: names of jobs whose reels are to be imported into it

TICK_SECONDS = 0.5
ADOPTED_PER_TICK = 8  # folders of jobs that are opened in one tick, after a start

_jobs: dict[str, Job] = {}
_waiting: deque[Path] = deque()
_session = ""


def jobs_folder() -> Path:
    """Return the folder in which each job has one of its own."""
    return preferences.log_folder() / "jobs"


def known() -> list[Job]:
    """Return all jobs that are known so far, newest first."""
    return sorted(_jobs.values(), key=lambda job: job.name, reverse=True)


def find(name: str) -> Job:
    """Return a job by its name; raises `HoloreelError` where there is none."""
    if name not in _jobs:
        raise HoloreelError(f"there is no job {name!r}: it may have been removed; refresh the list of jobs.")
    return _jobs[name]


def start(
    record: JobRecord,
    python: Path,
    *,
    import_into: bpy.types.Scene | None = None,
    prepare: Callable[[Path], None] = lambda folder: None,
) -> Job:
    """Start a job, with `python` for its supervisor; its reel goes into a scene when it is done, if one is given.

    Raises `HoloreelError` where a running job makes the same, and as `core.jobs.begin` does.
    """
    if any(job.state.alive and job.record.result == record.result for job in _jobs.values()):
        raise HoloreelError(
            f"{record.result} is being made by a job that runs: wait for it, or stop it in the panel Jobs."
        )
    notes = record.notes | {"import": import_into is not None, "blend": bpy.data.filepath, "session": _session}
    job = begin(jobs_folder(), replace(record, notes=notes), python, child_environment(), prepare)
    _jobs[job.name] = job
    if import_into is not None:
        import_into[PENDING] = f"{import_into.get(PENDING, '')} {job.name}".strip()
    _ensure_timer()
    return job


def resume(job: Job, python: Path) -> None:
    """Run a job again that was stopped or has failed; raises `HoloreelError`."""
    if job.state.alive:
        raise HoloreelError(f"{job.record.title} is running: stop it first.")
    job.resume(python, child_environment())
    _ensure_timer()


def remove(job: Job) -> None:
    """Forget a job that has ended; raises `HoloreelError` where it runs."""
    if job.state.alive:
        raise HoloreelError(f"{job.record.title} is running: stop it first.")
    job.remove()
    previews.forget(job.name)
    _jobs.pop(job.name, None)


def scan() -> None:
    """Look for jobs that other sessions have left; they are opened tick by tick."""
    _waiting.clear()
    _waiting.extend(folder for folder in job_folders(jobs_folder()) if folder.name not in _jobs)
    _ensure_timer()


def tick() -> float | None:
    """Look how running jobs stand; return when to look again, None where there is nothing to look at."""
    changed = _adopt()
    for job in list(_jobs.values()):
        if job.state.alive and job.look():
            changed = True
        if job.state is State.DONE:
            changed = _finish(job) or changed
    if changed:
        _redraw()
    return TICK_SECONDS if _waiting or any(job.state.alive or _wants_import(job) for job in _jobs.values()) else None


def take_reel(context: bpy.types.Context, job: Job) -> bpy.types.Object:
    """Import the reel that a job has made; raises `HoloreelError` where it cannot be read."""
    imported = import_reel(context, job.record.result)
    job.record.notes["import"] = False
    for scene in bpy.data.scenes:
        if PENDING in scene:
            left = [name for name in scene[PENDING].split() if name != job.name]
            scene[PENDING] = " ".join(left)
    return imported


def _adopt() -> bool:
    """Open a few of the jobs that other sessions have left."""
    opened = [_waiting.popleft() for _ in range(min(ADOPTED_PER_TICK, len(_waiting)))]
    for folder in opened:
        try:
            _jobs.setdefault(folder.name, open_job(folder))
        except HoloreelError:
            continue  # not one of ours, or of another version: let it lie
    return bool(opened)


def _finish(job: Job) -> bool:
    """Do what was asked for when a job is done; return whether that was done now."""
    if job.record.kind == "environment" and not job.record.notes.get("chosen"):
        job.record.notes["chosen"] = True
        if job.record.notes.get("session") == _session:
            preferences.choose_environment(job.record.result)
        return True
    if not _wants_import(job) or bpy.context.mode != "OBJECT" or bpy.app.is_job_running("RENDER"):
        return False
    job.record.notes["import"] = False
    if not job.take_result():  # another Blender has the same file open
        return False
    try:
        _import(job)
    except HoloreelError as error:
        job.message = str(error)
    return True


def _import(job: Job) -> None:
    """Import a reel from the timer, where no window is the active one."""
    windows = bpy.context.window_manager.windows
    if windows:
        with bpy.context.temp_override(window=windows[0]):
            take_reel(bpy.context, job)
            bpy.ops.ed.undo_push(message="Import Reel")
    else:
        take_reel(bpy.context, job)


def _wants_import(job: Job) -> bool:
    """Whether a job's reel is to be imported, and into the file that is open."""
    notes = job.record.notes
    if job.state is not State.DONE or not notes.get("import"):
        return False
    blend = notes.get("blend")
    same_file = blend == bpy.data.filepath and bool(blend or notes.get("session") == _session)
    return same_file or any(job.name in scene.get(PENDING, "").split() for scene in bpy.data.scenes)


def _redraw() -> None:
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type in {"VIEW_3D", "PREFERENCES"}:
                area.tag_redraw()


def _ensure_timer() -> None:
    if not bpy.app.timers.is_registered(tick):
        bpy.app.timers.register(tick, first_interval=TICK_SECONDS, persistent=True)


def _first_look() -> None:
    """Look for jobs once Blender has started: registration itself touches no file."""
    scan()


def register() -> None:
    """Begin to watch."""
    global _session
    _session = secrets.token_hex(8)
    bpy.app.timers.register(_first_look, first_interval=1.0, persistent=True)


def unregister() -> None:
    """Forget all jobs; those that run go on."""
    for timer in (tick, _first_look):
        if bpy.app.timers.is_registered(timer):
            bpy.app.timers.unregister(timer)
    _jobs.clear()
    _waiting.clear()
