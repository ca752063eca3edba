# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's cameras against Blender's own projection, over every fit, shift, aspect, percentage and parent."""

import math
from collections.abc import Iterator

import bpy
import numpy as np
import pytest
from bpy_extras.object_utils import world_to_camera_view
from holoreel.addon.cameras import camera_from_object, camera_settings, new_camera_object, set_format
from holoreel.core.camera import Camera
from holoreel.core.camera_blender import BlenderCamera
from holoreel.core.errors import HoloreelError
from mathutils import Euler, Matrix, Vector

CASES = 240


@pytest.fixture(autouse=True)
def empty_file() -> Iterator[None]:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    yield
    bpy.ops.wm.read_factory_settings(use_empty=True)


def random_camera(rng: np.random.Generator, index: int) -> bpy.types.Object:
    """A camera object with everything at random; every third one has a scaled parent, which shears nothing."""
    scene = bpy.context.scene
    data = bpy.data.cameras.new(f"camera {index}")
    data.lens = rng.uniform(12, 60)
    data.sensor_width, data.sensor_height = rng.uniform(24, 60, 2)
    data.sensor_fit = ("AUTO", "HORIZONTAL", "VERTICAL")[index % 3]
    data.shift_x, data.shift_y = rng.uniform(-0.6, 0.6, 2)
    camera = bpy.data.objects.new(data.name, data)
    scene.collection.objects.link(camera)
    camera.location = rng.uniform(-5, 5, 3)
    camera.rotation_euler = rng.uniform(-math.pi, math.pi, 3)
    camera.scale = rng.uniform(0.2, 3, 3)
    if index % 4 == 1:  # uniform scale keeps every rotation whole
        camera.parent = parent_with_scale(rng, [rng.uniform(0.1, 4)] * 3)
    elif index % 4 == 3:  # any scale keeps quarter turns whole; two negative ones are a turn
        camera.rotation_euler = Euler(rng.integers(0, 4, 3) * (math.pi / 2))
        camera.parent = parent_with_scale(rng, rng.uniform(0.1, 4, 3) * [(1, 1, 1), (-1, -1, 1)][index % 8 // 4])
    render = scene.render
    render.resolution_x, render.resolution_y = (int(v) for v in rng.integers(40, 1000, 2))
    render.resolution_percentage = int(rng.integers(10, 200)) if index % 2 else 100
    render.pixel_aspect_x, render.pixel_aspect_y = rng.uniform(1, 2, 2) if index % 5 < 3 else (1, 1)
    bpy.context.view_layer.update()
    return camera


def parent_with_scale(rng: np.random.Generator, scale: np.ndarray | list[float]) -> bpy.types.Object:
    parent = bpy.data.objects.new("parent", None)
    bpy.context.scene.collection.objects.link(parent)
    parent.location = rng.uniform(-5, 5, 3)
    parent.rotation_euler = rng.uniform(-math.pi, math.pi, 3)
    parent.scale = scale
    return parent


def blender_pixels(camera: bpy.types.Object, points: np.ndarray) -> np.ndarray:
    """Where Blender puts points, in pixels from the top left.

    `world_to_camera_view` does not know that percentages cut the picture to whole pixels, so it gets the cut size.
    """
    scene = bpy.context.scene
    render = scene.render
    width = render.resolution_x * render.resolution_percentage // 100
    height = render.resolution_y * render.resolution_percentage // 100
    before = render.resolution_x, render.resolution_y, render.resolution_percentage
    render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
    views = np.array([world_to_camera_view(scene, camera, Vector(point)) for point in points])
    render.resolution_x, render.resolution_y, render.resolution_percentage = before
    return np.stack([views[:, 0] * width, (1 - views[:, 1]) * height], axis=1)


def points_seen(camera: Camera, rng: np.random.Generator, count: int = 12) -> np.ndarray:
    uv = rng.uniform(0, 1, (count, 2)) * (camera.width, camera.height)
    return camera.unproject(uv, rng.uniform(3, 20, count))


def test_projection_is_blenders() -> None:
    rng = np.random.default_rng(1)
    worst = 0.0
    for index in range(CASES):
        blender_camera = random_camera(rng, index)
        camera = camera_from_object(blender_camera, bpy.context.scene)
        points = points_seen(camera, rng)
        uv, z = camera.project(points)
        assert (z > 0).all()
        worst = max(worst, float(np.abs(uv - blender_pixels(blender_camera, points)).max()))
    assert worst <= 1e-3


def test_round_trip_from_camera() -> None:
    """Camera → Blender → Camera, and Blender's own projection of the object in between."""
    rng = np.random.default_rng(2)
    scene = bpy.context.scene
    for index in range(60):
        matrix = np.eye(4)
        matrix[:3, :3] = np.array(Euler(rng.uniform(-3, 3, 3)).to_matrix())
        matrix[:3, 3] = rng.uniform(-5, 5, 3)
        width, height = (int(v) for v in rng.integers(40, 1000, 2))
        focal = width * rng.uniform(0.3, 3)
        center = rng.uniform(0.2, 0.8, 2) * (width, height)
        camera = Camera(width, height, focal, focal * rng.uniform(0.6, 1.6), *center, matrix, name=f"c{index}")
        blender_camera = new_camera_object(camera, scene.collection)
        set_format(scene, camera)
        bpy.context.view_layer.update()
        back = camera_from_object(blender_camera, scene)
        assert (back.width, back.height, back.name) == (width, height, camera.name)
        points = points_seen(camera, rng)
        uv, _ = camera.project(points)
        assert np.abs(back.project(points)[0] - uv).max() <= 1e-3
        assert np.abs(blender_pixels(blender_camera, points) - uv).max() <= 1e-3


@pytest.mark.parametrize("focal", [200, 2])
def test_numbers_alone_round_trip(focal: float) -> None:
    """The shorter focal length needs a lens under Blender's 1 mm, or a larger sensor."""
    camera = Camera.look_at((3, -4, 2), (0, 0, 1), width=321, height=123, fx=focal, fy=1.2 * focal)
    settings = BlenderCamera.from_camera(camera)
    assert settings.lens >= 1
    back = settings.to_camera()
    assert np.allclose(back.K, camera.K, atol=1e-9)
    assert np.allclose(back.world_to_camera, camera.world_to_camera, atol=1e-12)


def test_animation_and_constraints_count() -> None:
    scene = bpy.context.scene
    camera = new_camera_object(Camera.look_at((0, -5, 0), (0, 0, 0), width=100, height=50, fx=100), scene.collection)
    set_format(scene, camera_from_object(camera, scene))
    camera.data.lens = 20
    camera.data.keyframe_insert("lens", frame=1)
    camera.data.lens = 40
    camera.data.keyframe_insert("lens", frame=11)
    target = bpy.data.objects.new("target", None)
    scene.collection.objects.link(target)
    target.location = (3, 0, 0)
    constraint = camera.constraints.new("TRACK_TO")
    constraint.target = target
    seen = []
    for frame in (1, 11):
        scene.frame_set(frame)
        seen.append(camera_from_object(camera, scene))
        assert np.allclose(seen[-1].project([[3, 0, 0]])[0][0], (seen[-1].cx, seen[-1].cy), atol=1e-4)
    assert math.isclose(seen[1].fx / seen[0].fx, 2, rel_tol=1e-5)


@pytest.mark.parametrize(("kind", "word"), [("ORTHO", "orthographic"), ("PANO", "panoramic")])
def test_other_projections_are_refused(kind: str, word: str) -> None:
    camera = random_camera(np.random.default_rng(0), 0)
    camera.data.type = kind
    with pytest.raises(HoloreelError, match=word):
        camera_settings(camera, bpy.context.scene)


def test_no_camera_is_refused() -> None:
    empty = bpy.data.objects.new("empty", None)
    with pytest.raises(HoloreelError, match="no camera"):
        camera_settings(empty, bpy.context.scene)


@pytest.mark.parametrize(
    ("scale", "word"),
    [((1, 1, -1), "mirrored"), ((-1, -1, -1), "mirrored"), ((1, 2, 1), "sheared"), ((0, 1, 1), "scale")],
)
def test_what_no_pinhole_can_be_is_refused(scale: tuple[float, float, float], word: str) -> None:
    camera = random_camera(np.random.default_rng(0), 0)
    camera.parent = bpy.data.objects.new("parent", None)
    bpy.context.scene.collection.objects.link(camera.parent)
    camera.parent.matrix_world = Matrix.LocRotScale(None, None, Vector(scale))
    bpy.context.view_layer.update()
    with pytest.raises(HoloreelError, match=word):
        camera_from_object(camera, bpy.context.scene)
