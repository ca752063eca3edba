# SPDX-License-Identifier: GPL-3.0-or-later
"""What a reel or a trained model of a VideoRF holds, and what is wrong with it. Needs numpy, and PyAV to decode."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from ..errors import HoloreelError
from .decode import frames_text, rung_name, size_text
from .mapping import Layout
from .model import FieldVideo, read_field_video
from .package import VideoReel, read_video_reel
from .shading import ShadingShape


def describe_video_reel(path: Path) -> dict[str, Any]:
    """Return the facts about a reel, ready for JSON; `problems` lists sentences on its files."""
    reel = read_video_reel(path)
    tables = [
        f"{_span(reel, first, group.frames)}: {group.vertices:,} vertices, a table of {group.size:,} bytes"
        for first, group in zip(reel.firsts, reel.groups, strict=True)
    ]
    files = {reel.path, *(reel.path.parent / name for name in _files(reel))}
    columns, rows = reel.tiling.columns, reel.tiling.rows
    height, width = reel.tiling.picture
    return {
        "file": str(reel.path),
        "what": "a VideoRF reel",
        **_common(reel, reel.shading, (reel.tiling.height, reel.tiling.width), reel.layout),
        "groups": tables,
        "video": f"{width} x {height}, {columns} x {rows} tiles ({reel.profile})",
        "rungs": {rung_name(rung): size_text(reel, index) for index, rung in enumerate(reel.rungs)},
        "color space": "display",
        "files": reel.files,
        "bytes on disk": sum(file.stat().st_size for file in files if file.is_file()),
        "problems": list(_problems(reel)),
    }


def describe_model(folder: Path) -> dict[str, Any]:
    """Return the facts about the folder of a trained model, ready for JSON."""
    model = read_field_video(folder)
    table = model.tables[0]
    return {
        "file": str(folder),
        "what": "a trained VideoRF, not coded yet",
        **_common(model, model.shading.shape, table.size, table.layout),
        "groups": [
            f"{_span(model, group.first, group.count)}: {table.count:,} vertices"
            for group, table in zip(model.groups, model.tables, strict=True)
        ],
        "bytes on disk": sum(file.stat().st_size for file in folder.iterdir() if file.is_file()),
        "problems": [],
    }


def _common(
    source: VideoReel | FieldVideo, shape: ShadingShape, size: tuple[int, int], layout: Layout
) -> dict[str, Any]:
    x, y, z = source.lattice.shape
    waves = shape.frequencies
    direction = "no direction" if waves is None else f"the direction in {waves} frequenc{'y' if waves == 1 else 'ies'}"
    return {
        "frames": f"{source.frame_count} from frame {source.frame_start} at {source.fps:g} fps",
        "lattice": f"{x} x {y} x {z} vertices, {source.lattice.spacing:.4g} apart",
        "bounds": [list(source.lattice.lowest), list(source.lattice.highest)],
        "up": source.up,
        "feature image": f"{size[1]} x {size[0]}, {shape.features + 1} channels, layout {layout}",
        "network": f"{shape.features} features, {direction}, {shape.hidden} units",
        "march": f"steps of {source.step:g} spacings, until {source.transmittance_min:g} of the light is left",
        "background": list(source.background),
    }


def _span(source: VideoReel | FieldVideo, first: int, count: int) -> str:
    start = source.frame_start + first
    return frames_text(list(range(start, start + count)))


def _files(reel: VideoReel) -> list[str]:
    return [reel.tables_file, reel.shading_file, *(rung.file for rung in reel.rungs)]


def _problems(reel: VideoReel) -> Iterator[str]:
    """Yield what is wrong: read every file, and decode the first frame that each rung has."""
    yield from _told(reel.shade)
    for group in range(len(reel.groups)):
        yield from _told(partial(reel.table, group))
    for rung in range(len(reel.rungs)):
        yield from _told(partial(reel.video, rung)) or _video_problems(reel, rung)


def _video_problems(reel: VideoReel, rung: int) -> Iterator[str]:
    video = reel.video(rung)
    lost = video.missing()
    for group in lost:
        yield f"{video.path} is cut off: {_span(reel, group.first, group.frames)} cannot be played; fetch the rest."
    whole = [group for group in video.video.groups if group not in lost]
    damaged = dict.fromkeys(problem for group in whole for problem in _told(partial(video.check, group)))
    yield from damaged or (_told(partial(video.luma, whole[0].first)) if whole else ())
    if video.size > video.video.size:
        more = video.size - video.video.size
        yield f"{video.path} has {more:,} bytes more than its reel says: it may be another file; fetch the original."


def _told(work: Callable[[], object]) -> list[str]:
    """Return what is wrong, in a sentence, or nothing."""
    try:
        work()
    except HoloreelError as error:
        return [str(error)]
    return []
