# SPDX-License-Identifier: GPL-3.0-or-later
"""Light an animated glTF subject that stands alone, for captures over a transparent film, and save it as a .blend.

    PYTHON_WITH_BPY benchmarks/subjects.py SUBJECT.glb --clip Walking_A --out SUBJECT.blend [--hide NAME ...] [--glossy]

Nothing but the subject is there: no floor, no backdrop. At the end it says the command that renders a dome of 20
cameras around it, two of them held out: cam06 and cam13, both halfway up and on different sides.
"""

import argparse
import math
import shlex
from pathlib import Path

import bpy
import numpy as np
from holoreel.addon.synth import subject_bounds
from holoreel.benchmarks.stage import import_subject, put_on_floor

FRAMES = range(1, 49)  # that the distance of the cameras allows for
FOV = 40.0
FILL = 0.78  # of the sphere around the subject's box fits into a picture: enough for a figure that stands upright
GLOSS = {"Roughness": 0.28, "Specular IOR Level": 0.9, "Coat Weight": 0.7, "Coat Roughness": 0.22}
LAMPS = (  # color, place in radii of the subject, watts per square radius
    ((1.0, 0.55, 0.3), (-2.2, -1.6, 1.4), 90.0),
    ((0.35, 0.6, 1.0), (2.0, 1.8, 1.0), 90.0),
    ((0.7, 1.0, 0.6), (0.4, 2.4, 2.2), 60.0),
)


def light(glossy: bool, middle: np.ndarray, radius: float) -> None:
    """Add a bright even sky and a soft sun; with `glossy` three colored lamps that mirror in the subject too."""
    scene = bpy.context.scene
    scene.world = bpy.data.worlds.new("World")
    scene.world.use_nodes = True
    background = scene.world.node_tree.nodes["Background"]
    background.inputs[0].default_value, background.inputs[1].default_value = (1, 1, 1, 1), 0.4 if glossy else 0.7
    sun = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    sun.data.energy, sun.data.angle = 2.5, 0.3
    sun.rotation_euler = (math.radians(40), math.radians(15), math.radians(30))
    scene.collection.objects.link(sun)
    for number, (color, place, strength) in enumerate(LAMPS if glossy else (), 1):
        data = bpy.data.lights.new(f"Lamp {number}", "AREA")
        data.color, data.size, data.energy = color, 0.9 * radius, strength * radius**2
        lamp = bpy.data.objects.new(data.name, data)
        lamp.location = middle + radius * np.array(place)
        lamp.rotation_euler = toward(np.asarray(lamp.location), middle)
        scene.collection.objects.link(lamp)


def polish() -> None:
    """Give every surface a clear, broad shine."""
    for material in bpy.data.materials:
        for node in material.node_tree.nodes if material.node_tree else ():
            if node.type == "BSDF_PRINCIPLED":
                for name, value in GLOSS.items():
                    for link in list(node.inputs[name].links):
                        material.node_tree.links.remove(link)
                    node.inputs[name].default_value = value


def toward(place: np.ndarray, target: np.ndarray) -> tuple[float, float, float]:
    """The rotation under which a lamp at `place` shines at `target`."""
    x, y, z = target - place
    return math.atan2(math.hypot(x, y), -z), 0.0, math.atan2(-x, y)


def build(subject: Path, clip: str, hidden: list[str], glossy: bool) -> tuple[np.ndarray, np.ndarray]:
    """Make the scene; return the lower and the upper corner of the subject over all `FRAMES`."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    put_on_floor(import_subject(subject, clip, hidden))
    scene = bpy.context.scene
    scene.render.engine, scene.render.fps = "CYCLES", 24
    scene.cycles.max_bounces = 3
    scene.view_settings.view_transform = "Standard"
    scene.frame_start, scene.frame_end = FRAMES.start, FRAMES.stop - 1
    bounds = subject_bounds(scene, FRAMES)
    assert bounds is not None
    low, high = np.array(bounds)
    if glossy:
        polish()
    light(glossy, (low + high) / 2, float(np.linalg.norm(high - low)) / 2)
    scene.frame_set(1)
    return low, high


def main() -> None:
    """Build, save, and say what to do next."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("subject", type=Path)
    parser.add_argument("--clip", required=True, help="name of the action to play, over and over")
    parser.add_argument("--hide", nargs="*", default=[], help="objects of the file to leave out")
    parser.add_argument("--glossy", action="store_true", help="polish the subject, and add colored lamps")
    parser.add_argument(
        "--fill",
        type=float,
        default=FILL,
        help="share of the sphere around the subject in the picture; 1 for long ones",
    )
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    low, high = build(arguments.subject, arguments.clip, arguments.hide, arguments.glossy)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(arguments.out.resolve()), compress=True)
    target = [f"{value:.4f}" for value in (low + high) / 2]
    radius = arguments.fill * float(np.linalg.norm(high - low)) / 2 / math.sin(math.radians(FOV) / 2)
    print(
        f"holoreel synth {shlex.quote(str(arguments.out))} --out CAPTURE --frames 1:24 --rig dome --cameras 20 "
        f"--size 256x256 --film transparent --holdout 6 13 --seed-points 0 --samples 24 --fov {FOV:g} "
        f"--target {' '.join(target)} --radius {radius:.4f}"
    )


if __name__ == "__main__":
    main()
