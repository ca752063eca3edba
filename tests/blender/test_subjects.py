# SPDX-License-Identifier: GPL-3.0-or-later
"""Subjects that stand alone: what `benchmarks/subjects.py` makes of a glTF file, and the box that synthesis finds."""

from __future__ import annotations

import itertools
import json
import math
import shlex
import struct
import sys
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import pytest
from holoreel.addon.synth import render, subject_bounds
from holoreel.benchmarks import subjects
from holoreel.core.camera import Camera
from holoreel.core.rig import RigRequest, SceneFacts, fit_to_scene, make_rig
from mathutils import Vector

SIZE = (1.0, 3.0, 0.5)  # of the subject in its file: right, up, toward the viewer
SLIDE = 1.0  # how far its bone goes to the right while the clip plays once
STEPS = 24  # frames in that time
SCALE = 1.8 / SIZE[1]
TURN = math.radians(28)


def write_glb(path: Path) -> None:
    """Write a box on one bone, with the clips Rest and Slide, and a large loose part called Sword, as glTF 2.0 says."""
    x, y, z = np.array(SIZE) / 2
    corners = np.array([(i, j, k) for i in (-x, x) for j in (0, 2 * y) for k in (-z, z)], np.float32)
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = np.array([part for a, b, c, d in sides for part in (a, b, c, a, c, d)], np.uint16)
    weights = np.tile(np.array([1, 0, 0, 0], np.float32), (8, 1))
    moves = {"Rest": [(0, 0, 0), (0, 0, 0)], "Slide": [(0, 0, 0), (SLIDE, 0, 0)]}
    arrays = [
        (corners, 5126, "VEC3"), (triangles, 5123, "SCALAR"), (np.zeros((8, 4), np.uint8), 5121, "VEC4"),
        (weights, 5126, "VEC4"), (np.eye(4, dtype=np.float32).reshape(1, 16), 5126, "MAT4"),
        (np.array([0, STEPS / 24], np.float32), 5126, "SCALAR"),
        *((np.array(move, np.float32), 5126, "VEC3") for move in moves.values()),
    ]  # fmt: skip
    data, views, accessors = b"", [], []
    for array, component, kind in arrays:
        limits = {"min": array.min(0).ravel().tolist(), "max": array.max(0).ravel().tolist()}
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": array.nbytes})
        count = {"bufferView": len(views) - 1, "count": len(array), "componentType": component, "type": kind}
        accessors.append(count | (limits if component == 5126 and kind != "MAT4" else {}))
        data += array.tobytes() + bytes(-array.nbytes % 4)
    box = {"attributes": {"POSITION": 0}, "indices": 1, "material": 0}
    skinned = {"attributes": {"POSITION": 0, "JOINTS_0": 2, "WEIGHTS_0": 3}, "indices": 1, "material": 0}
    channel = {"sampler": 0, "target": {"node": 1, "path": "translation"}}
    value = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0, 2, 3]}],
        "nodes": [
            {"name": "Rig", "children": [1]}, {"name": "Bone"}, {"name": "Body", "mesh": 0, "skin": 0},
            {"name": "Sword", "mesh": 1, "scale": [9, 9, 9]},
        ],
        "meshes": [{"name": "Body", "primitives": [skinned]}, {"name": "Sword", "primitives": [box]}],
        "materials": [{"name": "Paint", "pbrMetallicRoughness": {"baseColorFactor": [0.8, 0.3, 0.1, 1]}}],
        "skins": [{"joints": [1], "inverseBindMatrices": 4}],
        "animations": [
            {"name": name, "channels": [channel], "samplers": [{"input": 5, "output": 6 + index}]}
            for index, name in enumerate(moves)
        ],
        "accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": len(data)}],
    }  # fmt: skip
    text = json.dumps(value).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(data), 0x004E4942) + data
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def expected_corners(shift: float) -> np.ndarray:
    """Where the box's corners are in the scene, (8, 3): z up, as high as a person, turned, standing on the origin."""
    x, y, z = SIZE[0] / 2, SIZE[2] / 2, SIZE[1]
    points = np.array([(i + shift, j, k) for i in (-x, x) for j in (-y, y) for k in (0, z)]) * SCALE
    turn = np.array([[math.cos(TURN), -math.sin(TURN), 0], [math.sin(TURN), math.cos(TURN), 0], [0, 0, 1]])
    return np.asarray(points @ turn.T)


def expected_box(shifts: list[float]) -> np.ndarray:
    points = np.concatenate([expected_corners(shift) for shift in shifts])
    return np.stack([points.min(axis=0), points.max(axis=0)])


def make(folder: Path, monkeypatch: pytest.MonkeyPatch, *more: str) -> Path:
    write_glb(folder / "a box.glb")
    command = ["subjects.py", str(folder / "a box.glb"), "--clip", "Slide", "--out", str(folder / "out" / "box.blend")]
    monkeypatch.setattr(sys, "argv", [*command, "--hide", "Sword", *more])
    subjects.main()
    return folder / "out" / "box.blend"


def shift_at(frame: int) -> float:
    """How far the bone has gone at a frame of the timeline: the clip begins at frame 1, over and over."""
    return SLIDE * ((frame - 1) % STEPS) / STEPS


def body_at(frame: int) -> np.ndarray:
    """The corners of what is shown, (8, 3), in the order of x, y, z of the file."""
    bpy.context.scene.frame_set(frame)
    depsgraph = bpy.context.evaluated_depsgraph_get()
    (body,) = [thing for thing in bpy.context.scene.objects if thing.type == "MESH"]
    evaluated = body.evaluated_get(depsgraph)
    return np.array([evaluated.matrix_world @ vertex.co for vertex in evaluated.data.vertices])


def same_points(first: np.ndarray, second: np.ndarray, tolerance: float = 1e-4) -> bool:
    """Whether each point of one set is one of the other, whatever their order."""
    distances = np.linalg.norm(first[:, None] - second[None], axis=2)
    return bool((distances.min(axis=0) < tolerance).all() and (distances.min(axis=1) < tolerance).all())


def test_a_subject_stands_on_the_floor_and_plays_its_clip_over_and_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    blend = make(tmp_path, monkeypatch)
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    scene = bpy.context.scene
    assert sorted(thing.name for thing in scene.objects if thing.type != "ARMATURE") == ["Body", "Sun"]
    assert (scene.frame_start, scene.frame_end, scene.render.fps, scene.render.engine) == (1, 48, 24, "CYCLES")
    for frame in (1, 2, 13, 24, 26, 37):
        assert same_points(body_at(frame), expected_corners(shift_at(frame))), frame


@pytest.mark.parametrize(("more", "fill"), [((), subjects.FILL), (("--fill", "1"), 1.0)])
def test_the_command_frames_all_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    more: tuple[str, ...], fill: float,
) -> None:  # fmt: skip
    """What is printed is a call of `holoreel synth`; filled with the whole sphere, every picture shows all of it."""
    blend = make(tmp_path, monkeypatch, *more)
    words = shlex.split(capsys.readouterr().out.strip().splitlines()[-1])
    assert words[:3] == ["holoreel", "synth", str(blend)]

    def after(flag: str, count: int = 1) -> list[float]:
        return [float(word) for word in words[words.index(flag) + 1 :][:count]]

    low, high = expected_box([shift_at(frame) for frame in range(1, 49)])
    x, y, z = after("--target", 3)
    np.testing.assert_allclose((x, y, z), (low + high) / 2, atol=2e-3)
    (fov,), (radius,) = after("--fov"), after("--radius")
    assert radius == pytest.approx(fill * np.linalg.norm(high - low) / 2 / math.sin(math.radians(fov / 2)), rel=2e-3)
    request = RigRequest(int(after("--cameras")[0]), 256, 256, target=(x, y, z), radius=radius, fov_degrees=fov)
    cameras = make_rig("dome", fit_to_scene(request, SceneFacts()))
    pixels = np.stack([camera.project(expected_corners(shift_at(f)))[0] for camera in cameras for f in range(1, 25)])
    if fill == 1:
        assert pixels.min() > 0
        assert pixels.max() < 256
    assert pixels.max() - pixels.min() > 200  # and it is not small


def test_glossy_subjects_are_polished_under_lamps_that_shine_at_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bpy.ops.wm.open_mainfile(filepath=str(make(tmp_path, monkeypatch, "--glossy")))
    lamps = [thing for thing in bpy.context.scene.objects if thing.type == "LIGHT" and thing.data.type == "AREA"]
    assert len({tuple(lamp.data.color) for lamp in lamps}) == len(lamps) == 3
    middle = Vector(expected_box([0.0, SLIDE]).mean(axis=0))
    for lamp in lamps:
        ahead = lamp.matrix_world.to_3x3() @ Vector((0, 0, -1))
        assert ahead.angle(middle - lamp.location) < math.radians(2)
    shader = bpy.data.materials["Paint"].node_tree.nodes["Principled BSDF"]
    for name, value in subjects.GLOSS.items():
        assert shader.inputs[name].default_value == pytest.approx(value)


def cube(name: str, place: tuple[float, float, float], half: float = 1.0) -> bpy.types.Object:
    bpy.ops.mesh.primitive_cube_add(size=2 * half, location=place)
    bpy.context.object.name = name
    return bpy.context.object


def there_and_back(thing: bpy.types.Object) -> None:
    """Move along x, farthest in the middle: at neither end is the box what it is over all frames."""
    for frame, x in ((1, 0.0), (4, 5.0), (7, -2.0), (9, 0.0)):
        thing.location.x = x
        thing.keyframe_insert("location", frame=frame)


def test_the_box_holds_all_frames_and_only_what_is_rendered() -> None:
    scene = bpy.context.scene
    assert subject_bounds(scene, range(1, 10)) is None
    there_and_back(cube("Mover", (0, 0, 0), 0.5))
    cube("Hidden", (50, 0, 0)).hide_render = True
    bpy.ops.object.empty_add(location=(-90, 0, 0))
    bpy.ops.object.camera_add(location=(0, -90, 0))
    np.testing.assert_allclose(subject_bounds(scene, range(1, 10)), [(-2.5, -0.5, -0.5), (5.5, 0.5, 0.5)], atol=1e-6)
    np.testing.assert_allclose(subject_bounds(scene, range(1, 2)), [(-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)], atol=1e-6)
    np.testing.assert_allclose(subject_bounds(scene, range(4, 5)), [(4.5, -0.5, -0.5), (5.5, 0.5, 0.5)], atol=1e-6)


def test_the_box_is_of_shapes_as_they_are_deformed_and_instanced() -> None:
    thing = cube("Body", (0, 0, 0))
    thing.shape_key_add(name="Basis")
    tall = thing.shape_key_add(name="Tall")
    for point in tall.data:
        point.co.z *= 3
    for frame, value in ((1, 0.0), (3, 1.0), (5, 0.0)):
        tall.value = value
        tall.keyframe_insert("value", frame=frame)
    thing.rotation_euler.z = math.radians(45)
    root = math.sqrt(2)
    box = subject_bounds(bpy.context.scene, range(1, 6))
    np.testing.assert_allclose(box, [(-root, -root, -3), (root, root, 3)], atol=1e-5)
    group = bpy.data.collections.new("Group")
    group.objects.link(cube("Part", (0, 0, 0)))
    bpy.context.scene.collection.objects.unlink(bpy.data.objects["Part"])
    holder = bpy.data.objects.new("Holder", None)
    holder.instance_type, holder.instance_collection, holder.location = "COLLECTION", group, (0, 9, 0)
    bpy.context.scene.collection.objects.link(holder)
    box = subject_bounds(bpy.context.scene, range(1, 6))
    np.testing.assert_allclose(box, [(-root, -root, -3), (root, 10, 3)], atol=1e-5)


@pytest.mark.parametrize(
    ("film", "frames", "box"),
    [
        ("transparent", (1, 9), ((-2.5, -0.5, 2.5), (5.5, 0.5, 3.5))),
        ("transparent", (1, 4), ((-0.5, -0.5, 2.5), (5.5, 0.5, 3.5))),
        ("scene", (1, 9), None),
    ],
)
def test_synthesis_tells_the_box_and_its_cameras_see_all_of_it(
    tmp_path: Path, film: str, frames: tuple[int, int], box: tuple[tuple[float, ...], tuple[float, ...]] | None
) -> None:
    """The job that renders, with nothing left to render."""
    there_and_back(cube("Mover", (0, 0, 3), 0.5))
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    job = {
        "scene": str(tmp_path / "a.blend"), "film": film, "frames": list(frames), "cameras": [], "preset": "dome",
        "rig": {"cameras": 4, "width": 64, "height": 64}, "samples": 1, "seed": 0, "denoise": False, "depth": False,
        "seed_points": 0, "todo": [], "names": [], "work": str(tmp_path),
    }  # fmt: skip
    events: list[dict[str, Any]] = []
    assert render(job, events.append) == {"rendered": 0}
    (event,) = events
    assert ("bounds" in event["scene"]) == (box is not None)
    if box is not None:
        np.testing.assert_allclose(event["scene"]["bounds"], box, atol=1e-6)
        corners = np.array(list(itertools.product(*zip(*box, strict=True))))
        assert len(event["cameras"]) == 4
        for camera in map(Camera.from_json, event["cameras"]):
            pixels, depth = camera.project(corners)
            assert depth.min() > 0
            assert pixels.min() > 0
            assert pixels.max() < 64
