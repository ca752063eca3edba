# SPDX-License-Identifier: GPL-3.0-or-later
"""Importing: several files, segments, detail, transforms, undo, drag and drop; reels that move or change."""

import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import bpy
import holoreel
import numpy as np
import pytest
from holoreel.addon import attributes, clouds, compat, reels, reload
from holoreel.addon.nodes.reel import DISPLAY, POINTS
from holoreel.addon.timeline import LOOP, Timeline
from holoreel.core.errors import HoloreelError
from holoreel.core.gaussians.importance import importance, most_important_first
from holoreel.core.gaussians.model import EvaluatedGaussians, SpacetimeGaussians
from holoreel.core.gaussians.ply import write_ply
from holoreel.core.reel import Reel, SegmentPayload, load_gaussians, save_gaussians, write_segments
from mathutils import Vector
from numpy.typing import NDArray

Model = Callable[..., SpacetimeGaussians]
COUNTS = (7, 1, 12)  # frames of the three segments


@pytest.fixture
def registered() -> Iterator[None]:
    """Holoreel's operators and panels, for the time of one test."""
    holoreel.register()
    yield
    holoreel.unregister()


def three_segments(random_model: Model, folder: Path) -> Reel:
    """Write a reel of three segments of different sizes and lengths, whose first frame is 101."""
    parts, start = [], 101
    for index, count in enumerate(COUNTS):
        parts.append(SegmentPayload(random_model(40 + 30 * index, index), None, start, count))
        start += count
    return write_segments(folder / "walk.reel", parts, fps=25, frame_start=101)


def show_points(reel: bpy.types.Object) -> bpy.types.NodesModifier:
    """Let a reel show all of its evaluated Gaussians as points."""
    modifier = reels.modifier_of(reel)
    for name, value in (("Look", POINTS), ("Color", DISPLAY), ("Hide Fainter Than", 0.0)):
        compat.set_input(modifier, name, value)
    return modifier


def seek(frame: float) -> None:
    """Go to a scene frame and its fraction."""
    bpy.context.scene.frame_set(int(np.floor(frame)), subframe=frame - np.floor(frame))


def evaluated(reel: bpy.types.Object) -> dict[str, NDArray[np.float32]]:
    """Read what the nodes made of a reel, its rows in an order that does not depend on theirs."""
    geometry = reel.evaluated_get(bpy.context.evaluated_depsgraph_get()).evaluated_geometry()
    if geometry.pointcloud is None:
        return {"position": np.zeros((0, 3), np.float32)}
    found = geometry.pointcloud.attributes
    values = {name: attributes.read(found, name) for name in ("position", "opacity", "rgb")}
    order = np.lexsort(values["rgb"].T)
    return {name: array[order] for name, array in values.items()}


def assert_shows(reel: bpy.types.Object, truth: EvaluatedGaussians) -> None:
    """Compare what the nodes show now with numpy's survivors, in any order."""
    shown, truth = evaluated(reel), truth.take(truth.alive)
    truth = truth.take(np.lexsort(np.column_stack([truth.features, np.ones(len(truth))]).T))
    assert len(shown["position"]) == len(truth) > 0
    np.testing.assert_array_equal(shown["rgb"][:, :3], truth.features)
    np.testing.assert_allclose(shown["position"], truth.means, rtol=1e-6, atol=1e-5)
    np.testing.assert_allclose(shown["opacity"], truth.opacities, rtol=0, atol=1e-5)


def test_segments_switch_exactly_at_their_frames(random_model: Model, tmp_path: Path) -> None:
    reel = three_segments(random_model, tmp_path)
    created = reels.import_reel(bpy.context, reel.path)
    assert len(created.data.points) == 40 + 70 + 100
    assert created[reels.INFO]["segments"] == 3
    modifier = show_points(created)
    models = [load_gaussians(reel.path, index).gaussians for index in range(3)]
    for frame in (50, 101, 104.5, 107.99, 108, 108.75, 109, 109.01, 115, 120, 300):
        index, time = reel.locate(min(frame, 120.0))
        seek(frame)
        assert_shows(created, models[index].evaluate(time))
    compat.set_input(modifier, "Repeat", LOOP)
    seek(121)  # starts over
    assert_shows(created, models[0].evaluate(0.0))
    for count in (5, 400):  # a count that is not the reel's never leaves it empty
        compat.set_input(modifier, "Frame Count", count)
        compat.set_input(modifier, "Last Frame", 399)
        for frame in (101, 120, 500):
            seek(frame)
            assert len(evaluated(created)["position"])


def test_any_part_of_a_reel_has_the_same_part_of_each_segment(random_model: Model, tmp_path: Path) -> None:
    reel = three_segments(random_model, tmp_path)
    created = reels.import_reel(bpy.context, reel.path, detail=20)
    firsts = attributes.read(created.data.attributes, "stg_first")
    assert [int((firsts == first).sum()) for first in (0, 7, 8)] == [8, 14, 20]


def test_most_important_come_first(random_model: Model) -> None:
    model = random_model(500)
    order = most_important_first([model])
    assert sorted(order) == list(range(500))
    assert np.all(np.diff(importance(model)[order]) <= 0)
    # By definition, integrated step by step.
    times = (np.arange(400) + 0.5) / 400
    alive = np.array([model.take([row]).evaluate(time).opacities[0] for row in range(3) for time in times])
    two = np.sort(model.log_scales[:3], axis=1)[:, 1:].sum(axis=1)
    expected = alive.reshape(3, -1).mean(axis=1) * np.exp(0.5 * two)
    np.testing.assert_allclose(importance(model)[:3], expected, rtol=1e-2)


def test_renders_have_a_detail_of_their_own(random_model: Model, render: Callable[[], NDArray]) -> None:
    scene = bpy.context.scene
    model = random_model(300)
    model.means[:, 2] *= -1  # before Blender's camera
    reel = reels.create_reel_object(bpy.context, "reel", model, Timeline(10))
    modifier = show_points(reel)
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 1, False
    scene.render.resolution_x, scene.render.resolution_y, scene.render.film_transparent = 24, 24, True
    for viewport, rendered, seen in ((0.0, 100.0, True), (100.0, 0.0, False)):
        compat.set_input(modifier, "Viewport Detail", viewport)
        compat.set_input(modifier, "Render Detail", rendered)
        assert render()[:, :, 3].any() == seen
        assert bool(len(evaluated(reel)["position"])) != seen


def test_scale_and_up_turn_the_whole_reel(random_model: Model, tmp_path: Path) -> None:
    save_gaussians(tmp_path / "a.reel", random_model(20), fps=24, frame_start=1, frame_count=5, up="-Y")
    created = reels.import_reel(bpy.context, tmp_path / "a.reel", up=reels.FROM_FILE, scale=2.5)
    bpy.context.view_layer.update()
    up = created.matrix_world.to_3x3() @ Vector((0, -1, 0))
    assert tuple(round(v, 5) for v in up) == (0, 0, 2.5)


@pytest.mark.usefixtures("registered")
@pytest.mark.parametrize(("start_at", "start"), [("OWN", 101), ("SCENE", 5), ("CURRENT", 33)])
def test_reels_start_where_asked(start_at: str, start: float, random_model: Model, tmp_path: Path) -> None:
    save_gaussians(tmp_path / "a.reel", random_model(20), fps=24, frame_start=101, frame_count=5)
    bpy.context.scene.frame_start, bpy.context.scene.frame_current = 5, 33
    bpy.ops.holoreel.import_reel(filepath=str(tmp_path / "a.reel"), start_at=start_at)
    assert reels.timeline_of(bpy.context.object).start == start


@pytest.mark.usefixtures("registered")
def test_import_can_be_undone(random_model: Model, tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", random_model(10))
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.holoreel.import_reel(filepath=str(tmp_path / "a.ply"))
    bpy.ops.ed.undo_push(message="import")
    bpy.ops.ed.undo()
    assert not bpy.data.objects
    bpy.ops.ed.redo()
    assert len(bpy.data.objects["a"].data.points) == 10
    assert len(evaluated(bpy.data.objects["a"])) > 0


@pytest.mark.usefixtures("registered")
def test_dropped_files_reach_the_importer() -> None:
    handler = bpy.types.HOLOREEL_FH_reel
    assert handler.bl_import_operator == "holoreel.import_reel"
    assert set(handler.bl_file_extensions.split(";")) == {".reel", ".splatv", ".stgc"}


def test_moved_reels_are_found_again(random_model: Model, tmp_path: Path) -> None:
    (tmp_path / "one" / "reels").mkdir(parents=True)
    path = tmp_path / "one" / "reels" / "a.reel"
    save_gaussians(path, random_model(20), fps=24, frame_start=1, frame_count=5)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "one" / "scene.blend"))
    reels.import_reel(bpy.context, path)
    bpy.ops.wm.save_mainfile()
    (tmp_path / "one").rename(tmp_path / "two")  # all of it
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "two" / "scene.blend"))
    assert reels.source_of(bpy.data.objects["a"]) == tmp_path / "two" / "reels" / "a.reel"
    (tmp_path / "two" / "reels" / "a.reel").rename(tmp_path / "two" / "a.reel")  # beside the .blend
    assert reels.source_of(bpy.data.objects["a"]) == tmp_path / "two" / "a.reel"
    (tmp_path / "two" / "a.reel").unlink()
    with pytest.raises(HoloreelError, match=r"a\.reel.*relink"):
        reels.source_of(bpy.data.objects["a"])
    assert len(bpy.data.objects["a"].data.points) == 20  # it still plays


@pytest.mark.usefixtures("registered")
def test_reloading_keeps_what_was_set(random_model: Model, tmp_path: Path) -> None:
    path = tmp_path / "a.reel"
    save_gaussians(path, random_model(20), fps=24, frame_start=1, frame_count=5)
    created = reels.import_reel(bpy.context, path)
    twin = created.copy()
    bpy.context.scene.collection.objects.link(twin)
    modifier = show_points(created)
    compat.set_input(modifier, "Speed", 0.5)
    created.location.x = 3
    bpy.context.view_layer.objects.active = created
    longer = random_model(60, 7)
    save_gaussians(path, longer, fps=24, frame_start=1, frame_count=9)
    assert bpy.ops.holoreel.reload_reel() == {"FINISHED"}
    assert len(created.data.points) == len(twin.data.points) == 60
    assert len(bpy.data.pointclouds) == 1
    assert len(bpy.data.objects) == 2
    timeline = reels.timeline_of(created)
    assert (timeline.frame_count, timeline.last_frame, timeline.speed) == (9, 8, 0.5)
    seek(3)
    assert_shows(created, longer.evaluate(1 / 9))
    path.write_text("{}")
    with pytest.raises(RuntimeError, match=r"a\.reel"):
        bpy.ops.holoreel.reload_reel()
    assert len(created.data.points) == 60
    save_gaussians(tmp_path / "b.reel", random_model(30), fps=24, frame_start=1, frame_count=9)
    assert bpy.ops.holoreel.relink_reel(filepath=str(tmp_path / "b.reel")) == {"FINISHED"}
    assert len(created.data.points) == 30
    assert reels.source_of(created).name == "b.reel"


@pytest.mark.usefixtures("registered")
@pytest.mark.skipif(sys.platform == "win32", reason="no limits of file sizes")
def test_no_room_for_points_beside_the_reel_changes_nothing(random_model: Model, tmp_path: Path) -> None:
    import resource

    save_gaussians(tmp_path / "a.reel", random_model(20_000), fps=24, frame_start=1, frame_count=5)
    assert bpy.ops.holoreel.import_reel(filepath=str(tmp_path / "a.reel")) == {"FINISHED"}
    cloud = bpy.context.object.data
    before = sorted(tmp_path.iterdir())
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    signalled = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        with pytest.raises(RuntimeError, match=r"a\.reel\.blend cannot be written: make room"):
            bpy.ops.holoreel.store_beside()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, signalled)
    assert (bpy.context.object.data, cloud.name, cloud.library, len(cloud.points)) == (cloud, "a", None, 20_000)
    assert sorted(tmp_path.iterdir()) == before
    assert bpy.ops.holoreel.store_beside() == {"FINISHED"}


@pytest.mark.usefixtures("registered")
def test_points_beside_the_reel_come_back_with_the_file(random_model: Model, tmp_path: Path) -> None:
    model = random_model(20_000)
    path = tmp_path / "a.reel"
    save_gaussians(path, model, fps=24, frame_start=1, frame_count=5)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    empty = (tmp_path / "scene.blend").stat().st_size
    assert bpy.ops.holoreel.import_reel(filepath=str(path), beside=True) == {"FINISHED"}
    show_points(bpy.context.object)
    bpy.ops.wm.save_mainfile()
    assert (
        (tmp_path / "scene.blend").stat().st_size - empty < 2_000_000 < 20_000 * 120
    )  # node groups are written, points are not
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "scene.blend"))
    seek(2)
    assert_shows(bpy.data.objects["a"], model.evaluate(0.2))

    clouds.library_path(path).unlink()  # missing: said, and made again from the reel
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "scene.blend"))
    created = bpy.data.objects["a"]
    assert "a.reel.blend" in (reload.problem_of(created) or "")
    bpy.context.view_layer.objects.active = created
    with pytest.raises(RuntimeError, match="reload"):
        bpy.ops.holoreel.store_inside()
    assert bpy.ops.holoreel.reload_reel() == {"FINISHED"}
    assert reload.problem_of(created) is None
    seek(2)
    assert_shows(created, model.evaluate(0.2))

    assert bpy.ops.holoreel.store_inside() == {"FINISHED"}
    assert created.data.library is None
    clouds.library_path(path).unlink()
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "scene.blend"))
    seek(2)
    assert_shows(bpy.data.objects["a"], model.evaluate(0.2))


@pytest.mark.usefixtures("registered")
def test_files_of_another_kind_are_not_read_into_a_reel(random_model: Model, tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", random_model(10))
    created = reels.import_reel(bpy.context, tmp_path / "a.ply")
    (tmp_path / "b.reel").write_text('{"kind": "videorf"}')
    with pytest.raises(HoloreelError, match=r"b\.reel is of another kind"):
        reload.relink_reel(bpy.context, created, tmp_path / "b.reel")
    with pytest.raises(HoloreelError, match="no reel"):
        reload.store_beside(bpy.data.objects.new("Empty", None))


def test_a_reel_made_by_a_script_can_be_given_a_file(random_model: Model, tmp_path: Path) -> None:
    save_gaussians(tmp_path / "a.reel", random_model(50), fps=24, frame_start=1, frame_count=5)
    reel = reels.create_reel_object(bpy.context, "reel", random_model(7), Timeline(10))
    with pytest.raises(HoloreelError, match="was not imported"):
        reload.reload_reel(bpy.context, reel)
    reload.relink_reel(bpy.context, reel, tmp_path / "a.reel")
    assert len(reel.data.points) == 50
    assert reels.timeline_of(reel).frame_count == 5
    assert reels.source_of(reel) == tmp_path / "a.reel"


@pytest.mark.usefixtures("registered")
def test_reels_share_the_points_beside_them(random_model: Model, tmp_path: Path) -> None:
    path = tmp_path / "a.reel"
    save_gaussians(path, random_model(50), fps=24, frame_start=1, frame_count=5)
    one, two = (reels.import_reel(bpy.context, path, beside=True) for _ in range(2))
    small = reels.import_reel(bpy.context, path, beside=True, detail=10)
    assert one.data == two.data
    assert [len(reel.data.points) for reel in (one, two, small)] == [50, 50, 5]
    save_gaussians(path, random_model(80), fps=24, frame_start=1, frame_count=5)
    reload.reload_reel(bpy.context, two)
    assert [len(reel.data.points) for reel in (one, two, small)] == [80, 80, 5]
    reload.store_inside(small)
    assert [reel.data.library is None for reel in (one, two, small)] == [False, False, True]
    assert len(bpy.data.pointclouds) == 2


@pytest.mark.usefixtures("registered")
def test_a_folder_that_takes_no_points_stops_the_import(random_model: Model, tmp_path: Path) -> None:
    save_gaussians(tmp_path / "a.reel", random_model(50), fps=24, frame_start=1, frame_count=5)
    clouds.library_path(tmp_path / "a.reel").mkdir()  # in the way
    with pytest.raises(RuntimeError, match=r"a\.reel\.blend cannot be written"):
        bpy.ops.holoreel.import_reel(filepath=str(tmp_path / "a.reel"), beside=True)
    assert not bpy.data.objects
    assert not bpy.data.pointclouds
