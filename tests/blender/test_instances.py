# SPDX-License-Identifier: GPL-3.0-or-later
"""Duplicates and instances of reels, as splats."""

from collections.abc import Callable, Iterator

import bpy
import holoreel
import numpy as np
import pytest
from holoreel.addon import compat, reels
from holoreel.tests.blender import oracle
from holoreel.tests.blender.test_looks import make_camera, render_exactly, resize, show, view_of, wide_model
from mathutils import Euler, Matrix
from numpy.typing import NDArray

Render = Callable[[], NDArray]
PLACE = Matrix.LocRotScale((0.5, 0.0, 2.0), Euler((0.3, 0.2, 0.1)), (1.2, 0.7, 1.0))
INNER = Matrix.LocRotScale((0.0, 0.3, 0.0), Euler((0.0, 0.5, 0.4)), (1.0, 1.3, 0.8))


@pytest.fixture
def registered() -> Iterator[None]:
    """Holoreel's operators, for the time of one test."""
    holoreel.register()
    yield
    holoreel.unregister()


def instance(collection: bpy.types.Collection, holder: bpy.types.Collection, matrix: Matrix) -> bpy.types.Object:
    """Add an Empty that instances a collection."""
    empty = bpy.data.objects.new("instance", None)
    empty.instance_type, empty.instance_collection, empty.matrix_world = "COLLECTION", collection, matrix
    holder.objects.link(empty)
    return empty


@pytest.mark.usefixtures("registered")
@pytest.mark.parametrize("nested", [False, True])
def test_instances_made_real_are_ewa_splatting(nested: bool, render: Render) -> None:
    """Placed by the instance alone, or by an instance in an instance, which shears."""
    resize(96, 64)
    camera = make_camera()
    model = wide_model()
    played = show(model, 0.4)
    inner, outer = (bpy.data.collections.new(name) for name in ("inner", "outer"))
    bpy.context.scene.collection.objects.unlink(played)
    inner.objects.link(played)
    if nested:
        instance(inner, outer, INNER)
    empty = instance(outer if nested else inner, bpy.context.scene.collection, PLACE)
    bpy.context.view_layer.update()
    empty.select_set(True)
    assert bpy.ops.holoreel.make_reels_real() == {"FINISHED"}
    (real,) = (chosen for chosen in bpy.context.selected_objects if chosen != empty)
    assert (real.data, real.parent, empty.instance_type) == (played.data, empty, "NONE")
    bpy.context.view_layer.update()
    world = np.array(PLACE @ INNER if nested else PLACE)
    np.testing.assert_allclose(np.array(real.matrix_world), world, atol=1e-6)
    assert compat.get_input(reels.modifier_of(real), "Render Width") == 96  # drivers came along
    truth = oracle.splat(model.evaluate(0.4), view_of(camera), world=world)
    assert truth[..., 3].mean() > 0.3
    assert oracle.psnr(render_exactly(render), truth) >= 60


@pytest.mark.parametrize("linked", [True, False])
def test_duplicates_face_the_camera_each_for_itself(linked: bool, render: Render) -> None:
    """A duplicate elsewhere, the original out of sight."""
    resize(96, 64)
    camera = make_camera()
    model = wide_model()
    played = show(model, 0.4)
    played.select_set(True)
    bpy.context.view_layer.objects.active = played
    bpy.ops.object.duplicate(linked=linked)
    (copy,) = bpy.context.selected_objects
    assert (copy.data == played.data) == linked
    copy.matrix_world = PLACE
    played.hide_render = True
    bpy.context.view_layer.update()
    truth = oracle.splat(model.evaluate(0.4), view_of(camera), world=np.array(PLACE))
    assert oracle.psnr(render_exactly(render), truth) >= 60


@pytest.mark.usefixtures("registered")
def test_nothing_to_make_real_is_said() -> None:
    empty = instance(bpy.data.collections.new("nothing"), bpy.context.scene.collection, PLACE)
    with pytest.raises(RuntimeError, match="poll"):
        bpy.ops.holoreel.make_reels_real()
    empty.select_set(True)
    assert bpy.ops.holoreel.make_reels_real() == {"CANCELLED"}
    assert empty.instance_type == "COLLECTION"
