# SPDX-License-Identifier: GPL-3.0-or-later
"""From a model to a reel and back to rows; what the reel weighs."""

import pytest
from holoreel.core.errors import HoloreelError
from holoreel.core.videorf.codec import CODECS
from holoreel.core.videorf.encode import RungSpec, decoded_rows, lumas_of, reel_size, round_trip, write_reel
from holoreel.core.videorf.package import read_video_reel
from holoreel.core.videorf.quantize import Ranges

from .videorf_model import ball_model


@pytest.fixture(scope="module")
def encoded(tmp_path_factory):
    model = ball_model()
    out = tmp_path_factory.mktemp("encode") / "ball.reel"
    return model, write_reel(model, out, [RungSpec(8), RungSpec(30), RungSpec(30, "hevc")], provenance={"more": 1})


def test_reels_hold_what_the_model_does(encoded):
    model, reel = encoded
    again = read_video_reel(reel.path)
    assert again == reel
    assert len(model.groups) > 1
    assert [rung.file for rung in reel.rungs] == ["ball.qp8.mp4", "ball.qp30.mp4", "ball.qp30.hevc.mp4"]
    assert (again.fps, again.frame_start, again.up) == (model.fps, 101, "Z")
    assert again.provenance == {"made": "by a test", "more": 1}
    assert all(
        (a == b).all() for one, two in zip(again.shade().layers, model.shading.layers, strict=True)
        for a, b in zip(one, two, strict=True)
    )  # fmt: skip
    for rung, steps in ((0, 3), (1, 40), (2, 40)):
        for index, (frame, table, rows) in enumerate(decoded_rows(again, rung)):
            assert index == frame
            assert (table.vertices == model.table_of(frame).vertices).all()
            assert (abs(rows - model.rows(frame)) / reel.ranges.step).max() < steps
        assert frame == model.frame_count - 1


def test_rows_are_those_of_single_frames(encoded):
    """Rows in order are bit for bit those of frames asked for in any order."""
    _, reel = encoded
    video = reel.video(1)
    in_order = {frame: rows for frame, _, rows in decoded_rows(reel, 1)}
    for frame in (4, 0, 3, 1, 2):
        codes = reel.table(reel.group_of(frame)).to_rows(reel.tiling.unpack(video.luma(frame)))
        assert (reel.ranges.decode(codes) == in_order[frame]).all()


def test_sizes_are_those_of_the_files(encoded):
    _, reel = encoded
    folder = reel.path.parent
    for rung in range(3):
        size = reel_size(reel, rung)
        names = (reel.rungs[rung].file, "ball.tables", "ball.shading", "ball.reel")
        assert size[:4] == tuple((folder / name).stat().st_size for name in names)
        assert size.total == sum(size[:4]) == size.per_frame * 5
    assert {path.name for path in folder.iterdir()} == {*names, "ball.qp8.mp4", "ball.qp30.mp4"}


@pytest.mark.parametrize("codec", CODECS)
def test_a_round_trip_in_memory_is_that_of_the_reel(encoded, tmp_path, codec):
    model, _ = encoded
    reel = write_reel(model, tmp_path / "a.reel", [RungSpec(28, codec)])
    decoded = {frame: (table, rows) for frame, table, rows in decoded_rows(reel)}
    lumas = list(lumas_of(model, reel.ranges, reel.tiling))
    for group, coded in zip(model.groups, reel.rungs[0].video.groups, strict=True):
        frames = range(group.first, group.first + group.count)
        images, size = round_trip([reel.tiling.unpack(lumas[frame]) for frame in frames], reel.tiling, 28, codec)
        assert -64 < size - coded.size < 1024  # boxes name the fragment's number and time; the first one is signed
        for frame, image in zip(frames, images, strict=True):
            table, rows = decoded[frame]
            assert (reel.ranges.decode(table.to_rows(image)) == rows).all()


def test_other_ranges_are_those_of_the_reel(encoded, tmp_path):
    model, _ = encoded
    wide = Ranges((-8.0, *[-40.0] * 7), (16.0, *[40.0] * 7))
    reel = write_reel(model, tmp_path / "a.reel", [RungSpec(0)], ranges=wide)
    assert reel.ranges == wide
    for frame, _, rows in decoded_rows(reel):
        assert (abs(rows - model.rows(frame)) <= 1.51 * wide.step).all()


def test_progress_counts_frames_of_all_rungs(encoded, tmp_path):
    heard = []
    rungs = [RungSpec(20), RungSpec(40)]
    write_reel(encoded[0], tmp_path / "a.reel", rungs, on_progress=lambda done, total: heard.append((done, total)))
    assert heard == [(done, 10) for done in range(1, 11)]


def test_models_that_cannot_be_encoded_are_refused(encoded, tmp_path):
    model, _ = encoded
    for rungs, profile, message in (
        ([], "universal", "none or not all different"),
        ([RungSpec(20), RungSpec(20)], "universal", "none or not all different"),
        ([RungSpec(52)], "universal", "QP of 52 is out of range: take 0 to 51 for h264"),
        ([RungSpec(20), RungSpec(20, "vp9")], "universal", "'vp9' is unknown"),
        ([RungSpec(20)], "tiny", "'tiny' is unknown"),
    ):
        with pytest.raises(HoloreelError, match=message):
            write_reel(model, tmp_path / "a.reel", rungs, profile)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ValueError, match="at least one frame"):
        round_trip([], encoded[1].tiling, 20)


def test_missing_encoders_are_named(encoded, tmp_path, monkeypatch):
    monkeypatch.setitem(CODECS, "hevc", CODECS["hevc"]._replace(encoder="libnone"))
    with pytest.raises(HoloreelError, match="PyAV has no libnone here"):
        write_reel(encoded[0], tmp_path / "a.reel", [RungSpec(20, "hevc")])
