# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender camera settings as numbers. Blender itself is asked in tests/blender/test_cameras.py."""

import math

import numpy as np
import pytest
from holoreel.core.camera import Camera
from holoreel.core.camera_blender import BlenderCamera
from holoreel.core.errors import HoloreelError
from hypothesis import given, settings
from hypothesis import strategies as st

positive = st.floats(0.2, 5)


@given(
    st.integers(8, 2000), st.integers(8, 2000), positive, positive, st.floats(-1, 2), st.floats(-1, 2),
    st.tuples(*[st.floats(-5, 5)] * 3),
)  # fmt: skip
@settings(max_examples=80, deadline=None)
def test_camera_survives_blender(
    width: int, height: int, fx: float, fy: float, cx: float, cy: float, eye: tuple[float, float, float]
) -> None:
    matrix = Camera.look_at(eye, (6, 6, 6), width=1, height=1, fx=1).world_to_camera
    camera = Camera(width, height, fx * width, fy * width, cx * width, cy * height, matrix, name="a")
    settings = BlenderCamera.from_camera(camera)
    assert settings.pixel_aspect_x >= 1
    assert settings.pixel_aspect_y >= 1
    assert settings.lens >= 1
    back = settings.to_camera()
    assert np.allclose(back.K, camera.K, rtol=1e-12, atol=1e-9)
    assert np.allclose(back.world_to_camera, camera.world_to_camera, atol=1e-12)
    assert (back.width, back.height, back.name) == (width, height, "a")


@pytest.mark.parametrize(
    ("settings", "fx", "fy"),
    [
        (BlenderCamera(50, 1920, 1080), 50 / 36 * 1920, 50 / 36 * 1920),
        (BlenderCamera(50, 1080, 1920), 50 / 36 * 1920, 50 / 36 * 1920),  # AUTO takes sensor_width for the longer side
        (BlenderCamera(50, 1920, 1080, sensor_fit="VERTICAL"), 50 / 24 * 1080, 50 / 24 * 1080),
        (BlenderCamera(50, 1080, 1920, sensor_fit="HORIZONTAL"), 50 / 36 * 1080, 50 / 36 * 1080),
        (BlenderCamera(50, 1000, 900, pixel_aspect_y=2), 50 / 36 * 1800, 50 / 36 * 900),  # AUTO counts the aspect
    ],
)
def test_focal_lengths_by_hand(settings: BlenderCamera, fx: float, fy: float) -> None:
    camera = settings.to_camera()
    assert math.isclose(camera.fx, fx)
    assert math.isclose(camera.fy, fy)


def test_percentage_cuts_to_whole_pixels() -> None:
    assert BlenderCamera(50, 333, 217, resolution_percentage=33).size == (109, 71)
    assert BlenderCamera(50, 3, 3, resolution_percentage=1).size == (1, 1)


def test_shift_by_hand() -> None:
    """Shifting right and up by a tenth of the longer side moves what is seen left and down by as much."""
    camera = BlenderCamera(50, 200, 100, shift_x=0.1, shift_y=0.1).to_camera()
    assert np.allclose((camera.cx, camera.cy), (80, 70))


def test_axes_by_hand() -> None:
    """A new camera in Blender looks down: along -z, with y up in the picture."""
    camera = BlenderCamera(36, 100, 100, matrix_world=np.diag([3.0, 0.5, 2.0, 1.0])).to_camera()
    uv, z = camera.project([[0, 0, -2], [0.2, 0.4, -2]])
    assert np.allclose(uv, [[50, 50], [60, 30]])
    assert np.allclose(z, 2)


@pytest.mark.parametrize(
    ("matrix", "word"),
    [
        (np.diag([1.0, 1, -1, 1]), "mirrored"),
        (np.array([[1, 0.1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]), "sheared"),
        (np.diag([0.0, 1, 1, 1]), "zero scale"),
        (np.full((4, 4), math.nan), "NaN"),
    ],
)
def test_matrices_that_are_no_camera(matrix: np.ndarray, word: str) -> None:
    with pytest.raises(HoloreelError, match=word):
        BlenderCamera(50, 100, 100, matrix_world=matrix, name="a").to_camera()
