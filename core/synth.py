# SPDX-License-Identifier: GPL-3.0-or-later
"""Synthesize a capture: Blender renders a rig of cameras frame by frame, this process keeps the books.

Blender (addon/synth.py) writes each view as a picture and a multilayer EXR into `.work`; here they are checked, depth
and seed points are taken out, and the picture moves to its place last, so a picture in place means a finished view. A
job that was stopped goes on with the views that lack one. The folder then holds

    transforms.json             the capture
    images/cam00/000001.png     by the scene's frame number
    depth/cam00/000001.exr      planar z in scene units, if asked for
    seeds/000001.ply            seed points of the training cameras, if asked for
    synth.json                  the job, the rig, and the Blender that did it
    blender.log
"""

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from .blender import Blender, run_in_blender
from .camera import Camera
from .capture import View, write_capture
from .errors import HoloreelError
from .files import read_json
from .rig import MAX_CAMERAS, RigRequest
from .synth_books import MAX_FRAMES, RECORD, Books, SynthJob, plain

__all__ = ["SynthJob", "SynthResult", "synthesize"]

FUNCTION = "holoreel.addon.synth:render"


@dataclass(frozen=True)
class SynthResult:
    """The capture that was made, and what looks odd about it."""

    transforms: Path
    rendered: int
    warnings: list[str]


def synthesize(
    job: SynthJob,
    out: str | Path,
    blender: Callable[[], Blender],
    *,
    overwrite: bool = False,
    on_progress: Callable[[int, int], None] | None = None,
    on_picture: Callable[[Path], None] | None = None,
) -> SynthResult:
    """Render the capture that `job` describes into the folder `out`, or go on where an earlier call stopped.

    `blender` is called for the Blender to use where there is something to render; `on_progress(done, total)` counts
    views, and `on_picture` hears of the picture of each before it is counted.
    Raises `HoloreelError` where the job, the folder or Blender cannot do it; what was rendered stays.
    """
    job.check()
    out = Path(out)
    with _lock(out) as lock:
        books = _open_books(job, out, overwrite)
        done = {view for view in books.views() if books.is_done(view)}
        todo = [view for view in books.views() if view not in done]
        if on_progress:
            on_progress(len(done), len(done) + len(todo))
        if todo or not books.cameras:
            _render(books, todo, blender(), lock, len(done), on_progress, on_picture)
        for frame in range(job.frame_count):
            books.merge_seeds(frame)
        transforms = write_capture(out, books.capture())
        shutil.rmtree(out / ".work", ignore_errors=True)
    return SynthResult(transforms, len(todo), books.warnings)


def _render(
    books: Books,
    todo: list[View],
    blender: Blender,
    lock: int,
    done: int,
    on_progress: Callable[[int, int], None] | None,
    on_picture: Callable[[Path], None] | None,
) -> None:
    job, work, total = books.job, books.out / ".work", done + len(todo)
    work.mkdir(parents=True, exist_ok=True)

    def on_event(event: dict[str, Any]) -> None:
        nonlocal done
        if event["event"] == "scene":
            books.cameras = [Camera.from_json(camera) for camera in event["cameras"]]
            books.scene = event["scene"]
            books.save()
        elif event["event"] == "view":
            layers = Path(event["layers"]) if event["layers"] else None
            books.take((event["camera"], event["frame"]), Path(event["picture"]), layers)
            done += 1
            if on_picture:
                on_picture(books.image((event["camera"], event["frame"])))
            if on_progress:
                on_progress(done, total)

    request = plain(asdict(job)) | {
        "scene": str(job.scene.resolve()),
        "work": str(work.resolve()),
        "cameras": [camera.to_json() for camera in books.cameras],
        "names": books.camera_names(),
        "todo": todo,
    }
    run_in_blender(blender, FUNCTION, request, log=books.out / "blender.log", on_event=on_event, inherit=(lock,))
    if left := [view for view in todo if not books.image(view).is_file()]:
        raise HoloreelError(f"Blender left out {len(left)} views, {books.image(left[0])} first; run it again.")


def _open_books(job: SynthJob, out: Path, overwrite: bool) -> Books:
    """Look at what the folder holds; refuse to mix two jobs."""
    books = Books(job, out)
    record = out / RECORD
    if not record.is_file():
        strangers = [
            path.name for path in out.iterdir() if path.name in ("images", "depth", "seeds", "transforms.json")
        ]
        if strangers and not overwrite:
            raise HoloreelError(
                f"{out} already holds {strangers[0]} of something else; choose another folder for --out."
            )
        return books
    before = read_json(record)
    if before.get("job") != job.to_json():
        if not overwrite:
            raise HoloreelError(
                f"{out} holds the capture of another job ({_difference(before.get('job'), job.to_json())}); "
                "choose another folder, or give --overwrite to replace it."
            )
        _books_before(before, out).remove_results()
        record.unlink()
        return books
    if overwrite:
        books.remove_results()
    books.cameras = [Camera.from_json(camera, record) for camera in before.get("cameras", [])]
    books.scene = before.get("scene", {})
    return books


def _books_before(record: dict[str, Any], out: Path) -> Books:
    """The books of the job that a folder's synth.json records."""
    try:
        job = record["job"]
        rig = RigRequest(cameras=int(job["rig"]["cameras"]), width=1, height=1)
        first, last = job["frames"]
        before = SynthJob(scene=Path(job["scene"]), rig=rig, frames=(int(first), int(last)))
    except (KeyError, TypeError, ValueError) as error:
        raise HoloreelError(f"{out / RECORD} is no record of a job ({error}); choose another folder.") from error
    if not (0 < rig.cameras <= MAX_CAMERAS and before.frame_count <= MAX_FRAMES):
        raise HoloreelError(f"{out / RECORD} is no record of a job; choose another folder.")
    return Books(before, out)


def _difference(before: Any, now: dict[str, Any]) -> str:
    """Name the first thing in which two jobs differ."""
    before = before if isinstance(before, dict) else {}
    for key, value in now.items():
        if before.get(key) != value:
            if isinstance(value, dict) and isinstance(before.get(key), dict):
                return _difference(before[key], value)
            return f"{key} was {before.get(key)!r}, is {value!r}" if "sha256" not in key else "the scene has changed"
    return "it has other settings"


@contextmanager
def _lock(out: Path) -> Iterator[int]:
    """Hold the folder for one job; Blender gets the open file too, so that the lock lasts as long as the last of us."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        lock = os.open(out / ".lock", os.O_CREAT | os.O_RDWR, 0o644)
    except OSError as error:
        raise HoloreelError(f"{out} cannot be written ({error.strerror}): choose another folder for --out.") from error
    try:
        _take_lock(lock, out)
        yield lock
    finally:
        os.close(lock)


def _take_lock(lock: int, out: Path) -> None:
    try:
        import fcntl
    except ImportError:  # Windows: no lock
        return
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        raise HoloreelError(f"{out} is being rendered by another process; wait for it, or stop it.") from error
