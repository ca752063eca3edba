# SPDX-License-Identifier: GPL-3.0-or-later
"""What a frame of the Holoreel engine costs beyond the drawing itself. Run it with a Python that has bpy:

    .venv-bpy52/bin/python benchmarks/blender_engine.py REEL [WIDTH HEIGHT [FRAMES]]

It renders frames without writing them and says, for each: the whole of `bpy.ops.render.render`, the worker's own
drawing, and the difference; of that, how much the same picture costs without any reel, which is Blender's own part.
"""

import statistics
import sys
import time
from pathlib import Path

import bpy
import holoreel
from holoreel.addon import reels, worker

FIELDS = ("whole", "drawing", "overhead", "finishing", "evaluation")


def seconds_of_render() -> float:
    """Render once and return how long it took."""
    began = time.perf_counter()
    bpy.ops.render.render()
    return time.perf_counter() - began


def main(path: Path, width: int = 1920, height: int = 1080, frames: int = 8) -> None:
    """Measure and print medians, after one frame that is not counted."""
    holoreel.register()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(camera)
    camera.location, camera.rotation_euler = (0.0, -6.0, 2.0), (1.3, 0.0, 0.0)
    scene.camera = camera
    scene.render.resolution_x, scene.render.resolution_y = width, height
    bpy.ops.holoreel.setup_engine()
    bare = statistics.median(seconds_of_render() for _ in range(frames))
    reels.import_reel(bpy.context, path, start=1)
    client, parts = worker.worker(), []
    draw = client.draw
    client.draw = lambda *args, **keys: parts.append(draw(*args, **keys)) or parts[-1]  # type: ignore[method-assign]
    rows = []
    for frame in range(frames + 1):
        began = time.perf_counter()
        scene.frame_set(1 + frame)
        evaluation = time.perf_counter() - began
        whole = seconds_of_render()
        spent = parts[-1].seconds
        rows.append((whole, spent["draw"], whole - spent["draw"], spent["finish"], evaluation))
    print(f"{path.name}, {width} x {height}, Blender {bpy.app.version_string}; medians of {frames} frames, ms")
    for name, values in zip(FIELDS, zip(*rows[1:], strict=True), strict=True):
        print(f"  {name:12}{statistics.median(values) * 1000:8.1f}")
    print(f"  {'no reel':12}{bare * 1000:8.1f}")
    holoreel.unregister()


if __name__ == "__main__":
    main(Path(sys.argv[1]), *map(int, sys.argv[2:]))
