# SPDX-License-Identifier: GPL-3.0-or-later
"""What users of other importers asked for, one test for each wish that touches import or the timeline."""

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import bpy
import holoreel
import numpy as np
import pytest
from holoreel.addon import attributes, compat, reels, reload
from holoreel.addon.nodes.reel import DISPLAY
from holoreel.addon.nodes.show import POINTS
from holoreel.addon.timeline import Timeline
from holoreel.core.errors import HoloreelError
from holoreel.core.gaussians.model import SpacetimeGaussians
from holoreel.core.gaussians.ply import write_ply
from holoreel.core.plyfile import write_vertices
from holoreel.core.reel import save_gaussians
from mathutils import Vector
from numpy.typing import NDArray

Model = Callable[..., SpacetimeGaussians]
DATA = Path(__file__).parents[1] / "data" / "field"


@pytest.fixture(autouse=True)
def _registered() -> Iterator[None]:
    """Holoreel's operators and panels."""
    holoreel.register()
    yield
    holoreel.unregister()


def show_points(reel: bpy.types.Object) -> None:
    """Let a reel show all of its evaluated Gaussians as points."""
    modifier = reels.modifier_of(reel)
    for name, value in (("Look", POINTS), ("Color", DISPLAY), ("Hide Fainter Than", 0.0)):
        compat.set_input(modifier, name, value)


def positions(reel: bpy.types.Object) -> NDArray[np.float32]:
    """Return where the points of a reel are now, whatever geometry it is."""
    geometry = reel.evaluated_get(bpy.context.evaluated_depsgraph_get()).evaluated_geometry()
    if geometry.pointcloud is None:
        return np.zeros((0, 3), np.float32)
    return attributes.read(geometry.pointcloud.attributes, "position")


def write_static_ply(path: Path, count: int = 40) -> None:
    """Write an ordinary 3D Gaussian PLY with harmonics that are not needed."""
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "f_rest_0", "f_rest_1", "opacity"]
    names += [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)]
    table = np.zeros(count, [(name, "f4") for name in names])
    table["x"], table["opacity"], table["rot_0"] = np.arange(count), 3.0, 1.0
    write_vertices(path, table)


def test_an_ordinary_splat_ply_is_taken_and_called_what_it_is(tmp_path: Path) -> None:
    write_static_ply(tmp_path / "still.ply")
    bpy.ops.holoreel.import_reel(filepath=str(tmp_path / "still.ply"))
    reel = bpy.context.object
    assert "ordinary 3D Gaussian PLY" in reel[reels.INFO]["report"]
    show_points(reel)
    for frame in (1, 30, 500):
        bpy.context.scene.frame_set(frame)
        assert sorted(positions(reel)[:, 0]) == list(range(40))


def test_ply_sequences_play_as_one_reel(random_model: Model, tmp_path: Path) -> None:
    """Frames 2 and 10 in their natural order, of different sizes; found and read again from elsewhere."""
    folder = tmp_path / "old"
    folder.mkdir()
    names = ["take 2.ply", "take 10.ply", "take 11.ply"]
    models = [random_model(count, count) for count in (30, 50, 20)]
    for name, model in zip(names, models, strict=True):
        write_ply(folder / name, model)
    files = [{"name": name} for name in sorted(names)]
    bpy.ops.holoreel.import_reel(directory=str(folder), files=files, sequence=True)
    reel = bpy.context.object
    assert len(bpy.data.objects) == 1
    assert "3 files are the frames" in reel[reels.INFO]["report"]
    assert reels.timeline_of(reel).frame_count == 3
    folder.rename(tmp_path / "new")
    assert bpy.ops.holoreel.relink_reel(filepath=str(tmp_path / "new" / names[0])) == {"FINISHED"}
    show_points(reel)
    for frame, model, time in ((-5, models[0], 0), (1, models[0], 0), (2.5, models[1], 0.5), (3, models[2], 0)):
        bpy.context.scene.frame_set(int(np.floor(frame)), subframe=frame % 1)
        truth = model.evaluate(time)
        expected, found = truth.take(truth.alive).means, positions(reel)
        np.testing.assert_allclose(np.sort(found, axis=0), np.sort(expected, axis=0), atol=1e-5)
    save_gaussians(tmp_path / "new" / "b.reel", models[0], fps=24, frame_start=1, frame_count=2)
    with pytest.raises(RuntimeError, match=r"b\.reel is a reel"):
        bpy.ops.holoreel.import_reel(directory=str(tmp_path / "new"), files=[*files, {"name": "b.reel"}], sequence=True)


def test_a_ply_of_plain_points_is_refused_with_the_reason(tmp_path: Path) -> None:
    write_vertices(tmp_path / "points.ply", np.zeros(9, [(name, "f4") for name in ("x", "y", "z", "t", "s")]))
    with pytest.raises(RuntimeError, match="PLY of plain points"):
        bpy.ops.holoreel.import_reel(filepath=str(tmp_path / "points.ply"))
    assert not bpy.data.objects
    assert not bpy.data.node_groups


def test_import_says_what_it_did_and_shows_where_it_is(
    random_model: Model, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    save_gaussians(tmp_path / "walk.reel", random_model(1234), fps=24, frame_start=1, frame_count=10)
    bpy.ops.holoreel.import_reel(filepath=str(tmp_path / "walk.reel"))
    assert "walk: 1,234 Gaussians, 10 frames at 24 per second" in capfd.readouterr().out
    assert bpy.context.object.select_get()
    assert bpy.context.object.visible_get()


def test_nothing_is_appended_from_files_that_can_be_missing() -> None:
    root = Path(holoreel.__file__).parent
    rooms = [root / room for room in ("addon", "core", "operators", "panels")]
    assert not [path for room in rooms for path in room.rglob("*.blend")]


@pytest.mark.parametrize("axis", list(reels.UPRIGHT))
def test_an_upside_down_sequence_can_be_set_upright(axis: str, random_model: Model, tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", random_model(10))
    bpy.ops.holoreel.import_reel(filepath=str(tmp_path / "a.ply"), up=axis, scale=2.0)
    bpy.context.view_layer.update()
    direction = Vector(np.eye(3)["XYZ".index(axis[-1])] * (-1 if axis.startswith("-") else 1))
    up = bpy.context.object.matrix_world.to_3x3() @ direction
    np.testing.assert_allclose(up, (0, 0, 2), atol=1e-6)


def test_every_frame_is_there_when_it_is_rendered(random_model: Model, render: Callable[[], NDArray]) -> None:
    """A render never shows the frame before: nothing is streamed in."""
    scene = bpy.context.scene
    model = random_model(3)
    model.means[:], model.motions[:] = ((-1, 0, -5), (0, 0.5, -5), (0, -0.5, -5)), 0.0
    model.motions[:, 0, 0], model.trbf_centers[:], model.trbf_log_scales[:] = (2.0, 0, 0), 0.0, 16.0
    model.opacity_logits[:], model.log_scales[:] = 5.0, -2.0
    show_points(reels.create_reel_object(bpy.context, "reel", model, Timeline(10)))
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 4, False
    scene.render.resolution_x, scene.render.resolution_y, scene.render.film_transparent = 60, 20, True
    seen = {}
    for frame in (9, 1, 5, 9):
        scene.frame_set(frame)
        alpha = render()[8:12, :, 3].sum(axis=0)
        place = float((alpha * np.arange(60)).sum() / alpha.sum())
        assert seen.setdefault(frame, place) == place
    assert seen[1] < seen[5] < seen[9]
    assert seen[5] - seen[1] == pytest.approx(seen[9] - seen[5], abs=1.0)


def test_an_asset_plays_in_another_file(random_model: Model, tmp_path: Path) -> None:
    """Appended and linked, with its timeline and its resolution drivers."""
    model = random_model(60)
    save_gaussians(tmp_path / "walk.reel", model, fps=24, frame_start=1, frame_count=10)
    reel = reels.import_reel(bpy.context, tmp_path / "walk.reel", start=5)
    show_points(reel)
    reel.asset_mark()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "library.blend"))
    for link in (False, True):
        bpy.ops.wm.read_factory_settings(use_empty=True)
        with bpy.data.libraries.load(str(tmp_path / "library.blend"), link=link, assets_only=True) as (found, wanted):
            wanted.objects = found.objects
        (brought,) = wanted.objects
        bpy.context.scene.collection.objects.link(brought)
        bpy.context.scene.frame_set(8)
        truth = model.evaluate(0.3)
        assert len(positions(brought)) == len(truth.alive) > 0
        timeline = reels.timeline_of(brought)
        assert (timeline.start, timeline.frame_count) == (5, 10)
        assert reels.source_of(brought) == tmp_path / "walk.reel"
        if link:
            with pytest.raises(HoloreelError, match="linked from another"):
                reload.reload_reel(bpy.context, brought)


def test_copies_play_on_their_own(random_model: Model) -> None:
    """A linked duplicate shares the points, and has a timeline of its own."""
    model = random_model(60)
    one = reels.create_reel_object(bpy.context, "reel", model, Timeline(10))
    show_points(one)
    two = one.copy()
    bpy.context.scene.collection.objects.link(two)
    reels.set_timeline(two, Timeline(10, start=4))
    bpy.context.scene.frame_set(4)
    assert len(bpy.data.pointclouds) == 1
    assert len(positions(one)) == len(model.evaluate(0.3).alive)
    assert len(positions(two)) == len(model.evaluate(0.0).alive)


def test_an_empty_moment_is_no_error(random_model: Model) -> None:
    """A reel that shows nothing at some frames, in every look."""
    model = random_model(20)
    model.trbf_centers[:], model.trbf_log_scales[:], model.opacity_logits[:] = 0.5, np.log(0.02), 4.0
    reel = reels.create_reel_object(bpy.context, "reel", model, Timeline(10))
    show_points(reel)
    for frame, count in ((1, 0), (6, 20), (9, 0), (6, 20)):
        bpy.context.scene.frame_set(frame)
        assert len(positions(reel)) == count


def test_a_videorf_that_moved_is_found_or_relinked(tmp_path: Path) -> None:
    shutil.copytree(DATA, tmp_path / "old")
    bpy.ops.holoreel.import_reel(filepath=str(tmp_path / "old" / "ball.reel"), up="Y")
    reel = bpy.context.object
    assert reel[reels.INFO]["kind"] == "videorf"
    (tmp_path / "old").rename(tmp_path / "new")
    with pytest.raises(RuntimeError, match=r"ball\.reel.*relink"):
        bpy.ops.holoreel.reload_reel()
    assert reload.problem_of(reel) is not None
    assert bpy.ops.holoreel.relink_reel(filepath=str(tmp_path / "new" / "ball.reel")) == {"FINISHED"}
    assert reload.problem_of(reel) is None
    assert reels.source_of(reel) == tmp_path / "new" / "ball.reel"
    bpy.context.scene.frame_set(4)
    show_points(reel)
    assert len(positions(reel))
    assert not bpy.ops.holoreel.store_beside.poll()
