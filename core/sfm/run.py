# SPDX-License-Identifier: GPL-3.0-or-later
"""Points of every frame of a capture whose cameras are known: known-pose triangulation, frame by frame."""

import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..camera import Camera
from ..capture import Capture
from ..errors import HoloreelError
from ..render.native import available_cores
from .calibration import CalibrationCheck, CameraCheck, refuse_contradictions
from .jobs import Found, Pairs, Selection, Workers, camera_job, good_points, put_pictures
from .pairs import choose_pairs
from .record import FrameResult, Keys, Record
from .settings import SfmSettings

OnProgress = Callable[[int, int], None]  # frames done, of all
OnMessage = Callable[[str], None]  # a sentence worth reading

_PER_FRAME = ("every", "held_out", "without", "matcher")  # settings that show in cameras and pairs, not beyond


@dataclass(frozen=True)
class SfmReport:
    """What a run left."""

    folder: Path
    frames: list[FrameResult]  # all that are done, in order
    done_now: int
    checks: list[CameraCheck]  # of this run's frames; none where all were done before
    seconds: float


@dataclass(frozen=True)
class _Done:
    frame: int
    found: Found
    chosen: Selection
    seconds: float


def chosen_cameras(capture: Capture, settings: SfmSettings) -> list[str]:
    """The names of the cameras whose pictures are used; at least two."""
    if unknown := [name for name in settings.without if name not in capture.cameras]:
        raise HoloreelError(
            f"--without {unknown[0]}: {capture.source} has no such camera; it has {', '.join(capture.cameras)}."
        )
    names = capture.camera_names(None if settings.held_out else "train")
    names = [name for name in names if name not in settings.without]
    if len(names) < 2:
        raise HoloreelError(
            f"{capture.source}: structure from motion needs two cameras and has {len(names)}; held-out cameras do not "
            "count unless --held-out is given."
        )
    return names


def run_sfm(
    capture: Capture,
    out: str | Path,
    settings: SfmSettings,
    *,
    jobs: int = 0,
    posed_here: bool = False,
    normalization: dict[str, Any] | None = None,
    on_progress: OnProgress | None = None,
    on_message: OnMessage | None = None,
) -> SfmReport:
    """Triangulate the points of every N-th frame of `capture` into the folder `out`, `jobs` frames at a time.

    Frames of an earlier run that would come out the same are kept. `posed_here` says that the cameras' poses were found
    by `poses`, not given. Raises `HoloreelError` where a camera's calibration contradicts the others, or no points are
    found; frames already done stay.
    """
    begin = time.monotonic()
    names = chosen_cameras(capture, settings)
    cameras = [capture.cameras[name] for name in names]
    pairs = choose_pairs(cameras, settings.matcher)
    if not pairs:
        raise HoloreelError(
            f"{capture.source}: no two cameras' views overlap; check the poses, or take --matcher exhaustive."
        )
    record = Record(Path(out), capture, list(capture.cameras.values()), posed_here, settings)
    record.normalization = normalization
    keys = _keys(capture, cameras, pairs, settings)
    if (reason := record.take_over(keys)) and on_message:
        on_message(f"{record.path}: {reason}; doing its frames again.")
    todo = [frame for frame in keys if frame not in record.frames]
    done_before = len(record.frames)
    run = _Run(capture, cameras, pairs, settings, jobs or available_cores(), len(todo))
    check = CalibrationCheck(cameras)

    def finish(done: _Done) -> None:
        check.add(done.found)
        record.pycolmap, record.seconds = done.found.version, time.monotonic() - begin
        record.note_checks(check.judge())
        record.add(done.frame, done.chosen, done.seconds, keys[done.frame])
        if on_progress:
            on_progress(len(record.frames), len(keys))

    if on_progress:
        on_progress(done_before, len(keys))
    with run:
        for probe in _probes(todo):
            done = run.frame(probe)
            check.add(done.found)
            refuse_contradictions(check.judge(), capture.source)
            if len(done.chosen.points):
                break
        else:
            if todo and not any(frame.points for frame in record.frames.values()):
                raise HoloreelError(f"{capture.source}: {_no_points(done.found, cameras)}")
        check = CalibrationCheck(cameras)
        run.all(todo, finish)
    if todo:
        refuse_contradictions(check.judge(), capture.source)
    record.save()
    frames = [record.frames[index] for index in sorted(record.frames)]
    return SfmReport(record.folder, frames, len(todo), check.judge() if todo else [], time.monotonic() - begin)


def _probes(todo: list[int]) -> list[int]:
    """The frames to look at before all others: what is wrong with the cameras shows at once."""
    return list(dict.fromkeys([todo[0], todo[len(todo) // 2]])) if todo else []


def _keys(capture: Capture, cameras: list[Camera], pairs: Pairs, settings: SfmSettings) -> dict[int, str]:
    """The key of each frame to do, in order."""
    options = {name: value for name, value in asdict(settings).items() if name not in _PER_FRAME}
    keys = Keys(capture, cameras, pairs)
    frames = range(0, capture.frame_count, settings.every)
    return {frame: keys.key(frame, options) for frame in frames}


class _Run:
    """Does frames, several at a time; a context that ends all children."""

    def __init__(
        self,
        capture: Capture,
        cameras: list[Camera],
        pairs: Pairs,
        settings: SfmSettings,
        jobs: int,
        frames: int,
    ) -> None:
        self._capture, self._cameras, self._pairs, self._settings = capture, cameras, pairs, settings
        self._jobs = max(1, min(jobs, frames))
        self._workers = Workers()
        self._reading = threading.Lock()  # videos are decoded by one at a time
        self._probed: dict[int, _Done] = {}

    def __enter__(self) -> "_Run":
        return self

    def __exit__(self, *_: object) -> None:
        self._workers.stop()

    def frame(self, frame: int) -> _Done:
        """Do one frame with all cores."""
        self._probed[frame] = self._do(frame, available_cores())
        return self._probed[frame]

    def all(self, frames: Sequence[int], finish: Callable[[_Done], None]) -> None:
        """Do `frames`; `finish` gets each in this thread, as soon as it is done."""
        threads = max(1, available_cores() // self._jobs)
        left = [frame for frame in frames if frame not in self._probed]
        for frame in frames:
            if frame in self._probed:
                finish(self._probed[frame])
        with ThreadPoolExecutor(self._jobs) as pool:
            running: set[Future[_Done]] = set()
            try:
                while left or running:
                    while left and len(running) < self._jobs:
                        running.add(pool.submit(self._do, left.pop(0), threads))
                    ended, running = wait(running, return_when=FIRST_COMPLETED)
                    for future in ended:
                        finish(future.result())
            finally:
                if running:  # something went wrong, or Ctrl-C
                    self._workers.stop()

    def _do(self, frame: int, threads: int) -> _Done:
        begin = time.monotonic()
        names = [camera.name for camera in self._cameras]
        with tempfile.TemporaryDirectory(prefix="holoreel-sfm-") as name:
            folder = Path(name)
            with self._reading:
                files, pictures, masked = put_pictures(self._capture, names, frame, folder)
            job = {
                "task": "triangulate",
                "frames": [files],
                "pictures": str(folder / "pictures"),
                "masks": str(folder / "masks") if masked else None,
                "cameras": [camera_job(camera, lens) for lens, camera in enumerate(self._cameras)],
                "poses": [camera.world_to_camera.tolist() for camera in self._cameras],
                "pairs": self._pairs,
                "options": self._settings.colmap_options(threads),
            }
            found = self._workers.run(job, folder)
        settings = self._settings
        chosen = good_points(found, pictures, settings.track(len(names)), settings.max_error)
        return _Done(frame, found, chosen, time.monotonic() - begin)


def _no_points(found: Found, cameras: Sequence[Camera]) -> str:
    """Why there are no points, as a sentence."""
    features = int(np.median([len(points) for points in found.keypoints]))
    matches = sum(len(pair) for pair in found.matches.values())
    figures = (
        f"no points were found (of {len(cameras)} cameras: {features} features per picture, {matches} matches, "
        f"{len(found.xyz)} points before filtering)"
    )
    if features < 100:
        return f"{figures}; the pictures are dark, blurred or without texture: light the scene, or take --quality high."
    if not matches:
        return (
            f"{figures}; the pictures show nothing in common: the cameras are too far apart or not synchronized, "
            "or the scene repeats itself; move them closer, or take --quality high."
        )
    return (
        f"{figures}; the matches do not fit the poses or their rays are nearly parallel: check the calibration, or "
        "take a smaller --min-angle or a larger --max-error."
    )
