# SPDX-License-Identifier: GPL-3.0-or-later
"""The sample scenes: self-contained, animated, cheap, and the very scenes that their scripts build."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import bpy
import numpy as np
import pytest

SCENES = Path(__file__).parents[2] / "sample_scenes"
NAMES = ("harbor", "dragon")
# What each scene must show to need the paper's terms: things that travel, spin, bend; and things that come and go.
MOVING = {
    "harbor": ("Sailboat hull", "Tug hull", "Mill sail 1", "Whale body", "Envelope", "Pennant", "Sea slice 06"),
    "dragon": ("Dragon body", "Dragon skull", "Pearl", "Banner 1", "Pinwheel leaf 1.1", "Lantern 1", "Petal 1.01"),
}
COMING = {"harbor": ("Spout drop 1", "Puff 3"), "dragon": ("Lantern 4", "Spark 1.01")}
GOING = {"harbor": ("Puff 2",), "dragon": ("Lantern 5", "Spark 2.01")}


@pytest.fixture(params=NAMES)
def scene(request: pytest.FixtureRequest) -> bpy.types.Scene:
    """A sample scene, freshly opened."""
    bpy.ops.wm.open_mainfile(filepath=str(SCENES / f"{request.param}.blend"))
    return bpy.context.scene


def opened() -> str:
    """The name of the open sample scene."""
    return Path(bpy.data.filepath).stem


def script(name: str) -> ModuleType:
    """The module of a build script; importing it builds nothing."""
    spec = importlib.util.spec_from_file_location(f"sample_scene_{name}", SCENES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def points(name: str, frame: int) -> np.ndarray:
    """World positions of an object's evaluated vertices at a frame, (n, 3)."""
    bpy.context.scene.frame_set(frame)
    thing = bpy.data.objects[name].evaluated_get(bpy.context.evaluated_depsgraph_get())
    mesh = thing.to_mesh()
    local = np.empty((len(mesh.vertices), 3), np.float32)
    mesh.vertices.foreach_get("co", local.ravel())
    thing.to_mesh_clear()
    world = np.array(thing.matrix_world)
    return local @ world[:3, :3].T + world[:3, 3]


def bounds(scene: bpy.types.Scene, frame: int) -> dict[str, np.ndarray]:
    """World bounding boxes of the evaluated meshes at a frame, (2, 3) each."""
    boxes = {}
    for name in [thing.name for thing in scene.objects if thing.type == "MESH"]:
        where = points(name, frame)
        boxes[name] = np.array([where.min(axis=0), where.max(axis=0)])
    return boxes


def snapshot(frame: int) -> dict[str, tuple[str, np.ndarray, int]]:
    """Type, world matrix and mesh size of every object at a frame."""
    bpy.context.scene.frame_set(frame)
    return {
        thing.name: (thing.type, np.array(thing.matrix_world), len(thing.data.vertices) if thing.type == "MESH" else 0)
        for thing in bpy.context.scene.objects
    }


def test_scene_is_ready_for_a_rig(scene: bpy.types.Scene) -> None:
    """A camera in front looks at the target, nothing blurs, and the colors are Standard."""
    camera, target = scene.camera, bpy.data.objects["Holoreel Target"]
    assert scene.render.engine == "CYCLES"
    assert scene.view_settings.view_transform == "Standard"
    assert not scene.render.use_motion_blur
    assert not camera.data.dof.use_dof
    assert (scene.frame_start, scene.frame_end, scene.render.fps) == (1, 48, 24)
    bpy.context.view_layer.update()
    forward = -np.array(camera.matrix_world)[:3, 2]
    toward = np.array(target.matrix_world)[:3, 3] - np.array(camera.matrix_world)[:3, 3]
    distance = np.linalg.norm(toward)
    assert 6.0 <= distance <= 8.0
    assert np.allclose(forward, toward / distance, atol=1e-5)
    assert 35.0 <= camera.data.lens <= 50.0


def test_file_is_small_and_self_contained(scene: bpy.types.Scene) -> None:
    """Nothing outside the file is needed, no script runs in it, and it stays small."""
    path = Path(bpy.data.filepath)
    assert path.stat().st_size < 2_000_000
    assert not bpy.data.libraries
    assert not bpy.data.texts
    assert not bpy.utils.blend_paths(absolute=True, packed=False, local=False)
    assert all(image.packed_file for image in bpy.data.images if image.source == "FILE")
    graph = bpy.context.evaluated_depsgraph_get()
    faces = 0
    for instance in graph.object_instances:
        if instance.object.type == "MESH":
            faces += len(instance.object.data.polygons)
    assert 10_000 < faces < 200_000


def test_drivers_need_no_python(scene: bpy.types.Scene) -> None:
    """Every driver is valid and simple enough to play where running scripts is not allowed."""
    scene.frame_set(7)
    blocks = [*scene.objects, *bpy.data.shape_keys]
    drivers = [curve.driver for block in blocks if block.animation_data for curve in block.animation_data.drivers]
    assert drivers
    assert all(driver.is_valid and driver.is_simple_expression for driver in drivers)


def test_things_move_over_the_first_frames(scene: bpy.types.Scene) -> None:
    """Between frames 1 and 12 the named things move, and no step is a jump."""
    boxes = {1: bounds(scene, 1), 12: bounds(scene, 12)}
    changed = [name for name, box in boxes[1].items() if not np.allclose(box, boxes[12][name], atol=1e-3)]
    assert len(changed) > 20
    for name in MOVING[opened()]:
        track = np.stack([points(name, frame) for frame in range(1, 13)])
        assert np.linalg.norm(track[-1] - track[0], axis=-1).max() > 0.04, name
        steps = np.linalg.norm(np.diff(track, axis=0), axis=-1)
        assert 0.005 < steps.max() < 0.25, name


def test_things_come_and_go(scene: bpy.types.Scene) -> None:
    """Something is born at frame 5 and something is gone by frame 10."""
    hidden = {}
    for frame in (4, 6, 10):
        scene.frame_set(frame)
        hidden[frame] = {thing.name for thing in scene.objects if thing.hide_render}
    for name in COMING[opened()]:
        assert name in hidden[4], name
        assert name not in hidden[6], name
    for name in GOING[opened()]:
        assert name not in hidden[4], name
        assert name in hidden[10], name


@pytest.mark.parametrize("name", NAMES)
def test_script_builds_the_same_scene(name: str, tmp_path: Path) -> None:
    """What the script builds now has the objects, meshes and motion of the file in the repository."""
    bpy.ops.wm.open_mainfile(filepath=str(SCENES / f"{name}.blend"))
    committed = {frame: snapshot(frame) for frame in (1, 30)}
    module = script(name)
    module.build()
    module.kit.save(tmp_path / f"{name}.blend")
    assert (tmp_path / f"{name}.blend").stat().st_size < 2_000_000
    for frame, expected in committed.items():
        built = snapshot(frame)
        assert built.keys() == expected.keys()
        for thing, (kind, matrix, count) in expected.items():
            assert built[thing][0] == kind, thing
            assert built[thing][2] == count, thing
            assert np.allclose(built[thing][1], matrix, atol=1e-5), thing


def test_tiny_render_shows_something(scene: bpy.types.Scene, tmp_path: Path) -> None:
    """One sample per pixel is enough to see that the scene is lit and in the picture."""
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 64, 36, 100
    scene.cycles.samples, scene.cycles.use_denoising = 1, False
    scene.render.filepath = str(tmp_path / "tiny.png")
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(scene.render.filepath)
    values = np.array(image.pixels[:]).reshape(36, 64, 4)[..., :3]
    assert 0.15 < values.mean() < 0.85
    assert values.std() > 0.05
