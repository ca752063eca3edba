# SPDX-License-Identifier: GPL-3.0-or-later
"""The looks against an independent rasterizer in numpy."""

from collections.abc import Callable

import bpy
import numpy as np
import pytest
from holoreel.addon import compat, reels
from holoreel.addon.exact import setup_exact_render
from holoreel.addon.timeline import Timeline
from holoreel.core.gaussians.model import SpacetimeGaussians
from holoreel.tests.blender import oracle
from mathutils import Matrix
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


@pytest.mark.parametrize("name", CAMERAS)
def test_splats_in_cycles_are_ewa_splatting(name: str, render: Callable[[], NDArray]) -> None:
    settings, size, pixel_aspect = CAMERAS[name]
    resize(*size, pixel_aspect)
    camera = make_camera(**settings)
    model = wide_model()
    show(model, 0.35)
    setup_exact_render(bpy.context.scene)
    bpy.context.scene.render.engine = "CYCLES"
    truth = oracle.splat(model.evaluate(0.35), view_of(camera))
    picture = render()
    assert truth[..., 3].mean() > 0.3
    assert oracle.psnr(picture, truth) >= 60
