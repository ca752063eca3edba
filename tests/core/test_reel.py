# SPDX-License-Identifier: GPL-3.0-or-later
"""The `.reel` manifest: what is written is read, what is wrong is named, and no path leaves the folder."""

import json
from dataclasses import replace

import numpy as np
import pytest
from holoreel.core.errors import HoloreelError
from holoreel.core.gaussians.decoder import Decoder, write_decoder
from holoreel.core.gaussians.model import ROWS
from holoreel.core.gaussians.ply import write_ply
from holoreel.core.reel import (
    Segment,
    SegmentPayload,
    load_gaussians,
    read_reel,
    save_gaussians,
    write_reel,
    write_segments,
)


@pytest.fixture
def saved(tmp_path, random_model):
    return save_gaussians(
        tmp_path / "out" / "a.reel", random_model(30), fps=24, frame_start=101, frame_count=12, up="Z",
        background=(0.25, 0.5, 1.0), files={"metrics": "logs/metrics.json"}, provenance={"trainer": {"seed": 3}},
    )  # fmt: skip


def change(reel, **changes) -> None:
    manifest = json.loads(reel.path.read_text())
    for key, value in changes.items():
        place, target = manifest, key
        if "__" in key:
            name, index, target = key.split("__")
            place = manifest[name][int(index)]
        if value is KeyError:
            del place[target]
        else:
            place[target] = value
    reel.path.write_text(json.dumps(manifest))


def test_a_reel_comes_back_as_it_went(saved, random_model):
    assert sorted(path.name for path in saved.path.parent.iterdir()) == ["a.ply", "a.reel"]
    assert read_reel(saved.path) == saved
    loaded = load_gaussians(saved.path)
    assert (loaded.kind, loaded.fps, loaded.frame_start, loaded.frame_count, loaded.up) == ("reel", 24.0, 101, 12, "Z")
    assert (loaded.color_space, loaded.background, loaded.report) == ("display", (0.25, 0.5, 1.0), [])
    for name in ROWS:
        np.testing.assert_array_equal(getattr(loaded.gaussians, name), getattr(random_model(30), name))
    np.testing.assert_allclose(saved.bounds, random_model(30).bounds())


def test_frames_become_times(saved):
    loaded = load_gaussians(saved.path)
    assert [loaded.time_of(frame) for frame in (101, 104, 107.5)] == [0.0, 0.25, 6.5 / 12]
    parts = (Segment("a.ply", 101, 4), Segment("b/c.ply", 105, 8))
    long = replace(saved, segments=parts)
    assert [long.locate(frame) for frame in (90, 101, 103, 104.5, 105, 111, 113, 200)] == [
        (0, 0.0), (0, 0.0), (0, 0.5), (0, 0.875), (1, 0.0), (1, 0.75), (1, 1.0), (1, 1.0),
    ]  # fmt: skip
    assert long.payload(1) == saved.path.parent / "b" / "c.ply"
    write_reel(long)
    assert read_reel(saved.path) == long
    with pytest.raises(HoloreelError, match=r"'b/c\.ply' is missing"):
        load_gaussians(saved.path, segment=1)
    with pytest.raises(HoloreelError, match="no segment 2: take 0 to 1"):
        load_gaussians(saved.path, segment=2)


def test_bare_files_have_assumed_lengths(tmp_path, random_model):
    write_ply(tmp_path / "a.PLY", random_model(5))
    loaded = load_gaussians(tmp_path / "a.PLY")
    assert (loaded.kind, loaded.fps, loaded.frame_start, loaded.frame_count, loaded.up) == ("ply", 30.0, 0, 50, None)
    assert "50 frames at 30 fps are assumed" in loaded.report[0]


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("kind", "videorf"), ("kind", KeyError), ("version", 0), ("version", "1"), ("version", True), ("version", 2),
        ("fps", 0), ("fps", -1), ("fps", "24"), ("fps", None), ("fps", float("nan")), ("fps", float("inf")),
        ("fps", 10**400), ("frame_start", 1.5), ("frame_start", None), ("frame_start", 102), ("frame_count", 0),
        ("frame_count", 10**12), ("frame_count", 13), ("frame_count", True), ("variant", "medium"),
        ("variant", KeyError), ("bounds", [1, 2]), ("bounds", [[0, 0, 0], [1, 1, -1]]), ("bounds", 7),
        ("bounds", [["a"] * 3] * 2), ("bounds", [[0, 0, float("nan")], [1, 1, 1]]), ("up", "W"), ("up", ["Z"]),
        ("color_space", "acescg"), ("color_space", KeyError), ("background", [0, 1]), ("background", None),
        ("background", "red"), ("decoder", {"file": "a.pt"}), ("decoder", {"output": "tanh"}), ("decoder", "sigmoid"),
        ("decoder", {"output": "sigmoid"}), ("segments__0__decoder", "a.decoder.safetensors"), ("files", []),
        ("files", {"metrics": "../m.json"}), ("provenance", 3), ("segments", []), ("segments", {}),
        ("segments", ["a.ply"]), ("segments", None), ("segments__0__file", "/etc/a.ply"),
        ("segments__0__file", "../a.ply"), ("segments__0__file", "b/../../a.ply"), ("segments__0__file", "..\\a.ply"),
        ("segments__0__file", "C:/a.ply"), ("segments__0__file", "//host/a.ply"), ("segments__0__file", ""),
        ("segments__0__file", 5), ("segments__0__file", KeyError), ("segments__0__file", "a.txt"),
        ("segments__0__file", "a\0.ply"), ("segments__0__frame_start", 100), ("segments__0__frame_start", KeyError),
        ("segments__0__frame_count", -12), ("segments__0__frame_count", 5), ("segments__0__frame_count", "12"),
    ],
)  # fmt: skip
def test_a_wrong_field_is_named(saved, field, value):
    change(saved, **{field: value})
    name = field.split("__")[-1]
    with pytest.raises(HoloreelError) as caught:
        load_gaussians(saved.path)
    assert "a.reel" in str(caught.value)
    assert name.removesuffix("s") in str(caught.value) or name.startswith("frame_")


def test_newer_reels_ask_for_an_update(saved):
    change(saved, version=2, segments="a new notion")
    with pytest.raises(HoloreelError, match=r"version 2, .* up to 1: update Holoreel"):
        read_reel(saved.path)


def test_unknown_fields_are_left_alone(saved):
    change(saved, title="a fox", segments__0__poster="a.png")
    assert read_reel(saved.path) == saved


def test_payload_and_manifest_must_agree(saved, random_model):
    write_ply(saved.payload(), random_model(5, features=9))
    with pytest.raises(HoloreelError, match=r"'variant' lite, but 'a\.ply' is full"):
        load_gaussians(saved.path)
    saved.payload().unlink()
    with pytest.raises(HoloreelError, match=r"'a\.ply' is missing; put .*a\.ply beside the reel"):
        load_gaussians(saved.path)


def test_what_is_no_reel_is_refused(tmp_path):
    path = tmp_path / "a.reel"
    for text in ("", "{", "[]", "7", '{"kind": null}', "\xff\xfe", "[" * 100000):
        path.write_bytes(text.encode("latin-1"))
        with pytest.raises(HoloreelError, match=r"a\.reel"):
            load_gaussians(path)
    for other in (tmp_path, tmp_path / "absent.reel", tmp_path / "absent.ply", tmp_path / "a.obj"):
        with pytest.raises(HoloreelError, match=other.name):
            load_gaussians(other)


def test_nothing_half_written(tmp_path, random_model):
    with pytest.raises(HoloreelError, match="'fps' is 0"):
        save_gaussians(tmp_path / "a.reel", random_model(3), fps=0, frame_start=0, frame_count=5)
    with pytest.raises(HoloreelError, match=r"name like a\.reel"):
        save_gaussians(tmp_path / "a.ply", random_model(3), fps=24, frame_start=0, frame_count=5)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").write_text("")
    with pytest.raises(HoloreelError, match="cannot be written"):
        save_gaussians(tmp_path / "file" / "a.reel", random_model(3), fps=24, frame_start=0, frame_count=5)


@pytest.fixture
def decoders():
    random = np.random.default_rng(4)
    return [Decoder(random.normal(size=(6, 12)), random.normal(size=(3, 6)), "clamp") for _ in range(2)]


def test_segments_of_a_full_model_each_have_their_decoder(tmp_path, random_model, decoders):
    models = [random_model(20, seed, features=9) for seed in (1, 2)]
    parts = [SegmentPayload(*both, 11 + 4 * i, 4) for i, both in enumerate(zip(models, decoders, strict=True))]
    reel = write_segments(tmp_path / "a.reel", parts, fps=25, frame_start=11, viewpoint=(1.0, 2.0, 3.0))
    assert read_reel(reel.path) == reel
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "a.000.decoder.safetensors", "a.000.ply", "a.001.decoder.safetensors", "a.001.ply", "a.reel",
    ]  # fmt: skip
    assert json.loads(reel.path.read_text())["decoder"] == {"output": "clamp", "viewpoint": [1.0, 2.0, 3.0]}
    assert (reel.frame_count, reel.locate(15), reel.locate(14)) == (8, (1, 0.0), (0, 0.75))
    for index, (model, decoder) in enumerate(zip(models, decoders, strict=True)):
        loaded = load_gaussians(reel.path, index)
        np.testing.assert_array_equal(loaded.gaussians.features, model.features)
        np.testing.assert_array_equal(loaded.decoder.hidden, decoder.hidden)
        assert (loaded.decoder.activation, loaded.viewpoint, loaded.report) == ("clamp", (1.0, 2.0, 3.0), [])
    boxes = np.array([model.bounds() for model in models])
    np.testing.assert_allclose(reel.bounds, [boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])
    write_decoder(reel.decoder(1), Decoder(decoders[0].hidden, decoders[0].output, "none"))
    with pytest.raises(HoloreelError, match=r"'decoder.output' clamp, but 'a\.001\.decoder\.safetensors' says none"):
        load_gaussians(reel.path, 1)
    reel.decoder(0).unlink()
    with pytest.raises(HoloreelError, match=r"its decoder 'a\.000\.decoder\.safetensors' is missing"):
        load_gaussians(reel.path)
    with pytest.raises(HoloreelError, match="leave --decoder-output away"):
        load_gaussians(reel.path, decoder_output="clamp")


def test_segments_must_hold_together(tmp_path, random_model, decoders):
    lite, full = random_model(5), random_model(5, features=9)
    other = Decoder(decoders[0].hidden, decoders[0].output, "none")
    cases = [
        ([(lite, None, 1, 4), (lite, None, 6, 4)], "'segments.1..frame_start' is 6, not 5"),
        ([(lite, None, 2, 4)], "'segments.0..frame_start' is 2, not 1"),
        ([(lite, None, 1, 4), (full, None, 5, 4)], "differ .full, lite"),
        ([(full, other, 1, 4), (full, decoders[1], 5, 4)], "differ .full, clamp, none"),
        ([(full, other, 1, 4), (full, None, 5, 4)], "'segments.1..decoder' is None"),
        ([(lite, other, 1, 4)], "'decoder' is 'none', not null in a lite reel"),
        ([], "'frame_count' is 0"),
    ]
    for parts, words in cases:
        with pytest.raises(HoloreelError, match=words):
            write_segments(tmp_path / "a.reel", [SegmentPayload(*part) for part in parts], fps=25, frame_start=1)
        assert list(tmp_path.iterdir()) == []
