# SPDX-License-Identifier: GPL-3.0-or-later
"""The look Hull: whatever ray meets it, against rays followed in numpy."""

from collections.abc import Callable

import bpy
import numpy as np
import pytest
from holoreel.addon import compat, reels
from holoreel.addon.exact import setup_exact_render
from holoreel.core.gaussians.model import SpacetimeGaussians
from holoreel.tests.blender import oracle
from holoreel.tests.blender.test_looks import TRANSFORMS, make_camera, place, render_exactly, resize, show, wide_model
from mathutils import Euler, Matrix
from numpy.typing import NDArray

Render = Callable[[], NDArray]
Rays = tuple[NDArray[np.float64], NDArray[np.float64]]


def sparse_model(count: int = 120, seed: int = 3) -> SpacetimeGaussians:
    """Return Gaussians all around the origin, few of which overlap."""
    model = wide_model(count, seed)
    random = np.random.default_rng(seed)
    directions = random.normal(size=(count, 3))
    model.means[:] = directions / np.linalg.norm(directions, axis=1, keepdims=True) * random.uniform(2, 4, (count, 1))
    model.log_scales[:] = np.log(random.uniform(0.05, 0.3, (count, 3)))
    return model


def show_hulls(model: SpacetimeGaussians, low_pass: float = 0.0) -> bpy.types.Object:
    """Put a model into the scene at the time 0.4, as it is unless there is a low-pass."""
    played = show(model, 0.4, "Hull")
    compat.set_input(reels.modifier_of(played), "Low Pass", low_pass)
    return played


def pixels(width: int, height: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the centers of all pixels, counted from the middle of the picture, x to the right and y up."""
    y, x = np.mgrid[:height, :width] + 0.5
    return (x - width / 2).ravel(), (height / 2 - y).ravel()


def pinhole_rays(camera: bpy.types.Object, width: int, height: int, lens: float, sensor: float = 36.0) -> Rays:
    """Return what a perspective camera, wider than high, casts through its pixels."""
    x, y = pixels(width, height)
    focal = lens / sensor * width
    return cast(camera.matrix_world, np.stack([x / focal, y / focal, -np.ones_like(x)], axis=1))


def fisheye_rays(camera: bpy.types.Object, size: int, field: float) -> tuple[Rays, NDArray[np.bool_]]:
    """Return what an equidistant fisheye casts, and the pixels inside its circle: the angle grows as the radius."""
    x, y = pixels(size, size)
    radius = np.hypot(x, y)
    angle = radius / size * field
    sine = np.sin(angle) / radius
    return cast(camera.matrix_world, np.stack([sine * x, sine * y, -np.cos(angle)], axis=1)), radius < size / 2 - 1


def cast(matrix: Matrix, directions: NDArray[np.float64]) -> Rays:
    """Return origins and unit directions in the world."""
    world = np.array(matrix.normalized())
    turned = directions @ world[:3, :3].T
    return np.tile(world[:3, 3], (len(turned), 1)), turned / np.linalg.norm(turned, axis=1, keepdims=True)


def assert_seen(picture: NDArray, truth: NDArray, shape: tuple[int, int], colors: float = 30.0) -> None:
    """Alpha knows no order; colors may differ where Gaussians overlap, because hulls are ordered by their far sides."""
    truth = truth.reshape(*shape, 4)
    assert truth[..., 3].mean() > 0.03
    assert oracle.psnr(picture[..., 3], truth[..., 3]) >= 60
    assert oracle.psnr(picture[..., :3], truth[..., :3]) >= colors


@pytest.mark.parametrize("name", TRANSFORMS)
def test_hulls_can_be_placed_by_any_transform(name: str, render: Render) -> None:
    resize(96, 64)
    camera = make_camera()
    model = sparse_model()
    world = place(show_hulls(model), name)
    bpy.context.view_layer.update()
    truth = oracle.trace(model.evaluate(0.4), *pinhole_rays(camera, 96, 64, 30.0), world)
    assert_seen(render_exactly(render), truth, (64, 96))


@pytest.mark.parametrize("low_pass", [0.0, 0.3, 2.0])
def test_hulls_under_a_fisheye(low_pass: float, render: Render) -> None:
    """With the low-pass, Gaussians are wider by what a pixel is at their distance."""
    size, field = 80, np.radians(180)
    resize(size, size)
    camera = make_camera()
    camera.data.type, camera.data.panorama_type, camera.data.fisheye_fov = "PANO", "FISHEYE_EQUIDISTANT", field
    model = sparse_model()
    show_hulls(model, low_pass)
    bpy.context.view_layer.update()
    picture = render_exactly(render)
    rays, inside = fisheye_rays(camera, size, field)
    shown = model.evaluate(0.4)
    pixel = np.linalg.norm(shown.means, axis=1, keepdims=True) * field / size
    shown.scales = np.sqrt(shown.scales**2 + low_pass * pixel**2)
    truth = oracle.trace(shown, *rays)
    truth[~inside] = 0.0
    assert_seen(picture * inside.reshape(size, size, 1), truth, (size, size))


def mirror_plane(height: float, size: float, name: str = "plane") -> bpy.types.Object:
    """Add a square that faces up, at a height."""
    corners = [(-size, -size, height), (size, -size, height), (size, size, height), (-size, size, height)]
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(corners, [], [(0, 1, 2, 3)])
    plane = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(plane)
    return plane


def shader(block: bpy.types.Material, kind: str, **inputs: object) -> None:
    """Let a material be one shader."""
    tree = compat.enable_nodes(block)
    tree.nodes.clear()
    node, output = tree.nodes.new(kind), tree.nodes.new("ShaderNodeOutputMaterial")
    for name, value in inputs.items():
        node.inputs[name].default_value = value
    tree.links.new(node.outputs[0], output.inputs["Surface"])


def looking_down(height: float, lens: float = 30.0) -> bpy.types.Object:
    """Add the active camera, above the origin."""
    camera = make_camera(lens=lens)
    camera.matrix_world = Matrix.Translation((0, 0, height))
    bpy.context.view_layer.update()
    return camera


def test_hulls_are_seen_in_a_mirror(render: Render) -> None:
    """A camera that sees a mirror alone sees what a camera behind it would see."""
    resize(72, 48)
    model = sparse_model()
    model.means[:, 2] = np.abs(model.means[:, 2]) + 6.0  # above the camera, behind its back
    model.motions[:] = 0.0
    show_hulls(model)
    mirror = mirror_plane(-2.0, 50.0)
    mirror.data.materials.append(bpy.data.materials.new("mirror"))
    shader(mirror.data.materials[0], "ShaderNodeBsdfGlossy", Roughness=0.0, Color=(1, 1, 1, 1))
    camera = looking_down(3.0)
    origins, directions = pinhole_rays(camera, 72, 48, 30.0)
    flip = np.array([1.0, 1.0, -1.0])
    truth = oracle.trace(model.evaluate(0.4), origins * flip - (0, 0, 4.0), directions * flip)
    set_up_with(bounces=2)
    picture = render()
    truth, picture = truth.reshape(48, 72, 4), picture[..., :3]
    assert truth[..., 3].mean() > 0.05
    assert oracle.psnr(picture, truth[..., :3]) >= 30


def test_hulls_cast_shadows(render: Render) -> None:
    """Under a sun, what is left of a white floor's light is what the Gaussians let through."""
    resize(72, 48)
    model = sparse_model()
    model.means[:] = model.means * (1, 1, 0.2) + (0, 0, 5)
    model.motions[:] = 0.0
    model.features[:] = 0.0
    show_hulls(model)
    floor = mirror_plane(0.0, 50.0)
    floor.data.materials.append(bpy.data.materials.new("floor"))
    shader(floor.data.materials[0], "ShaderNodeBsdfDiffuse", Color=(1, 1, 1, 1))
    lamp = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    lamp.data.energy, lamp.data.angle = np.pi, 0.0
    lamp.rotation_euler = (0.5, 0.2, 0.0)
    bpy.context.scene.collection.objects.link(lamp)
    camera = looking_down(3.0)  # below the Gaussians, looking at the floor
    origins, directions = pinhole_rays(camera, 72, 48, 30.0)
    floor_points = origins + directions * (origins[:, 2:] / -directions[:, 2:])
    toward_sun = np.array(lamp.matrix_world.to_3x3())[:, 2]
    shade = oracle.trace(model.evaluate(0.4), floor_points, np.tile(toward_sun, (len(origins), 1)))[:, 3]
    set_up_with(bounces=1)
    picture = render()[..., 0]
    assert shade.mean() > 0.03
    assert oracle.psnr(picture / toward_sun[2], (1 - shade).reshape(48, 72)) >= 40


def set_up_with(bounces: int) -> None:
    """Set up an exact render that lets light bounce."""
    bpy.context.scene.render.engine = "CYCLES"
    setup_exact_render(bpy.context.scene)
    bpy.context.scene.cycles.max_bounces = bounces


def test_hulls_of_instances(render: Render) -> None:
    """Collection instances, turned and scaled, one of them of another instance."""
    resize(96, 64)
    camera = make_camera()
    model = sparse_model(60)
    played = show_hulls(model)
    inner, outer = (bpy.data.collections.new(name) for name in ("inner", "outer"))
    bpy.context.scene.collection.objects.unlink(played)
    inner.objects.link(played)
    first = Matrix.LocRotScale((-1.5, 0, 3), Euler((0.5, 0, 1)), (0.5, 0.7, 0.4))
    second = Matrix.LocRotScale((1.5, 0.5, 1), Euler((0, 0.4, 0)), (0.8, 0.8, 0.8))
    for collection, matrix, holder in (
        (inner, first, bpy.context.scene.collection),
        (inner, first, outer),
        (outer, second, bpy.context.scene.collection),
    ):
        empty = bpy.data.objects.new("instance", None)
        empty.instance_type, empty.instance_collection, empty.matrix_world = "COLLECTION", collection, matrix
        holder.objects.link(empty)
    bpy.context.view_layer.update()
    shown = model.evaluate(0.4)
    rays = pinhole_rays(camera, 96, 64, 30.0)
    truth = oracle.trace(shown, *rays, np.array(first)), oracle.trace(shown, *rays, np.array(second @ first))
    through = (1 - truth[0][:, 3]) * (1 - truth[1][:, 3])
    picture = render_exactly(render)
    assert min(part[:, 3].mean() for part in truth) > 0.01
    assert oracle.psnr(picture[..., 3], 1 - through.reshape(64, 96)) >= 60


def test_camera_inside_a_hull_sees_what_lies_ahead(render: Render) -> None:
    """One Gaussian around the camera: looking to its middle and away from it."""
    resize(32, 32)
    camera = make_camera()
    model = wide_model(1)
    model.means[:], model.motions[:], model.log_scales[:], model.opacity_logits[:] = (0, 0, 0.5), 0, np.log(0.6), 2.0
    model.trbf_log_scales[:] = 16
    show_hulls(model)
    for turned in (Matrix.Diagonal((1, -1, -1, 1)), Matrix.Identity(4)):
        camera.matrix_world = turned
        bpy.context.view_layer.update()
        truth = oracle.trace(model.evaluate(0.4), *pinhole_rays(camera, 32, 32, 30.0)).reshape(32, 32, 4)
        assert oracle.psnr(render_exactly(render), truth) >= 60
    assert not truth.any()
