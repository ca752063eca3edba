# SPDX-License-Identifier: GPL-3.0-or-later
"""Movement as others see it: velocities, motion blur, constraints, and evaluation without Holoreel."""

import subprocess
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np
import pytest
from holoreel.addon import attributes, compat, reels
from holoreel.addon.nodes.reel import DISPLAY
from holoreel.addon.nodes.show import LOOKS, POINTS
from holoreel.addon.timeline import HOLD, LOOP, PING_PONG, Timeline
from holoreel.core.gaussians.model import SpacetimeGaussians
from holoreel.core.reel import SegmentPayload, write_segments
from numpy.typing import NDArray

Model = Callable[..., SpacetimeGaussians]
Picture = NDArray[np.float32]


def lasting(model: SpacetimeGaussians) -> SpacetimeGaussians:
    """Let all Gaussians be visible at all times."""
    model.opacity_logits[:], model.trbf_log_scales[:] = 4.0, 16.0
    return model


def show_points(reel: bpy.types.Object) -> bpy.types.NodesModifier:
    """Let a reel show all of its evaluated Gaussians as points."""
    modifier = reels.modifier_of(reel)
    for name, value in (("Look", POINTS), ("Color", DISPLAY), ("Hide Fainter Than", 0.0)):
        compat.set_input(modifier, name, value)
    return modifier


def at(reel: bpy.types.Object, frame: float, name: str = "position") -> NDArray[np.float32]:
    """Return an attribute of a reel's evaluated points at a scene frame."""
    bpy.context.scene.frame_set(int(np.floor(frame)), subframe=frame - np.floor(frame))
    geometry = reel.evaluated_get(bpy.context.evaluated_depsgraph_get()).evaluated_geometry()
    return attributes.read(geometry.pointcloud.attributes, name)


@pytest.mark.parametrize(
    ("repeat", "frames"), [(HOLD, (4, 11.25, 70, -20)), (LOOP, (4, 61.5, -33)), (PING_PONG, (4, 26.5, 70, -9))]
)
def test_velocity_is_the_change_of_position(repeat: str, frames: tuple[float, ...], random_model: Model) -> None:
    bpy.context.scene.render.fps = 30
    timeline = Timeline(20, start=3, speed=0.75, repeat=repeat)
    reel = reels.create_reel_object(bpy.context, "reel", lasting(random_model(50)), timeline)
    modifier = show_points(reel)
    for frame in frames:
        step = 1 / 64
        change = (at(reel, frame + step) - at(reel, frame - step)) / (2 * step) * 30
        np.testing.assert_allclose(at(reel, frame, "velocity"), change, atol=5e-3)
    compat.set_input(modifier, "Retime", True)
    assert not at(reel, 5, "velocity").any()
    compat.set_input(modifier, "Motion Blur", False)
    with pytest.raises(KeyError):
        at(reel, 5, "velocity")


def test_velocity_in_segments_is_that_of_the_segment(random_model: Model, tmp_path: Path) -> None:
    parts = [SegmentPayload(lasting(random_model(40, i)), None, 1 + 4 * i, (4, 15)[i]) for i in range(2)]
    write_segments(tmp_path / "a.reel", parts, fps=24, frame_start=1)
    reel = reels.import_reel(bpy.context, tmp_path / "a.reel")
    show_points(reel)
    for frame in (2.5, 11):
        change = (at(reel, frame + 1 / 64) - at(reel, frame - 1 / 64)) * 32 * 24
        np.testing.assert_allclose(at(reel, frame, "velocity"), change, atol=2e-2)


def passing_by() -> SpacetimeGaussians:
    """Return three Gaussians, the outer ones in opposite motion, and a fourth far away that lives but an instant."""
    means = np.array([[0, -1.4, -9], [0, -0.7, 0], [0, 0, 0.01], [0, 0.7, 0.02]])
    motions = np.zeros((4, 3, 3))
    motions[1, 0, 0], motions[3, 0, 0] = 8, -8
    still, one = np.tile([1.0, 0, 0, 0], (4, 1)), np.ones(4)
    lives = np.array([np.log(0.008), 16, 16, 16])
    return SpacetimeGaussians(
        means, motions, still, 0 * still, np.full((4, 3), -2.5), 5 * one, np.ones((4, 3)), one / 2, lives
    )


@pytest.mark.parametrize("look", list(LOOKS))
def test_motion_blur_in_cycles_though_points_come_and_go(look: str, render: Callable[[], Picture]) -> None:
    """Between the opening and the closing of the shutter a point appears, is gone again, and was the first of all."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.render.resolution_x = scene.render.resolution_y = 48
    scene.render.film_transparent = scene.render.use_motion_blur = True
    scene.render.motion_blur_shutter = 1.0
    scene.cycles.samples, scene.cycles.use_denoising = 32, False
    scene.cycles.transparent_max_bounces = scene.cycles.min_transparent_bounces = 64
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(camera)
    camera.location, scene.camera = (0, 0, 5), camera
    reel = reels.create_reel_object(bpy.context, "reel", passing_by(), Timeline(10, start=0))
    modifier = reels.modifier_of(reel)
    compat.set_input(modifier, "Look", look)
    scene.frame_set(5)
    widths = {}
    for blurred in (True, False):
        compat.set_input(modifier, "Motion Blur", blurred)
        alpha = render()[:, :, 3]
        # Rows of the three Gaussians: 13 pixels per unit, the first one lowest.
        widths[blurred] = [np.ptp(np.flatnonzero(alpha[row - 4 : row + 5].max(axis=0) > 0.04)) for row in (33, 24, 15)]
    moving, still = (widths[True][0], widths[True][2]), widths[True][1]
    assert moving[0] == pytest.approx(moving[1], abs=1)
    assert min(moving) >= still + 6  # 0.8 units, 11 pixels, less what is too thin to count
    assert widths[False] != widths[True]  # without velocities, renderers are lost


def test_other_objects_see_what_the_reel_shows(random_model: Model) -> None:
    """A mesh that copies the reel's points by its own nodes, and a reel that follows an animated empty."""
    reel = reels.create_reel_object(bpy.context, "reel", lasting(random_model(60)), Timeline(20, speed=0.7))
    show_points(reel)
    watcher = bpy.data.objects.new("watcher", bpy.data.meshes.new("watcher"))
    bpy.context.scene.collection.objects.link(watcher)
    group = bpy.data.node_groups.new("watch", "GeometryNodeTree")
    group.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    info, out = group.nodes.new("GeometryNodeObjectInfo"), group.nodes.new("NodeGroupOutput")
    info.inputs["Object"].default_value = reel
    group.links.new(info.outputs["Geometry"], out.inputs[0])
    watcher.modifiers.new("watch", "NODES").node_group = group
    empty = bpy.data.objects.new("empty", None)
    bpy.context.scene.collection.objects.link(empty)
    for frame, x in ((1, 0.0), (11, 10.0)):
        empty.location.x = x
        empty.keyframe_insert("location", frame=frame)
    reel.constraints.new("COPY_LOCATION").target = empty
    for frame in (4.5, 9.25, 2):
        np.testing.assert_array_equal(at(watcher, frame), at(reel, frame))
        depsgraph = bpy.context.evaluated_depsgraph_get()
        place = [one.evaluated_get(depsgraph).matrix_world.translation.x for one in (reel, empty)]
        assert place[0] == place[1] > 0


PLAY = """
    import sys
    import bpy, numpy as np
    bpy.ops.wm.open_mainfile(filepath=sys.argv[1])
    played = bpy.data.objects["reel"]
    found = {}
    for frame in (7, 3, 12):
        bpy.context.scene.frame_set(frame)
        depsgraph = bpy.context.evaluated_depsgraph_get()
        geometry = played.evaluated_get(depsgraph).evaluated_geometry()
        values = np.empty(3 * len(geometry.pointcloud.points), np.float32)
        geometry.pointcloud.attributes["position"].data.foreach_get("vector", values)
        found[str(frame)] = values.reshape(-1, 3)
    assert not [name for name in sys.modules if "holoreel" in name]
    np.savez(sys.argv[2], **found)
"""


def test_a_farm_without_holoreel_sees_the_same(random_model: Model, tmp_path: Path) -> None:
    """What a saved file evaluates to in a Blender that has no add-on, against playing here, back and forth."""
    reel = reels.create_reel_object(bpy.context, "reel", random_model(200), Timeline(20, speed=0.7, repeat=PING_PONG))
    show_points(reel)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    arguments = [sys.executable, "-c", textwrap.dedent(PLAY), str(tmp_path / "scene.blend"), str(tmp_path / "out.npz")]
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    with np.load(tmp_path / "out.npz") as found:
        for frame in (12, 3, 7):
            np.testing.assert_array_equal(found[str(frame)], at(reel, frame))
