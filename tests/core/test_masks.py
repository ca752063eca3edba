# SPDX-License-Identifier: GPL-3.0-or-later
"""Masks of captures: what they say of a pixel, how they travel, and what is refused."""

import json
from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
from holoreel.core.camera import Camera
from holoreel.core.capture import Capture, View, read_capture, write_capture
from holoreel.core.capture.convert import convert
from holoreel.core.capture.export import encode_video
from holoreel.core.capture.images import composite
from holoreel.core.capture.masks import cut_out, read_mask
from holoreel.core.capture.media import Media, VideoFrame
from holoreel.core.capture.undistort import undistort_capture
from holoreel.core.errors import HoloreelError

SIZE = (16, 12)  # width, height
BOX = ((-1.0, -2.0, -3.0), (1.0, 2.0, 3.5))


def plane(camera: int, frame: int) -> np.ndarray:
    """A mask whose values encode their place, (12, 16)."""
    v, u = np.mgrid[:12, :16]
    return (40 * camera + 20 * frame + 7 * v + 3 * u).astype(np.uint8)


@pytest.fixture
def capture(tmp_path: Path) -> Capture:
    """Two cameras and two frames of plain pictures with masks beside them."""
    images: dict[View, Media] = {}
    masks: dict[View, Media] = {}
    rng = np.random.default_rng(1)
    for camera in range(2):
        for frame in range(2):
            view = f"cam{camera}", frame
            images[view], masks[view] = tmp_path / f"i{camera}{frame}.png", tmp_path / f"m{camera}{frame}.png"
            iio.imwrite(images[view], rng.integers(0, 256, (12, 16, 3), np.uint8))
            iio.imwrite(masks[view], plane(camera, frame))
    cameras = {f"cam{c}": Camera(*SIZE, 20, 20, 8, 6, name=f"cam{c}") for c in range(2)}
    cameras["cam1"] = Camera.look_at((2, 0, 0), (0, 0, 5), width=16, height=12, fx=20, name="cam1")
    return Capture(cameras, images, 2, masks=masks, bounds=BOX, source=tmp_path / "transforms.json")


def test_a_mask_is_the_alpha(capture: Capture) -> None:
    assert capture.masked
    for camera in range(2):
        picture = capture.rgba(f"cam{camera}", 1)
        assert np.array_equal(picture[..., 3], plane(camera, 1))
        assert np.array_equal(picture[..., :3], capture.image(f"cam{camera}", 1))
    part = capture.frames(1, 1)
    assert np.array_equal(part.rgba("cam1", 0)[..., 3], plane(1, 1))


def test_masks_and_bounds_travel_in_transforms(capture: Capture, tmp_path: Path) -> None:
    write_capture(tmp_path, replace(capture, matte=(0.0, 0.5, 1.0)))
    back = read_capture(tmp_path)
    assert (back.bounds, back.matte, back.masks) == (BOX, (0.0, 0.5, 1.0), capture.masks)
    assert np.array_equal(back.rgba("cam1", 1)[..., 3], plane(1, 1))


@pytest.mark.parametrize(
    ("field", "value", "complaint"),
    [
        ("bounds", [[0, 0, 0]], "bounds"),
        ("bounds", [[0, 0, 0], [1, 1, -1]], "bounds"),
        ("bounds", [[0, 0, 0], [1, 1, "x"]], "bounds"),
        ("matte", [1, 1], "matte"),
    ],
)
def test_other_bounds_are_refused(capture: Capture, tmp_path: Path, field: str, value: object, complaint: str) -> None:
    path = write_capture(tmp_path, capture)
    meta = json.loads(path.read_text())
    meta["holoreel"][field] = value
    path.write_text(json.dumps(meta))
    with pytest.raises(HoloreelError, match=complaint):
        read_capture(path)


def test_a_converted_capture_has_its_masks_as_alpha(capture: Capture, tmp_path: Path) -> None:
    convert(capture, "nerfstudio", tmp_path / "out", {})
    back = read_capture(tmp_path / "out")
    assert back.masked
    assert back.bounds == BOX
    assert not back.masks
    assert np.array_equal(back.rgba("cam0", 1), capture.rgba("cam0", 1))


def test_rectified_cameras_lose_their_masks(capture: Capture, tmp_path: Path) -> None:
    bent = replace(capture.cameras["cam0"], model="OPENCV", distortion=(0.1, 0.0, 0.0, 0.0))
    rectified = undistort_capture(replace(capture, cameras=capture.cameras | {"cam0": bent}), tmp_path / "flat")
    assert {name for name, _ in rectified.masks} == {"cam1"}
    assert not rectified.masked


def test_no_mask_and_another_size_are_refused(capture: Capture, tmp_path: Path) -> None:
    bare = replace(capture, masks={})
    assert not bare.masked
    with pytest.raises(HoloreelError, match=r"cam1.*no mask at frame 2"):
        bare.rgba("cam1", 1)
    iio.imwrite(tmp_path / "m00.png", np.zeros((12, 15), np.uint8))
    with pytest.raises(HoloreelError, match=r"m00\.png: the mask is 15x12, its picture 16x12"):
        capture.rgba("cam0", 0)
    with pytest.raises(HoloreelError, match="frame 7"):
        replace(capture, masks={("cam0", 7): tmp_path / "m00.png"})
    (tmp_path / "m11.png").unlink()
    with pytest.raises(HoloreelError, match=r"m11\.png"):
        capture.check_files()


def test_own_alpha_serves_too(capture: Capture) -> None:
    rgba = np.dstack([np.full((12, 16, 3), 9, np.uint8), plane(0, 0)])
    for media in capture.images.values():
        iio.imwrite(media, rgba)
    own = replace(capture, masks={})
    assert own.masked
    assert np.array_equal(own.rgba("cam0", 0), rgba)


def test_a_large_mask_is_averaged(tmp_path: Path) -> None:
    iio.imwrite(tmp_path / "m.png", np.kron(plane(0, 0), np.ones((2, 2), np.uint8)))
    assert np.array_equal(read_mask(tmp_path / "m.png", *SIZE), plane(0, 0))


def test_video_masks_are_clean(tmp_path: Path) -> None:
    mask = np.zeros((48, 64, 3), np.uint8)
    mask[10:30, 20:50] = 255
    encode_video(tmp_path / "m.mp4", (64, 48), 24, [mask, 255 - mask])
    for frame, wanted in enumerate([mask, 255 - mask]):
        found = read_mask(VideoFrame(tmp_path / "m.mp4", frame), 64, 48)
        assert (found != wanted[..., 0]).mean() < 0.01


def test_a_known_matte_is_taken_out() -> None:
    rng = np.random.default_rng(2)
    mask = rng.integers(0, 256, (20, 30), np.uint8)
    color = rng.integers(0, 256, (20, 30, 3), np.uint8)
    over = composite(np.dstack([color, mask]), (1.0, 0.5, 0.0))
    cut = cut_out(over, mask, (1.0, 0.5, 0.0))
    assert np.abs(composite(cut, (1.0, 0.5, 0.0)).astype(int) - over).max() <= 1
    assert np.abs(cut[mask > 127, :3].astype(int) - color[mask > 127]).max() <= 2
