# SPDX-License-Identifier: GPL-3.0-or-later
"""What users of other add-ons for splats asked for, as far as it touches looks: one test per wish."""

from collections.abc import Callable

import bpy
import numpy as np
import pytest
from holoreel.addon import compat, reels
from holoreel.addon.exact import setup_exact_render
from holoreel.addon.nodes.show import HULL, LINEAR, LOOKS, POINTS
from holoreel.core.gaussians.model import SpacetimeGaussians
from holoreel.tests.blender import oracle
from holoreel.tests.blender.test_looks import TRANSFORMS, make_camera, place, render_exactly, resize, show, view_of
from holoreel.tests.blender.test_looks import wide_model as cloud
from mathutils import Euler, Matrix
from numpy.typing import NDArray

Render = Callable[[], NDArray]


def one_gaussian(color: tuple[float, float, float] = (0.8, 0.4, 0.1)) -> SpacetimeGaussians:
    """Return one long, opaque Gaussian ahead of the camera, at all times."""
    return SpacetimeGaussians(
        means=[[0.0, 0.0, 3.0]],
        motions=np.zeros((1, 3, 3)),
        quats=[[0.9, 0.1, -0.2, 0.3]],
        omegas=np.zeros((1, 4)),
        log_scales=np.log([[0.4, 0.1, 0.15]]),
        opacity_logits=[9.0],
        features=[color],
        trbf_centers=[0.5],
        trbf_log_scales=[16.0],
    )


def spread(picture: NDArray) -> NDArray[np.float64]:
    """Return the standard deviations of a picture's alpha, across and down, in pixels."""
    alpha = picture[..., 3].astype(np.float64)
    rows, columns = np.mgrid[: alpha.shape[0], : alpha.shape[1]]
    places = np.stack([columns.ravel(), rows.ravel()])
    return np.sqrt(np.diag(np.cov(places, aweights=alpha.ravel())))


def test_splats_grow_with_the_focal_length(render: Render) -> None:
    resize(96, 96)
    camera = make_camera(lens=15.0)
    reel = show(one_gaussian(), 0.5)
    compat.set_input(reels.modifier_of(reel), "Low Pass", 0.0)
    small = spread(render_exactly(render))
    camera.data.lens = 30.0
    np.testing.assert_allclose(spread(render_exactly(render)) / small, 2.0, rtol=0.02)


@pytest.mark.parametrize("angle", range(0, 360, 60))
def test_splats_vanish_at_no_angle(angle: int, render: Render) -> None:
    resize(48, 32)
    camera = make_camera()
    model = one_gaussian()
    show(model, 0.5)
    around = Matrix.Translation((0, 0, 3)) @ Euler((0.4, np.radians(angle), 0.2)).to_matrix().to_4x4()
    camera.matrix_world = around @ Matrix.Translation((0, 0, -3)) @ Matrix.Diagonal((1, -1, -1, 1))
    bpy.context.view_layer.update()
    truth = oracle.splat(model.evaluate(0.5), view_of(camera))
    assert truth[16, 24, 3] > 0.9
    assert oracle.psnr(render_exactly(render), truth) >= 60


def test_camera_inside_the_cloud(render: Render) -> None:
    resize(64, 48)
    camera = make_camera()
    model = cloud(200, seed=11)
    model.means[:] = np.random.default_rng(1).normal(0, 1.2, (200, 3))
    show(model, 0.5)
    for turned in (Euler((0, 0, 0)), Euler((1.3, 0.4, 2.0))):
        camera.matrix_world = turned.to_matrix().to_4x4()
        bpy.context.view_layer.update()
        truth = oracle.splat(model.evaluate(0.5), view_of(camera))
        assert truth[..., 3].mean() > 0.5
        assert oracle.psnr(render_exactly(render), truth) >= 60


def test_viewport_and_render_show_the_same(render: Render) -> None:
    """What the viewport evaluates through the camera, once it is real geometry, renders as the reel does."""
    resize(64, 48)
    make_camera()
    reel = show(cloud(), 0.3)
    picture = render_exactly(render)
    evaluated = reel.evaluated_get(bpy.context.evaluated_depsgraph_get())
    geometry = evaluated.evaluated_geometry()
    mesh = geometry.mesh.copy()
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("copy", mesh))
    reel.hide_render = True
    np.testing.assert_allclose(render(), picture, atol=1e-5)


@pytest.mark.parametrize("look", LOOKS)
def test_colors_are_those_of_training_under_the_standard_view(look: str, render: Render) -> None:
    """Blender's default workflow: scene-linear colors, shown by the transform Standard."""
    resize(33, 33)
    make_camera(lens=60.0)
    color = (0.8, 0.4, 0.1)
    reel = show(one_gaussian(color), 0.5, look)
    render_exactly(render)
    compat.set_input(reels.modifier_of(reel), "Color", LINEAR)
    linear = render()[16, 16]
    straight = linear[:3] / linear[3]
    shown = np.where(straight <= 0.0031308, straight * 12.92, 1.055 * np.maximum(straight, 0) ** (1 / 2.4) - 0.055)
    assert linear[3] > 0.98
    np.testing.assert_allclose(shown, color, atol=1e-3)


def test_reels_can_be_instanced_in_geometry_nodes(render: Render) -> None:
    """On the points of another object, turned and scaled there."""
    resize(96, 64)
    camera = make_camera()
    model = one_gaussian()
    model.means[:] = 0.0
    reel = show(model, 0.5, HULL)
    compat.set_input(reels.modifier_of(reel), "Low Pass", 0.0)
    bpy.context.scene.collection.objects.unlink(reel)
    places, turn, scale = [(-0.8, 0.2, 3.0), (0.7, -0.1, 2.5)], (0.3, 0.5, 1.0), (1.2, 0.8, 1.0)
    mesh = bpy.data.meshes.new("places")
    mesh.from_pydata(places, [], [])
    scatter = bpy.data.objects.new("scatter", mesh)
    bpy.context.scene.collection.objects.link(scatter)
    group = bpy.data.node_groups.new("scatter", "GeometryNodeTree")
    for direction in ("INPUT", "OUTPUT"):
        group.interface.new_socket("Geometry", in_out=direction, socket_type="NodeSocketGeometry")
    kinds = ("NodeGroupInput", "GeometryNodeObjectInfo", "GeometryNodeInstanceOnPoints", "NodeGroupOutput")
    entry, info, instancer, exit_node = (group.nodes.new(kind) for kind in kinds)
    info.inputs["Object"].default_value, info.inputs["As Instance"].default_value = reel, True
    instancer.inputs["Rotation"].default_value, instancer.inputs["Scale"].default_value = Euler(turn), scale
    group.links.new(entry.outputs[0], instancer.inputs["Points"])
    group.links.new(info.outputs["Geometry"], instancer.inputs["Instance"])
    group.links.new(instancer.outputs[0], exit_node.inputs[0])
    scatter.modifiers.new("scatter", "NODES").node_group = group
    picture = render_exactly(render)
    through = np.ones(96 * 64)
    rows, columns = np.mgrid[:64, :96] + 0.5
    focal = view_of(camera).fx
    directions = np.stack([(columns - 48).ravel() / focal, (rows - 32).ravel() / focal, np.ones(96 * 64)], axis=1)
    for location in places:
        world = np.array(Matrix.LocRotScale(location, Euler(turn), scale))
        through *= 1 - oracle.trace(model.evaluate(0.5), np.zeros_like(directions), directions, world)[:, 3]
    assert (1 - through).mean() > 0.01
    assert oracle.psnr(picture[..., 3], 1 - through.reshape(64, 96)) >= 60


@pytest.mark.parametrize("name", TRANSFORMS)
def test_points_can_be_placed_by_any_transform(name: str, render: Render) -> None:
    resize(96, 64)
    camera = make_camera()
    model = one_gaussian()
    world = place(show(model, 0.5, POINTS), name)
    there = (world @ [0.0, 0.0, 3.0, 1.0])[:3] - (0.5, -0.2, 3.0)
    camera.matrix_world = Matrix.Translation(there.tolist()) @ Matrix.Diagonal((1, -1, -1, 1))
    bpy.context.view_layer.update()
    picture, view = render_exactly(render), view_of(camera)
    column, row = int(view.fx * 0.5 / 3 + view.cx), int(view.fy * -0.2 / 3 + view.cy)
    np.testing.assert_allclose(picture[row, column], [*model.features[0], 1.0], atol=1e-5)


def test_setting_up_needs_no_camera() -> None:
    show(one_gaussian(), 0.5)
    setup_exact_render(bpy.context.scene)
    assert bpy.context.scene.view_settings.view_transform == "Raw"
