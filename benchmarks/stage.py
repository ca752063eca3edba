# SPDX-License-Identifier: GPL-3.0-or-later
"""Put an animated glTF subject on a stage with floor, backdrop and light, and save it as a .blend.

    PYTHON_WITH_BPY benchmarks/stage.py SUBJECT.glb --clip Walking_A --out STAGE.blend [--hide NAME ...]

The result is a scene like the samples, of a subject nobody tuned anything for.
"""

import argparse
import math
from pathlib import Path

import bpy
from mathutils import Matrix, Vector

HEIGHT = 1.8  # of the subject, in scene units
CAMERA = ((0.0, -6.2, 1.9), 55.0)  # place and lens in mm


def parse() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("subject", type=Path)
    parser.add_argument("--clip", required=True, help="name of the action to play")
    parser.add_argument("--hide", nargs="*", default=[], help="objects of the file to leave out")
    parser.add_argument("--out", type=Path, required=True)
    return parser.parse_args()


def import_subject(path: Path, clip: str, hidden: list[str]) -> list[bpy.types.Object]:
    """Import the file, play one action on its armature over and over from frame 1, and return its visible meshes."""
    bpy.ops.import_scene.gltf(filepath=str(path))
    bones = {b.custom_shape for o in bpy.data.objects if o.type == "ARMATURE" for b in o.pose.bones if b.custom_shape}
    for shape in [o for o in bpy.data.objects if o in bones or o.name in hidden]:
        bpy.data.objects.remove(shape)
    for armature in [o for o in bpy.data.objects if o.type == "ARMATURE"]:
        animation = armature.animation_data
        for track in list(animation.nla_tracks):
            animation.nla_tracks.remove(track)
        animation.action = None
        strip = animation.nla_tracks.new().strips.new(clip, 1, bpy.data.actions[clip])
        strip.repeat = 100
    return [o for o in bpy.data.objects if o.type == "MESH"]


def evaluated_corners(meshes: list[bpy.types.Object]) -> list[Vector]:
    """Return world corners of the meshes' boxes at the current frame, deformation included."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    evaluated = [o.evaluated_get(depsgraph) for o in meshes]
    return [o.matrix_world @ Vector(corner) for o in evaluated for corner in o.bound_box]


def put_on_floor(meshes: list[bpy.types.Object]) -> None:
    """Scale the subject to `HEIGHT`, turn it three quarters to the camera, and stand it on z = 0 at the origin."""
    bpy.context.scene.frame_set(1)
    corners = evaluated_corners(meshes)
    low = Vector(min(c[axis] for c in corners) for axis in range(3))
    high = Vector(max(c[axis] for c in corners) for axis in range(3))
    middle = Vector(((low.x + high.x) / 2, (low.y + high.y) / 2, low.z))
    place = (
        Matrix.Rotation(math.radians(28), 4, "Z")
        @ Matrix.Scale(HEIGHT / (high.z - low.z), 4)
        @ Matrix.Translation(-middle)
    )
    for root in [o for o in bpy.data.objects if o.parent is None]:
        root.matrix_world = place @ root.matrix_world


def textured(name: str, dark: tuple[float, ...], light: tuple[float, ...], scale: float) -> bpy.types.Material:
    """Make a matte material of soft blotches between two colors."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    tree = material.node_tree
    shader = tree.nodes["Principled BSDF"]
    shader.inputs["Roughness"].default_value = 0.9
    noise, ramp = tree.nodes.new("ShaderNodeTexNoise"), tree.nodes.new("ShaderNodeValToRGB")
    noise.inputs["Scale"].default_value = scale
    ramp.color_ramp.elements[0].position, ramp.color_ramp.elements[1].position = 0.4, 0.6
    ramp.color_ramp.elements[0].color, ramp.color_ramp.elements[1].color = (*dark, 1), (*light, 1)
    tree.links.new(noise.outputs[0], ramp.inputs[0])
    tree.links.new(ramp.outputs[0], shader.inputs["Base Color"])
    return material


def build_stage() -> None:
    """Add floor, backdrop, lights, camera and the point the rig aims at."""
    scene = bpy.context.scene
    bpy.ops.mesh.primitive_plane_add(size=9, location=(0, 1, 0))
    bpy.context.object.data.materials.append(textured("Floor", (0.30, 0.22, 0.16), (0.62, 0.50, 0.36), 3.0))
    bpy.ops.mesh.primitive_plane_add(size=14, location=(0, 4.2, 3), rotation=(math.pi / 2, 0, 0))
    bpy.context.object.data.materials.append(textured("Backdrop", (0.16, 0.26, 0.34), (0.38, 0.52, 0.58), 0.7))
    bpy.ops.object.light_add(type="AREA", location=(-3, -3, 5), rotation=(math.radians(45), 0, math.radians(-40)))
    bpy.context.object.data.energy, bpy.context.object.data.size = 420, 3
    scene.world = bpy.data.worlds.new("World")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs[0].default_value = (0.75, 0.82, 0.95, 1)
    scene.world.node_tree.nodes["Background"].inputs[1].default_value = 0.55
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    target = bpy.data.objects.new("Holoreel Target", None)
    target.location = (0, 0, 0.5 * HEIGHT)
    for item in (camera, target):
        scene.collection.objects.link(item)
    camera.location, camera.data.lens = CAMERA
    camera.rotation_euler = (target.location - camera.location).to_track_quat("-Z", "Y").to_euler()
    scene.camera = camera
    scene.render.engine = "CYCLES"
    scene.cycles.max_bounces = 3
    scene.view_settings.view_transform = "Standard"
    scene.frame_start, scene.frame_end, scene.render.fps = 1, 48, 24


def main() -> None:
    """Build and save."""
    arguments = parse()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    put_on_floor(import_subject(arguments.subject, arguments.clip, arguments.hide))
    build_stage()
    bpy.ops.wm.save_as_mainfile(filepath=str(arguments.out.resolve()), compress=True)


if __name__ == "__main__":
    main()
