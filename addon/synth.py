# SPDX-License-Identifier: GPL-3.0-or-later
"""The Blender side of `holoreel synth`: open a scene, set up cameras and the data-set look, render view by view.

Runs in a Blender of its own (`core.blender`); the other side is `core/synth.py`.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..core.camera import Camera
from ..core.errors import HoloreelError
from ..core.rig import RigRequest, SceneFacts, fit_to_scene, make_rig
from . import compat
from .cameras import camera_from_object, new_camera_object, set_format

Emit = Callable[[dict[str, Any]], None]
Bounds = tuple[tuple[float, ...], tuple[float, ...]]

TARGET_NAME = "Holoreel Target"  # an object of this name is what rigs aim at
_GEOMETRY = {"MESH", "CURVE", "CURVES", "SURFACE", "META", "FONT", "POINTCLOUD", "VOLUME"}
_AGREEMENT_PX = 0.01


def render(job: dict[str, Any], emit: Emit) -> dict[str, Any]:
    """Render what `job` lists (see `core.synth`); emits `scene` once and `view` after each picture."""
    scene = open_scene(job["scene"])
    facts = describe(scene)
    if job["film"] == "transparent":
        facts["bounds"] = subject_bounds(scene, range(job["frames"][0], job["frames"][1] + 1))
    scene.frame_set(job["frames"][0])
    cameras = [Camera.from_json(camera) for camera in job["cameras"]] or place_rig(job, scene, facts.get("bounds"))
    emit({"event": "scene", "cameras": [camera.to_json() for camera in cameras], "scene": facts})
    apply_look(scene, job)
    objects = make_cameras(scene, cameras)
    frame_now = None
    for name, frame in job["todo"]:
        if frame != frame_now:
            scene.frame_set(job["frames"][0] + frame)
            frame_now = frame
        index = job["names"].index(name)
        set_format(scene, cameras[index])
        scene.camera = objects[index]
        stem = Path(job["work"]) / f"{name}-{frame}"
        depth = bool(job["depth"] or job["seed_points"])
        picture, layers = render_view(scene, stem, job["film"] == "transparent", depth)
        emit({"event": "view", "camera": name, "frame": frame, "picture": picture, "layers": layers})
    return {"rendered": len(job["todo"])}


def open_scene(path: str) -> bpy.types.Scene:
    """Open a .blend file without running scripts of its own; return its active scene."""
    try:
        bpy.ops.wm.open_mainfile(filepath=path, load_ui=False, use_scripts=False)
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[-1]
        raise HoloreelError(f"{path} cannot be opened by Blender {bpy.app.version_string} ({reason}).") from error
    return bpy.context.scene


def describe(scene: bpy.types.Scene) -> dict[str, Any]:
    """What the capture has to know of a scene."""
    return {
        "fps": scene.render.fps / scene.render.fps_base,
        "blender": bpy.app.version_string,
        "scene": scene.name,
        "unit_meters": scene.unit_settings.scale_length,
    }


def place_rig(job: dict[str, Any], scene: bpy.types.Scene, bounds: Bounds | None) -> list[Camera]:
    """Make the rig that the job asks for, placed by what the scene shows at the current frame, or within `bounds`."""
    return make_rig(job["preset"], fit_to_scene(RigRequest(**job["rig"]), scene_facts(scene, bounds)))


def scene_facts(scene: bpy.types.Scene, bounds: Bounds | None) -> SceneFacts:
    """Read what `core.rig` places rigs by."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    camera = scene.camera
    target = scene.objects.get(TARGET_NAME)
    return SceneFacts(
        camera=camera_from_object(camera, scene, depsgraph) if camera and camera.data.type == "PERSP" else None,
        target=tuple(target.evaluated_get(depsgraph).matrix_world.translation) if target else None,
        bounds=bounds or visible_bounds(depsgraph),
    )


def subject_bounds(scene: bpy.types.Scene, frames: range) -> Bounds | None:
    """Return the lower and the upper corner of what is rendered in any of the frames, None if nothing."""
    boxes = []
    for frame in frames:
        scene.frame_set(frame)
        if box := visible_bounds(bpy.context.evaluated_depsgraph_get()):
            boxes.append(box)
    if not boxes:
        return None
    low, high = np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)
    return tuple(low.tolist()), tuple(high.tolist())


def visible_bounds(depsgraph: bpy.types.Depsgraph) -> Bounds | None:
    """Return the lower and the upper corner of what is rendered, None where that is nothing."""
    boxes = []
    for instance in depsgraph.object_instances:
        thing = instance.object
        if thing.type in _GEOMETRY and not thing.hide_render and thing.dimensions.length > 0:
            points = _points(thing) @ np.array(instance.matrix_world, np.float64)[:3].T
            boxes += [points.min(axis=0), points.max(axis=0)]
    if not boxes:
        return None
    return tuple(np.min(boxes, axis=0).tolist()), tuple(np.max(boxes, axis=0).tolist())


def _points(thing: bpy.types.Object) -> np.ndarray:
    """Points that an evaluated object lies between, homogeneous (N, 4): a mesh's vertices, else corners of its box."""
    if thing.type == "MESH" and len(thing.data.vertices):
        values = np.empty(3 * len(thing.data.vertices), np.float32)
        thing.data.vertices.foreach_get("co", values)
        points = values.reshape(-1, 3).astype(np.float64)
    else:
        points = np.array(thing.bound_box, np.float64)
    return np.concatenate([points, np.ones((len(points), 1))], axis=1)


def make_cameras(scene: bpy.types.Scene, cameras: list[Camera]) -> list[bpy.types.Object]:
    """Make a camera object for each camera, and make sure that Blender's own reading of it agrees."""
    objects = [new_camera_object(camera, scene.collection) for camera in cameras]
    bpy.context.view_layer.update()
    scene.cycles.dicing_camera = objects[0]  # subdivision is the same for all cameras
    for marker in scene.timeline_markers:
        marker.camera = None  # else the timeline chooses the camera
    for camera, camera_object in zip(cameras, objects, strict=True):
        set_format(scene, camera)
        _set_clipping(camera_object, camera)
        corners = np.array([[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]])
        points = camera.unproject(corners, np.full(4, 10.0))
        uv, _ = camera_from_object(camera_object, scene).project(points)
        if np.abs(uv - corners).max() > _AGREEMENT_PX:
            raise HoloreelError(
                f"camera {camera.name} cannot be set up exactly in Blender; move it nearer to the origin."
            )
    return objects


def _set_clipping(camera_object: bpy.types.Object, camera: Camera) -> None:
    """Clip next to nothing: Cycles clips pictures too."""
    distance = max(float(np.linalg.norm(camera.center)), 1.0)
    camera_object.data.clip_start = 1e-3
    camera_object.data.clip_end = 1e4 * distance


def apply_look(scene: bpy.types.Scene, job: dict[str, Any]) -> None:
    """Set what makes pictures measurements: Cycles, the Standard view, no lens effects, nothing random or added."""
    render = scene.render
    render.engine = "CYCLES"
    render.film_transparent = job["film"] == "transparent"
    render.use_persistent_data = True
    render.dither_intensity = 0.0
    for name in ("use_motion_blur", "use_compositing", "use_sequencer", "use_stamp", "use_border", "use_multiview"):
        setattr(render, name, False)
    render.use_crop_to_border = False
    scene.display_settings.display_device = "sRGB"
    view = scene.view_settings
    view.view_transform, view.look, view.exposure, view.gamma = "Standard", "None", 0.0, 1.0
    view.use_curve_mapping = False
    cycles = scene.cycles
    cycles.device = "CPU"
    cycles.samples = job["samples"]
    cycles.use_adaptive_sampling = False
    cycles.time_limit = 0.0
    cycles.seed = job["seed"]
    cycles.use_animated_seed = False
    cycles.sample_offset = 0
    cycles.use_denoising = job["denoise"]
    cycles.denoiser = "OPENIMAGEDENOISE"
    cycles.film_exposure = 1.0
    cycles.pixel_filter_type, cycles.filter_width = "BLACKMAN_HARRIS", 1.5
    layer = bpy.context.view_layer
    for other in scene.view_layers:
        other.use = other == layer
    layer.samples = 0  # those of the scene
    layer.use_pass_z = bool(job["depth"] or job["seed_points"])


def render_view(scene: bpy.types.Scene, stem: Path, alpha: bool, depth: bool) -> tuple[str, str | None]:
    """Render the active camera; return the picture's path and, with `depth`, that of an EXR with a depth pass.

    Cycles takes depth from the first sample, and sends that through the center of the pixel: depth is exact.
    """
    bpy.ops.render.render(write_still=False)
    result = bpy.data.images["Render Result"]
    settings = scene.render.image_settings
    picture = f"{stem}.png"
    compat.set_image_format(settings, "PNG")
    settings.color_mode, settings.color_depth, settings.compression = "RGBA" if alpha else "RGB", "8", 15
    result.save_render(picture, scene=scene)
    if not depth:
        return picture, None
    compat.set_image_format(settings, "OPEN_EXR_MULTILAYER")
    settings.color_depth, settings.exr_codec = "32", "NONE"  # read at once and deleted
    result.save_render(f"{stem}.exr", scene=scene)
    return picture, f"{stem}.exr"
