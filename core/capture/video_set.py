# SPDX-License-Identifier: GPL-3.0-or-later
"""Several cameras' videos of one event, as a capture: what they must have in common is checked before."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from ..camera import Camera
from ..errors import HoloreelError
from .capture import MAX_FRAMES, Capture
from .media import VideoFacts, VideoFrame, probe
from .options import CaptureOptions, listed, odd_ones

SUFFIXES = (".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v")
MAX_VIDEOS = 10_000


def find_videos(folder: str | Path) -> dict[str, Path]:
    """Return the videos in a folder by their names without ending, in natural order (cam_2 before cam_10)."""
    folder = Path(folder)
    try:
        found = [file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES and not file.name.startswith(".")]
    except OSError as error:
        raise HoloreelError(f"{folder} cannot be read ({error.strerror or error}): give a folder of videos.") from error
    if len(found) > MAX_VIDEOS:
        raise HoloreelError(f"{folder} holds {len(found)} videos, more than {MAX_VIDEOS} cameras; give another folder.")
    twice = [name for name, count in Counter(file.stem for file in found).items() if count > 1]
    if twice:
        raise HoloreelError(f"{folder} holds several videos called {twice[0]}; keep one video per camera.")
    return {file.stem: file for file in sorted(found, key=lambda file: natural(file.stem))}


def natural(name: str) -> list[tuple[int, str]]:
    """A sorting key under which numbers in names count as numbers."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name) if part]


def check_pairs(source: Path, wanted: Sequence[str], videos: Mapping[str, Path]) -> None:
    """Raise `HoloreelError` unless each camera that `source` describes has a video, and each video a camera."""
    missing = [name for name in wanted if name not in videos]
    extra = [name for name in videos if name not in wanted]
    if missing:
        raise HoloreelError(
            f"{source} describes {missing[0]}{_more(missing)}, but no video of that name lies there; "
            "fetch the missing video, or take the camera out of the file."
        )
    if extra:
        raise HoloreelError(
            f"{videos[extra[0]]}{_more(extra)} is not described in {source.name}; "
            "fetch the matching file of cameras, or move the video away."
        )


def _more(names: Sequence[str]) -> str:
    return f" and {len(names) - 1} more" if len(names) > 1 else ""


def probe_all(videos: Mapping[str, Path]) -> dict[str, VideoFacts]:
    """Look into every video; raises `HoloreelError` for one that cannot be read."""
    return {name: probe(path) for name, path in videos.items()}


def video_capture(
    source: Path,
    cameras: Mapping[str, Camera],
    videos: Mapping[str, Path],
    options: CaptureOptions,
    facts: Mapping[str, VideoFacts] | None = None,
    masks: Mapping[str, Path] | None = None,
) -> Capture:
    """Return the capture of `videos` that start together, frame k of each being frame k of the capture.

    Cameras must have the sizes of their videos. `masks` are videos of all cameras or none, of the same size or a whole
    number of times larger. Raises `HoloreelError` where sizes, frame counts or rates disagree.
    """
    facts, masks = facts or probe_all(videos), masks or {}
    check_sizes(source, cameras, facts)
    files = {videos[name]: found for name, found in facts.items()} | {masks[n]: f for n, f in probe_all(masks).items()}
    for name, mask in masks.items():
        check_mask_size(mask, files[mask], facts[name])
    counts = {_said(file, source.parent): found.frames for file, found in files.items()}
    chosen = options.common_frames(source, counts)
    if len(chosen) > MAX_FRAMES:
        raise HoloreelError(f"{source}: {len(chosen)} frames are more than {MAX_FRAMES}; take a part by --frames.")
    return Capture(
        cameras={name: replace(camera, name=name) for name, camera in cameras.items()},
        images={(name, j): VideoFrame(videos[name], k) for j, k in enumerate(chosen) for name in cameras},
        masks={(name, j): VideoFrame(mask, k) for j, k in enumerate(chosen) for name, mask in masks.items()},
        frame_count=len(chosen),
        fps=common_rate(source, facts, options),
        frame_start=chosen.start,
        source=source,
    )


def check_sizes(source: Path, cameras: Mapping[str, Camera], facts: Mapping[str, VideoFacts]) -> None:
    """Raise `HoloreelError` naming the first video that has not the size its camera was calibrated for."""
    for name, camera in cameras.items():
        found = facts[name]
        if (found.width, found.height) != (camera.width, camera.height):
            raise HoloreelError(
                f"{source}: {name} was calibrated at {camera.width}x{camera.height}, its video is "
                f"{found.width}x{found.height}; give the calibration of these videos."
            )


def check_mask_size(mask: Path, found: VideoFacts, video: VideoFacts) -> None:
    """Raise `HoloreelError` unless a mask's video is as large as its camera's, or a whole number of times as large."""
    times = max(found.width // video.width, 1)
    if (found.width, found.height) != (times * video.width, times * video.height):
        raise HoloreelError(
            f"{mask}: the mask is {found.width}x{found.height}, its video {video.width}x{video.height}; "
            "make the masks from these videos."
        )


def _said(file: Path, folder: Path) -> str:
    """How a file is called in a message about what lies in `folder`."""
    return file.relative_to(folder).as_posix() if file.is_relative_to(folder) else file.name


def common_rate(source: Path, facts: Mapping[str, VideoFacts], options: CaptureOptions) -> float:
    """Return the frame rate of all videos, or the one asked for."""
    if options.fps is not None:
        return options.fps
    rates = {name: f"{found.fps:.4g} frames per second" for name, found in facts.items()}
    if wrong := odd_ones(rates):
        others = next(rate for name, rate in rates.items() if name not in wrong)
        raise HoloreelError(
            f"{source}: {listed({name: rates[name] for name in wrong})}, the others {others}; "
            "record with one rate, or say by --fps which one is true."
        )
    return next(iter(facts.values())).fps
