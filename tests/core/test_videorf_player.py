# SPDX-License-Identifier: GPL-3.0-or-later
"""Playing a VideoRF: any frame from any rung is what the decoded rows draw, and what is missing is named."""

import math
from dataclasses import replace

import numpy as np
import pytest
from holoreel.core.camera import Camera
from holoreel.core.draw import open_player
from holoreel.core.errors import HoloreelError
from holoreel.core.gaussians.player import GaussianPlayer
from holoreel.core.metrics import psnr
from holoreel.core.reel import VIDEORF, reel_kind
from holoreel.core.videorf import decode
from holoreel.core.videorf.decode import DecodedVideo, find_rung, frames_text
from holoreel.core.videorf.draw import QUALITY
from holoreel.core.videorf.encode import RungSpec, decoded_rows, write_reel
from holoreel.core.videorf.field import MarchRules
from holoreel.core.videorf.grouping import Group
from holoreel.core.videorf.mapping import build_table
from holoreel.core.videorf.model import FieldVideo, in_memory
from holoreel.core.videorf.occupancy import Lattice
from holoreel.core.videorf.player import FieldPlayer, VideoPlayer, rules_of
from holoreel.core.videorf.quantize import Ranges
from holoreel.core.videorf.shading import Shading, ShadingShape

from .videorf_model import ball_model

FIRST = 101  # frame of the timeline
VIEW = Camera.look_at((2.5, -3.0, 1.2), (0.0, 0.0, 0.0), width=41, height=33, fx=80.0)


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """A model of five frames in several groups, and its reel."""
    model = ball_model()
    rungs = [RungSpec(34), RungSpec(8), RungSpec(34, "hevc")]
    return model, write_reel(model, tmp_path_factory.mktemp("player") / "ball.reel", rungs)


def test_a_reel_is_drawn_as_its_decoded_rows_are(played):
    """Bit for bit in the rows, and in the picture what the trainer's own drawing makes of them."""
    model, reel = played
    for rung in range(3):
        rows = [part for _, _, part in decoded_rows(reel, rung)]
        mine, truth = VideoPlayer(reel.path, rung), FieldPlayer(replace(model, load=in_memory(rows)))
        for frame in range(5):
            np.testing.assert_array_equal(mine.source.rows(frame), rows[frame])
            one, other = mine.draw(VIEW, FIRST + frame), truth.draw(VIEW, FIRST + frame)
            assert 0.1 < other.alpha.mean() < 0.9
            for part, wanted in zip(one, other, strict=True):
                np.testing.assert_array_equal(part, wanted)
    unquantized = FieldPlayer(model).draw(VIEW, FIRST).image
    fine, coarse = (VideoPlayer(reel.path, name).draw(VIEW, FIRST).image for name in ("8", "34"))
    assert psnr(fine, unquantized) > psnr(coarse, unquantized) + 3


@pytest.mark.parametrize("held", [decode.CODES_HELD, 0])
def test_frames_in_any_order_are_those_in_order(played, monkeypatch, held):
    """With decoded frames kept, and with none."""
    monkeypatch.setattr(decode, "CODES_HELD", held)
    _, reel = played
    in_order = VideoPlayer(reel.path)
    drawn = [in_order.draw(VIEW, FIRST + frame) for frame in range(5)]
    anywhere = VideoPlayer(reel.path)
    for frame in (4, 0, 3, 1, 1, 2, 0, 4):
        for part, wanted in zip(anywhere.draw(VIEW, FIRST + frame), drawn[frame], strict=True):
            np.testing.assert_array_equal(part, wanted)


def test_going_back_decodes_nothing_twice(played):
    _, reel = played
    source = DecodedVideo(reel)
    decoded = []
    luma = source.video.luma
    source.video.luma = lambda frame: decoded.append(frame) or luma(frame)
    last = reel.groups[0].frames - 1
    assert last > 0
    for frame in (last, 0, last, len(reel.groups) and reel.firsts[1], 0):
        source.rows(frame)
    assert decoded == [*range(last + 1), reel.firsts[1]]
    player = VideoPlayer(reel.path)
    player.draw(VIEW, FIRST)
    assert set(player.seconds) == {"decode", "unpack", "prepare", "draw"}
    player.draw(VIEW, FIRST)
    assert "decode" not in player.seconds


def test_moments_between_frames_show_the_earlier(played):
    player = VideoPlayer(played[1].path)
    for frame, index in ((101, 0), (101.99, 0), (103, 2), (102.9999999, 2), (-5, 0), (105.0, 4), (106, 4), (1e9, 4)):
        assert player.index_of(frame) == index
    for index in range(5):
        assert player.index_of(player.frame_at(index / 5)) == index


def slab_model(density, feature, shape=(9, 9, 9)):
    """A cube of one density and one feature, one frame, in a box from -1 to 1; the network gives the feature's sign."""
    lattice = Lattice(shape, (-1.0, -1.0, -1.0), 0.25)
    occupancy = np.ones(shape, bool)
    table = build_table(occupancy, (32, 32))
    rows = np.tile(np.array([density, feature], np.float32), (table.count, 1))
    network = ShadingShape(1, None, 1)
    layers = [np.ones((1, 1)), np.zeros(1), np.ones((1, 1)), np.zeros(1), np.array([[1.0], [-1.0], [0.0]]), np.zeros(3)]
    weights = [part.astype(np.float32) for part in layers]
    shading = Shading(network, tuple(zip(weights[::2], weights[1::2], strict=True)))
    groups = (Group(0, 1, occupancy),)
    return FieldVideo(lattice, groups, (table,), shading, Ranges((-8.0, -20.0), (60.0, 20.0)), in_memory([rows]))


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_colors_alpha_and_depth_are_those_of_a_known_cube(backend):
    solid = FieldPlayer(slab_model(60.0, 3.0), backend=backend)
    eye = (0.3, -4.0, 0.2)
    camera = Camera.look_at(eye, (0.3, -3.0, 0.2), width=31, height=31, fx=60.0)
    image, alpha, depth = solid.draw(camera, 1, (0.0, 0.0, 1.0))
    x, z = (camera.pixel_centers().reshape(31, 31, 2) - 15.5).T / 60.0 * 3.0  # at the front face, 3 before the eye
    hit = ((abs(x + eye[0]) < 0.95) & (abs(eye[2] - z) < 0.95)).T
    assert 100 < hit.sum() < 900
    np.testing.assert_allclose(alpha[hit], 1, atol=1e-4)
    sigmoid = 1 / (1 + math.exp(-3))
    np.testing.assert_allclose(image[hit], np.tile([sigmoid, 1 - sigmoid, 0.5], (hit.sum(), 1)), atol=2e-3)
    assert (abs(depth[hit] - 3) < 0.25).all()  # planar: the same all over the face, within a step
    assert np.ptp(depth[hit]) < 0.15
    miss = ((abs(x + eye[0]) > 1.4) | (abs(eye[2] - z) > 1.4)).T
    assert (alpha[miss] == 0).all()
    assert (depth[miss] == 0).all()
    np.testing.assert_array_equal(image[miss], np.tile(np.float32([0, 0, 1]), (miss.sum(), 1)))
    thin = FieldPlayer(slab_model(math.log(math.expm1(0.1)), 0.0), backend=backend)  # 0.1 per spacing, 8 spacings
    middle = Camera.look_at((0.0, -4.0, 0.0), (0, 0, 0), width=3, height=3, fx=60.0)
    assert thin.draw(middle, 1).alpha[1, 1] == pytest.approx(1 - math.exp(-0.8), abs=0.02)


def test_backends_and_backgrounds_agree(played):
    _, reel = played
    mine, twin = (VideoPlayer(reel.path, backend=backend) for backend in ("cpu", "reference"))
    assert (mine.backend_name, twin.backend_name) == ("cpu", "reference")
    parts = zip(mine.draw(VIEW, 103), twin.draw(VIEW, 103), (1e-4, 1e-4, 5e-3), strict=True)
    for part, wanted, most in parts:  # a ray that ends a sample later moves the depth more than the color
        np.testing.assert_allclose(part, wanted, atol=most)
    white, green = mine.draw(VIEW, 103), mine.draw(VIEW, 103, (0.0, 1.0, 0.0))
    left = (1 - white.alpha)[..., None]
    np.testing.assert_allclose(white.image - left, green.image - left * np.array([0, 1, 0]), atol=1e-6)
    with pytest.raises(ValueError, match="no backend"):
        VideoPlayer(reel.path, backend="best")


def test_qualities_take_longer_steps_than_training(played):
    model, reel = played
    trained = replace(model, step=0.25, transmittance_min=1e-3)
    assert rules_of(trained, "full") == MarchRules(0.25, 1e-3)
    draft = rules_of(trained, "draft")
    assert draft.step / 0.25 == QUALITY["draft"].step / QUALITY["full"].step > 1
    assert draft.transmittance_min >= 1e-3
    full, fast = (VideoPlayer(reel.path, "8", quality).draw(VIEW, 102).image for quality in ("full", "fast"))
    assert 25 < psnr(fast, full) < 90
    with pytest.raises(HoloreelError, match="'best' is unknown: take one of full"):
        VideoPlayer(reel.path, quality="best")


def test_lenses_reach_what_they_see(played):
    _, reel = played
    player = VideoPlayer(reel.path)
    assert player.reach(VIEW) is None
    fisheye = replace(VIEW, model="OPENCV_FISHEYE", fx=40.0, fy=40.0, distortion=(0.0, 0.0, 0.0, 0.0))
    drawn, plain = player.draw(fisheye, FIRST), player.draw(VIEW, FIRST)
    assert plain.alpha[16, 20] > 0.1
    for part, wanted in zip(drawn, plain, strict=True):  # both look straight ahead in the middle
        np.testing.assert_allclose(part[16, 20], wanted[16, 20], atol=1e-4)
    assert 0 < drawn.alpha.sum() < 0.4 * plain.alpha.sum()
    poles = replace(VIEW, model="OPENCV_FISHEYE", fx=5.0, fy=5.0, distortion=(0.0, 0.0, 0.0, 0.0))
    seen = player.reach(poles)  # the corners lie 290 degrees off the axis
    assert seen is not None
    assert seen[16, 20]
    assert not seen[0, 0]
    assert (player.draw(poles, FIRST).alpha[~seen] == 0).all()


def test_rungs_are_found_by_place_and_name(played):
    _, reel = played
    wanted = {None: 1, 0: 0, 2: 2, "8": 1, "34": 0, "h264:34": 0, "hevc:34": 2}
    assert {name: find_rung(reel, name) for name in wanted} == wanted
    for name in (3, -1, "20", "av1:34", ""):
        with pytest.raises(HoloreelError, match=r"has no rung .*: take one of h264:34, h264:8, hevc:34"):
            find_rung(reel, name)
    player = VideoPlayer(reel.path, "hevc:34")
    assert player.facts()["rung"] == "hevc:34"
    names = (reel.rungs[2].file, reel.tables_file, reel.shading_file, reel.path.name)
    assert player.size() == sum((reel.path.parent / name).stat().st_size for name in names)
    assert f"{player.size():,} bytes" in player.facts()["rungs"]["hevc:34"]


def test_what_is_whole_of_a_truncated_reel_plays(played, tmp_path):
    model, _ = played
    reel = write_reel(model, tmp_path / "cut.reel", [RungSpec(20)])
    whole = VideoPlayer(reel.path).draw(VIEW, FIRST)
    video = tmp_path / reel.rungs[0].file
    last = reel.rungs[0].video.groups[-1]
    video.write_bytes(video.read_bytes()[: last.offset + last.size // 2])
    player = VideoPlayer(reel.path)
    lost = [FIRST + last.first + index for index in range(last.frames)]
    assert player.missing() == lost
    assert player.report == [f"{video} is cut off: {frames_text(lost)} cannot be drawn; fetch the rest of it."]
    with pytest.raises(HoloreelError, match="is cut off"):
        player.draw(VIEW, lost[0])
    np.testing.assert_array_equal(player.draw(VIEW, FIRST).image, whole.image)
    video.unlink()
    with pytest.raises(HoloreelError, match="put it beside"):
        VideoPlayer(reel.path)


def test_frames_in_words():
    assert frames_text([7]) == "frame 7"
    assert frames_text([7, 8]) == "frames 7 to 8"
    assert frames_text([1, 2, 3, 5, 9, 10]) == "frames 1 to 3, 5, 9 to 10"


def test_kinds_of_reels_are_told_apart(played, recording, tmp_path):
    assert reel_kind(played[1].path) == VIDEORF
    assert reel_kind(recording.reel) == "spacetime_gaussians"
    (tmp_path / "a.reel").write_text('{"kind": ["videorf"]}')
    assert reel_kind(tmp_path / "a.reel") == reel_kind(tmp_path) == reel_kind(recording.reel.with_suffix(".ply")) == ""
    for path in (tmp_path / "a.reel", tmp_path / "none.reel", tmp_path):
        with pytest.raises(HoloreelError, match=str(path)):
            open_player(path)


def test_every_file_finds_its_player(played, recording, tmp_path):
    model, reel = played
    folder = model.write(tmp_path / "ball.model")
    assert isinstance(open_player(reel.path, rung="hevc:34", quality="draft"), VideoPlayer)
    assert isinstance(open_player(folder, quality="fast"), FieldPlayer)
    assert isinstance(open_player(recording.reel, "reference"), GaussianPlayer)
    np.testing.assert_array_equal(open_player(folder).draw(VIEW, 104).image, FieldPlayer(model).draw(VIEW, 104).image)
    assert open_player(folder).size() > 4 * sum(model.rows(frame).size for frame in range(5))
    for path, choices in (
        (reel.path, {"decoder_output": "clamp"}),
        (folder, {"rung": "8"}),
        (folder, {"decoder_output": "clamp"}),
        (recording.reel, {"rung": "8"}),
        (recording.reel, {"quality": "fast"}),
    ):
        flag = next(iter(choices)).replace("_", "-")
        with pytest.raises(HoloreelError, match=f"has no use for --{flag}: leave it away"):
            open_player(path, **choices)
