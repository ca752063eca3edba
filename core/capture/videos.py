# SPDX-License-Identifier: GPL-3.0-or-later
"""A folder of plain videos, one per camera, with an OpenCV calibration or with poses from `holoreel sfm`.

Without timestamps.csv frame k of every video is one moment. With it frames are matched to a common clock. The camera
that is held out by default is the first.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..errors import HoloreelError
from . import sfm_result
from .calibration import FILE_NAMES, find_calibration, read_calibration, write_calibration
from .capture import Capture, View
from .export import Export, file_names, write_videos
from .media import Media, VideoFacts, VideoFrame
from .options import CaptureOptions
from .sync import FILE_NAME as TIMESTAMPS
from .sync import read_timestamps, synchronize
from .video_set import check_pairs, check_sizes, find_videos, probe_all, video_capture

_GUESSED_FOCAL = 0.8  # of the longer side, until structure from motion knows better


def matches(path: Path) -> bool:
    """Whether there are videos in the folder."""
    return path.is_dir() and bool(find_videos(path))


def read(path: Path, options: CaptureOptions) -> Capture:
    """Read videos whose cameras are known, from a calibration or from a result of `holoreel sfm`."""
    calibration = options.calibration or find_calibration(path)
    if calibration is None and not sfm_result.has_result(options.sfm or path / sfm_result.FOLDER):
        raise HoloreelError(
            f"{path} holds videos, but nothing says where their cameras stood: put {' or '.join(FILE_NAMES)} there, or "
            f"find the poses by `holoreel sfm {path}`."
        )
    return read_unposed(path, options) if calibration is None else _read_calibrated(path, calibration, options)


def read_unposed(path: Path, options: CaptureOptions) -> Capture:
    """Read videos of unknown cameras: all stand at the origin, with guessed lenses, until somebody finds them out."""
    videos = _videos(path)
    facts = probe_all(videos)
    cameras = {}
    for name, found in facts.items():
        focal = _GUESSED_FOCAL * max(found.width, found.height)
        cameras[name] = Camera(found.width, found.height, focal, focal, found.width / 2, found.height / 2, name=name)
    return _capture(path, path, cameras, videos, facts, options)


def _read_calibrated(path: Path, calibration: Path, options: CaptureOptions) -> Capture:
    videos = _videos(path)
    cameras: dict[str, Camera] = {}
    for entry in read_calibration(calibration):
        name = entry.stem if entry.stem in videos else _video_of(entry.label, videos)
        if name in cameras:
            raise HoloreelError(f"{calibration}: two cameras mean the video {name}; give each one its own name.")
        cameras[name] = replace(entry.camera, name=name)
    check_pairs(calibration, list(cameras), videos)
    cameras = {name: cameras[name] for name in videos}
    return _capture(path, calibration, cameras, videos, probe_all(videos), options)


def _videos(path: Path) -> dict[str, Path]:
    videos = find_videos(path)
    if not videos:
        raise HoloreelError(f"{path} holds no videos; give the folder that has one video per camera.")
    return videos


def _video_of(label: str, videos: Mapping[str, Path]) -> str:
    """The video whose name is `label`, or ends in the same number: camera 0 is cam_0.mp4; else the label itself."""
    if label in videos:
        return label
    number = _number(label)
    found = [name for name in videos if number is not None and _number(name) == number]
    return found[0] if len(found) == 1 else label


def _number(name: str) -> int | None:
    match = re.search(r"(\d{1,9})$", name)
    return int(match[1]) if match else None


def _capture(
    path: Path,
    source: Path,
    cameras: dict[str, Camera],
    videos: dict[str, Path],
    facts: dict[str, VideoFacts],
    options: CaptureOptions,
) -> Capture:
    if not (path / TIMESTAMPS).is_file():
        return video_capture(source, cameras, videos, options, facts)
    check_sizes(source, cameras, facts)
    times = _times(path / TIMESTAMPS, videos, facts)
    clock = synchronize(path / TIMESTAMPS, times)
    clock.check(path / TIMESTAMPS, options.sync_tolerance)
    chosen = options.choose_frames(path, range(clock.ticks))
    images: dict[View, Media] = {
        (n, j): VideoFrame(videos[n], int(clock.frames[n][k])) for j, k in enumerate(chosen) for n in cameras
    }
    return Capture(
        cameras=cameras,
        images=images,
        frame_count=len(chosen),
        fps=options.fps or 1 / clock.interval_s,
        frame_start=chosen.start,
        source=source,
        notes=(f"{path / TIMESTAMPS}: {clock.note}",),
    )


def _times(file: Path, videos: Mapping[str, Path], facts: Mapping[str, VideoFacts]) -> dict[str, NDArray[np.float64]]:
    """The moments of each video's frames; both must tell of the same number of frames."""
    times = {_video_of(label, videos): moments for label, moments in read_timestamps(file).items()}
    for name, path in videos.items():
        if name not in times:
            raise HoloreelError(f"{file} says nothing about {path.name}; add its cam_id, or take the file away.")
        if len(times[name]) != facts[name].frames:
            raise HoloreelError(
                f"{file} has {len(times[name])} moments of {path.name}, which has {facts[name].frames} frames; "
                "fetch the files that belong together, or take the timestamps away."
            )
    return {name: times[name] for name in videos}


def write(capture: Capture, path: Path, export: Export) -> None:
    """Write CAMERA.mp4 for each camera and cameras_opencv.json into `path`; the held-out one is named by the reader."""
    names = file_names(capture)
    lenses = export.lenses(capture)
    write_videos(capture, lenses, {name: path / f"{file}.mp4" for name, file in names.items()}, export)
    write_calibration(path / FILE_NAMES[1], {names[name]: camera for name, camera in lenses.items()})
