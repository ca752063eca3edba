# SPDX-License-Identifier: GPL-3.0-or-later
"""The `.splatv` reader: against an independent packer, on files that others made, and on damaged ones."""

import json
import math
import struct
from contextlib import suppress

import numpy as np
import pytest
from holoreel.core.errors import HoloreelError
from holoreel.core.gaussians.model import ROWS
from holoreel.core.gaussians.splatv import read_splatv
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

ROW = 65536


def pack(records: list[bytes], *, padded: bool = True, chunks_before: int = 0, **changes) -> bytes:
    height = max(1, math.ceil(len(records) / 1024))
    splat = {"type": "splat", "size": height * ROW, "texwidth": 4096, "texheight": height, "cameras": [], **changes}
    payload = b"".join(records)
    chunks = [{"type": "note", "size": 5}] * chunks_before + [splat]
    text = json.dumps(chunks).encode()
    if padded:
        payload = payload.ljust(height * ROW, b"\0")
    return struct.pack("<II", 0x674B, len(text)) + text + b"12345" * chunks_before + payload


def record(row: int, **changes) -> bytes:
    """One Gaussian whose values encode their place, packed word by word as the format's description has it."""
    v = {"xyz": [row, row + 0.25, row + 0.5], "rot": [1, 2, 3, 4], "scale": [0.5, 0.25, 2], "rgba": [51, 102, 204, 128],
         "motion": [row / 4 + i / 16 for i in range(9)], "omega": [0.5, 1.5, 2.5, 3.5], "center": 0.25 + row / 32,
         "width": 0.125, **changes}  # fmt: skip

    def half2(low: float, high: float) -> bytes:
        return struct.pack("<ee", low, high)

    m, (r, g, b, a) = v["motion"], v["rgba"]
    return b"".join([
        struct.pack("<3f", *v["xyz"]),
        half2(v["rot"][0], v["rot"][1]), half2(v["rot"][2], v["rot"][3]),
        half2(v["scale"][0], v["scale"][1]), half2(v["scale"][2], 0.0),
        struct.pack("<I", r | g << 8 | b << 16 | a << 24),
        half2(m[0], m[1]), half2(m[2], m[3]), half2(m[4], m[5]), half2(m[6], m[7]), half2(m[8], 0.0),
        half2(v["omega"][0], v["omega"][1]), half2(v["omega"][2], v["omega"][3]),
        half2(v["center"], v["width"]),
    ])  # fmt: skip


@pytest.mark.parametrize("padded", [True, False])
@pytest.mark.parametrize("chunks_before", [0, 2])
def test_every_value_is_in_its_place(tmp_path, padded, chunks_before):
    path = tmp_path / "a.splatv"
    path.write_bytes(pack([record(row) for row in range(5)], padded=padded, chunks_before=chunks_before))
    model, report = read_splatv(path)
    assert len(model) == 5
    for row in range(5):
        assert model.means[row].tolist() == [row, row + 0.25, row + 0.5]
        assert model.motions[row].ravel().tolist() == [row / 4 + i / 16 for i in range(9)]
    assert model.quats[3].tolist() == [1, 2, 3, 4]
    assert model.omegas[3].tolist() == [0.5, 1.5, 2.5, 3.5]
    assert model.trbf_centers.tolist() == [0.25 + row / 32 for row in range(5)]
    np.testing.assert_allclose(np.exp(model.log_scales[2]), [0.5, 0.25, 2.0], rtol=1e-6)
    np.testing.assert_allclose(np.exp(model.trbf_log_scales), 0.125, rtol=1e-6)
    np.testing.assert_allclose(model.features[4], [0.2, 0.4, 0.8], rtol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-model.opacity_logits)), 128 / 255, rtol=1e-6)
    assert len(report) == 1  # padding left out, or padding missing


def test_extremes_become_finite(tmp_path):
    path = tmp_path / "a.splatv"
    strange = [
        record(0, width=math.inf),
        record(1, width=0.0),
        record(2, scale=[0.0, 1.0, 1.0]),
        record(3, rgba=[0, 0, 0, 0]),
        record(4, rgba=[255, 255, 255, 255]),
        record(5, rot=[0, 0, 0, 0], omega=[0, 0, 0, 0]),
        record(6, xyz=[math.nan, 0, 0]),
        record(7, xyz=[0, math.inf, 0]),
        record(8, width=-1.0),
    ]
    path.write_bytes(pack(strange, padded=False))
    model, report = read_splatv(path)
    assert len(model) == 6
    assert any("3 rows of 9 left out" in sentence for sentence in report)
    assert any("1 row with an infinite temporal width" in sentence for sentence in report)
    for name in ROWS:
        assert np.isfinite(getattr(model, name)).all(), name
    for time in (0.0, 0.98):
        assert model.evaluate(time).opacities[0] == pytest.approx(128 / 255, rel=1e-6)
    evaluated = model.evaluate(0.375)  # the center of row 4
    assert 3 not in evaluated.alive
    assert evaluated.opacities[4] > 0.998
    np.testing.assert_array_equal(evaluated.quats[5], [1, 0, 0, 0])


@pytest.mark.parametrize(
    ("name", "rows", "bad", "endless"),
    [("spinach_4", 62442, 0, 821), ("yellow_clip2", 51773, 122, 287), ("coffee10", 11926, 24, 4)],
)
def test_files_made_by_others(shared_data, name, rows, bad, endless):
    model, report = read_splatv(shared_data(f"stg_splatv/{name}.splatv"))
    assert len(model) == rows - bad
    assert any(f"{bad} rows of {rows:,} left out" in sentence for sentence in report) == (bad > 0)
    assert any(f"{endless} rows with an infinite" in sentence for sentence in report)
    assert not model.bad_rows().any()
    evaluated = model.evaluate(0.5)
    assert len(evaluated.alive) > rows / 2
    for field in ("means", "quats", "scales", "opacities", "features"):
        assert np.isfinite(getattr(evaluated, field)).all(), field


@pytest.mark.parametrize("tenth", range(10))
@pytest.mark.parametrize("padded", [True, False])
def test_truncated_files_are_refused(tmp_path, tenth, padded):
    data = pack([record(0)] * 12000, padded=padded)
    (tmp_path / "a.splatv").write_bytes(data[: len(data) * tenth // 10])
    with pytest.raises(HoloreelError, match=r"a\.splatv"):
        read_splatv(tmp_path / "a.splatv")


def test_flipped_header_bytes_never_crash(tmp_path):
    data = pack([record(row) for row in range(3)])
    for place in range(len(data) - ROW):
        damaged = bytearray(data)
        damaged[place] ^= 0x15
        (tmp_path / "a.splatv").write_bytes(damaged)
        with suppress(HoloreelError):  # a flip in the list of cameras does no harm
            assert len(read_splatv(tmp_path / "a.splatv")[0]) == 3


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=40)
@given(st.binary(min_size=64, max_size=64 * 8).map(lambda data: data[: len(data) // 64 * 64]))
def test_any_payload_becomes_finite_gaussians(tmp_path, payload):
    (tmp_path / "a.splatv").write_bytes(pack([payload], padded=False))
    with suppress(HoloreelError):
        model, _ = read_splatv(tmp_path / "a.splatv")
        assert 0 < len(model) <= len(payload) // 64
        for values in (*vars(model).values(), *vars(model.evaluate(0.3)).values()):
            assert np.isfinite(values).all()


@pytest.mark.parametrize(
    "changes",
    [{"size": 2**50}, {"size": -ROW}, {"size": "many"}, {"size": True}, {"texwidth": 2048}, {"texheight": 10**30},
     {"size": 2**40, "texheight": 2**24}, {"type": "mesh"}, {"size": 10**9 * ROW, "texheight": 10**9}],
)  # fmt: skip
def test_absurd_headers_allocate_nothing(tmp_path, changes):
    (tmp_path / "a.splatv").write_bytes(pack([record(0)], **changes))
    with pytest.raises(HoloreelError, match=r"a\.splatv"):
        read_splatv(tmp_path / "a.splatv")


@pytest.mark.parametrize(
    "data",
    [b"", b"ply\n", struct.pack("<II", 0x674B, 2**31), struct.pack("<II", 0x674B, 2) + b"{}",
     struct.pack("<II", 0x674B, 4) + b"[[3]", struct.pack("<II", 0x674B, 2) + b"[]",
     struct.pack("<II", 0x674B, 3) + b"[1]", struct.pack("<II", 0x674B, 60000) + b"[" * 60000],
)  # fmt: skip
def test_no_splatv_at_all(tmp_path, data):
    (tmp_path / "a.splatv").write_bytes(data)
    with pytest.raises(HoloreelError, match=r"a\.splatv"):
        read_splatv(tmp_path / "a.splatv")


def test_folders_missing_files_and_bad_models(tmp_path):
    for path in (tmp_path, tmp_path / "absent.splatv"):
        with pytest.raises(HoloreelError, match="cannot be read"):
            read_splatv(path)
    (tmp_path / "a.splatv").write_bytes(pack([record(0, xyz=[math.nan] * 3)] * 3, padded=False))
    with pytest.raises(HoloreelError, match="all of its 3 rows"):
        read_splatv(tmp_path / "a.splatv")
    (tmp_path / "a.splatv").write_bytes(pack([]))
    with pytest.raises(HoloreelError, match="holds no Gaussians"):
        read_splatv(tmp_path / "a.splatv")
