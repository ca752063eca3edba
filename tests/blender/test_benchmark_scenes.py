# SPDX-License-Identifier: GPL-3.0-or-later
"""The scenes of the ablation need what they say they need, and are the same whenever they are built."""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path
from types import ModuleType

import bpy
import numpy as np
import pytest

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "scenes.py"


@pytest.fixture(scope="module")
def scenes() -> ModuleType:
    """The build script; importing it builds nothing."""
    spec = importlib.util.spec_from_file_location("benchmark_scenes", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def snapshot() -> dict[str, np.ndarray]:
    """Where every object is at frame 7, and the pixels of every picture."""
    bpy.context.scene.frame_set(7)
    things = {thing.name: np.array(thing.matrix_world) for thing in bpy.data.objects}
    for image in bpy.data.images:
        pixels = np.empty(len(image.pixels), np.float32)
        image.pixels.foreach_get(pixels)
        things[f"image {image.name}"] = pixels
    return things


@pytest.mark.parametrize("name", ["box", "vista", "glaze"])
def test_the_same_script_gives_the_same_scene(scenes: ModuleType, name: str) -> None:
    scenes.SCENES[name]()
    first = snapshot()
    scenes.SCENES[name]()
    second = snapshot()
    assert first.keys() == second.keys()
    assert all(np.array_equal(first[key], second[key]) for key in first)
    assert "Holoreel Target" in first
    assert bpy.context.scene.camera is not None


def test_the_crate_turns_and_stays_where_it_is(scenes: ModuleType) -> None:
    scenes.build_box()
    places = []
    for frame in (1, 13):
        bpy.context.scene.frame_set(frame)
        places.append(np.array(bpy.data.objects["Spinner"].matrix_world))
    turn = places[0][:3, :3].T @ places[1][:3, :3]
    assert math.degrees(math.acos((np.trace(turn) - 1) / 2)) == pytest.approx(135, abs=0.1)
    np.testing.assert_allclose(places[0][:3, 3], places[1][:3, 3], atol=1e-6)


def test_nothing_stands_between_the_terrace_and_the_mountains(scenes: ModuleType) -> None:
    scenes.build_vista()
    far = bpy.data.objects["Far mountains"]
    assert min(np.hypot(*(far.matrix_world @ v.co).xy) for v in far.data.vertices) > 149
    for thing in (thing for thing in bpy.data.objects if thing.type == "MESH" and thing is not far):
        assert max((thing.matrix_world @ v.co).length for v in thing.data.vertices) < 7


def test_the_light_changes(scenes: ModuleType) -> None:
    scenes.build_glaze()
    strengths = []
    for frame in (1, 12):
        bpy.context.scene.frame_set(frame)
        graph = bpy.context.evaluated_depsgraph_get()
        strengths.append([bpy.data.objects[name].evaluated_get(graph).data.energy for name in ("Sun", "Blue lamp")])
    assert strengths[0] == pytest.approx([4.2, 0.0])
    assert strengths[1] == pytest.approx([0.4, 600.0], rel=1e-5)
