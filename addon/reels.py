# SPDX-License-Identifier: GPL-3.0-or-later
"""Reels as Blender objects: a point cloud with a model's parameters, and a modifier that plays it."""

import math
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import bpy
from mathutils import Matrix

from ..core.errors import HoloreelError
from ..core.gaussians.model import SpacetimeGaussians
from ..core.reel import VIDEORF, Loaded, load_gaussians, load_segments, reel_kind
from ..core.videorf.package import VideoReel, read_video_reel
from . import clouds
from .compat import get_input, input_names, input_path, set_input
from .nodes.library import is_tagged
from .nodes.reel import NAME, reel
from .timeline import Timeline

MODIFIER = "Holoreel"
FIELD_NAME = "Holoreel Field Reel"  # the group of a VideoRF, as `NAME` is that of Spacetime Gaussians
INFO = "holoreel"  # custom property of a reel's object: source, kind, fps, frame_count, gaussians or points, report

# Inputs of a look that follow the scene: a driver's expression and its variables, which are 0 where there is no camera,
# or no Holoreel to ask.
# Blender numbers its render engines and kinds of cameras: 1 is Workbench, 2 a panoramic camera.
_SIZE = {"x": "render.resolution_x", "y": "render.resolution_y", "percent": "render.resolution_percentage"}
_FOLLOWED = {
    "Render Width": ("floor(x * percent / 100)", _SIZE),
    "Render Height": ("floor(y * percent / 100)", _SIZE),
    "Workbench": ("engine == 1", {"engine": "render.engine"}),
    "Holoreel Engine": ("is_chosen", {"is_chosen": "holoreel_engine.is_chosen"}),
    "Pixel Angle": (
        "field * 100 / (max(x, y) * percent) if kind == 2 else 0",
        {"kind": "camera.data.type", "field": "camera.data.fisheye_fov", **_SIZE},
    ),
}

FRAME_BY_FRAME, REAL_TIME = "FRAMES", "REAL_TIME"

# The fields of `Timeline` and the modifier's inputs.
TIMELINE_INPUTS = {
    "frame_count": "Frame Count",
    "start": "Start Frame",
    "speed": "Speed",
    "offset": "Offset",
    "first": "First Frame",
    "last": "Last Frame",
    "repeat": "Repeat",
    "retime": "Retime",
    "at": "Reel Frame",
}

MAX_SENTENCES = 8  # about all files of a sequence
_WORDS = re.compile(r"(\d+)")

FROM_FILE = "FILE"
# Quarter turns that bring the axis that points up in the file onto Blender's Z.
UPRIGHT = {
    "Z": Matrix.Identity(4),
    "-Z": Matrix.Rotation(math.pi, 4, "X"),
    "Y": Matrix.Rotation(math.pi / 2, 4, "X"),
    "-Y": Matrix.Rotation(-math.pi / 2, 4, "X"),
    "X": Matrix.Rotation(-math.pi / 2, 4, "Y"),
    "-X": Matrix.Rotation(math.pi / 2, 4, "Y"),
}


Read: TypeAlias = list[Loaded] | VideoReel


class Clip(NamedTuple):
    """What the timeline asks of a reel of either kind."""

    path: Path
    fps: float
    frame_start: int
    frame_count: int
    up: str | None


@dataclass(frozen=True)
class Options:
    """How a reel is imported.

    `start` is the scene frame of the reel's first frame: None takes the reel's own `frame_start`, and the scene's first
    frame for files without one. `pace` FRAMES shows one reel frame per scene frame, REAL_TIME keeps the reel's speed
    whatever the scene's rate. `up` is the file's axis that shall point up (a key of `UPRIGHT`), or `FROM_FILE` for the
    one that the file says; None turns nothing. `scale` multiplies sizes. `set_scene_timing` sets the scene's frame
    range and rate to the reel's; otherwise the scene stays as it is. `detail` percent of the Gaussians are kept, the
    most important ones; `beside` stores them beside the reel instead of in the .blend. `rung` is which movie a VideoRF
    plays, as in `core.videorf.decode.find_rung`.
    """

    start: float | None = None
    pace: str = FRAME_BY_FRAME
    up: str | None = None
    scale: float = 1.0
    set_scene_timing: bool = False
    detail: float = 100.0
    beside: bool = False
    rung: int | str | None = None


def import_reel(context: bpy.types.Context, path: str | Path, **options: Any) -> bpy.types.Object:
    """Read a `.reel` of either kind, `.ply`, `.stgc` or `.splatv` and return the object that plays it.

    `options` are the fields of `Options`. Raises `HoloreelError` for a missing, damaged or unknown file; then nothing
    is added.
    """
    return add_reel(context, read(path), Options(**options))


def read(path: str | Path) -> Read:
    """Read a file, without adding anything: the segments of Spacetime Gaussians, or the reel of a VideoRF."""
    if reel_kind(path) == VIDEORF:
        return read_video_reel(path)
    return load_segments(path)


def read_sequence(paths: Sequence[Path]) -> list[Loaded]:
    """Read files of Gaussians as the frames of one reel, in the natural order of their names.

    Raises `HoloreelError` where a file cannot be read, or is a reel and so has frames of its own.
    """
    paths = sorted(paths, key=lambda path: [int(word) if word.isdigit() else word for word in _WORDS.split(path.name)])
    for path in paths:
        if path.suffix.lower() == ".reel":
            raise HoloreelError(f"{path} is a reel and no single frame: import it without Sequence.")
    parts = [load_gaussians(path) for path in paths]
    said = [f"{len(parts)} files are the frames of one reel, at {parts[0].fps:g} frames per second."]
    said += [sentence.replace(part.path.name, "a file") for part in parts for sentence in part.report[1:]]
    report = list(dict.fromkeys(said))
    if len(report) > MAX_SENTENCES:
        report = [*report[:MAX_SENTENCES], f"{len(report) - MAX_SENTENCES} more sentences like these."]
    return [
        replace(part, frame_start=index, frame_count=1, report=report if index == 0 else [])
        for index, part in enumerate(parts)
    ]


def clip_of(found: Read) -> Clip:
    """Return what the timeline asks of what `read` or `read_sequence` has found."""
    if isinstance(found, VideoReel):
        return Clip(found.path, found.fps, found.frame_start, found.frame_count, found.up)
    first = found[0]
    return Clip(first.path, first.fps, first.frame_start, sum(part.frame_count for part in found), first.up)


def add_reel(context: bpy.types.Context, found: Read, options: Options) -> bpy.types.Object:
    """Return a new object that plays what `read` or `read_sequence` has found."""
    clip = clip_of(found)
    start = options.start
    if start is None:
        start = clip.frame_start if clip.path.suffix.lower() == ".reel" else context.scene.frame_start
    if options.set_scene_timing:
        _set_scene_timing(context.scene, clip, start)
    rate = context.scene.render.fps / context.scene.render.fps_base
    timeline = Timeline(clip.frame_count, start, speed=clip.fps / rate if options.pace == REAL_TIME else 1.0)
    if isinstance(found, VideoReel):
        from .fields import add_field_reel  # which itself needs what is here

        created = add_field_reel(context, found, timeline=timeline, name=clip.path.stem, rung=options.rung)
    else:
        created = _add_gaussians(context, found, timeline, options)
    remember_source(created, clip.path)
    if options.up is not None or options.scale != 1.0:
        axis = "Z" if options.up is None else (clip.up or "Z") if options.up == FROM_FILE else options.up
        created.matrix_world = UPRIGHT[axis] @ Matrix.Scale(options.scale, 4)
    return created


def _add_gaussians(
    context: bpy.types.Context, parts: list[Loaded], timeline: Timeline, options: Options
) -> bpy.types.Object:
    path = parts[0].path
    created = _create(context, path.stem, clouds.join(parts, options.detail), timeline)
    created[INFO] = describe(parts, options.detail)
    if options.beside:
        try:
            clouds.store_beside(created.data, clouds.library_path(path, options.detail))
        except HoloreelError:
            remove_reel(created)
            raise
    return created


def describe(parts: Sequence[Loaded], detail: float) -> dict[str, Any]:
    """Return what `INFO` holds of Spacetime Gaussians."""
    clip = clip_of(parts)
    files = [part.path.name for part in parts] if parts[-1].path != clip.path else []
    return {
        "source": str(clip.path),
        "files": "\n".join(files),  # of a sequence
        "kind": parts[0].kind,
        "fps": clip.fps,
        "frame_count": clip.frame_count,
        "gaussians": sum(len(part.gaussians) for part in parts),
        "segments": len(parts),
        "detail": detail,
        "report": "\n".join(report_of(parts)),
    }


def report_of(parts: Sequence[Loaded]) -> list[str]:
    """Say in sentences what was assumed, what is unusual, and what will not be shown; each once."""
    report = [sentence for part in parts for sentence in part.report]
    if parts[0].decoder is not None:
        how = "of its base" if parts[0].viewpoint is None else "decoded as seen from the reel's viewpoint"
        report.append(f"A full model: each Gaussian shows one color, {how} (an approximation).")
    return list(dict.fromkeys(report))


def summary(played: bpy.types.Object) -> str:
    """Say in a few words what an imported reel is."""
    info = played[INFO]
    amount = f"{info['gaussians']:,} Gaussians" if "gaussians" in info else f"{info.get('points', 0):,} points"
    return f"{played.name}: {amount}, {info['frame_count']:,} frames at {info['fps']:g} per second"


def create_reel_object(
    context: bpy.types.Context, name: str, gaussians: SpacetimeGaussians, timeline: Timeline
) -> bpy.types.Object:
    """Return a new point cloud object that plays `gaussians` by `timeline`, in the context's collection.

    The points stay in the order of the rows: sort them by `core.gaussians.importance` if detail shall be reduced.
    """
    return _create(context, name, clouds.Points(gaussians), timeline)


def _create(context: bpy.types.Context, name: str, points: clouds.Points, timeline: Timeline) -> bpy.types.Object:
    created = clouds.new_cloud_object(context, name, points)
    modifier = created.modifiers.new(MODIFIER, "NODES")
    modifier.node_group = reel()
    set_timeline(created, timeline)
    follow_scene(created)
    return created


def remove_reel(played: bpy.types.Object) -> None:
    """Remove a reel's object, and its points where nothing else uses them."""
    points = played.data
    bpy.data.objects.remove(played)
    if points.users == 0:
        bpy.data.pointclouds.remove(points)


def modifier_of(candidate: bpy.types.Object | None) -> bpy.types.NodesModifier | None:
    """Return the modifier that plays a reel, or None if the object is no reel."""
    if candidate is None:
        return None
    for modifier in candidate.modifiers:
        group = modifier.node_group if modifier.type == "NODES" else None
        if group is not None and (is_tagged(group, NAME) or is_tagged(group, FIELD_NAME)):
            return modifier
    return None


def remember_source(played: bpy.types.Object, path: Path) -> None:
    """Write down where a reel lies: by its full path, and relative to the .blend once that is saved."""
    info = dict(played.get(INFO, {}))
    info |= {"source": str(path.absolute()), "relative": ""}
    if bpy.data.is_saved:
        with suppress(ValueError):  # on another drive
            info["relative"] = bpy.path.relpath(info["source"])
    played[INFO] = info


def source_of(played: bpy.types.Object) -> Path:
    """Return the file that a reel was imported from, wherever it is now.

    It is sought relative to the .blend (the library, for a linked reel) as it lay when it was imported, at its full
    path, and beside the .blend under the same name. Raises `HoloreelError` if it is in none of these places, or the
    object is no imported reel.
    """
    info = played.get(INFO)
    if info is None or not info.get("source"):
        raise HoloreelError(f"object '{played.name}' was not imported from a reel: import one.")
    source, relative = str(info["source"]), str(info.get("relative", ""))
    recorded = Path(bpy.path.abspath(source, library=played.library))
    candidates = [recorded]
    folder = bpy.path.abspath("//", library=played.library)
    if folder:
        candidates.append(Path(folder, recorded.name.rpartition("\\")[2]))
        if relative:
            candidates.insert(0, Path(bpy.path.abspath(relative, library=played.library)))
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    raise HoloreelError(f"{recorded}, the reel of object '{played.name}', is not there: put it back, or relink it.")


def timeline_of(played: bpy.types.Object) -> Timeline:
    """Read the mapping of the scene's frames to a reel's time back from the modifier's inputs, as they are now.

    Pass an evaluated object for the values that drivers and keyframes give at its dependency graph's frame. Raises
    `HoloreelError` if the object is no reel.
    """
    modifier = modifier_of(played)
    if modifier is None:
        raise HoloreelError(f"object '{played.name}' is no reel: choose one.")
    there = input_names(modifier.node_group)  # groups of older files have fewer
    return Timeline(**{field: get_input(modifier, name) for field, name in TIMELINE_INPUTS.items() if name in there})


def set_timeline(played: bpy.types.Object, timeline: Timeline) -> None:
    """Set the mapping of the scene's frames to a reel's time."""
    modifier = modifier_of(played)
    there = input_names(modifier.node_group)
    for field, name in TIMELINE_INPUTS.items():
        if name not in there:
            continue
        value = timeline.last_frame if field == "last" else getattr(timeline, field)
        set_input(modifier, name, value)


def _set_scene_timing(scene: bpy.types.Scene, played: Clip, start: float) -> None:
    whole = max(1, round(played.fps))
    scene.render.fps, scene.render.fps_base = whole, whole / played.fps
    scene.frame_start = math.floor(start)
    scene.frame_end = math.ceil(start) + played.frame_count - 1


def follow_scene(played: bpy.types.Object) -> None:
    """Drive what a look has to know of whatever scene the reel is in: the picture's size, and the render engine."""
    modifier = modifier_of(played)
    for name, (expression, paths) in _FOLLOWED.items():
        driver = played.driver_add(input_path(modifier, name)).driver
        driver.type = "SCRIPTED"
        for variable_name, path in paths.items():
            variable = driver.variables.new()
            variable.name = variable_name
            variable.type = "CONTEXT_PROP"
            variable.targets[0].context_property = "ACTIVE_SCENE"
            variable.targets[0].data_path = path
            variable.targets[0].use_fallback_value = True
        driver.expression = expression
