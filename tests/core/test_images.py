# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures survive being written and read, and what is no picture is refused."""

import numpy as np
import pytest
from holoreel.core.errors import HoloreelError
from holoreel.core.images import picture_path, read_exr, read_image, write_exr, write_image, write_png


@pytest.mark.parametrize("channels", [3, 4])
def test_png_keeps_every_8_bit_value_in_its_place(tmp_path, channels):
    pixels = np.arange(6 * 14 * channels, dtype=np.float64).reshape(6, 14, channels) % 256 / 255
    write_png(tmp_path / "new" / "a.png", pixels)
    np.testing.assert_array_equal(read_image(tmp_path / "new" / "a.png"), pixels.astype(np.float32))


def test_png_rounds_and_clips(tmp_path):
    values = np.array([[[-1.0, 0.49 / 255, 0.51 / 255], [2.0, 254.6 / 255, np.nan]]])
    write_png(tmp_path / "a.png", values)
    assert (read_image(tmp_path / "a.png") * 255).round().tolist() == [[[0, 0, 1], [255, 255, 0]]]


@pytest.mark.parametrize("channels", [3, 4])
def test_exr_keeps_every_float(tmp_path, channels):
    values = np.random.default_rng(0).normal(0, 1e3, (5, 9, channels)).astype(np.float32)
    depth = np.arange(45, dtype=np.float32).reshape(5, 9)
    write_exr(tmp_path / "a.exr", values, depth)
    read, z = read_exr(tmp_path / "a.exr")
    np.testing.assert_array_equal(read, values)
    np.testing.assert_array_equal(z, depth)
    write_image(tmp_path / "b.exr", values)
    assert read_exr(tmp_path / "b.exr")[1] is None
    np.testing.assert_array_equal(read_image(tmp_path / "b.exr"), values)


def test_gray_pictures_become_rgb(tmp_path):
    import imageio.v3 as iio

    iio.imwrite(tmp_path / "a.png", np.array([[0, 51], [102, 255]], np.uint8))
    image = read_image(tmp_path / "a.png")
    assert image.shape == (2, 2, 3)
    np.testing.assert_allclose(image[:, :, 2], [[0, 0.2], [0.4, 1.0]])


@pytest.mark.parametrize("name", ["a.png", "a.exr"])
def test_what_is_no_picture_is_refused(tmp_path, name):
    path = tmp_path / name
    for prepare in (lambda: None, lambda: path.write_bytes(b""), lambda: path.write_bytes(b"no picture" * 50)):
        prepare()
        with pytest.raises(HoloreelError, match=name):
            read_image(path)


@pytest.mark.parametrize("name", ["a.png", "a.exr"])
def test_truncated_pictures_are_refused(tmp_path, name):
    write_image(tmp_path / name, np.random.default_rng(0).random((40, 40, 3)))
    data = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(data[: len(data) // 2])
    with pytest.raises(HoloreelError, match=name):
        read_image(tmp_path / name)


def test_other_endings_and_unwritable_folders_are_refused(tmp_path):
    with pytest.raises(HoloreelError, match=r"\.png or \.exr"):
        write_image(tmp_path / "a.gif", np.zeros((2, 2, 3)))
    (tmp_path / "file").write_text("")
    for name in ("file/a.png", "file/a.exr"):
        with pytest.raises(HoloreelError, match="cannot be written"):
            write_image(tmp_path / name, np.zeros((2, 2, 3)))
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_no_camera_name_leaves_the_folder(tmp_path):
    assert picture_path(tmp_path, "cam00", 7) == tmp_path / "cam00" / "0007.png"
    assert picture_path(tmp_path, "a b", "12.5", ".exr") == tmp_path / "a_b" / "12.5.exr"
    for name in ("../../x", "/etc", "..", "C:\\x", "a/../../b", "", "\0"):
        assert picture_path(tmp_path, name, 1).resolve().parent.parent == tmp_path.resolve()
