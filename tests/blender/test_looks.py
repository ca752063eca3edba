# SPDX-License-Identifier: GPL-3.0-or-later
"""The looks against an independent rasterizer in numpy."""

from collections.abc import Callable

import bpy
import numpy as np
import pytest
from holoreel.addon import compat, reels
from holoreel.addon.exact import setup_exact_render
from holoreel.addon.nodes.reel import DISPLAY
from holoreel.addon.timeline import Timeline
from holoreel.core.gaussians.model import SpacetimeGaussians
from holoreel.tests.blender import oracle
from mathutils import Euler, Matrix
from numpy.typing import NDArray

TIME_FRAMES = 10  # frames of the test's reels


def make_camera(
    lens: float = 30.0,
    sensor: tuple[float, float] = (36.0, 24.0),
    fit: str = "AUTO",
    shift: tuple[float, float] = (0, 0),
) -> bpy.types.Object:
    """Add the active camera: at the origin, looking along +z with y down, as OpenCV's."""
    data = bpy.data.cameras.new("camera")
    data.lens, (data.sensor_width, data.sensor_height), data.sensor_fit = lens, sensor, fit
    data.shift_x, data.shift_y = shift
    camera = bpy.data.objects.new("camera", data)
    bpy.context.scene.collection.objects.link(camera)
    camera.matrix_world = Matrix.Diagonal((1, -1, -1, 1))
    bpy.context.scene.camera = camera
    return camera


def view_of(camera: bpy.types.Object) -> oracle.View:
    """Calculate the pinhole camera that Blender renders with, from its definition of lens, sensor fit and shift."""
    render, data = bpy.context.scene.render, camera.data
    width, height = render.resolution_x, render.resolution_y
    aspect = render.pixel_aspect_y / render.pixel_aspect_x
    horizontal = data.sensor_fit == "HORIZONTAL" or (data.sensor_fit == "AUTO" and width >= height * aspect)
    side = width if horizontal else height * aspect
    sensor = data.sensor_height if data.sensor_fit == "VERTICAL" else data.sensor_width
    focal = data.lens / sensor * side
    pose = np.array(camera.matrix_world.normalized()) @ np.diag([1.0, -1.0, -1.0, 1.0])
    return oracle.View(
        width,
        height,
        focal,
        focal / aspect,
        width / 2 - data.shift_x * side,
        height / 2 + data.shift_y * side / aspect,
        np.linalg.inv(pose),
    )


def show(model: SpacetimeGaussians, time: float, look: str = "Splats") -> bpy.types.Object:
    """Put a model into the scene, stopped at a time."""
    stopped = Timeline(TIME_FRAMES, speed=0.0, offset=time * TIME_FRAMES, repeat="Loop")
    reel = reels.create_reel_object(bpy.context, "reel", model, stopped)
    compat.set_input(reels.modifier_of(reel), "Look", look)
    return reel


def resize(width: int, height: int, pixel_aspect: tuple[float, float] = (1.0, 1.0)) -> None:
    """Set the size of the picture."""
    render = bpy.context.scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
    render.pixel_aspect_x, render.pixel_aspect_y = pixel_aspect


def wide_model(count: int = 150, seed: int = 3) -> SpacetimeGaussians:
    """Return Gaussians in and far around the frame, some behind the camera, some nearly touching it, some thin."""
    random = np.random.default_rng(seed)
    means = random.uniform([-4, -3, -1], [4, 3, 5], (count, 3))
    return SpacetimeGaussians(
        means=means,
        motions=random.normal(0, 0.1, (count, 3, 3)),
        quats=random.normal(size=(count, 4)),
        omegas=random.normal(0, 0.5, (count, 4)),
        log_scales=np.log(random.uniform(0.01, 0.4, (count, 3))),
        opacity_logits=random.normal(1, 2, count),
        features=random.random((count, 3)),
        trbf_centers=random.random(count),
        trbf_log_scales=random.uniform(-1, 2, count),
    )


CAMERAS = {
    "plain": ({}, (96, 64), (1.0, 1.0)),
    "wide angle": ({"lens": 12.0}, (96, 64), (1.0, 1.0)),
    "shifted": ({"shift": (0.3, -0.2)}, (96, 64), (1.0, 1.0)),
    "upright": ({}, (64, 96), (1.0, 1.0)),
    "fit to height": ({"fit": "VERTICAL", "shift": (0.1, 0.1)}, (96, 64), (1.0, 1.0)),
    "fit to width, upright": ({"fit": "HORIZONTAL"}, (64, 96), (1.0, 1.0)),
    "wide pixels": ({}, (64, 96), (2.0, 1.0)),
}


def render_exactly(render: Callable[[], NDArray], engine: str = "CYCLES") -> NDArray:
    """Set the scene up and render it."""
    bpy.context.scene.render.engine = engine
    setup_exact_render(bpy.context.scene)
    return render()


@pytest.mark.parametrize("name", CAMERAS)
def test_splats_in_cycles_are_ewa_splatting(name: str, render: Callable[[], NDArray]) -> None:
    settings, size, pixel_aspect = CAMERAS[name]
    resize(*size, pixel_aspect)
    camera = make_camera(**settings)
    model = wide_model()
    show(model, 0.35)
    truth = oracle.splat(model.evaluate(0.35), view_of(camera))
    assert truth[..., 3].mean() > 0.3
    assert oracle.psnr(render_exactly(render), truth) >= 60


def test_splats_follow_resolution_percentage_and_render_frame(render: Callable[[], NDArray]) -> None:
    camera = make_camera()
    model = wide_model()
    show(model, 0.2)
    resize(200, 140)
    bpy.context.scene.render.resolution_percentage = 40
    picture = render_exactly(render)
    resize(80, 56)
    assert oracle.psnr(picture, oracle.splat(model.evaluate(0.2), view_of(camera))) >= 60


def test_colors_beyond_the_display_pass_through(render: Callable[[], NDArray]) -> None:
    resize(64, 48)
    camera = make_camera()
    model = wide_model()
    model.features[:] = 1.8 * model.features - 0.4
    show(model, 0.5)
    truth = oracle.splat(model.evaluate(0.5), view_of(camera))
    assert truth[..., :3].min() < -0.05
    assert truth[..., :3].max() > 1.05
    assert oracle.psnr(render_exactly(render), truth) >= 60


SHEAR = np.array([[1.0, 0.4, 0.0], [0.0, 1.0, -0.2], [0.1, 0.0, 1.0]])
TRANSFORMS = {
    "scaled": np.eye(3) * 2.5,
    "scaled along axes": np.diag([2.0, 0.7, 1.3]),
    "sheared": SHEAR,
    "mirrored and sheared": np.diag([-1.0, 1.5, 1.0]) @ SHEAR,
}


def place(reel: bpy.types.Object, name: str) -> NDArray[np.float64]:
    """Move and turn a reel after one of the transforms above; return its matrix."""
    turned = Matrix.LocRotScale((0.4, -0.3, 2.0), Euler((0.3, -0.2, 0.5)), None)
    linear = np.eye(4)
    linear[:3, :3] = TRANSFORMS[name]
    world = np.array(turned) @ linear
    reel.parent = bpy.data.objects.new("placed", None)
    reel.matrix_parent_inverse = Matrix(world.tolist())  # an object's own channels know no shear
    bpy.context.scene.collection.objects.link(reel.parent)
    return world


@pytest.mark.parametrize("name", TRANSFORMS)
def test_splats_can_be_placed_by_any_transform(name: str, render: Callable[[], NDArray]) -> None:
    resize(96, 64)
    camera = make_camera(shift=(0.1, 0.0))
    model = wide_model()
    world = place(show(model, 0.6), name)
    camera.parent = bpy.data.objects.new("parent", None)
    bpy.context.scene.collection.objects.link(camera.parent)
    camera.parent.scale = (3.0, 3.0, 3.0)
    camera.parent.rotation_euler = (0.0, 0.1, 0.2)
    bpy.context.view_layer.update()
    truth = oracle.splat(model.evaluate(0.6), view_of(camera), world=world)
    assert truth[..., 3].mean() > 0.3
    assert oracle.psnr(render_exactly(render), truth) >= 60


def test_splats_follow_the_active_camera(render: Callable[[], NDArray]) -> None:
    resize(64, 48)
    make_camera()
    model = wide_model()
    show(model, 0.5)
    render_exactly(render)
    second = make_camera(lens=50.0)
    second.location = (0.5, 0.2, -1.0)
    bpy.context.view_layer.update()
    truth = oracle.splat(model.evaluate(0.5), view_of(second))
    assert oracle.psnr(render_exactly(render), truth) >= 60


def test_orthographic_splats_are_projected_covariances(render: Callable[[], NDArray]) -> None:
    """From far away with a long lens, perspective is orthographic."""
    resize(64, 48)
    camera = make_camera()
    model = wide_model()
    model.means[:, 2] = np.abs(model.means[:, 2]) + 1.0
    show(model, 0.5)
    camera.data.type, camera.data.ortho_scale = "ORTHO", 6.0
    picture = render_exactly(render)
    far = 1e4
    pose = np.eye(4)
    pose[2, 3] = far
    focal = far * 64 / 6.0
    truth = oracle.splat(model.evaluate(0.5), oracle.View(64, 48, focal, focal, 32, 24, pose))
    assert oracle.psnr(picture, truth) >= 45


@pytest.mark.parametrize("engine", ["CYCLES"])
def test_points_show_their_colors(engine: str, render: Callable[[], NDArray]) -> None:
    resize(64, 48)
    make_camera()
    model = wide_model(5)
    model.means[:] = [[0, 0, 2], [-0.8, 0, 2], [0.8, 0, 2], [0, 0.5, 2], [0, -0.5, 2]]
    model.motions[:] = 0
    model.log_scales[:] = np.log(0.05)
    model.opacity_logits[:] = [9, 9, 9, 9, -3]
    model.trbf_log_scales[:] = 16
    camera = bpy.context.scene.camera
    show(model, 0.5, "Points")
    picture = render_exactly(render, engine)
    view = view_of(camera)
    for index, mean in enumerate(model.means):
        column, row = int(view.fx * mean[0] / mean[2] + view.cx), int(view.fy * mean[1] / mean[2] + view.cy)
        expected = [*model.features[index], 1.0] if index < 4 else [0.0] * 4  # the last is too faint
        np.testing.assert_allclose(picture[row, column], expected, atol=1e-5)


@pytest.mark.slow
@pytest.mark.usefixtures("gpu")
@pytest.mark.parametrize("name", ["plain", "shifted"])
def test_splats_in_eevee_are_ewa_splatting(name: str, render: Callable[[], NDArray]) -> None:
    settings, size, pixel_aspect = CAMERAS[name]
    resize(*size, pixel_aspect)
    camera = make_camera(**settings)
    model = wide_model()
    show(model, 0.35)
    picture = render_exactly(render, compat.eevee_engine())
    assert oracle.psnr(picture, oracle.splat(model.evaluate(0.35), view_of(camera))) >= 45


def test_exact_set_up_keeps_the_engine_and_says_what_it_means() -> None:
    make_camera()
    reel = show(wide_model(), 0.5)
    scene = bpy.context.scene
    for engine, after in (("CYCLES", "CYCLES"), (compat.eevee_engine(),) * 2, ("BLENDER_WORKBENCH", "CYCLES")):
        scene.render.engine = engine
        setup_exact_render(scene)
        assert scene.render.engine == after
    assert scene.view_settings.view_transform == "Raw"
    assert compat.get_input(reels.modifier_of(reel), "Color") == DISPLAY
    assert scene.cycles.min_transparent_bounces == scene.cycles.transparent_max_bounces >= 256
