# SPDX-License-Identifier: GPL-3.0-or-later
"""Cropping by boxes and meshes: what stays, however reel and crop object are placed."""

from collections.abc import Callable, Iterator

import bpy
import holoreel
import numpy as np
import pytest
from holoreel.addon import attributes, compat, reels
from holoreel.addon.crop import crop_problem
from holoreel.addon.nodes.crop import KEEP, OFF, REMOVE
from holoreel.addon.nodes.show import LOOKS, POINTS
from holoreel.addon.timeline import Timeline
from holoreel.core.gaussians.model import SpacetimeGaussians
from mathutils import Euler, Matrix, Vector
from numpy.typing import NDArray

Model = Callable[..., SpacetimeGaussians]
COUNT = 400


@pytest.fixture
def registered() -> Iterator[None]:
    """Holoreel's operators, for the time of one test."""
    holoreel.register()
    yield
    holoreel.unregister()


@pytest.fixture
def reel() -> bpy.types.Object:
    """A reel of points between -2 and 2, moved, turned and scaled."""
    random = np.random.default_rng(8)
    model = SpacetimeGaussians(
        means=random.uniform(-2, 2, (COUNT, 3)),
        motions=np.zeros((COUNT, 3, 3)),
        quats=np.tile([1.0, 0, 0, 0], (COUNT, 1)),
        omegas=np.zeros((COUNT, 4)),
        log_scales=np.full((COUNT, 3), np.log(0.05)),
        opacity_logits=np.full(COUNT, 3.0),
        features=random.random((COUNT, 3)),
        trbf_centers=np.zeros(COUNT),
        trbf_log_scales=np.full(COUNT, 16.0),
    )
    created = reels.create_reel_object(bpy.context, "reel", model, Timeline(10))
    compat.set_input(reels.modifier_of(created), "Look", POINTS)
    created.matrix_world = Matrix.LocRotScale((3, 1, -2), Euler((0.4, 0.2, -1)), (1.5, 0.8, 1.1))
    bpy.context.view_layer.update()
    return created


def shown(reel: bpy.types.Object) -> NDArray[np.float32]:
    """Return the places of the points that are shown, in the reel's space."""
    geometry = reel.evaluated_get(bpy.context.evaluated_depsgraph_get()).evaluated_geometry()
    return attributes.read(geometry.pointcloud.attributes, "position")


def inside(reel: bpy.types.Object, crop: bpy.types.Object, test: Callable[[NDArray], NDArray]) -> NDArray[np.bool_]:
    """Return which of the reel's points pass a test on their place in the crop object's space."""
    bpy.context.view_layer.update()
    places = attributes.read(reel.data.attributes, "position")
    matrix = np.array(crop.matrix_world.inverted() @ reel.matrix_world)
    return test(places @ matrix[:3, :3].T + matrix[:3, 3])


def assert_cropped(reel: bpy.types.Object, crop: bpy.types.Object, test: Callable[[NDArray], NDArray]) -> None:
    """Compare all modes with a test of what is inside."""
    modifier = reels.modifier_of(reel)
    compat.set_input(modifier, "Crop Object", crop)
    places, kept = attributes.read(reel.data.attributes, "position"), inside(reel, crop, test)
    assert 20 < kept.sum() < COUNT - 20
    for mode, expected in ((OFF, places), (KEEP, places[kept]), (REMOVE, places[~kept])):
        compat.set_input(modifier, "Crop", mode)
        found = shown(reel)
        assert len(found) == len(expected), mode
        np.testing.assert_array_equal(found[np.lexsort(found.T)], expected[np.lexsort(expected.T)])


PLACES = {
    "upright": Matrix.LocRotScale((3, 1, -2), None, (1.5, 0.8, 1.2)),
    "turned and mirrored": Matrix.LocRotScale((3.3, 1, -2), Euler((1, 2, 3)), (-1.5, 1.0, 1.2)),
}


def box_test(local: NDArray) -> NDArray:
    """Whether points lie in the box from -1 to 1."""
    return (np.abs(local) <= 1).all(axis=1)


@pytest.mark.parametrize("name", PLACES)
def test_box_of_an_empty(name: str, reel: bpy.types.Object) -> None:
    empty = bpy.data.objects.new("box", None)
    bpy.context.scene.collection.objects.link(empty)
    empty.matrix_world = PLACES[name]
    assert_cropped(reel, empty, box_test)


@pytest.mark.parametrize("name", PLACES)
def test_mesh_that_is_not_convex(name: str, reel: bpy.types.Object) -> None:
    """An L of three cubes, extruded, against its own inequalities."""
    outline = [(-1, -1), (1, -1), (1, 0), (0, 0), (0, 1), (-1, 1)]
    corners = [(x, y, z) for z in (-1, 1) for x, y in outline]
    sides = [(i, (i + 1) % 6, (i + 1) % 6 + 6, i + 6) for i in range(6)]
    mesh = bpy.data.meshes.new("corner")
    mesh.from_pydata(corners, [], [tuple(range(5, -1, -1)), tuple(range(6, 12)), *sides])
    crop = bpy.data.objects.new("corner", mesh)
    bpy.context.scene.collection.objects.link(crop)
    crop.matrix_world = PLACES[name]

    def in_corner(local: NDArray) -> NDArray:
        return box_test(local) & ~((local[:, 0] > 0) & (local[:, 1] > 0))

    assert_cropped(reel, crop, in_corner)


def test_crop_without_object_shows_everything(reel: bpy.types.Object) -> None:
    compat.set_input(reels.modifier_of(reel), "Crop", KEEP)
    assert len(shown(reel)) == COUNT
    assert "Choose a crop object" in crop_problem(reel)


def test_crop_follows_its_object(reel: bpy.types.Object) -> None:
    """Keyed or constrained: nothing needs to be told."""
    empty = bpy.data.objects.new("box", None)
    bpy.context.scene.collection.objects.link(empty)
    modifier = reels.modifier_of(reel)
    compat.set_input(modifier, "Crop Object", empty)
    compat.set_input(modifier, "Crop", KEEP)
    counts = []
    for frame, x in ((1, 3.0), (10, 4.5)):
        empty.location = (x, 1, -2)
        empty.keyframe_insert("location", frame=frame)
    for frame in (1, 10):
        bpy.context.scene.frame_set(frame)
        assert len(shown(reel)) == inside(reel, empty, box_test).sum() > 5
        counts.append(len(shown(reel)))
    assert counts[0] != counts[1]


@pytest.mark.parametrize("look", LOOKS)
def test_every_look_is_cropped(look: str, reel: bpy.types.Object) -> None:
    data = bpy.data.cameras.new("camera")
    camera = bpy.data.objects.new("camera", data)
    camera.location = (3, 1, 20)
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    empty = bpy.data.objects.new("box", None)
    empty.matrix_world = PLACES["upright"]
    bpy.context.scene.collection.objects.link(empty)
    modifier = reels.modifier_of(reel)
    for name, value in (("Look", look), ("Crop Object", empty), ("Crop", KEEP)):
        compat.set_input(modifier, name, value)
    bpy.context.view_layer.update()
    geometry = reel.evaluated_get(bpy.context.evaluated_depsgraph_get()).evaluated_geometry()
    instances = geometry.instances_pointcloud()
    counts = {
        "Points": lambda: len(geometry.pointcloud.points),
        "Splats": lambda: len(geometry.mesh.polygons),
        "Hull": lambda: len(instances.points),
    }
    assert counts[look]() == inside(reel, empty, box_test).sum() > 20


@pytest.mark.usefixtures("registered")
def test_operator_adds_a_box_that_moves_with_the_reel(reel: bpy.types.Object) -> None:
    with pytest.raises(RuntimeError, match="poll"):
        bpy.ops.holoreel.add_crop_box()
    bpy.context.view_layer.objects.active = reel
    assert bpy.ops.holoreel.add_crop_box(mode=REMOVE) == {"FINISHED"}
    (box,) = bpy.context.selected_objects
    assert (box.parent, box.empty_display_type) == (reel, "CUBE")
    assert compat.get_input(reels.modifier_of(reel), "Crop Object") == box
    kept = len(shown(reel))
    assert kept == COUNT - inside(reel, box, box_test).sum()
    assert 0.2 < kept / COUNT < 0.4  # about 1 - 0.9³
    assert crop_problem(reel) == ""
    box.empty_display_size = 2.0
    assert "size 1" in crop_problem(reel)
    reel.matrix_world = Matrix.Translation(Vector((5, 5, 5)))
    bpy.context.view_layer.update()
    assert len(shown(reel)) == kept
    bpy.data.objects.remove(box)
    assert len(shown(reel)) == COUNT
