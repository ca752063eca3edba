# SPDX-License-Identifier: GPL-3.0-or-later
"""Reels as Blender objects: a point cloud with a model's parameters, and a modifier that plays it."""

import math
from pathlib import Path
from typing import Protocol

import bpy
from mathutils import Matrix

from ..core.errors import HoloreelError
from ..core.gaussians.flat import flattened
from ..core.gaussians.model import SpacetimeGaussians
from ..core.reel import VIDEORF, Loaded, load_gaussians, reel_kind
from . import attributes
from .compat import get_input, input_path, new_point_cloud, set_input
from .nodes.library import is_tagged
from .nodes.reel import NAME, reel
from .timeline import Timeline

MODIFIER = "Holoreel"
FIELD_NAME = "Holoreel Field Reel"  # the group of a VideoRF, as `NAME` is that of Spacetime Gaussians
INFO = "holoreel"  # custom property of a reel's object: source, kind, fps, frame_count, gaussians, report

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


class Clip(Protocol):
    """What the timeline asks of a reel of either kind."""

    @property
    def fps(self) -> float:
        """Frames per second."""

    @property
    def frame_count(self) -> int:
        """How many frames there are."""


def import_reel(
    context: bpy.types.Context,
    path: str | Path,
    *,
    start: float | None = None,
    pace: str = FRAME_BY_FRAME,
    up: str | None = None,
    set_scene_timing: bool = False,
) -> bpy.types.Object:
    """Read a `.reel`, `.ply`, `.stgc` or `.splatv` and return the object that plays it; see `add_reel`.

    Raises `HoloreelError` for a missing, damaged or unknown file; then nothing is added.
    """
    if reel_kind(path) == VIDEORF:
        return _add_field_reel(context, Path(path), start, pace, up, set_scene_timing)
    return add_reel(context, load_gaussians(path), start=start, pace=pace, up=up, set_scene_timing=set_scene_timing)


def add_reel(
    context: bpy.types.Context,
    loaded: Loaded,
    *,
    start: float | None = None,
    pace: str = FRAME_BY_FRAME,
    up: str | None = None,
    set_scene_timing: bool = False,
) -> bpy.types.Object:
    """Return a new object that plays what was loaded.

    `start` is the scene frame of the reel's first frame: None takes the reel's own `frame_start`, and the scene's first
    frame for files without one. `pace` FRAMES shows one reel frame per scene frame, REAL_TIME keeps the reel's speed
    whatever the scene's rate. `up` is the file's axis that shall point up (a key of `UPRIGHT`), or `FROM_FILE` for the
    one that the file says; None turns nothing. `set_scene_timing` sets the scene's frame range and rate to the reel's;
    otherwise the scene stays as it is.
    """
    scene = context.scene
    if start is None:
        start = loaded.frame_start if loaded.kind == "reel" else scene.frame_start
    timeline = _timeline(scene, loaded, start, pace, set_scene_timing)
    shown = flattened(loaded.gaussians, loaded.decoder, loaded.viewpoint)
    created = create_reel_object(context, loaded.path.stem, shown, timeline)
    _turn(created, loaded.up, up)
    created[INFO] = {
        "source": str(loaded.path),
        "kind": loaded.kind,
        "fps": loaded.fps,
        "frame_count": loaded.frame_count,
        "gaussians": len(loaded.gaussians),
        "report": "\n".join(report_of(loaded)),
    }
    return created


def _add_field_reel(
    context: bpy.types.Context, path: Path, start: float | None, pace: str, up: str | None, set_scene_timing: bool
) -> bpy.types.Object:
    from ..core.videorf.package import read_video_reel
    from .fields import add_field_reel

    reel = read_video_reel(path)
    start = reel.frame_start if start is None else start
    timeline = _timeline(context.scene, reel, start, pace, set_scene_timing)
    created = add_field_reel(context, reel, timeline=timeline, name=path.stem)
    _turn(created, reel.up, up)
    return created


def _timeline(scene: bpy.types.Scene, played: Clip, start: float, pace: str, set_scene_timing: bool) -> Timeline:
    if set_scene_timing:
        _set_scene_timing(scene, played, start)
    rate = scene.render.fps / scene.render.fps_base
    return Timeline(played.frame_count, start=start, speed=played.fps / rate if pace == REAL_TIME else 1.0)


def _turn(created: bpy.types.Object, up_in_file: str | None, up: str | None) -> None:
    if up is not None:
        created.matrix_world = UPRIGHT[(up_in_file or "Z") if up == FROM_FILE else up]


def report_of(loaded: Loaded) -> list[str]:
    """Say in sentences what was assumed, what is unusual, and what will not be shown."""
    report = list(loaded.report)
    if loaded.decoder is not None:
        how = "of its base" if loaded.viewpoint is None else "decoded as seen from the reel's viewpoint"
        report.append(f"A full model: each Gaussian shows one color, {how} (an approximation).")
    if loaded.reel is not None and len(loaded.reel.segments) > 1:
        report.append(f"The first of {len(loaded.reel.segments)} segments is shown.")
    return report


def create_reel_object(
    context: bpy.types.Context, name: str, gaussians: SpacetimeGaussians, timeline: Timeline
) -> bpy.types.Object:
    """Return a new point cloud object that plays `gaussians` by `timeline`, in the context's collection."""
    created = new_point_cloud(context, name, len(gaussians))
    attributes.write(created.data, gaussians)
    modifier = created.modifiers.new(MODIFIER, "NODES")
    modifier.node_group = reel()
    set_timeline(created, timeline)
    follow_resolution(created)
    return created


def modifier_of(candidate: bpy.types.Object | None) -> bpy.types.NodesModifier | None:
    """Return the modifier that plays a reel, or None if the object is no reel."""
    if candidate is None:
        return None
    for modifier in candidate.modifiers:
        group = modifier.node_group if modifier.type == "NODES" else None
        if group is not None and (is_tagged(group, NAME) or is_tagged(group, FIELD_NAME)):
            return modifier
    return None


def source_of(played: bpy.types.Object) -> Path:
    """Return the file that a reel was imported from: where it was, or beside the .blend under the same name.

    A path beginning with // is relative to the .blend (the library, for a linked reel). Raises `HoloreelError` if the
    file is nowhere there, or the object is no imported reel.
    """
    info = played.get(INFO)
    if info is None or not info.get("source"):
        raise HoloreelError(f"object '{played.name}' was not imported from a reel: import one.")
    source = str(info["source"])
    recorded = Path(bpy.path.abspath(source, library=played.library))
    beside = Path(bpy.path.abspath("//", library=played.library) or ".", recorded.name)
    for candidate in (recorded, beside):
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
    values = {field: get_input(modifier, name) for field, name in TIMELINE_INPUTS.items()}
    return Timeline(**values)


def set_timeline(played: bpy.types.Object, timeline: Timeline) -> None:
    """Set the mapping of the scene's frames to a reel's time."""
    modifier = modifier_of(played)
    for field, name in TIMELINE_INPUTS.items():
        value = timeline.last_frame if field == "last" else getattr(timeline, field)
        set_input(modifier, name, value)


def _set_scene_timing(scene: bpy.types.Scene, played: Clip, start: float) -> None:
    whole = max(1, round(played.fps))
    scene.render.fps, scene.render.fps_base = whole, whole / played.fps
    scene.frame_start = math.floor(start)
    scene.frame_end = math.ceil(start) + played.frame_count - 1


def follow_resolution(played: bpy.types.Object) -> None:
    """Drive the look's picture size by the resolution of whatever scene the reel is in."""
    modifier = modifier_of(played)
    sources = {"percent": "render.resolution_percentage"}
    for name, side in (("Render Width", "x"), ("Render Height", "y")):
        driver = played.driver_add(input_path(modifier, name)).driver
        driver.type = "SCRIPTED"
        for variable_name, path in {**sources, "pixels": f"render.resolution_{side}"}.items():
            variable = driver.variables.new()
            variable.name = variable_name
            variable.type = "CONTEXT_PROP"
            variable.targets[0].context_property = "ACTIVE_SCENE"
            variable.targets[0].data_path = path
        driver.expression = "floor(pixels * percent / 100)"
