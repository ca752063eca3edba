# SPDX-License-Identifier: GPL-3.0-or-later
"""Splats that face a viewport's own view: the same geometry as facing a camera that stands there."""

from collections.abc import Callable
from types import SimpleNamespace

import bpy
import holoreel
import numpy as np
import pytest
from holoreel.addon import compat, reels, viewport
from holoreel.addon.nodes.show import HULL, POINTS, SPLATS
from holoreel.tests.blender.test_looks import make_camera, resize, show, wide_model
from mathutils import Euler, Matrix
from numpy.typing import NDArray

PLACE = Matrix.LocRotScale((0.4, -0.3, -1.0), Euler((0.2, 2.9, 0.1)), None)
WIDTH, HEIGHT = 96, 64  # of the scene's pictures
REGION = 240, 160  # of the viewport


@pytest.fixture
def reel() -> bpy.types.Object:
    """Splats that face the active camera, which stands elsewhere."""
    resize(WIDTH, HEIGHT)
    make_camera()
    return show(wide_model(), 0.4)


def geometry(reel: bpy.types.Object) -> bpy.types.GeometrySet:
    """Return what a viewport shows of a reel."""
    bpy.context.view_layer.update()
    return reel.evaluated_get(bpy.context.evaluated_depsgraph_get()).evaluated_geometry()


def corners(reel: bpy.types.Object) -> NDArray[np.float32]:
    """Return the corners of the splats, in their order."""
    shown = geometry(reel)
    places = np.empty(len(shown.mesh.vertices) * 3, np.float32)
    shown.mesh.vertices.foreach_get("co", places)
    return places.reshape(-1, 3)


def seen_from(camera: bpy.types.Object, is_plain: bool = False) -> viewport.Looking:
    """Return what a viewport shows that stands and looks like a camera of its own format."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    window = camera.calc_matrix_camera(depsgraph, x=REGION[0], y=REGION[1])
    view = camera.matrix_world.inverted()
    rows = (tuple(value for row in matrix for value in row) for matrix in (view, window))
    return viewport.Looking(*rows, REGION[0], camera.data.type == "PERSP", is_plain)


@pytest.mark.parametrize("kind", ["PERSP", "ORTHO"])
def test_splats_face_the_viewport(kind: str, reel: bpy.types.Object) -> None:
    facing_camera = corners(reel)
    active, other = bpy.context.scene.camera, make_camera(lens=40.0)
    other.data.type, other.data.ortho_scale, other.matrix_world = kind, 5.0, PLACE
    bpy.context.view_layer.update()
    looking = seen_from(other)
    # Pictures as large as the viewport, through the second camera, must look the same.
    resize(*REGION)
    if kind == "ORTHO":
        other.matrix_world = PLACE @ Matrix.Translation((0, 0, viewport.BEHIND))
    truth = corners(reel)
    resize(WIDTH, HEIGHT)
    bpy.context.scene.camera = active
    np.testing.assert_array_equal(corners(reel), facing_camera)

    assert viewport.face(bpy.context.scene, looking)
    shown = corners(reel)
    assert shown.shape == truth.shape != facing_camera.shape
    np.testing.assert_allclose(shown, truth, atol=2e-3 if kind == "ORTHO" else 2e-4)

    compat.set_input(reels.modifier_of(reel), "Follow View", False)
    np.testing.assert_array_equal(corners(reel), facing_camera)
    compat.set_input(reels.modifier_of(reel), "Follow View", True)
    assert viewport.face(bpy.context.scene, viewport.Looking((), (), 0, True, False))
    np.testing.assert_array_equal(corners(reel), facing_camera)
    assert [o.name for o in bpy.context.scene.objects if o.type == "CAMERA"] == ["camera", "camera.001"]


def test_renders_face_the_camera_all_the_same(reel: bpy.types.Object, render: Callable[[], NDArray]) -> None:
    bpy.context.scene.render.engine = "CYCLES"
    bpy.context.scene.cycles.samples = 1
    before = render()
    other = make_camera()
    other.matrix_world = PLACE
    bpy.context.view_layer.update()
    viewport.face(bpy.context.scene, seen_from(other, is_plain=True))
    bpy.context.scene.camera = bpy.data.objects["camera"]
    np.testing.assert_allclose(render(), before, atol=1e-6)


@pytest.mark.parametrize("look", [SPLATS, HULL, POINTS])
def test_solid_shading_shows_points(look: str, reel: bpy.types.Object) -> None:
    compat.set_input(reels.modifier_of(reel), "Look", look)
    for is_plain in (True, False, True):
        viewport.face(bpy.context.scene, viewport.Looking((), (), 0, True, is_plain))
        shown = geometry(reel)
        as_points = shown.pointcloud is not None and len(shown.pointcloud.points) > 0
        assert as_points == (is_plain or look == POINTS)


@pytest.mark.usefixtures("gpu")
@pytest.mark.parametrize("look", [SPLATS, HULL])
def test_workbench_renders_points(look: str, reel: bpy.types.Object, render: Callable[[], NDArray]) -> None:
    resize(24, 16)
    bpy.context.scene.render.engine = "BLENDER_WORKBENCH"
    pictures = []
    for shown in (look, POINTS):
        compat.set_input(reels.modifier_of(reel), "Look", shown)
        pictures.append(render())
    np.testing.assert_allclose(*pictures, atol=0.02)
    assert pictures[0].std() > 0.01


def test_without_a_camera_points_are_shown(reel: bpy.types.Object) -> None:
    bpy.data.objects.remove(bpy.context.scene.camera)
    assert len(geometry(reel).pointcloud.points) > 0


def test_only_changed_views_are_faced(reel: bpy.types.Object, monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing writes nothing; the timer does, once for each change, and less where no reel shows splats."""
    views = [viewport.Looking((), (), width, True, False) for width in (1, 1, 2, 2, 3, 1)]
    turned = viewport.Looking((1.0,), (2.0,), 9, True, True)
    drawn, faced = iter([*views, turned, turned, views[0]]), []
    context = SimpleNamespace(
        region=SimpleNamespace(as_pointer=lambda: 7),
        region_data=object(),
        space_data=None,
        scene=bpy.context.scene,
        view_layer=bpy.context.view_layer,
    )
    app = SimpleNamespace(timers=SimpleNamespace(is_registered=lambda _: True))
    monkeypatch.setattr(viewport, "face", lambda _scene, seen: faced.append(seen))
    monkeypatch.setattr(viewport, "looking", lambda *_: next(drawn))
    monkeypatch.setattr(viewport, "bpy", SimpleNamespace(context=context, data=bpy.data, app=app))
    for _ in views:
        viewport._drawn()
        viewport._follow()
    assert [seen.width_px for seen in faced] == [1, 2, 3, 1]
    for look, expected in ((HULL, viewport.Looking((), (), 9, True, True)), (POINTS, None)):
        faced.clear()
        compat.set_input(reels.modifier_of(reel), "Look", look)
        viewport._drawn()
        viewport._follow()
        viewport._forget()
        assert faced == ([expected] if expected else [])


def test_registering_watches_and_unregistering_stops() -> None:
    before = [len(getattr(bpy.app.handlers, name)) for name in viewport._FORGETTING]
    for _ in range(2):
        holoreel.register()
        assert viewport._handle is not None
        holoreel.unregister()
        assert viewport._handle is None
    assert [len(getattr(bpy.app.handlers, name)) for name in viewport._FORGETTING] == before
