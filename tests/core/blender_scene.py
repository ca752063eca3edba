# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs inside Blender for the tests: a scene of glowing marks above a floor, and functions that misbehave."""

import os
import signal
import sys
import time
from collections.abc import Callable
from typing import Any

Emit = Callable[[dict[str, Any]], None]

MARKS = {"red": (-0.8, 0.1, 0.6), "green": (0.7, -0.3, 1.1), "blue": (0.1, 0.5, 0.25)}
GLOW = {"red": (1.0, 0.0, 0.0), "green": (0.0, 1.0, 0.0), "blue": (0.0, 0.0, 1.0)}
STEP = 0.4  # how far the red mark moves along x per frame


def build(job: dict[str, Any], emit: Emit) -> None:
    """Save a scene with three small glowing spheres, the red one moving, over a gray glowing floor at z = 0."""
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps = 25
    scene.world = bpy.data.worlds.new("black")
    scene.view_settings.view_transform = "AgX"
    scene.render.resolution_percentage = 37
    scene.render.dither_intensity = 2.0
    scene.render.use_motion_blur = True
    for name, place in MARKS.items():
        bpy.ops.mesh.primitive_uv_sphere_add(radius=0.06, location=place)
        bpy.context.object.data.materials.append(glow(name, GLOW[name]))
        if name == "red":
            for frame in (1, 11):
                bpy.context.object.location.x = place[0] + STEP * (frame - 1)
                bpy.context.object.keyframe_insert("location", frame=frame)
            bpy.context.object.animation_data_create()
            linear(bpy.context.object)
    if job.get("floor", True):
        bpy.ops.mesh.primitive_plane_add(size=40)
        bpy.context.object.data.materials.append(glow("floor", (0.02, 0.02, 0.02)))
    if job.get("camera", True):
        bpy.ops.object.camera_add(location=(0.3, -4.0, 2.0))
        scene.camera = bpy.context.object
        scene.camera.data.lens = 30
        scene.camera.data.dof.use_dof = True
        aim = scene.camera.constraints.new("TRACK_TO")
        aim.target = bpy.data.objects.new("Holoreel Target", None)
        aim.target.location = (0, 0, 0.5)
        scene.collection.objects.link(aim.target)
        for frame in (1, 4):
            scene.timeline_markers.new(f"cut {frame}", frame=frame).camera = scene.camera
    bpy.ops.wm.save_as_mainfile(filepath=job["path"], compress=True)


def linear(thing: Any) -> None:
    """Give the animation of an object straight curves."""
    from bpy_extras import anim_utils

    animation = thing.animation_data
    bag = anim_utils.action_get_channelbag_for_slot(animation.action, animation.action_slot)
    for curve in bag.fcurves:
        for point in curve.keyframe_points:
            point.interpolation = "LINEAR"


def glow(name: str, color: tuple[float, float, float]) -> Any:
    import bpy

    material = bpy.data.materials.new(name)
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    emission = tree.nodes.new("ShaderNodeEmission")
    emission.inputs["Color"].default_value = (*color, 1)
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(emission.outputs[0], output.inputs["Surface"])
    return material


def echo(job: dict[str, Any], emit: Emit) -> dict[str, Any]:
    """Send the job back twice, with noise around it."""
    sys.stdout.write("half a line")
    emit({"event": "seen", "job": job})
    sys.stdout.write("talk\n")
    return {"job": job, "pythonpath": os.environ.get("PYTHONPATH"), "pid": os.getpid()}


def mendable(job: dict[str, Any], emit: Emit) -> None:
    from holoreel.core.errors import HoloreelError

    raise HoloreelError("the scene is empty: put something in.")


def broken(job: dict[str, Any], emit: Emit) -> None:
    raise KeyError("oops")


def crash(job: dict[str, Any], emit: Emit) -> None:
    sys.stdout.write("Error: the last words\n")
    sys.stdout.flush()
    os.kill(os.getpid(), signal.SIGSEGV)


def linger(job: dict[str, Any], emit: Emit) -> None:
    """Say who is there, then stay for good."""
    emit({"event": "here", "pid": os.getpid()})
    time.sleep(600)
