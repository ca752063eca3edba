# SPDX-License-Identifier: GPL-3.0-or-later
"""VideoRF reels in Blender: seconds to import, milliseconds per frame to evaluated points, and what the network takes.

Run by a Python that has `bpy`: `.venv-bpy52/bin/python benchmarks/blender_field.py REEL [--json FILE]`.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from holoreel.addon import compat, reels
from holoreel.addon.nodes.builder import Tree, Value
from holoreel.addon.nodes.decoder import decoder, feature_sockets
from holoreel.addon.nodes.reel import DISPLAY, HULL, POINTS, SPLATS
from holoreel.core.videorf.package import read_video_reel
from holoreel.core.videorf.shading import Shading

POINTS_DECODED = 100_000


def evaluate(played: bpy.types.Object, frame: int) -> bpy.types.GeometrySet:
    """Return the evaluated geometry at a scene frame."""
    bpy.context.scene.frame_set(frame)
    return played.evaluated_get(bpy.context.evaluated_depsgraph_get()).evaluated_geometry()


def median_ms(deed: Callable[[int], Any], frames: Iterable[int]) -> float:
    """Return the median time of a deed over frames."""
    seconds = []
    for frame in frames:
        began = time.perf_counter()
        deed(frame)
        seconds.append(time.perf_counter() - began)
    return 1e3 * float(np.median(seconds))


def network_ms(shading: Shading) -> float:
    """Return the time that the network takes for 100,000 points, in nodes, beyond that of storing a color."""
    random = np.random.default_rng(0)
    names = [*feature_sockets(shading.shape.features), "Direction"]
    mesh = bpy.data.meshes.new("Features")
    mesh.vertices.add(POINTS_DECODED)
    for name in names:
        values = random.normal(size=(POINTS_DECODED, 3)).astype(np.float32)
        mesh.attributes.new(name, "FLOAT_VECTOR", "POINT").data.foreach_set("vector", values.ravel())
    carrier = bpy.data.objects.new("Features", mesh)
    bpy.context.scene.collection.objects.link(carrier)
    times = []
    for decoded in (True, False):
        tree = Tree(bpy.data.node_groups.new("Network", "GeometryNodeTree"))
        cloud = tree.geometry_input()
        inputs = {name: tree.attribute(name, "FLOAT_VECTOR") for name in names}
        group = tree.group(decoder(shading), inputs) if decoded else None
        color = Value(tree, group.outputs["Color"]) if group else inputs[names[0]]
        tree.output("Geometry", tree.store(cloud, "color", color, "FLOAT_VECTOR"))
        modifier = carrier.modifiers.new("Network", "NODES")
        modifier.node_group = tree.tree

        def again(_: int) -> None:
            mesh.update_tag()
            evaluate(carrier, 1)

        again(0)
        times.append(median_ms(again, range(20)))
        carrier.modifiers.remove(modifier)
    bpy.data.objects.remove(carrier)
    return times[0] - times[1]


def measure(path: Path) -> dict[str, Any]:
    """Import a reel into an empty file and play it in every look."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    began = time.perf_counter()
    reel = read_video_reel(path)
    played = reels.import_reel(bpy.context, path, start=1)
    imported = time.perf_counter() - began
    center = (np.array(reel.lattice.lowest) + np.array(reel.lattice.highest)) / 2
    camera.location = center - np.array((0.0, 4 * reel.lattice.spacing * max(reel.lattice.shape), 0.0))
    camera.rotation_euler = (np.pi / 2, 0, 0)
    modifier = reels.modifier_of(played)
    compat.set_input(modifier, "Color", DISPLAY)
    frames = range(1, reel.frame_count + 1)
    figures: dict[str, Any] = {
        "file": path.name,
        "blender": bpy.app.version_string,
        "points": len(played.data.points),
        "points_in_a_group": max(group.vertices for group in reel.groups),
        "import_s": imported,
    }
    evaluate(played, 1)
    figures["in_order_ms"] = median_ms(lambda frame: evaluate(played, frame), frames)
    two = [1 + index % 2 for index in range(20)]
    for look in (POINTS, SPLATS, HULL):
        compat.set_input(modifier, "Look", look)
        evaluate(played, 1)
        figures[f"{look.lower()}_held_ms"] = median_ms(
            lambda frame: evaluate(played, frame), two
        )  # frames whose pictures Blender holds
    compat.set_input(modifier, "Look", POINTS)
    geometry = evaluate(played, 1)
    figures["shown"] = len(geometry.pointcloud.points)
    figures["network_ms_per_100k"] = network_ms(reel.shade())
    return figures


def main() -> None:
    """Measure a reel, print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("reel", type=Path, help="a reel of a VideoRF")
    parser.add_argument("--json", type=Path, help="write the figures there")
    chosen = parser.parse_args()
    figures = measure(chosen.reel)
    for name, value in figures.items():
        print(f"{name:20} {value:.1f}" if isinstance(value, float) else f"{name:20} {value}")
    if chosen.json:
        chosen.json.write_text(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
