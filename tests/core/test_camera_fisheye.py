# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's fisheye lenses as cameras: what is seen at an angle lands where the lens's formula says."""

import math
from dataclasses import replace

import numpy as np
import pytest
from holoreel.core.camera_blender import BlenderCamera
from holoreel.core.camera_fisheye import EQUIDISTANT, EQUISOLID, POLYNOMIAL, Fisheye, fisheye_camera
from holoreel.core.errors import HoloreelError
from hypothesis import given, settings
from hypothesis import strategies as st

SETTINGS = BlenderCamera(50.0, 640, 360, name="Fish")
DEFAULT = (-1.1735e-05, -0.019988, -3.3525e-06, 3.0993e-06, -2.6064e-08)  # Blender's own polynomial


def seen(camera, theta, phi):
    """Where points at angles from the axis, and around it from the right over the top, land from the middle."""
    points = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), -np.cos(theta)], axis=-1)
    uv, _ = camera.project(points)
    return (uv - (camera.width / 2, camera.height / 2)) * (1, -1)


angles = st.floats(0.01, 1.0)
turns = st.floats(-math.pi, math.pi)


@settings(max_examples=40, deadline=None)
@given(angles, turns, st.floats(0.5, 2 * math.pi))
def test_equidistant_lenses_spread_angles_evenly(theta, phi, fov):
    found = seen(fisheye_camera(SETTINGS, Fisheye(EQUIDISTANT, fov)), np.array([theta]), np.array([phi]))[0]
    np.testing.assert_allclose(found, theta / fov * np.array([640 * math.cos(phi), 360 * math.sin(phi)]), atol=1e-6)


@settings(max_examples=40, deadline=None)
@given(angles, turns, st.floats(8.0, 40.0))
def test_equisolid_lenses_follow_half_the_sine(theta, phi, lens):
    camera = fisheye_camera(SETTINGS, Fisheye(EQUISOLID, math.pi, lens))
    radius = 2 * lens * math.sin(theta / 2) * 640 / 36
    if radius < math.hypot(320, 180):  # in the picture
        found = seen(camera, np.array([theta]), np.array([phi]))[0]
        np.testing.assert_allclose(found, [radius * math.cos(phi), radius * math.sin(phi)], atol=0.1)


@settings(max_examples=40, deadline=None)
@given(st.floats(0.1, 18.0), turns)
def test_polynomial_lenses_follow_their_polynomial(radius, phi):
    camera = fisheye_camera(SETTINGS, Fisheye(POLYNOMIAL, math.pi, polynomial=DEFAULT))
    theta = -sum(k * radius**power for power, k in enumerate(DEFAULT))
    found = seen(camera, np.array([theta]), np.array([phi]))[0]
    np.testing.assert_allclose(np.hypot(*found), radius * 640 / 36, atol=0.1)


def test_shifts_are_shares_of_the_picture_and_pixels_may_be_oblong():
    shifted = replace(SETTINGS, shift_x=0.1, shift_y=0.05, pixel_aspect_x=2.0)
    camera = fisheye_camera(shifted, Fisheye(EQUISOLID, 3.0, 15.0))
    assert (camera.cx, camera.cy) == pytest.approx((320 - 64, 180 + 18))
    assert camera.fy == pytest.approx(2 * camera.fx)


@pytest.mark.parametrize(
    ("lens", "sentence"),
    [
        (Fisheye(EQUISOLID, 3.0, 0.0), "without length"),
        (Fisheye(EQUIDISTANT, 0.0), "field of view"),
        (Fisheye(POLYNOMIAL, 3.0, polynomial=(0.1, -0.06, 0, 0, 0)), "K0"),
        (Fisheye(POLYNOMIAL, 3.0, polynomial=(0, 0.06, 0, 0, 0)), "K1 should be negative"),
        (Fisheye(POLYNOMIAL, 3.0, polynomial=(0, -1e-9, 0, 0, -1e-4)), "tenth of a pixel"),
    ],
)
def test_lenses_that_cannot_be_are_refused(lens, sentence):
    with pytest.raises(HoloreelError, match=f"camera 'Fish' .*{sentence}"):
        fisheye_camera(SETTINGS, lens)
