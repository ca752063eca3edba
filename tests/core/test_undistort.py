# SPDX-License-Identifier: GPL-3.0-or-later
"""Rectified captures: what a distorted lens saw, seen by a pinhole at its place."""

from dataclasses import replace
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
from holoreel.core.camera import Camera
from holoreel.core.capture import Capture
from holoreel.core.capture.undistort import pinhole_of, undistort_capture
from holoreel.core.errors import HoloreelError


def seen(camera: Camera) -> np.ndarray:
    """A smooth pattern on the sphere of directions, as a camera sees it; black where it sees nothing."""
    _, rays = camera.rays()
    waves = np.sin(rays @ np.random.default_rng(0).normal(size=(3, 3)) * 6) * 100 + 128
    return np.nan_to_num(np.rint(waves)).astype(np.uint8).reshape(camera.height, camera.width, 3)


@pytest.mark.parametrize(
    ("model", "distortion"),
    [("OPENCV", (-0.2, 0.03, 0.002, 0.001)), ("OPENCV_FISHEYE", (0.03, -0.01, 0.002, 0.0))],
)
def test_pictures_are_those_of_the_pinhole(tmp_path: Path, model: str, distortion: tuple[float, ...]) -> None:
    plain = Camera.look_at((0, -4, 1), (0, 0, 0), width=96, height=64, fx=70.0, name="plain")
    bent = replace(plain, name="bent", model=model, distortion=distortion, cx=45.0)
    images = {}
    for camera in (plain, bent):
        images[camera.name, 0] = tmp_path / f"{camera.name}.png"
        imageio.imwrite(images[camera.name, 0], seen(camera))
    capture = Capture({"plain": plain, "bent": bent}, dict(images), depths={("bent", 0): tmp_path / "none.exr"})
    flat = undistort_capture(capture, tmp_path / "flat", focal=0.9)
    assert flat.cameras["bent"].model == "PINHOLE"
    assert (flat.cameras["bent"].fx, flat.cameras["bent"].cx) == (63.0, 45.0)
    assert flat.images["plain", 0] == images["plain", 0]
    assert not flat.depths
    picture = flat.image("bent", 0).astype(int)
    covered = picture.any(axis=2)
    assert covered.mean() > 0.6
    difference = np.abs(picture - seen(flat.cameras["bent"]))[covered]
    assert difference.mean() < 1
    assert np.quantile(difference, 0.99) <= 3
    path = flat.images["bent", 0]
    before = path.stat().st_mtime_ns
    undistort_capture(capture, tmp_path / "flat", focal=0.9)
    assert path.stat().st_mtime_ns == before
    with pytest.raises(HoloreelError, match="wider than 170 degrees"):
        pinhole_of(bent, 0.01)
