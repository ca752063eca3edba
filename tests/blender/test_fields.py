# SPDX-License-Identifier: GPL-3.0-or-later
"""VideoRF reels in Geometry Nodes, against what Holoreel itself decodes (`tests/data/field/make.py`)."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import bpy
import holoreel
import numpy as np
import pytest
from holoreel.addon import attributes, fields, reels
from holoreel.addon.compat import get_input, set_input
from holoreel.addon.nodes.builder import Tree, Value
from holoreel.addon.nodes.decoder import decoder, feature_sockets, fits
from holoreel.addon.nodes.field import BROKEN, CAMERA, DIRECTION, feature_attributes, field_frame, field_reel
from holoreel.addon.nodes.reel import DISPLAY, SPLATS
from holoreel.addon.timeline import HOLD, LOOP, PING_PONG, Timeline
from holoreel.core.errors import HoloreelError
from holoreel.core.videorf.occupancy import GAMMA, opacity
from holoreel.core.videorf.package import VideoReel, read_video_reel
from holoreel.core.videorf.points import field_points
from holoreel.core.videorf.shading import Shading, ShadingShape
from mathutils import Euler, Matrix, Vector
from numpy.typing import NDArray

DATA = Path(__file__).parents[1] / "data" / "field"
FRAMES = 9
ANY_ORDER = (3, 0, 8, 1, 7, 2, 6, 0, 5, 4)  # over the seams 0|1 and 6|7, forward and backward
Array = NDArray[np.float32]


class Shown(NamedTuple):
    """The evaluated points of an object: places (N, 3), colors (N, 3), opacities (N)."""

    xyz: Array
    rgb: Array
    opacity: Array


def evaluated(played: bpy.types.Object, frame: float) -> bpy.types.GeometrySet:
    bpy.context.scene.frame_set(int(np.floor(frame)), subframe=float(frame - np.floor(frame)))
    return played.evaluated_get(bpy.context.evaluated_depsgraph_get()).evaluated_geometry()


def shown(played: bpy.types.Object, frame: float) -> Shown:
    geometry = evaluated(played, frame)
    found = {name: attributes.read(geometry.pointcloud.attributes, name) for name in ("position", "rgb", "opacity")}
    return Shown(found["position"], found["rgb"][:, :3], found["opacity"])


@pytest.fixture(scope="module")
def ball_blend(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A .blend with the ball: its node groups take longer to build than to load."""
    path = str(tmp_path_factory.mktemp("blend") / "ball.blend")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    played = reels.import_reel(bpy.context, DATA / "ball.reel")
    set_input(reels.modifier_of(played), "Color", DISPLAY)
    set_input(reels.modifier_of(played), "Hide Fainter Than", 0.0)
    bpy.ops.wm.save_as_mainfile(filepath=path)
    return path


@pytest.fixture
def ball(ball_blend: str) -> bpy.types.Object:
    """The ball's object: reel frame t is shown at scene frame t + 1, with all points, in display-referred colors."""
    bpy.ops.wm.open_mainfile(filepath=ball_blend)
    return bpy.data.objects["ball"]


@pytest.fixture(scope="module")
def reel() -> VideoReel:
    return read_video_reel(DATA / "ball.reel")


@pytest.fixture(scope="module")
def rows(reel: VideoReel) -> list[Array]:
    """The rows (N, C) of every frame, as core's own player decodes them."""
    with np.load(DATA / "codes.npz") as codes:
        return [reel.ranges.decode(codes[f"t{t}"]) for t in range(FRAMES)]


def group_rows(reel: VideoReel, frame: int) -> slice:
    """Return which of the object's points are those of a frame's group."""
    group = reel.group_of(frame)
    start = sum(entry.vertices for entry in reel.groups[:group])
    return slice(start, start + reel.groups[group].vertices)


def test_every_frame_comes_as_it_was_decoded(ball: bpy.types.Object, reel: VideoReel, rows: list[Array]) -> None:
    modifier = ball.modifiers.new("Frame", "NODES")
    modifier.node_group = field_frame(reel)
    set_input(modifier, "Movie", fields.movie_of(ball))
    set_input(modifier, "Minimum Opacity", 0.0)
    ball.modifiers.remove(reels.modifier_of(ball))
    step = np.array(reel.ranges.high) - np.array(reel.ranges.low)
    for frame in ANY_ORDER:
        set_input(modifier, "Frame", frame)
        geometry = evaluated(ball, 1)
        part = group_rows(reel, frame)
        found = geometry.pointcloud.attributes
        lattice_places = reel.lattice.positions(reel.table(reel.group_of(frame)).vertices).astype(np.float32)
        np.testing.assert_array_equal(attributes.read(found, "position")[part], lattice_places)
        features = np.concatenate([attributes.read(found, name) for name in feature_attributes(7)], 1)[part, :7]
        density = attributes.read(found, "field_density")[part, None]
        error = abs(np.concatenate((density, features), 1) - rows[frame]) / step
        assert error.max() < 1e-6, frame
        expected = opacity(rows[frame][:, 0].astype(np.float64))
        np.testing.assert_allclose(attributes.read(found, "opacity")[part], expected, atol=1e-6)


def test_points_are_those_that_core_exports(ball: bpy.types.Object, reel: VideoReel, rows: list[Array]) -> None:
    counts = set()
    for frame in ANY_ORDER:
        expected = field_points(reel.lattice, reel.table(reel.group_of(frame)), rows[frame], reel.shade())
        seen = shown(ball, frame + 1)
        np.testing.assert_array_equal(seen.xyz, expected.xyz)
        np.testing.assert_allclose(
            -np.log1p(-seen.opacity.astype(np.float64)) / reel.lattice.spacing, expected.density, rtol=2e-3
        )
        counts.add(len(seen.xyz))
    assert len(counts) > 4
    assert max(counts) < max(entry.vertices for entry in reel.groups)


def expected_colors(reel: VideoReel, rows: Array, frame: int, eye: Array | None, way: Array | None = None) -> Array:
    kept = opacity(rows[:, 0].astype(np.float64)) > GAMMA
    places = reel.lattice.positions(reel.table(reel.group_of(frame)).vertices)[kept]
    ways = places - eye if eye is not None else np.broadcast_to(np.asarray(way, np.float64), places.shape)
    return reel.shade()(rows[kept, 1:], ways / np.linalg.norm(ways, axis=1, keepdims=True)).astype(np.float32)


def add_camera(place: tuple[float, float, float], turned: Euler, kind: str = "PERSP") -> bpy.types.Object:
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    camera.location, camera.rotation_euler, camera.data.type = place, turned, kind
    return camera


def test_colors_are_those_that_the_camera_sees(ball: bpy.types.Object, reel: VideoReel, rows: list[Array]) -> None:
    camera = add_camera((0.4, -1.5, 2.0), Euler((1.1, 0.3, 0.2)))
    ball.matrix_world = (
        Matrix.Translation((1, 2, -3)) @ Euler((0.4, -0.8, 2)).to_matrix().to_4x4() @ Matrix.Diagonal((2, 0.5, 1.5, 1))
    )
    seen = []
    for frame, place in ((2, (0.4, -1.5, 2.0)), (7, (0.4, -1.5, 2.0)), (7, (-3.0, 2.5, 1.0))):
        camera.location = place
        eye = np.array(ball.matrix_world.inverted() @ Vector(place))
        seen.append(shown(ball, frame + 1).rgb)
        np.testing.assert_allclose(seen[-1], expected_colors(reel, rows[frame], frame, eye), atol=2e-5)
    assert abs(seen[1] - seen[2]).max() > 0.05


def test_an_orthographic_camera_looks_along_one_direction(
    ball: bpy.types.Object, reel: VideoReel, rows: list[Array]
) -> None:
    camera = add_camera((0, -9, 0), Euler((1.2, 0, 0.4)), "ORTHO")
    ahead = np.array(camera.rotation_euler.to_matrix() @ Vector((0, 0, -1)))
    np.testing.assert_allclose(shown(ball, 4).rgb, expected_colors(reel, rows[3], 3, None, ahead), atol=2e-5)


def test_colors_along_a_stated_direction_need_no_camera(
    ball: bpy.types.Object, reel: VideoReel, rows: list[Array]
) -> None:
    modifier = reels.modifier_of(ball)
    assert get_input(modifier, "Seen From") == CAMERA
    for view, way in ((CAMERA, (0.5, 1.0, -0.5)), (DIRECTION, (3.0, -1.0, 0.5))):
        set_input(modifier, "Seen From", view)
        set_input(modifier, "Direction", way)
        expected = expected_colors(reel, rows[8], 8, None, np.array(way))
        np.testing.assert_allclose(shown(ball, 9).rgb, expected, atol=2e-5)


@pytest.mark.parametrize(
    "shape",
    [
        ShadingShape(7, 1, 16),
        ShadingShape(1, 0, 1),
        ShadingShape(15, 2, 8),
        ShadingShape(6, None, 5),
        ShadingShape(8, 2, 3),
    ],
    ids=str,
)
def test_networks_of_any_shape_are_computed_in_nodes(shape: ShadingShape) -> None:
    random = np.random.default_rng(shape.count)
    layers = tuple(
        (random.normal(size=(o, i)).astype(np.float32), random.normal(size=o).astype(np.float32))
        for o, i in shape.layers
    )
    shading = Shading(shape, layers)
    features = random.normal(size=(50, shape.features)).astype(np.float32)
    ways = random.normal(size=(50, 3))
    ways = (ways / np.linalg.norm(ways, axis=1, keepdims=True)).astype(np.float32)
    group = decoder(shading)
    assert decoder(Shading(shape, layers)) == group  # built once

    mesh = bpy.data.meshes.new("Features")
    mesh.vertices.add(50)
    columns = np.pad(features, ((0, 0), (0, -shape.features % 3)), constant_values=9e9).reshape(50, -1, 3)
    names = feature_sockets(shape.features)
    for name, values in [*zip(names, columns.swapaxes(0, 1), strict=True), ("Direction", ways)]:
        mesh.attributes.new(name, "FLOAT_VECTOR", "POINT").data.foreach_set(
            "vector", np.ascontiguousarray(values).ravel()
        )
    tree = Tree(bpy.data.node_groups.new("Test", "GeometryNodeTree"))
    cloud = tree.geometry_input()
    inputs = {name: tree.attribute(name, "FLOAT_VECTOR") for name in (*names, "Direction")}
    color = Value(tree, tree.group(group, inputs).outputs["Color"])
    tree.output("Geometry", tree.store(cloud, "color", color, "FLOAT_VECTOR"))
    carrier = bpy.data.objects.new("Features", mesh)
    bpy.context.scene.collection.objects.link(carrier)
    carrier.modifiers.new("Test", "NODES").node_group = tree.tree
    computed = np.empty(150, np.float32)
    geometry = evaluated(carrier, 1)
    geometry.mesh.attributes["color"].data.foreach_get("vector", computed)
    np.testing.assert_allclose(computed.reshape(50, 3), shading(features, ways), atol=1e-5)


def test_networks_too_large_for_nodes_leave_a_hint(ball: bpy.types.Object, reel: VideoReel, rows: list[Array]) -> None:
    shape = ShadingShape(7, 1, 64)
    assert fits(reel.shading)
    assert not fits(shape)
    layers = tuple((np.zeros((o, i), np.float32), np.zeros(o, np.float32)) for o, i in shape.layers)
    group = field_reel(replace(reel, shading=shape), Shading(shape, layers))
    reels.modifier_of(ball).node_group = group  # inputs keep their values
    set_input(reels.modifier_of(ball), "Color", DISPLAY)
    kept = opacity(rows[2][:, 0].astype(np.float64)) > GAMMA
    low, high = np.array(reel.ranges.low[1:4]), np.array(reel.ranges.high[1:4])
    np.testing.assert_allclose(shown(ball, 3).rgb, (rows[2][kept, 1:4] - low) / (high - low), atol=1e-5)


def test_the_timeline_chooses_whole_frames(ball: bpy.types.Object, reel: VideoReel, rows: list[Array]) -> None:
    counts = [int((opacity(row[:, 0].astype(np.float64)) > GAMMA).sum()) for row in rows]
    firsts = [row[0, 0] for row in rows]
    assert len(set(zip(counts, firsts, strict=True))) == FRAMES  # so that every frame can be told
    mappings = [
        Timeline(FRAMES, start=1, speed=0.5),
        Timeline(FRAMES, start=3, speed=0.1, offset=0.2, repeat=LOOP),
        Timeline(FRAMES, start=-4.5, speed=-1.7, repeat=LOOP),
        Timeline(FRAMES, start=2, speed=1.25, repeat=PING_PONG),
        Timeline(FRAMES, start=1, first=2, last=40, repeat=HOLD),  # beyond the reel: its last frame
    ]
    for mapping in mappings:
        reels.set_timeline(ball, mapping)
        for frame in (-20, 0, 1, 2, 3.5, 7, 13, 1000):
            expected = mapping.whole_frame(frame)
            seen = shown(ball, frame)
            assert len(seen.xyz) == counts[expected], (mapping, frame)
            kept = opacity(rows[expected][:, 0].astype(np.float64)) > GAMMA
            np.testing.assert_allclose(
                seen.opacity,
                opacity(rows[expected][kept, 0].astype(np.float64)),
                atol=1e-5,
                err_msg=str((mapping, frame)),
            )


def test_whole_frames_survive_rounding() -> None:
    mapping = Timeline(100, start=1, speed=0.1)
    assert [mapping.whole_frame(1 + 10 * k) for k in range(100)] == list(range(100))
    assert mapping.whole_frame(1.9) == 0
    assert Timeline(5, repeat=LOOP).whole_frame(5.9999) == 4  # not the sixth frame of five


def test_what_is_shown_looks_like_gaussians(ball: bpy.types.Object, reel: VideoReel) -> None:
    geometry = evaluated(ball, 1)
    names = {attribute.name for attribute in geometry.pointcloud.attributes}
    assert {"rgb", "opacity", "scale", "radius"} <= names
    assert not [name for name in names if name.startswith("field_")]
    radius = attributes.read(geometry.pointcloud.attributes, "radius")
    assert radius.min() > reel.lattice.spacing * 3**0.5 / 2  # no gaps between neighbors
    assert radius.max() < reel.lattice.spacing
    add_camera((0, -5, 1), Euler((1.4, 0, 0)))
    count = len(geometry.pointcloud.points)
    set_input(reels.modifier_of(ball), "Look", SPLATS)
    assert len(evaluated(ball, 1).mesh.vertices) == 4 * count


def copied(folder: Path) -> Path:
    for path in DATA.glob("ball.*"):
        shutil.copy(path, folder)
    return folder / "ball.reel"


@pytest.mark.usefixtures("ball")
def test_a_movie_that_goes_missing_is_seen_and_said(tmp_path: Path) -> None:
    played = reels.import_reel(bpy.context, copied(tmp_path))
    played.name = "copy"
    set_input(reels.modifier_of(played), "Color", DISPLAY)
    assert fields.movie_problem(played) is None
    (tmp_path / "ball.qp18.mp4").rename(tmp_path / "gone.mp4")
    blend = str(tmp_path / "scene.blend")
    bpy.ops.wm.save_as_mainfile(filepath=blend)
    bpy.ops.wm.open_mainfile(filepath=blend)
    played = bpy.data.objects["copy"]
    assert "ball.qp18.mp4" in str(fields.movie_problem(played))
    for frame in (1, 5):
        seen = shown(played, frame)
        assert len(seen.xyz) in {188, 220}  # all points of the group, in a color that nobody overlooks
        np.testing.assert_array_equal(seen.rgb, np.broadcast_to(np.float32(BROKEN), seen.rgb.shape))
    with pytest.raises(HoloreelError, match="qp18"):
        fields.set_rung(played, read_video_reel(tmp_path / "ball.reel"), "18")
    assert fields.set_rung(played, read_video_reel(tmp_path / "ball.reel")) == "h264:34"
    assert fields.movie_problem(played) is None
    set_input(reels.modifier_of(played), "Seen From", DIRECTION)
    assert (shown(played, 1).rgb != np.float32(BROKEN)).any(1).all()


@pytest.mark.usefixtures("ball")
def test_a_folder_with_the_blend_and_the_reel_can_be_moved(tmp_path: Path) -> None:
    old, new = tmp_path / "old", tmp_path / "new"
    old.mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(old / "scene.blend"))
    reels.import_reel(bpy.context, copied(old)).name = "moved"
    bpy.ops.wm.save_mainfile()
    old.rename(new)
    bpy.ops.wm.open_mainfile(filepath=str(new / "scene.blend"))
    moved = bpy.data.objects["moved"]
    assert fields.movie_problem(moved) is None
    for name in ("Color", "Hide Fainter Than"):
        set_input(reels.modifier_of(moved), name, get_input(reels.modifier_of(bpy.data.objects["ball"]), name))
    np.testing.assert_array_equal(shown(moved, 4).rgb, shown(bpy.data.objects["ball"], 4).rgb)
    assert fields.set_rung(moved, read_video_reel(reels.source_of(moved)), "34") == "h264:34"


def test_another_movie_in_its_place_is_seen(ball: bpy.types.Object, tmp_path: Path) -> None:
    other = bpy.data.images.new("Other", 64, 48)
    set_input(reels.modifier_of(ball), "Movie", other)
    np.testing.assert_array_equal(np.unique(shown(ball, 3).rgb, axis=0), [BROKEN])
    set_input(reels.modifier_of(ball), "Movie", None)
    np.testing.assert_array_equal(np.unique(shown(ball, 3).rgb, axis=0), [BROKEN])
    assert "No movie" in str(fields.movie_problem(ball))
    (warning,) = reels.modifier_of(ball).node_warnings
    assert warning.type == "ERROR"
    assert "The movie of this VideoRF is missing" in warning.message


class Layout:
    """Stands for a layout: keeps the texts that are drawn."""

    def __init__(self) -> None:
        self.texts: list[str] = []

    def label(self, text: str, icon: str) -> None:
        assert icon in bpy.types.UILayout.bl_rna.functions["label"].parameters["icon"].enum_items
        self.texts.append(text)

    def column(self, align: bool) -> "Layout":
        assert align
        return self

    def operator_menu_enum(self, _operator: str, _name: str, text: str, icon: str) -> None:
        self.label(text, icon)

    def prop(self, data: Any, name: str, text: str) -> None:
        assert hasattr(data, name) or data.path_resolve(name) is not None
        self.texts.append(text)


def test_the_panel_shows_what_matters(ball: bpy.types.Object) -> None:
    holoreel.register()
    try:
        kind = bpy.types.HOLOREEL_PT_field

        def drawn() -> list[str]:
            host = SimpleNamespace(layout=Layout())
            host.inputs = lambda context, *names: kind.inputs(host, context, *names)
            region = SimpleNamespace(width=900)
            kind.draw(host, SimpleNamespace(object=ball, scene=bpy.context.scene, region=region))
            return host.layout.texts

        add_camera((0, -5, 0), Euler((1.5, 0, 0)))
        assert drawn() == ["ball.qp18.mp4", "Rate h264:18", "Movie", "Seen From", "Minimum Opacity"]
        set_input(reels.modifier_of(ball), "Seen From", DIRECTION)
        assert "Direction" in drawn()
        set_input(reels.modifier_of(ball), "Movie", None)
        assert "No movie" in drawn()[0]
    finally:
        holoreel.unregister()


@pytest.mark.usefixtures("ball")
def test_rungs_are_chosen_on_import_and_later(reel: VideoReel) -> None:
    with np.load(DATA / "codes.npz") as codes:
        coarse = reel.ranges.decode(codes["last"])
    played = fields.add_field_reel(bpy.context, reel, timeline=Timeline(FRAMES), name="ball", rung="34")
    set_input(reels.modifier_of(played), "Hide Fainter Than", 0.0)
    assert played[reels.INFO]["rung"] == "h264:34"
    kept = opacity(coarse[:, 0].astype(np.float64)) > GAMMA
    expected = opacity(coarse[kept, 0].astype(np.float64))
    np.testing.assert_allclose(shown(played, FRAMES).opacity, expected, atol=1e-6)
    assert fields.set_rung(played, reel, "18") == "h264:18"
    assert played[reels.INFO]["rung"] == "h264:18"
    assert len(shown(played, FRAMES).opacity) != len(expected)
    with pytest.raises(HoloreelError, match="no rung 20"):
        fields.set_rung(played, reel, "20")
    groups = len(bpy.data.node_groups)
    for other in (replace(reel, shading_sha256="0" * 64), replace(reel, groups=reel.groups[:-1])):
        with pytest.raises(HoloreelError, match="of another training than object 'ball"):
            fields.set_rung(played, other)
    assert len(bpy.data.node_groups) == groups
    with pytest.raises(HoloreelError, match="plays no VideoRF"):
        fields.set_rung(add_camera((0, 0, 0), Euler()), reel)


def test_operator_and_panel_change_the_movie(ball: bpy.types.Object, tmp_path: Path) -> None:
    holoreel.register()
    try:
        bpy.context.view_layer.objects.active = ball
        assert bpy.types.HOLOREEL_PT_field.poll(bpy.context)
        assert bpy.ops.holoreel.choose_rung(rung="h264:34") == {"FINISHED"}
        assert ball[reels.INFO]["rung"] == "h264:34"
        with pytest.raises(TypeError, match="h264:18"):
            bpy.ops.holoreel.choose_rung(rung="h264:20")
        bpy.ops.wm.read_factory_settings(use_empty=True)
        assert not bpy.ops.holoreel.choose_rung.poll()
        assert not bpy.types.HOLOREEL_PT_field.poll(bpy.context)
        result = bpy.ops.holoreel.import_reel(filepath=str(copied(tmp_path)), rung="34")
        assert result == {"FINISHED"}
        assert bpy.context.object[reels.INFO]["rung"] == "h264:34"
    finally:
        holoreel.unregister()


@pytest.mark.usefixtures("ball")
def test_the_best_rung_that_is_there_is_taken(tmp_path: Path) -> None:
    path = copied(tmp_path)
    (tmp_path / "ball.qp18.mp4").unlink()
    played = reels.import_reel(bpy.context, path)
    assert "movie 'ball.qp18.mp4' is missing: rung h264:34 is shown" in played[reels.INFO]["report"]
    (tmp_path / "ball.qp34.mp4").unlink()
    with pytest.raises(HoloreelError, match=r"movie 'ball\.qp18\.mp4' is missing"):
        reels.import_reel(bpy.context, path)


def test_a_movie_cut_off_plays_as_far_as_it_goes(ball: bpy.types.Object, tmp_path: Path, reel: VideoReel) -> None:
    path = copied(tmp_path)
    movie = tmp_path / "ball.qp18.mp4"
    whole = [shown(ball, frame + 1).rgb for frame in range(FRAMES)]
    for place, group in enumerate(reel.rungs[0].video.groups[1:], start=1):
        for share in (0.01, 0.5, 0.99):  # without its head, in the middle of its frames, all but all
            movie.write_bytes((DATA / movie.name).read_bytes()[: group.offset + int(share * group.size)])
            played = reels.import_reel(bpy.context, path)
            for name in ("Color", "Hide Fainter Than"):
                set_input(reels.modifier_of(played), name, get_input(reels.modifier_of(ball), name))
            assert f"frames {group.first} to {FRAMES - 1} cannot be shown" in played[reels.INFO]["report"]
            for frame in range(FRAMES):
                seen = shown(played, frame + 1).rgb
                if frame < group.first:
                    np.testing.assert_array_equal(seen, whole[frame])
                else:
                    np.testing.assert_array_equal(np.unique(seen, axis=0), [BROKEN], err_msg=str((place, share, frame)))
            reels.remove_reel(played)


@pytest.mark.usefixtures("ball")
def test_a_movie_that_blender_seeks_wrongly_is_refused(tmp_path: Path) -> None:
    path = copied(tmp_path)
    path.write_text(path.read_text().replace('"fps": 24.0', '"fps": 24.02'))
    with pytest.raises(HoloreelError, match=r"takes it for 24 frames per second, it has 24\.02"):
        reels.import_reel(bpy.context, path)


def flip(path: Path, at: int) -> None:
    data = bytearray(path.read_bytes())
    data[at] ^= 0xFF
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("damage", "named"),
    [
        (lambda folder: (folder / "ball.tables").unlink(), r"ball\.tables"),
        (lambda folder: flip(folder / "ball.tables", 70), r"ball\.tables"),
        (lambda folder: (folder / "ball.shading").unlink(), r"ball\.shading"),
        (lambda folder: flip(folder / "ball.shading", 9), r"ball\.shading"),
        (lambda folder: flip(folder / "ball.qp18.mp4", 4000), r"ball\.qp18\.mp4"),
        (lambda folder: shutil.copy(folder / "ball.qp34.mp4", folder / "ball.qp18.mp4"), r"ball\.qp18\.mp4"),
        (lambda folder: (folder / "ball.qp18.mp4").write_bytes(b"no movie"), r"ball\.qp18\.mp4"),
    ],
)
def test_damaged_payloads_are_refused_and_nothing_is_added(
    damage: Callable[[Path], None], named: str, tmp_path: Path
) -> None:
    path = copied(tmp_path)
    damage(tmp_path)
    with pytest.raises(HoloreelError, match=named):
        reels.import_reel(bpy.context, path)
    assert not bpy.data.objects
    assert not bpy.data.pointclouds
    assert not bpy.data.images
    assert not bpy.data.movieclips


def test_a_blend_keeps_playing_and_duplicates_share_what_they_can(tmp_path: Path, ball: bpy.types.Object) -> None:
    groups = len(bpy.data.node_groups)
    again = reels.import_reel(bpy.context, DATA / "ball.reel")
    assert len(bpy.data.node_groups) == groups
    assert fields.movie_of(again) == fields.movie_of(ball)
    reels.set_timeline(again, Timeline(FRAMES, start=5))
    assert reels.timeline_of(again) == Timeline(FRAMES, start=5, last=FRAMES - 1)
    before = [shown(ball, 6), shown(again, 6)]
    assert len(before[0].xyz) != len(before[1].xyz)
    blend = str(tmp_path / "scene.blend")
    bpy.ops.wm.save_as_mainfile(filepath=blend)
    bpy.ops.wm.open_mainfile(filepath=blend)
    for name, old in zip(("ball", "ball.001"), before, strict=True):
        new = shown(bpy.data.objects[name], 6)
        for one, other in zip(new, old, strict=True):
            np.testing.assert_array_equal(one, other)
