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

import hashlib
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .blender import Blender, run_in_blender
from .camera import Camera
from .capture import Capture, View, read_points, write_capture, write_points
from .capture.images import read_depth, read_picture
from .capture.seeding import merge_points, seeds_from_depth
from .errors import HoloreelError
from .files import atomic_path, read_json, write_json
from .rig import MAX_CAMERAS, PRESETS, RigRequest

FUNCTION = "holoreel.addon.synth:render"
MAX_FRAMES = 100_000
_VERSION = 1
_FILMS = ("opaque", "transparent")


@dataclass(frozen=True)
class SynthJob:
    """Everything that decides what the capture looks like. `frames` are the first and the last, both included."""

    scene: Path
    rig: RigRequest
    frames: tuple[int, int]
    preset: str = "arc"
    samples: int = 64
    holdout: tuple[int, ...] = (0,)
    film: str = "opaque"
    depth: bool = False
    seed_points: int = 20_000
    denoise: bool = True
    seed: int = 0

    @property
    def frame_count(self) -> int:
        """How many frames are rendered."""
        return self.frames[1] - self.frames[0] + 1

    def check(self) -> None:
        """Raise `HoloreelError` for what cannot be rendered."""
        rig, (first, last) = self.rig, self.frames
        if not self.scene.is_file():
            raise HoloreelError(f"{self.scene} is not there: give a .blend file.")
        if self.preset not in PRESETS:
            raise HoloreelError(f"there is no rig {self.preset!r}; take one of {', '.join(PRESETS)}.")
        if not 1 <= rig.cameras <= MAX_CAMERAS:
            raise HoloreelError(f"--cameras must be 1 to {MAX_CAMERAS}, not {rig.cameras}.")
        if not 0 <= first <= last or self.frame_count > MAX_FRAMES:
            raise HoloreelError(f"--frames {first}:{last} is no range of 1 to {MAX_FRAMES} frames; write FIRST:LAST.")
        if not (8 <= rig.width <= 1 << 14 and 8 <= rig.height <= 1 << 14):
            raise HoloreelError(f"--size {rig.width}x{rig.height} must lie between 8 and {1 << 14} pixels a side.")
        if not 1 <= self.samples <= 1 << 20:
            raise HoloreelError(f"--samples must be 1 or more, not {self.samples}.")
        if self.film not in _FILMS:
            raise HoloreelError(f"--film must be one of {', '.join(_FILMS)}, not {self.film!r}.")
        if self.seed_points < 0:
            raise HoloreelError(f"--seed-points must be 0 or more, not {self.seed_points}.")
        if wrong := [index for index in self.holdout if not 0 <= index < rig.cameras]:
            raise HoloreelError(f"--holdout {wrong[0]} is no camera: they are 0 to {rig.cameras - 1}.")
        if len(set(self.holdout)) == rig.cameras:
            raise HoloreelError("--holdout leaves no camera to train with: hold out fewer, or take more --cameras.")

    def to_json(self) -> dict[str, Any]:
        """The job as what decides it: the scene by its content."""
        value = asdict(self) | {"scene": self.scene.name, "scene_sha256": _digest(self.scene)}
        return _plain(value)


@dataclass
class _Books:
    """What is where, and what is done."""

    job: SynthJob
    out: Path
    cameras: list[Camera] = field(default_factory=list)
    scene: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def file(self, folder: str, name: str, frame: int, suffix: str) -> Path:
        return self.out / folder / name / f"{self.job.frames[0] + frame:06d}{suffix}"

    def image(self, view: View) -> Path:
        return self.file("images", *view, ".png")

    def depth(self, view: View) -> Path:
        return self.file("depth", *view, ".exr")

    def part(self, view: View) -> Path:
        """Seed points of one view, until those of the frame are complete."""
        return self.file(".work", *view, ".ply")

    def seeds(self, frame: int) -> Path:
        return self.file("seeds", "", frame, ".ply")

    def camera_names(self) -> list[str]:
        digits = max(2, len(str(self.job.rig.cameras - 1)))
        return [f"cam{index:0{digits}d}" for index in range(self.job.rig.cameras)]

    def training_names(self) -> list[str]:
        return [name for index, name in enumerate(self.camera_names()) if index not in self.job.holdout]

    def views(self) -> list[View]:
        """All views, all cameras of a frame before the next frame."""
        return [(name, frame) for frame in range(self.job.frame_count) for name in self.camera_names()]

    def is_done(self, view: View) -> bool:
        """Whether a view has all its files, whole."""
        width, height = self.job.rig.width, self.job.rig.height
        try:
            read_picture(self.image(view), width, height)
            if self.job.depth:
                read_depth(self.depth(view), width, height)
            if self._gives_seeds(view) and not self.seeds(view[1]).is_file():
                read_points(self.part(view))
        except HoloreelError:
            return False
        return True

    def _gives_seeds(self, view: View) -> bool:
        return self.job.seed_points > 0 and view[0] in self.training_names()

    def take(self, view: View, picture_file: Path, layers_file: Path | None) -> None:
        """Take a view that Blender rendered into the capture."""
        camera = self.cameras[self.camera_names().index(view[0])]
        picture = read_picture(picture_file, camera.width, camera.height)
        if (picture[..., :3] == picture[0, 0, :3]).all():
            self.warnings.append(f"{view[0]} sees a single color at frame {self.job.frames[0] + view[1]}")
        if layers_file:
            depth = read_depth(layers_file, camera.width, camera.height)
            if self.job.depth:
                write_depth(self.depth(view), depth)
            if self._gives_seeds(view) and not self.seeds(view[1]).is_file():
                rng = np.random.default_rng((self.job.seed, view[1], self.camera_names().index(view[0])))
                share = -(-self.job.seed_points // len(self.training_names()))
                write_points(self.part(view), seeds_from_depth(camera, picture, depth, share, rng))
            layers_file.unlink()
        with atomic_path(self.image(view)) as temporary:
            os.replace(picture_file, temporary)
        self.merge_seeds(view[1])

    def merge_seeds(self, frame: int) -> None:
        """Put a frame's seed points together once all its training cameras gave theirs."""
        parts = [self.part((name, frame)) for name in self.training_names()]
        if self.job.seed_points and not self.seeds(frame).is_file() and all(part.is_file() for part in parts):
            write_points(self.seeds(frame), merge_points(read_points(part) for part in parts))
            for part in parts:
                part.unlink()

    def capture(self) -> Capture:
        job, views = self.job, self.views()
        names = self.camera_names()
        return Capture(
            cameras=dict(zip(names, self.cameras, strict=True)),
            images={view: self.image(view) for view in views},
            frame_count=job.frame_count,
            splits={names[index]: "test" for index in job.holdout},
            fps=self.scene["fps"],
            frame_start=job.frames[0],
            depths={view: self.depth(view) for view in views} if job.depth else {},
            seeds={frame: self.seeds(frame) for frame in range(job.frame_count)} if job.seed_points else {},
            source=self.out / "transforms.json",
        )

    def save(self) -> None:
        cameras = [camera.to_json() for camera in self.cameras]
        write_json(
            self.out / "synth.json",
            {"version": _VERSION, "job": self.job.to_json(), "scene": self.scene, "cameras": cameras},
        )

    def remove_results(self) -> None:
        """Delete the files that a job in this folder made, and no others."""
        (self.out / "transforms.json").unlink(missing_ok=True)
        shutil.rmtree(self.out / ".work", ignore_errors=True)
        for view in self.views():
            self.image(view).unlink(missing_ok=True)
            self.depth(view).unlink(missing_ok=True)
            self.seeds(view[1]).unlink(missing_ok=True)


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
) -> SynthResult:
    """Render the capture that `job` describes into the folder `out`, or go on where an earlier call stopped.

    `blender` is called for the Blender to use where there is something to render; `on_progress(done, total)` counts
    views.
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
            _render(books, todo, blender(), lock, len(done), on_progress)
        for frame in range(job.frame_count):
            books.merge_seeds(frame)
        transforms = write_capture(out, books.capture())
        shutil.rmtree(out / ".work", ignore_errors=True)
    return SynthResult(transforms, len(todo), books.warnings)


def write_depth(path: Path, depth: np.ndarray) -> None:
    """Write a depth map (H, W) as float32 EXR of one channel Z, atomically; infinity becomes 1e10, as in Cycles."""
    import OpenEXR

    pixels = np.where(np.isfinite(depth), depth, 1e10).astype(np.float32)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with atomic_path(path) as temporary:
        OpenEXR.File(header, {"Z": pixels}).write(str(temporary))


def _render(
    books: _Books,
    todo: list[View],
    blender: Blender,
    lock: int,
    done: int,
    on_progress: Callable[[int, int], None] | None,
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
            if on_progress:
                on_progress(done, total)

    request = _plain(asdict(job)) | {
        "scene": str(job.scene.resolve()),
        "work": str(work.resolve()),
        "cameras": [camera.to_json() for camera in books.cameras],
        "names": books.camera_names(),
        "todo": todo,
    }
    run_in_blender(blender, FUNCTION, request, log=books.out / "blender.log", on_event=on_event, inherit=(lock,))
    if left := [view for view in todo if not books.image(view).is_file()]:
        raise HoloreelError(f"Blender left out {len(left)} views, {books.image(left[0])} first; run it again.")


def _open_books(job: SynthJob, out: Path, overwrite: bool) -> _Books:
    """Look at what the folder holds; refuse to mix two jobs."""
    books = _Books(job, out)
    record = out / "synth.json"
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


def _books_before(record: dict[str, Any], out: Path) -> _Books:
    """The books of the job that a folder's synth.json records."""
    try:
        job = record["job"]
        rig = RigRequest(cameras=int(job["rig"]["cameras"]), width=1, height=1)
        first, last = job["frames"]
        before = SynthJob(scene=Path(job["scene"]), rig=rig, frames=(int(first), int(last)))
    except (KeyError, TypeError, ValueError) as error:
        raise HoloreelError(f"{out / 'synth.json'} is no record of a job ({error}); choose another folder.") from error
    if not (0 < rig.cameras <= MAX_CAMERAS and before.frame_count <= MAX_FRAMES):
        raise HoloreelError(f"{out / 'synth.json'} is no record of a job; choose another folder.")
    return _Books(before, out)


def _difference(before: Any, now: dict[str, Any]) -> str:
    """Name the first thing in which two jobs differ."""
    before = before if isinstance(before, dict) else {}
    for key, value in now.items():
        if before.get(key) != value:
            if isinstance(value, dict) and isinstance(before.get(key), dict):
                return _difference(before[key], value)
            return f"{key} was {before.get(key)!r}, is {value!r}" if "sha256" not in key else "the scene has changed"
    return "it has other settings"


def _plain(value: dict[str, Any]) -> dict[str, Any]:
    """The same value as JSON gives it back: lists for tuples, text for paths."""
    import json

    return json.loads(json.dumps(value, default=str))


def _digest(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@contextmanager
def _lock(out: Path) -> Iterator[int]:
    """Hold the folder for one job; Blender gets the open file too, so that the lock lasts as long as the last of us."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        lock = os.open(out / ".lock", os.O_CREAT | os.O_RDWR)
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
