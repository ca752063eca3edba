# SPDX-License-Identifier: GPL-3.0-or-later
"""Compact payloads: against a reader written from docs/formats.md, by what pictures lose, and on damaged files."""

import json
import struct
import zlib
from contextlib import suppress

import numpy as np
import pytest
from holoreel.core.errors import HoloreelError
from holoreel.core.gaussians.compact import STEPS, read_compact, write_compact
from holoreel.core.gaussians.decoder import Decoder
from holoreel.core.gaussians.model import ROWS, sigmoid
from holoreel.core.gaussians.player import GaussianPlayer
from holoreel.core.gaussians.ply import write_ply
from holoreel.core.gaussians.splatv import read_splatv
from holoreel.core.reel import SegmentPayload, load_gaussians, read_reel, write_segments
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

NAMES = {
    "means": 3, "motions": 9, "quats": 4, "omegas": 4, "log_scales": 3, "opacity_logits": 1, "features": 3,
    "trbf_centers": 1, "trbf_log_scales": 1,
}  # fmt: skip


def split(data: bytes) -> tuple[dict, bytes]:
    magic, length, check = struct.unpack("<4sII", data[:12])
    assert magic == b"STGC"
    assert zlib.crc32(data[12 : 12 + length]) == check
    return json.loads(data[12 : 12 + length]), data[12 + length :]


def join(header: object, streams: bytes) -> bytes:
    text = json.dumps(header).encode()
    return struct.pack("<4sII", b"STGC", len(text), zlib.crc32(text)) + text + streams


def read_by_the_book(data: bytes) -> dict[str, list[float]]:
    """Every number of every row, one by one."""
    header, streams = split(data)
    columns, at, count = {}, 0, header["count"]
    for column in header["columns"]:
        raw = zlib.decompress(streams[at : at + column["size"]]) if column["planes"] else b""
        at += column["size"]
        assert len(raw) == count * column["planes"]
        values, before = [], 0
        for row in range(count):
            k = sum(raw[plane * count + row] << (8 * plane) for plane in range(column["planes"]))
            if column["delta"]:
                k = before + (-(k + 1) // 2 if k % 2 else k // 2)
                before = k
            values.append(column["low"] + column["step"] * k)
        columns[column["name"]] = values
    assert at == len(streams)
    return columns


@pytest.mark.parametrize("features", [3, 9])
def test_a_reader_by_the_book_reads_the_same(tmp_path, random_model, features):
    model = random_model(300, features=features)
    model.omegas[:, 1] = 0.0  # a column without planes
    write_compact(tmp_path / "a.stgc", model)
    data = (tmp_path / "a.stgc").read_bytes()
    header, _ = split(data)
    assert (header["version"], header["count"]) == (1, 300)
    assert header["variant"] == {3: "lite", 9: "full"}[features]
    assert {part["delta"] for part in header["columns"]} == {False, True}
    assert {part["planes"] for part in header["columns"]} >= {0, 1, 2}
    columns = read_by_the_book(data)
    assert list(columns) == [f"{n}_{i}" for n, w in (NAMES | {"features": features}).items() for i in range(w)]
    read, report = read_compact(tmp_path / "a.stgc")
    assert report == []
    for name in ROWS:
        for index, values in enumerate(read.columns(name).T):
            np.testing.assert_allclose(values, columns[f"{name}_{index}"], rtol=1e-6, atol=1e-9)


def test_what_is_seen_hardly_changes(tmp_path, random_model):
    """Row by row, over the whole time: places, directions, sizes, opacities and colors stay within their steps."""
    model = random_model(400, seed=5, features=9)
    model.trbf_log_scales[:] = np.random.default_rng(0).uniform(-1, 1, 400)
    model.opacity_logits[:] = model.opacity_logits.clip(-7, 7)
    write_compact(tmp_path / "a.stgc", model)
    read, _ = read_compact(tmp_path / "a.stgc")
    assert len(read) == 400
    # The rows' order changed: features tell which is which.
    order = np.abs(read.features[:, None] - model.features[None]).max(axis=2).argmin(axis=1)
    assert sorted(order) == list(range(400))
    model = model.take(order)
    size = np.quantile(np.exp(model.log_scales.max(axis=1)), 0.1)
    for time in (0.0, 0.3, 0.8, 1.0):
        before, after = model.evaluate(time), read.evaluate(time)
        np.testing.assert_allclose(after.means, before.means, atol=0.5 * size * (0.04 + 0.08 + 0.16 + 0.32) + 1e-5)
        alike = np.abs((after.quats * before.quats).sum(axis=1))
        assert alike.min() > 0.999
        np.testing.assert_allclose(np.log(after.scales), np.log(before.scales), atol=0.5 * STEPS["log_scales"] + 1e-5)
        np.testing.assert_allclose(after.opacities, before.opacities, atol=0.03)
        np.testing.assert_allclose(after.features, before.features, atol=0.5 * STEPS["features"] + 2e-3)


def test_strange_rows_keep_their_meaning(tmp_path, random_model):
    model = random_model(50)
    model.quats[:10] = 0.0
    model.omegas[:5] = 0.0
    model.means[20] = [3e9, -2e8, 1e7]  # one far away does not coarsen the others
    model.log_scales[21] = -1e30
    model.opacity_logits[22:24] = [1e30, -1e30]
    model.trbf_log_scales[24:26] = [1e30, -40.0]
    model.motions[30] = np.nan
    write_compact(tmp_path / "a.stgc", model)
    read, _ = read_compact(tmp_path / "a.stgc")
    assert len(read) == 49
    assert not read.bad_rows().any()
    assert (~(read.quats.any(axis=1) | read.omegas.any(axis=1))).sum() == 5
    turned = model.omegas[5:10] / np.linalg.norm(model.omegas[5:10], axis=1, keepdims=True)
    turned *= np.sign(turned[:, :1])
    assert np.abs(read.quats[:, None] - turned[None]).max(axis=2).min(axis=0).max() < 0.01
    near = model.means[np.abs(model.means).max(axis=1) < 100]
    distance = np.abs(read.means[:, None] - near[None]).max(axis=2).min(axis=1)
    assert np.sort(distance)[:-1].max() < 0.01
    peaks = sigmoid(read.opacity_logits)
    assert peaks.max() > 0.999
    assert peaks.min() < 1 / 255
    assert np.nanmax(read.lifetimes()) > 1e6
    write_compact(tmp_path / "a.stgc", model.take([]))
    with pytest.raises(HoloreelError, match="holds no Gaussians"):
        read_compact(tmp_path / "a.stgc")


def test_a_fourth_of_the_size_at_no_visible_loss(shared_data, tmp_path):
    from holoreel.core.camera import Camera

    model, _ = read_splatv(shared_data("stg_splatv/spinach_4.splatv"))
    model = model.take(np.exp(model.log_scales).prod(axis=1).argsort()[::2])
    write_ply(tmp_path / "a.ply", model)
    write_compact(tmp_path / "a.stgc", model)
    assert 4 * (tmp_path / "a.stgc").stat().st_size <= (tmp_path / "a.ply").stat().st_size
    camera = Camera(320, 240, 290.0, 290.0, 160.0, 120.0)
    for frame in (0, 25):
        exact, read = (
            GaussianPlayer(tmp_path / name).draw(camera, frame).image.clip(0, 1) for name in ("a.ply", "a.stgc")
        )
        assert exact.std() > 0.05
        # So little that a model 33 dB from the truth loses less than 0.1 dB.
        assert -10 * np.log10(np.mean((exact - read) ** 2)) > 49.0


def test_reels_may_have_compact_segments(tmp_path, random_model):
    random = np.random.default_rng(4)
    decoders = [Decoder(random.normal(size=(6, 12)), random.normal(size=(3, 6)), "none") for _ in range(2)]
    parts = [SegmentPayload(random_model(30, i, features=9), decoders[i], 1 + 5 * i, 5) for i in range(2)]
    reel = write_segments(tmp_path / "a.reel", parts, fps=24, frame_start=1, suffix=".stgc")
    assert read_reel(reel.path) == reel
    assert {path.name for path in tmp_path.iterdir()} == {
        "a.reel", "a.000.stgc", "a.001.stgc", "a.000.decoder.safetensors", "a.001.decoder.safetensors",
    }  # fmt: skip
    for index in range(2):
        loaded = load_gaussians(reel.path, index)
        assert (loaded.gaussians.variant, len(loaded.gaussians), loaded.decoder.activation) == ("full", 30, "none")
    bare = load_gaussians(tmp_path / "a.001.stgc")  # its decoder lies beside it
    assert (bare.kind, bare.decoder.activation) == ("stgc", "none")
    np.testing.assert_array_equal(bare.decoder.hidden, decoders[1].hidden)


@pytest.fixture
def packed(tmp_path, random_model):
    write_compact(tmp_path / "good.stgc", random_model(40))
    return (tmp_path / "good.stgc").read_bytes()


def refuse(folder, data: bytes) -> str:
    """Expect one sentence about `a.stgc`."""
    (folder / "a.stgc").write_bytes(data)
    with pytest.raises(HoloreelError) as caught:
        read_compact(folder / "a.stgc")
    assert "a.stgc" in str(caught.value)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_truncated_and_longer_files_are_refused(tmp_path, packed):
    for length in [*range(0, len(packed), 97), len(packed) - 1]:
        refuse(tmp_path, packed[:length])
    assert "promises" in refuse(tmp_path, packed + b"\0")


def test_any_flipped_byte_is_noticed(tmp_path, packed):
    for place in range(0, len(packed), 13):
        damaged = bytearray(packed)
        damaged[place] ^= 0x15
        refuse(tmp_path, bytes(damaged))


@pytest.mark.parametrize(
    "change",
    [
        {"version": 2}, {"version": "1"}, {"version": True}, {"variant": "full"}, {"variant": None}, {"variant": [3]},
        {"count": 2**40}, {"count": -1}, {"count": 39}, {"count": 41}, {"count": 1e9}, {"count": "many"}, {"count": 0},
        {"columns": []}, {"columns": None}, {"columns": [1] * 29}, {"column": {"planes": 7}},
        {"column": {"planes": -1}}, {"column": {"planes": 0}}, {"column": {"planes": True}},
        {"column": {"size": 2**60}}, {"column": {"size": -1}}, {"column": {"size": 3}},
        {"column": {"low": float("nan")}}, {"column": {"low": 10**400}},
        {"column": {"step": 0}}, {"column": {"step": -1.0}}, {"column": {"step": None}}, {"column": {"delta": 1}},
        {"column": {"name": "means_9"}}, {"column": {"name": ["means_0"]}},
    ],
)  # fmt: skip
def test_headers_that_lie_are_refused(tmp_path, packed, change):
    header, streams = split(packed)
    header["columns"][0] |= change.pop("column", {})
    refuse(tmp_path, join(header | change, streams))


def test_no_payload_at_all(tmp_path):
    for data in (b"", b"ply\n", b"STGC", b"STGC" + b"\xff" * 8, join([], b""), join({}, b""), join("x", b"")):
        refuse(tmp_path, data)
    deep = b"[" * 60000
    refuse(tmp_path, struct.pack("<4sII", b"STGC", len(deep), zlib.crc32(deep)) + deep)
    for path in (tmp_path, tmp_path / "absent.stgc"):
        with pytest.raises(HoloreelError, match="cannot be read"):
            read_compact(path)


def test_a_stream_that_would_fill_the_memory_is_not_unpacked(tmp_path, packed):
    header, streams = split(packed)
    first = header["columns"][0]
    bomb = zlib.compress(bytes(20 * 2**20), 9)
    rest = streams[first["size"] :]
    first |= {"size": len(bomb)}
    assert "does not hold 40 rows" in refuse(tmp_path, join(header, bomb + rest))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([3, 9]))
def test_any_model_can_be_written(tmp_path, random_model, seed, features):
    """Every bit pattern of a float in one value of twenty: what comes back is finite, or nothing was left."""
    random = np.random.default_rng(seed)
    model = random_model(30, features=features)
    for name in ROWS:
        columns = model.columns(name)
        wild = random.random(columns.shape) < 0.02
        columns[wild] = random.integers(0, 2**32, wild.sum(), np.uint32).view(np.float32)
    write_compact(tmp_path / "a.stgc", model)
    with suppress(HoloreelError):
        read, report = read_compact(tmp_path / "a.stgc")
        assert report == []
        assert len(read) == len(model.without_bad_rows())
        for array in (*vars(read).values(), *vars(read.evaluate(0.5)).values()):
            assert np.isfinite(array).all()
