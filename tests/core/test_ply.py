# SPDX-License-Identifier: GPL-3.0-or-later
"""The authors' PLY layout: against an independent packer, and with files that are wrong."""

import struct
from contextlib import suppress

import numpy as np
import pytest
from holoreel.core.errors import HoloreelError
from holoreel.core.gaussians.model import ROWS
from holoreel.core.gaussians.ply import read_ply, write_ply
from holoreel.core.plyfile import read_vertices, write_vertices
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

# The order of the authors' files, with the place of each value in `telling_model` (see conftest): 3 means, 9 motions,
# 4 quats, 4 omegas, 3 scales, opacity, features, center, width.
HEAD = "x y z trbf_center trbf_scale nx ny nz"
MOTION = " ".join(f"motion_{i}" for i in range(9))
TAIL = "opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3 omega_0 omega_1 omega_2 omega_3"
ORDERS = {
    3: (f"{HEAD} {MOTION} f_dc_0 f_dc_1 f_dc_2 {TAIL}",
        [0, 1, 2, 27, 28, None, None, None, *range(3, 12), 24, 25, 26, 23, 20, 21, 22, *range(12, 20)]),
    9: (f"{HEAD} {MOTION} f_dc_0 f_dc_1 f_dc_2 f_dc_3 f_dc_4 f_dc_5 {TAIL} f_t_0 f_t_1 f_t_2",
        [0, 1, 2, 33, 34, None, None, None, *range(3, 12), *range(24, 30), 23, 20, 21, 22, *range(12, 20), 30, 31, 32]),
}  # fmt: skip


def authors_file(count: int, features: int) -> bytes:
    names, places = ORDERS[features]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    lines += [f"property float {name}" for name in names.split()] + ["end_header"]
    body = b""
    for row in range(count):
        body += b"".join(struct.pack("<f", 0.0 if c is None else (100 * row + c) / 64) for c in places)
    return "\n".join(lines).encode() + b"\n" + body


@pytest.mark.parametrize(("features", "width"), [(3, 128), (9, 152)])
def test_written_files_are_the_authors_byte_for_byte(tmp_path, telling_model, features, width):
    write_ply(tmp_path / "a.ply", telling_model(7, features))
    data = (tmp_path / "a.ply").read_bytes()
    assert data == authors_file(7, features)
    assert len(data.split(b"end_header\n", 1)[1]) == 7 * width


@pytest.mark.parametrize("features", [3, 9])
def test_read_files_have_every_value_in_its_place(tmp_path, telling_model, features):
    (tmp_path / "a.ply").write_bytes(authors_file(7, features))
    model, report = read_ply(tmp_path / "a.ply")
    for name in ROWS:
        np.testing.assert_array_equal(getattr(model, name), getattr(telling_model(7, features), name), err_msg=name)
    assert model.variant == {3: "lite", 9: "full"}[features]
    assert report == []


def test_properties_are_read_by_name(tmp_path, telling_model):
    write_ply(tmp_path / "a.ply", telling_model(7, 3))
    table = read_vertices(tmp_path / "a.ply")
    names = sorted(table.dtype.names)
    shuffled = np.empty(7, [(name, "f8") for name in [*names, "extra"]])
    for name in names:
        shuffled[name] = table[name]
    write_vertices(tmp_path / "b.ply", shuffled)
    model, _ = read_ply(tmp_path / "b.ply")
    for name in ROWS:
        np.testing.assert_array_equal(getattr(model, name), getattr(telling_model(7, 3), name), err_msg=name)


@pytest.mark.parametrize("missing", ["x", "trbf_scale", "motion_8", "f_dc_2", "opacity", "rot_3", "omega_0"])
def test_a_missing_property_is_named(tmp_path, telling_model, missing):
    write_ply(tmp_path / "a.ply", telling_model(2, 3))
    table = read_vertices(tmp_path / "a.ply")
    write_vertices(tmp_path / "b.ply", table[[name for name in table.dtype.names if name != missing]].copy())
    with pytest.raises(HoloreelError, match=rf"b\.ply lacks the property '{missing}'"):
        read_ply(tmp_path / "b.ply")


def test_ordinary_gaussian_files_stand_still(tmp_path):
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "f_rest_0", "opacity", "scale_0", "scale_1", "scale_2",
             "rot_0", "rot_1", "rot_2", "rot_3"]  # fmt: skip
    table = np.zeros(2, [(name, "f4") for name in names])
    for column, name in enumerate(names):
        table[name] = [column, column + 0.5]
    table["f_dc_0"] = [1.0, -3.0]
    write_vertices(tmp_path / "a.ply", table)
    model, report = read_ply(tmp_path / "a.ply")
    assert "ordinary 3D Gaussian PLY" in report[0]
    np.testing.assert_allclose(model.features[:, 0], [0.5 + 0.28209479, 0.0], rtol=1e-6)
    early, late = model.evaluate(0.0), model.evaluate(1.0)
    for name in ("means", "quats", "opacities", "features"):
        np.testing.assert_array_equal(getattr(early, name), getattr(late, name))
    np.testing.assert_allclose(early.opacities[0], 1 / (1 + np.exp(-7.0)), rtol=1e-6)
    np.testing.assert_array_equal(model.means, [[0, 1, 2], [0.5, 1.5, 2.5]])
    np.testing.assert_array_equal(model.quats, [[11, 12, 13, 14], [11.5, 12.5, 13.5, 14.5]])


def test_plain_points_are_refused(tmp_path):
    write_vertices(tmp_path / "a.ply", np.zeros(3, [(n, "f4") for n in "xyz"]))
    with pytest.raises(HoloreelError, match=r"plain points.*trbf_center"):
        read_ply(tmp_path / "a.ply")


def test_nan_rows_are_left_out_and_counted(tmp_path, random_model):
    model = random_model(20)
    model.motions[3, 1, 2] = np.nan
    model.log_scales[11, 0] = np.inf
    write_ply(tmp_path / "a.ply", model)
    read, report = read_ply(tmp_path / "a.ply")
    assert len(read) == 18
    assert report == ["2 rows of 20 left out: NaN, infinite or unusable values."]
    np.testing.assert_array_equal(read.means, np.delete(model.means, [3, 11], axis=0))
    model.means[:] = np.nan
    write_ply(tmp_path / "a.ply", model)
    with pytest.raises(HoloreelError, match=r"a\.ply has NaN .* all of its 20 rows"):
        read_ply(tmp_path / "a.ply")


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=40)
@given(st.integers(0, 2**32 - 1), st.sampled_from([3, 9]))
def test_any_values_become_finite_gaussians(tmp_path, seed, features):
    """Every bit pattern of a float, among them NaN, infinities, denormals and giants, in files of the right layout."""
    width = 38 if features == 9 else 32
    values = np.random.default_rng(seed).integers(0, 2**32, (60, width), np.uint32)
    calm = np.random.default_rng(seed).random(values.shape) < 0.95  # so that some rows survive
    values[calm] = np.float32(0.5).view(np.uint32)
    header = authors_file(60, features).split(b"end_header\n")[0] + b"end_header\n"
    (tmp_path / "a.ply").write_bytes(header + values.astype("<u4").tobytes())
    with suppress(HoloreelError):
        model, _ = read_ply(tmp_path / "a.ply")
        for time in (-1.0, 0.0, 0.5, 1.0):
            for array in (*vars(model).values(), *vars(model.evaluate(time)).values()):
                assert np.isfinite(array).all()
        bounds = model.bounds()
        assert bounds is None or np.isfinite(bounds).all()


def test_a_file_without_gaussians_is_refused(tmp_path, random_model):
    write_ply(tmp_path / "a.ply", random_model(3).take([]))
    with pytest.raises(HoloreelError, match="holds no Gaussians"):
        read_ply(tmp_path / "a.ply")


@pytest.mark.parametrize("tenth", range(10))
def test_truncated_files_are_refused(tmp_path, random_model, tenth):
    write_ply(tmp_path / "a.ply", random_model(50))
    data = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(data[: len(data) * tenth // 10])
    with pytest.raises(HoloreelError, match=r"a\.ply"):
        read_ply(tmp_path / "a.ply")


def test_an_absurd_count_allocates_nothing(tmp_path):
    data = authors_file(2, 3).replace(b"element vertex 2", b"element vertex 4000000000000")
    (tmp_path / "a.ply").write_bytes(data)
    with pytest.raises(HoloreelError, match="cut short"):
        read_ply(tmp_path / "a.ply")


def test_flipped_header_bytes_never_crash(tmp_path):
    data = bytearray(authors_file(3, 3))
    end = data.index(b"end_header") + 10
    for place in range(0, end, 3):
        damaged = bytearray(data)
        damaged[place] ^= 0x15
        (tmp_path / "a.ply").write_bytes(damaged)
        with suppress(HoloreelError):  # a flip in the name of an unused property does no harm
            assert len(read_ply(tmp_path / "a.ply")[0]) == 3
