# SPDX-License-Identifier: GPL-3.0-or-later
"""Reels on the timeline: what the nodes evaluate against numpy, and what importing does to a file."""

import json
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import bpy
import numpy as np
import pytest
from holoreel.addon import attributes, compat, reels
from holoreel.addon.nodes.reel import DISPLAY, LINEAR, LOOKS, POINTS
from holoreel.addon.retime import key_reel_frames
from holoreel.addon.timeline import HOLD, LOOP, PING_PONG, Timeline
from holoreel.core.errors import HoloreelError
from holoreel.core.gaussians.decoder import Decoder
from holoreel.core.gaussians.importance import most_important_first
from holoreel.core.gaussians.model import EvaluatedGaussians, SpacetimeGaussians
from holoreel.core.reel import SegmentPayload, load_gaussians, save_gaussians, write_segments
from mathutils import Vector
from numpy.typing import NDArray

Model = Callable[..., SpacetimeGaussians]


def awkward(model: SpacetimeGaussians) -> SpacetimeGaussians:
    """Add what breaks careless arithmetic: zero quaternions, endless and minute widths, certain and absent opacity."""
    model.quats[:10] = 0.0
    model.omegas[:5] = 0.0
    model.trbf_log_scales[10:20] = 1e30
    model.trbf_log_scales[20:30] = 16.0
    model.trbf_log_scales[30:40] = -40.0
    model.trbf_centers[30:35] = 0.0
    model.opacity_logits[40:45] = 1e30
    model.opacity_logits[45:50] = -1e30
    return model


def show_points(reel: bpy.types.Object, color: str = DISPLAY) -> bpy.types.NodesModifier:
    """Let a reel show all of its evaluated Gaussians as points."""
    modifier = reels.modifier_of(reel)
    compat.set_input(modifier, "Look", POINTS)
    compat.set_input(modifier, "Color", color)
    compat.set_input(modifier, "Hide Fainter Than", 0.0)
    return modifier


def seek(frame: float) -> None:
    """Go to a scene frame and its fraction."""
    bpy.context.scene.frame_set(int(np.floor(frame)), subframe=frame - np.floor(frame))


def evaluated(reel: bpy.types.Object) -> dict[str, NDArray[np.float32]]:
    """Read what the nodes made of a reel."""
    geometry = reel.evaluated_get(bpy.context.evaluated_depsgraph_get()).evaluated_geometry()
    if geometry.pointcloud is None:
        return {"position": np.zeros((0, 3), np.float32)}
    found = geometry.pointcloud.attributes
    return {name: attributes.read(found, name) for name in ("position", "rotation", "opacity", "scale", "rgb")}


def sorted_model(path: Path) -> SpacetimeGaussians:
    """Read the Gaussians of a file in the order in which they are imported."""
    model = load_gaussians(path).gaussians
    return model.take(most_important_first([model]))


def assert_same(shown: dict[str, NDArray[np.float32]], truth: EvaluatedGaussians) -> None:
    """Compare what the nodes evaluated with numpy's survivors."""
    truth = truth.take(truth.alive)
    assert len(shown["position"]) == len(truth) > 0
    np.testing.assert_allclose(shown["position"], truth.means, rtol=1e-6, atol=1e-5)
    np.testing.assert_allclose(shown["rotation"], truth.quats, rtol=0, atol=1e-5)
    np.testing.assert_allclose(shown["opacity"], truth.opacities, rtol=0, atol=1e-5)
    np.testing.assert_allclose(shown["scale"], truth.scales, rtol=1e-5)
    np.testing.assert_array_equal(shown["rgb"][:, :3], truth.features[:, :3])


@pytest.mark.parametrize("repeat", [HOLD, LOOP, PING_PONG])
def test_nodes_evaluate_as_numpy_does(repeat: str, random_model: Model) -> None:
    random = np.random.default_rng(5)
    model = awkward(random_model(3000))
    timeline = Timeline(40, start=3.5, speed=0.7, offset=0.25, first=2, last=33, repeat=repeat)
    reel = reels.create_reel_object(bpy.context, "reel", model, timeline)
    show_points(reel)
    for frame in [*random.uniform(-150, 150, 8), *random.integers(-100, 200, 4)]:
        seek(frame)
        time = timeline.time(bpy.context.scene.frame_current_final)
        assert 2 / 40 <= time < 34 / 40
        assert_same(evaluated(reel), model.evaluate(float(time)))


def test_timeline_follows_its_formula() -> None:
    """The stepwise float32 of `Timeline` against exact fractions, written from the documentation."""
    random = np.random.default_rng(2)
    for _ in range(300):
        count = int(random.integers(1, 60))
        first, last = sorted(int(i) for i in random.integers(0, count, 2))
        speed, start, offset, frame = (Fraction(int(random.integers(-80, 80)), 8) for _ in range(4))
        passed, steps = (frame - start) * speed + offset, last - first
        turn = passed % (2 * steps) if steps else 0
        expected = {
            HOLD: min(max(passed, 0), steps),
            LOOP: passed % (steps + 1),
            PING_PONG: turn if turn <= steps else 2 * steps - turn,
        }
        for repeat, shown in expected.items():
            timeline = Timeline(count, float(start), float(speed), float(offset), first, last, repeat)
            assert float(timeline.reel_frame(float(frame))) == pytest.approx(float(first + shown), abs=1e-4)


def test_each_frame_shows_itself(random_model: Model) -> None:
    timeline = Timeline(24, start=1001)
    for frame in range(24):
        assert float(timeline.reel_frame(1001 + frame)) == frame
        assert timeline.time(1001 + frame) == np.float32(frame) / np.float32(24)
    assert timeline.reel_frame(0) == 0
    assert timeline.reel_frame(2000) == 23


def test_keyed_offset_chooses_frames(random_model: Model) -> None:
    model = random_model(200)
    reel = reels.create_reel_object(bpy.context, "reel", model, Timeline(10, speed=0.0))
    modifier = show_points(reel)
    for frame, offset in ((1, 0.0), (11, 8.0)):
        compat.set_input(modifier, "Offset", offset)
        reel.keyframe_insert(compat.input_path(modifier, "Offset"), frame=frame)
    seek(11)
    assert_same(evaluated(reel), model.evaluate(0.8))
    seek(1)
    assert_same(evaluated(reel), model.evaluate(0.0))


def test_changed_inputs_show_at_once(random_model: Model) -> None:
    model = random_model(200)
    reel = reels.create_reel_object(bpy.context, "reel", model, Timeline(10, speed=0.0))
    modifier = show_points(reel)
    for offset in (0.0, 5.0, 2.5):
        compat.set_input(modifier, "Offset", offset)
        assert_same(evaluated(reel), model.evaluate(offset / 10))
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera = camera  # without one, splats are shown as points
    for look, points in (("Splats", False), (POINTS, True)):
        compat.set_input(modifier, "Look", look)
        assert bool(len(evaluated(reel)["position"])) == points
    reels.set_timeline(reel, Timeline(10, speed=0.0, offset=3.0, repeat=LOOP))
    assert_same(evaluated(reel), model.evaluate(0.3))


def test_nothing_visible_is_no_error() -> None:
    model = SpacetimeGaussians(
        *(np.zeros(shape) for shape in ((3, 3), (3, 3, 3), (3, 4), (3, 4), (3, 3))),
        opacity_logits=np.full(3, -30.0),
        features=np.zeros((3, 3)),
        trbf_centers=np.zeros(3),
        trbf_log_scales=np.zeros(3),
    )
    reel = reels.create_reel_object(bpy.context, "reel", model, Timeline(10))
    for look in LOOKS:
        compat.set_input(reels.modifier_of(reel), "Look", look)
        assert len(evaluated(reel)["position"]) == 0


def test_scene_linear_is_the_srgb_curve(random_model: Model) -> None:
    model = random_model(500)
    model.features[:] = np.linspace(-0.1, 1.3, 1500).reshape(500, 3)
    model.opacity_logits[:] = 4
    model.trbf_log_scales[:] = 16
    reel = reels.create_reel_object(bpy.context, "reel", model, Timeline(10))
    show_points(reel, LINEAR)
    values = model.features.astype(np.float64)
    truth = np.where(values <= 0.04045, values / 12.92, (np.maximum(values + 0.055, 0) / 1.055) ** 2.4)
    np.testing.assert_allclose(evaluated(reel)["rgb"][:, :3], truth, atol=2e-6)


def test_reel_is_one_point_cloud_with_shared_groups(random_model: Model) -> None:
    for index in range(3):
        reel = reels.create_reel_object(bpy.context, f"reel {index}", random_model(50), Timeline(10))
        assert (reel.type, len(reel.data.points), len(reel.modifiers)) == ("POINTCLOUD", 50, 1)
        if index == 0:
            groups, materials = len(bpy.data.node_groups), len(bpy.data.materials)
    assert (len(bpy.data.node_groups), len(bpy.data.materials)) == (groups, materials)
    assert len(bpy.data.objects) == 3
    assert not bpy.data.meshes


def test_groups_are_found_by_tag_not_name(random_model: Model) -> None:
    first = reels.create_reel_object(bpy.context, "a", random_model(5), Timeline(10))
    group = reels.modifier_of(first).node_group
    group.name = "My own name"
    second = reels.create_reel_object(bpy.context, "b", random_model(5), Timeline(10))
    assert reels.modifier_of(second).node_group == group


def test_every_input_explains_itself(random_model: Model) -> None:
    reel = reels.create_reel_object(bpy.context, "reel", random_model(5), Timeline(10))
    for item in reels.modifier_of(reel).node_group.interface.items_tree:
        if item.item_type == "SOCKET" and item.in_out == "INPUT":
            assert item.description, item.name


def test_reel_survives_saving(random_model: Model, tmp_path: Path) -> None:
    model = random_model(300)
    timeline = Timeline(20, start=5, repeat=LOOP)
    show_points(reels.create_reel_object(bpy.context, "reel", model, timeline))
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "scene.blend"))
    seek(37.5)
    assert_same(evaluated(bpy.data.objects["reel"]), model.evaluate(float(timeline.time(37.5))))


@pytest.mark.parametrize("count", [1, 50])
def test_import_of_a_reel(count: int, random_model: Model, tmp_path: Path) -> None:
    model = random_model(100)
    path = tmp_path / "walk.reel"
    save_gaussians(path, model, fps=25.0, frame_start=101, frame_count=count, up="-Y")
    scene = bpy.context.scene
    before = (scene.frame_start, scene.frame_end, scene.render.fps)
    reel = reels.import_reel(bpy.context, path, up=reels.FROM_FILE)
    assert (scene.frame_start, scene.frame_end, scene.render.fps) == before
    assert reel.name == "walk"
    assert reel[reels.INFO]["source"] == str(path)
    show_points(reel)
    seek(101)
    assert_same(evaluated(reel), sorted_model(path).evaluate(0.0))
    bpy.context.view_layer.update()
    up = reel.matrix_world.to_3x3() @ Vector((0, -1, 0))
    assert tuple(round(v, 6) for v in up) == (0, 0, 1)


@pytest.mark.parametrize("axis", list(reels.UPRIGHT))
def test_every_axis_can_point_up(axis: str) -> None:
    direction = np.eye(3)["XYZ".index(axis[-1])] * (-1 if axis.startswith("-") else 1)
    np.testing.assert_allclose(np.array(reels.UPRIGHT[axis].to_3x3()) @ direction, [0, 0, 1], atol=1e-6)


def test_real_time_and_scene_timing(random_model: Model, tmp_path: Path) -> None:
    path = tmp_path / "walk.reel"
    save_gaussians(path, random_model(20), fps=29.97, frame_start=11, frame_count=60)
    scene = bpy.context.scene
    scene.render.fps = 24
    modifier = reels.modifier_of(reels.import_reel(bpy.context, path, pace=reels.REAL_TIME))
    assert compat.get_input(modifier, "Speed") == pytest.approx(29.97 / 24)
    modifier = reels.modifier_of(reels.import_reel(bpy.context, path, pace=reels.REAL_TIME, set_scene_timing=True))
    assert compat.get_input(modifier, "Speed") == pytest.approx(1.0)
    assert (scene.frame_start, scene.frame_end) == (11, 70)
    assert scene.render.fps / scene.render.fps_base == pytest.approx(29.97)


def test_compact_full_reels_show_decoded_colors(random_model: Model, tmp_path: Path) -> None:
    """Quantised, with one color for each Gaussian."""
    random = np.random.default_rng(3)
    decoder = Decoder(random.normal(size=(6, 12)), random.normal(size=(3, 6)), "sigmoid")
    parts = [SegmentPayload(random_model(60, features=9), decoder, 1, 5)]
    path = tmp_path / "walk.reel"
    write_segments(path, parts, fps=25, frame_start=1, viewpoint=(0.0, 0.5, -1.0), suffix=".stgc")
    reel = reels.import_reel(bpy.context, path)
    show_points(reel)
    seek(3)
    model = sorted_model(path)
    shown, truth = evaluated(reel), model.evaluate(0.4)
    alive = truth.take(truth.alive)
    assert len(shown["position"]) == len(alive) > 20
    np.testing.assert_allclose(shown["position"], alive.means, rtol=1e-6, atol=1e-5)
    still, eye = model.take(truth.alive), np.array([0.0, 0.5, -1.0])
    features = still.features.astype(np.float64)
    features[:, 6:] = 0.0
    rays = (still.means - eye) / np.linalg.norm(still.means - eye, axis=1, keepdims=True)
    inputs = np.concatenate([features[:, 3:], np.broadcast_to(eye, rays.shape), rays], axis=1)
    raw = features[:, :3] + np.maximum(inputs @ decoder.hidden.T, 0.0) @ decoder.output.T
    np.testing.assert_allclose(shown["rgb"][:, :3], 1 / (1 + np.exp(-raw)), atol=1e-5)
    report = reel[reels.INFO]["report"]
    assert "one color" in report


def test_refused_files_add_nothing(tmp_path: Path) -> None:
    (tmp_path / "a.reel").write_text(json.dumps({"kind": "video"}))
    (tmp_path / "b.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\n")
    (tmp_path / "c.splatv").write_bytes(b"\0" * 100)
    (tmp_path / "e.stgc").write_bytes(b"STGC" * 100)
    for name in ("a.reel", "b.ply", "c.splatv", "e.stgc", "absent.ply", "d.txt"):
        with pytest.raises(HoloreelError, match=name):
            reels.import_reel(bpy.context, tmp_path / name)
    assert not bpy.data.objects
    assert not bpy.data.node_groups


@pytest.mark.parametrize("name", ["spinach_4", "yellow_clip2", "coffee10"])
def test_real_models_evaluate_as_numpy_does(name: str, shared_data: Callable[[str], Path]) -> None:
    path = shared_data(f"stg_splatv/{name}.splatv")
    reel = reels.import_reel(bpy.context, path)
    show_points(reel)
    model = sorted_model(path)
    for frame in (1, 13.37, 26):
        seek(frame)
        time = Timeline(50).time(bpy.context.scene.frame_current_final)
        truth, shown = model.evaluate(float(time)), evaluated(reel)
        alive = truth.take(truth.alive)
        assert abs(len(alive) - len(shown["position"])) <= 1  # 1/255 itself may round either way
        if len(alive) == len(shown["position"]):
            assert_same(shown, truth)


def test_mapping_reads_back_as_it_was_set(random_model: Model) -> None:
    timeline = Timeline(40, start=3.5, speed=-0.75, offset=0.25, first=2, last=33, repeat=PING_PONG)
    reel = reels.create_reel_object(bpy.context, "reel", random_model(5), timeline)
    assert reels.timeline_of(reel) == timeline
    with pytest.raises(HoloreelError, match="no reel"):
        reels.timeline_of(bpy.data.objects.new("Empty", None))


def test_ranges_beyond_the_reel_show_its_end(random_model: Model) -> None:
    model = random_model(300)
    for repeat in (HOLD, LOOP, PING_PONG):
        timeline = Timeline(10, first=0, last=500, repeat=repeat)
        reel = reels.create_reel_object(bpy.context, "reel", model, timeline)
        show_points(reel)
        seek(400)
        assert timeline.time(400) == 1.0
        assert_same(evaluated(reel), model.evaluate(1.0))
        reels.set_timeline(reel, Timeline(10, first=90, last=20, repeat=repeat))
        assert_same(evaluated(reel), model.evaluate(1.0))


def test_keyed_and_driven_reel_frames(random_model: Model) -> None:
    model = random_model(300)
    timeline = Timeline(40, start=7, speed=3, first=2, last=33, retime=True)
    reel = reels.create_reel_object(bpy.context, "reel", model, timeline)
    modifier = show_points(reel)
    path = compat.input_path(modifier, "Reel Frame")
    for frame, shown in ((1, 2.0), (11, 32.0), (21, 99.0)):
        compat.set_input(modifier, "Reel Frame", shown)
        reel.keyframe_insert(path, frame=frame)
    for frame, shown in ((1, 2.0), (11, 32.0), (21, 33.0)):  # 99 is beyond the range, which Hold keeps
        seek(frame)
        assert_same(evaluated(reel), model.evaluate(shown / 40))
    reel.animation_data_clear()
    follow = reel.driver_add(path).driver
    follow.expression = "frame * 0.5"
    seek(24.5)
    assert_same(evaluated(reel), model.evaluate(12.25 / 40))
    depsgraph = bpy.context.evaluated_depsgraph_get()
    assert reels.timeline_of(reel.evaluated_get(depsgraph)).at == 12.25


def test_keyed_speed_is_read_at_each_frame(random_model: Model) -> None:
    model = random_model(300)
    reel = reels.create_reel_object(bpy.context, "reel", model, Timeline(40))
    modifier = show_points(reel)
    for frame, speed in ((1, 0.0), (11, 2.0)):
        compat.set_input(modifier, "Speed", speed)
        reel.keyframe_insert(compat.input_path(modifier, "Speed"), frame=frame)
    seek(11)
    assert_same(evaluated(reel), model.evaluate(20 / 40))


@pytest.mark.parametrize(("percent", "kept"), [(100.0, 250), (50.0, 125), (10.1, 26), (0.0, 0)])
def test_viewport_detail_keeps_the_first(percent: float, kept: int, random_model: Model) -> None:
    model = random_model(250)
    model.opacity_logits[:], model.trbf_log_scales[:] = 4, 16
    reel = reels.create_reel_object(bpy.context, "reel", model, Timeline(10))
    modifier = show_points(reel)
    compat.set_input(modifier, "Viewport Detail", percent)
    assert len(evaluated(reel)["position"]) == kept
    if kept:
        assert_same(evaluated(reel), model.take(slice(kept)).evaluate(0.0))
    compat.set_input(modifier, "Viewport Detail", 100.0)
    compat.set_input(modifier, "Render Detail", percent)
    assert len(evaluated(reel)["position"]) == 250


def test_key_reel_frames_keeps_what_plays(random_model: Model) -> None:
    backward, loop = Timeline(40, start=5, speed=-2, offset=30), Timeline(40, start=2, speed=0.75, repeat=LOOP)
    for timeline in (Timeline(40, start=5, speed=0.5, first=3, last=21), backward, loop):
        model = random_model(100)
        reel = reels.create_reel_object(bpy.context, "reel", model, timeline)
        show_points(reel)
        assert key_reel_frames(bpy.context.scene, reel) == 2
        for frame in (-10, 5, 11.5, 20, 90):
            seek(frame)
            now = reels.timeline_of(reel.evaluated_get(bpy.context.evaluated_depsgraph_get()))
            assert now.retime
            assert float(now.reel_frame(frame)) == pytest.approx(float(timeline.reel_frame(frame)), abs=1e-4)
            assert_same(evaluated(reel), model.evaluate(float(now.time(frame))))
        with pytest.raises(HoloreelError, match="retimed already"):
            key_reel_frames(bpy.context.scene, reel)
    still = reels.create_reel_object(bpy.context, "reel", random_model(3), Timeline(40, speed=0))
    with pytest.raises(HoloreelError, match="Speed 0"):
        key_reel_frames(bpy.context.scene, still)


def test_key_reel_frames_adds_a_keyed_speed_up(random_model: Model) -> None:
    scene = bpy.context.scene
    scene.frame_end = 60
    reel = reels.create_reel_object(bpy.context, "reel", random_model(3), Timeline(100))
    path = compat.input_path(reels.modifier_of(reel), "Speed")
    for frame, speed in ((1, 2.0), (41, 0.0)):
        compat.set_input(reels.modifier_of(reel), "Speed", speed)
        reel.keyframe_insert(path, frame=frame)
    for key in compat.find_fcurve(reel, path).keyframe_points:
        key.interpolation = "LINEAR"
    assert key_reel_frames(scene, reel) == 60
    for frame in (1, 11, 21, 41, 60):
        seek(frame)
        t = min(frame - 1, 40)
        now = reels.timeline_of(reel.evaluated_get(bpy.context.evaluated_depsgraph_get()))
        assert now.at == pytest.approx(2 * t - t * t / 40, abs=1e-3)  # slows down to a stop, never runs back


def test_reels_of_older_files_keep_what_they_have(random_model: Model) -> None:
    """Their node groups have fewer inputs; a new one is built beside them."""
    reel = reels.create_reel_object(bpy.context, "reel", random_model(5), Timeline(10, start=4))
    group = reels.modifier_of(reel).node_group
    for item in list(group.interface.items_tree):
        if item.item_type == "SOCKET" and item.name in ("Retime", "Reel Frame"):
            group.interface.remove(item)
    group["holoreel"] = "Holoreel Reel 1"
    assert reels.timeline_of(reel) == Timeline(10, start=4, last=9)
    reels.set_timeline(reel, Timeline(20, start=2, retime=True))
    assert reels.timeline_of(reel) == Timeline(20, start=2, last=19)
    newer = reels.create_reel_object(bpy.context, "reel", random_model(5), Timeline(10))
    assert reels.modifier_of(newer).node_group != group
