# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs for a Blender of their own (`core.blender.run_in_blender`): pictures of a reel, and a scene that plays it."""

import ctypes
import os
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import bpy

from ..core.camera import Camera
from ..core.errors import HoloreelError
from . import compat, reels
from .cameras import new_camera_object, set_camera_object, set_format
from .exact import setup_exact_camera, setup_exact_render
from .nodes.reel import COLORS, DISPLAY, LINEAR, LOOKS, SPLATS
from .timeline import HOLD, Timeline

Emit = Callable[[dict[str, Any]], None]
ENGINES = ("CYCLES", "EEVEE")


@dataclass(frozen=True)
class Setting:
    """What both jobs share; keys of the job.

    `reel` is a .reel, .ply or .splatv. `color` DISPLAY renders exactly (`exact.setup_exact_render`), LINEAR under the
    view transform Standard. `background` is a color behind everything, raw as the reel's colors; None is transparent.
    """

    reel: str
    look: str = SPLATS
    engine: str = "CYCLES"
    color: str = DISPLAY
    background: list[float] | None = None

    def __post_init__(self) -> None:
        for key, allowed in (("look", LOOKS), ("engine", ENGINES), ("color", COLORS)):
            if getattr(self, key) not in allowed:
                raise HoloreelError(f"job: '{key}' is {getattr(self, key)!r}; take one of {', '.join(allowed)}.")


@dataclass(frozen=True)
class Shot:
    """One picture: `camera` as in CAMERA.json, `time` normalized, `out` ending in .png or .exr."""

    camera: dict[str, Any]
    time: float
    out: str


@dataclass(frozen=True)
class Stage:
    """The scene to save: frames, and `path`, a list of (scene frame, camera as in CAMERA.json) to key."""

    out: str
    path: list[tuple[float, dict[str, Any]]] = field(default_factory=list)


def main(job: dict[str, Any], emit: Emit) -> dict[str, Any]:
    """Render `job["shots"]` (dictionaries with the fields of `Shot`), `job["setting"]` having the fields of `Setting`.

    An EXR holds premultiplied RGBA as floats; a PNG 8 bits, straight alpha, without alpha where there is a background.
    Emits {"event": "picture", "index", "count", "out", "seconds"} after each. Returns the number of `gaussians`, the
    `seconds` per picture and `blender`, the version.
    """
    setting = Setting(**job["setting"])
    shots = [Shot(**shot) for shot in job["shots"]]
    scene = _new_scene(setting)
    played = reels.import_reel(bpy.context, setting.reel)
    _apply(setting, scene, played)
    camera_object = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(camera_object)
    scene.camera = camera_object
    seconds = []
    for index, shot in enumerate(shots):
        began = time.perf_counter()
        camera = Camera.from_json(shot.camera, "job")
        set_camera_object(camera_object, camera)
        setup_exact_camera(camera_object.data)
        set_format(scene, camera)
        _stop_at(played, shot.time)
        _render(scene, Path(shot.out))
        seconds.append(time.perf_counter() - began)
        emit({"event": "picture", "index": index, "count": len(shots), "out": shot.out, "seconds": seconds[-1]})
    return {"gaussians": len(played.data.points), "seconds": seconds, "blender": bpy.app.version_string}


def save_scene(job: dict[str, Any], emit: Emit) -> dict[str, Any]:
    """Save a .blend that plays `job["setting"]`'s reel from inside the file, as `job["stage"]` (a `Stage`) says.

    The scene gets the reel's frame range and rate, the format of the path's first camera, and a 3D viewport that looks
    through the camera in EEVEE. Returns the size in `bytes`.
    """
    setting, stage = Setting(**job["setting"]), Stage(**job["stage"])
    scene = _new_scene(setting)
    played = reels.import_reel(bpy.context, setting.reel, set_scene_timing=True)
    _key_camera(scene, [(frame, Camera.from_json(camera, "job")) for frame, camera in stage.path])
    _apply(setting, scene, played)
    _look_through_camera()
    bpy.context.view_layer.objects.active = played
    scene.frame_set(scene.frame_start)
    out = Path(stage.out)
    save_blend(out)
    emit({"event": "saved", "out": str(out)})
    return {"bytes": out.stat().st_size}


def save_blend(out: Path) -> None:
    """Save a copy of the open file as `out`, atomically and compressed."""
    partial = out.with_name(f".{out.stem}.partial.blend")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        bpy.ops.wm.save_as_mainfile(filepath=str(partial.absolute()), check_existing=False, compress=True, copy=True)
        os.replace(partial, out)
    except (OSError, RuntimeError) as error:
        with suppress(OSError):
            partial.unlink()
        reason = str(error).strip().splitlines()[-1]
        raise HoloreelError(f"{out} cannot be written ({reason}): choose another place for the .blend.") from error


def _new_scene(setting: Setting) -> bpy.types.Scene:
    """Start from an empty file; refuse EEVEE where it would take the process down."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    if setting.engine == "EEVEE":
        _demand_gpu()
        scene.render.engine = compat.eevee_engine()
    else:
        scene.render.engine = "CYCLES"
    return scene


def _demand_gpu() -> None:
    if not (bpy.app.background and sys.platform == "linux"):
        return
    try:
        ctypes.CDLL("libEGL.so.1")
    except OSError as error:
        raise HoloreelError(
            "EEVEE needs libEGL.so.1, which is not installed: `apt-get install libegl1`, or render with Cycles."
        ) from error


def _apply(setting: Setting, scene: bpy.types.Scene, played: bpy.types.Object) -> None:
    setup_exact_render(scene)
    modifier = reels.modifier_of(played)
    compat.set_input(modifier, "Look", setting.look)
    compat.set_input(modifier, "Color", setting.color)
    if setting.color == LINEAR:
        scene.view_settings.view_transform = "Standard"
    if setting.background is not None:
        scene.render.film_transparent = False
        scene.world = bpy.data.worlds.new("Background")
        nodes = compat.enable_nodes(scene.world).nodes
        nodes["Background"].inputs["Color"].default_value = (*setting.background, 1.0)


def _stop_at(played: bpy.types.Object, moment: float) -> None:
    """Show the reel at a normalized time, whatever the scene's frame; 1 is the end of its last frame."""
    count = compat.get_input(reels.modifier_of(played), "Frame Count")
    reels.set_timeline(played, Timeline(count, speed=0.0, offset=moment * count, last=count, repeat=HOLD))


def _render(scene: bpy.types.Scene, out: Path) -> None:
    """Render one picture into `out`, atomically."""
    settings = scene.render.image_settings
    if out.suffix.lower() == ".exr":
        compat.set_image_format(settings, "OPEN_EXR")
        settings.color_depth, settings.color_mode = "32", "RGBA"
    elif out.suffix.lower() == ".png":
        compat.set_image_format(settings, "PNG")
        settings.color_depth, settings.color_mode = "8", "RGBA" if scene.render.film_transparent else "RGB"
    else:
        raise HoloreelError(f"{out}: pictures are written as .png or .exr; choose one of these endings.")
    partial = out.with_name(f".{out.stem}.partial{out.suffix}")
    out.parent.mkdir(parents=True, exist_ok=True)
    scene.render.filepath = str(partial.absolute())
    bpy.ops.render.render(write_still=True)
    os.replace(partial, out)


def _key_camera(scene: bpy.types.Scene, path: list[tuple[float, Camera]]) -> None:
    """Animate the active camera along a path of cameras."""
    if not path:
        return
    set_format(scene, path[0][1])
    camera_object = new_camera_object(path[0][1], scene.collection)
    camera_object.name = camera_object.data.name = "Camera"
    scene.camera = camera_object
    before = None
    for frame, camera in path:
        set_camera_object(camera_object, camera)
        rotation = camera_object.rotation_quaternion.copy()
        if before is not None and rotation.dot(before) < 0.0:  # the short way round
            rotation.negate()
        camera_object.rotation_quaternion = before = rotation
        for channel in ("location", "rotation_quaternion"):
            camera_object.keyframe_insert(channel, frame=frame)
        for channel in ("lens", "shift_x", "shift_y"):
            camera_object.data.keyframe_insert(channel, frame=frame)


def _look_through_camera() -> None:
    """Let every 3D viewport of the file show what the camera sees, as EEVEE renders it.

    Material Preview with the scene's world and lamps: Blender opens files in Solid where they were saved in Rendered.
    """
    for screen in bpy.data.screens:
        for area in screen.areas:
            for space in area.spaces:
                if space.type == "VIEW_3D":
                    space.shading.type = "MATERIAL"
                    space.shading.use_scene_world = space.shading.use_scene_lights = True
                    space.region_3d.view_perspective = "CAMERA"
