# SPDX-License-Identifier: GPL-3.0-or-later
"""The looks of a reel in Blender against Holoreel's own rasterizer: PSNR by engine, camera and time.

Run by the core environment; Blender runs as a child.
"""

import argparse
import json
import math
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from holoreel.core.blender import Blender, find_blender, run_in_blender
from holoreel.core.camera import Camera
from numpy.typing import NDArray

SIZE = 160, 120
TIMES = 0.1, 0.5, 0.9
FISHEYE_DEGREES = 140.0  # the rasterizer's virtual pinhole covers 150 degrees
CHANGES = 15


def cameras(eye: NDArray[np.float64], target: NDArray[np.float64], up: NDArray[np.float64]) -> dict[str, Camera]:
    """Return five views of a place: plain, lens shifted, wide angle, from aside, upright with another focal length."""
    width, height = SIZE

    def look(offset: tuple[float, float], w: int, h: int, focal: float, shift: tuple[float, float] = (0, 0)) -> Camera:
        forward = target - eye
        right = np.cross(forward, up)
        right /= np.linalg.norm(right)
        moved = eye + np.linalg.norm(forward) * (offset[0] * right + offset[1] * up)
        camera = Camera.look_at(moved, target, up, width=w, height=h, fx=focal)
        return Camera(
            w, h, focal, focal, w / 2 + shift[0] * w, h / 2 + shift[1] * w, camera.world_to_camera, name="camera"
        )

    return {
        "plain": look((0, 0), width, height, 0.9 * width),
        "shifted lens": look((0.05, 0), width, height, 0.9 * width, (0.2, -0.15)),
        "wide angle": look((0, 0.05), width, height, 0.4 * width),
        "from aside": look((0.3, 0.1), width, height, 0.9 * width),
        "upright": look((-0.1, 0), height, width, 1.1 * height, (-0.1, 0.1)),
    }


def fisheye_job(job: dict[str, Any], emit: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """In Blender: render the look Hull under an equidistant fisheye; keys reel, camera, shots (time, out)."""
    import bpy
    from holoreel.addon import compat, reels, render
    from holoreel.addon.cameras import new_camera_object, set_format

    scene = render._new_scene(render.Setting(job["reel"]))
    played = reels.import_reel(bpy.context, job["reel"])
    render._apply(render.Setting(job["reel"], look="Hull"), scene, played)
    camera = Camera.from_json(job["camera"])
    scene.camera = new_camera_object(camera, scene.collection)
    set_format(scene, camera)
    data = scene.camera.data
    data.type, data.panorama_type, data.shift_x, data.shift_y = "PANO", "FISHEYE_EQUIDISTANT", 0.0, 0.0
    data.fisheye_fov = math.radians(job["degrees"])
    data.clip_start = 0.01
    for index, (moment, out) in enumerate(job["shots"]):
        render._stop_at(played, moment)
        render._render(scene, Path(out))
        emit({"event": "picture", "index": index})
    return {"visible": len(played.data.points), "hull": compat.get_input(reels.modifier_of(played), "Look")}


def sorting_job(job: dict[str, Any], _emit: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """In Blender: milliseconds to evaluate the look Splats after the camera moved."""
    import bpy
    from holoreel.addon import reels
    from holoreel.addon.cameras import new_camera_object, set_format

    bpy.ops.wm.read_factory_settings(use_empty=True)
    played, scene = reels.import_reel(bpy.context, job["reel"]), bpy.context.scene
    camera = Camera.from_json(job["camera"])
    scene.camera = new_camera_object(camera, scene.collection)
    set_format(scene, camera)
    scene.frame_set(job["frame"])
    seconds = []
    for index in range(CHANGES + 1):
        scene.camera.location.x += 0.001 * (index % 3 - 1)
        began = time.perf_counter()
        geometry = played.evaluated_get(bpy.context.evaluated_depsgraph_get()).evaluated_geometry()
        splats = len(geometry.mesh.polygons)
        seconds.append(time.perf_counter() - began)
        del geometry
    return {"splats": splats, "ms": 1e3 * float(np.median(seconds[1:])), "ms_least": 1e3 * min(seconds[1:])}


def psnr(picture: NDArray[np.float32], truth: NDArray[np.float32]) -> float:
    """Return dB for a peak of 1."""
    return -10.0 * math.log10(max(float(np.mean(np.square(picture.astype(np.float64) - truth))), 1e-20))


def measure(reel: Path, views: dict[str, Camera], engines: list[str], blender: Blender) -> list[dict[str, Any]]:
    """Return a row for each engine, camera and time."""
    from holoreel.core.draw import open_player
    from holoreel.core.images import read_image

    player, rows = open_player(reel, "cpu"), []
    with tempfile.TemporaryDirectory() as folder:
        for engine in engines:
            shots, facts = [], []
            for name, camera in views.items():
                for moment in TIMES:
                    out = str(Path(folder, f"{engine}-{len(shots)}.exr"))
                    shots.append({"camera": camera.to_json(), "time": moment, "out": out})
                    facts.append((name, camera))
            job = {"setting": {"reel": str(reel), "engine": engine}, "shots": shots}
            done = run_in_blender(blender, "holoreel.addon.render:main", job, log=Path(folder, "log"))
            for shot, (name, camera), seconds in zip(shots, facts, done["seconds"], strict=True):
                truth = player.draw(camera, player.frame_at(shot["time"]), (0.0, 0.0, 0.0)).image
                row = {"reel": reel.name, "look": "Splats", "engine": engine, "camera": name, "time": shot["time"]}
                rows.append({**row, "psnr": psnr(read_image(Path(shot["out"]))[..., :3], truth), "seconds": seconds})
                print(json.dumps(rows[-1]), flush=True)
    return rows


def measure_fisheye(reel: Path, view: Camera, blender: Blender, size: int) -> list[dict[str, Any]]:
    """Return a row for each time: the look Hull in Cycles, inside the fisheye's circle."""
    from holoreel.core.draw import open_player
    from holoreel.core.images import read_image

    player = open_player(reel, "cpu")
    focal = size / math.radians(FISHEYE_DEGREES)
    camera = Camera(
        size,
        size,
        focal,
        focal,
        size / 2,
        size / 2,
        view.world_to_camera,
        model="OPENCV_FISHEYE",
        distortion=(0.0, 0.0, 0.0, 0.0),
    )
    y, x = np.mgrid[:size, :size] + 0.5
    inside = np.hypot(x - size / 2, y - size / 2) < size / 2 - 1
    reach = player.reach(camera)
    inside &= np.ones_like(inside) if reach is None else reach
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        plain = Camera(size, size, size, size, size / 2, size / 2, view.world_to_camera)
        shots = [(moment, str(Path(folder, f"{index}.exr"))) for index, moment in enumerate(TIMES)]
        job = {"reel": str(reel), "camera": plain.to_json(), "degrees": FISHEYE_DEGREES, "shots": shots}
        here = "holoreel.benchmarks.blender_looks:fisheye_job"
        run_in_blender(blender, here, job, log=Path(folder, "log"))
        for moment, out in shots:
            truth = player.draw(camera, player.frame_at(moment), (0.0, 0.0, 0.0)).image
            row = {"reel": reel.name, "look": "Hull", "engine": "CYCLES", "camera": "fisheye", "time": moment}
            picture = read_image(Path(out))[..., :3]
            rows.append({**row, "psnr": psnr(picture[inside], truth[inside])})
            print(json.dumps(rows[-1]), flush=True)
    return rows


def measure_sorting(reel: Path, view: Camera, blender: Blender) -> dict[str, Any]:
    """Return how long the look Splats takes when the camera has moved."""
    from holoreel.core.draw import open_player

    player = open_player(reel, "cpu")
    job = {"reel": str(reel), "camera": view.to_json(), "frame": round(player.frame_at(0.5))}
    with tempfile.TemporaryDirectory() as folder:
        here = "holoreel.benchmarks.blender_looks:sorting_job"
        row = run_in_blender(blender, here, job, log=Path(folder, "log"))
    print(json.dumps({"reel": reel.name, **row}), flush=True)
    return {"reel": reel.name, **row}


def main() -> None:
    """Measure, print a line for each picture."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("reel", type=Path)
    parser.add_argument("--eye", type=float, nargs=3, default=(0.0, 0.0, 0.0), help="where the cameras stand")
    parser.add_argument("--target", type=float, nargs=3, default=(0.0, 0.0, 10.0), help="what they look at")
    parser.add_argument("--up", type=float, nargs=3, default=(0.0, -1.0, 0.0))
    parser.add_argument("--blender", help="the blender to use")
    parser.add_argument("--engines", nargs="*", default=["CYCLES", "EEVEE"])
    parser.add_argument("--fisheye", type=int, default=192, help="pixels across of the fisheye's pictures; 0: none")
    parser.add_argument("--json", type=Path, help="write the figures there")
    chosen = parser.parse_args()
    blender = find_blender(chosen.blender)
    views = cameras(np.array(chosen.eye), np.array(chosen.target), np.array(chosen.up))
    rows = [measure_sorting(chosen.reel, views["plain"], blender)]
    if chosen.fisheye:
        rows += measure_fisheye(chosen.reel, views["plain"], blender, chosen.fisheye)
    rows += measure(chosen.reel, views, chosen.engines, blender)
    if chosen.json:
        chosen.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
