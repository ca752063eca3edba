# SPDX-License-Identifier: GPL-3.0-or-later
"""Rigs: where their cameras stand and look, and how a scene places them."""

import math
from dataclasses import replace

import numpy as np
import pytest
from holoreel.core.camera import Camera
from holoreel.core.errors import HoloreelError
from holoreel.core.rig import RigRequest, RigSettings, SceneFacts, fit_to_scene, make_rig, request
from hypothesis import given, settings
from hypothesis import strategies as st

SETTINGS = RigSettings(
    cameras=12, width=320, height=180, target=(1, 2, 3), radius=5, azimuth_degrees=-90, elevation_degrees=15,
    fov_degrees=60,
)  # fmt: skip


@given(
    st.integers(1, 40), st.floats(0.1, 100), st.floats(-180, 180), st.floats(-60, 60), st.floats(0, 360),
    st.floats(0, 20), st.floats(5, 150),
)  # fmt: skip
@settings(max_examples=50, deadline=None)
def test_arc_surrounds_and_aims(
    count: int, radius: float, azimuth: float, elevation: float, span: float, rise: float, fov: float
) -> None:
    rig = replace(
        SETTINGS, cameras=count, radius=radius, azimuth_degrees=azimuth, elevation_degrees=elevation,
        span_degrees=span, rise_degrees=rise, fov_degrees=fov,
    )  # fmt: skip
    cameras = make_rig("arc", rig)
    assert len({camera.name for camera in cameras}) == len(cameras) == count
    for camera in cameras:
        uv, z = camera.project([rig.target])
        assert np.allclose(uv, [[160, 90]], atol=1e-6)
        assert np.isclose(z[0], radius)
        assert math.isclose(2 * math.degrees(math.atan(160 / camera.fx)), fov, rel_tol=1e-9)


def test_arc_by_hand() -> None:
    cameras = make_rig("arc", replace(SETTINGS, cameras=5, target=(0, 0, 0), elevation_degrees=0, span_degrees=60))
    centers = np.array([camera.center for camera in cameras])
    assert np.allclose(centers[0], (0, -5, 0))  # the middle one comes first
    assert (np.diff(centers[1:, 0]) > 0).all()  # the others from left to right
    azimuths = np.degrees(np.arctan2(centers[:, 1], centers[:, 0]))
    assert np.allclose(azimuths, [-90, -120, -105, -75, -60])
    heights = np.degrees(np.arcsin(centers[:, 2] / 5))
    assert np.allclose(heights, [0, 4, -4, 4, -4])
    assert [camera.name for camera in cameras] == ["cam00", "cam01", "cam02", "cam03", "cam04"]


def test_dome_surrounds_and_aims() -> None:
    wanted = request("dome", 20, 64, 64, target=(0, 0, 1), radius=3.0, fov_degrees=40, azimuth_degrees=None)
    cameras = make_rig("dome", fit_to_scene(wanted, SceneFacts()))
    offsets = np.array([camera.center for camera in cameras]) - (0, 0, 1)
    assert np.allclose(np.linalg.norm(offsets, axis=1), 3)
    assert all(np.allclose(camera.project([(0, 0, 1)])[0], (32, 32)) for camera in cameras)
    elevations = np.degrees(np.arcsin(offsets[:, 2] / 3))
    assert (np.diff(elevations) > 0).all()
    assert -5 < elevations[0] < 0
    assert 60 < elevations[-1] < 65
    for start in range(16):  # any five in a row look from all sides
        azimuths = np.sort(np.degrees(np.arctan2(offsets[start : start + 5, 1], offsets[start : start + 5, 0])))
        assert np.diff([*azimuths, azimuths[0] + 360]).max() < 140
    assert request("arc", 3, 8, 8) == RigRequest(3, 8, 8)


@pytest.mark.parametrize("count", [3, 4, 12, 21])
def test_held_out_middle_is_surrounded(count: int) -> None:
    centers = np.array([camera.center for camera in make_rig("arc", replace(SETTINGS, cameras=count))])
    assert (centers[1:] < centers[0])[:, 0].any()
    assert (centers[1:] > centers[0])[:, 0].any()


def test_scene_with_camera_places_the_rig() -> None:
    camera = Camera.look_at((3, -4, 2), (0, 0, 1), width=640, height=480, fx=500)
    facts = SceneFacts(camera, None, ((-1, -1, 0), (1, 1, 2)))
    rig = fit_to_scene(RigRequest(6, 320, 180), facts)
    assert np.allclose(rig.target, (0, 0, 1), atol=1e-9)  # the camera looks at the middle of the bounds
    middle = make_rig("arc", replace(rig, cameras=5))[0]
    assert np.allclose(middle.center, camera.center)
    assert math.isclose(rig.fov_degrees, math.degrees(2 * math.atan(320 / 500)))
    marked = fit_to_scene(RigRequest(6, 320, 180), replace(facts, target=(0, 0, 0)))
    assert marked.target == (0, 0, 0)
    asked = fit_to_scene(RigRequest(6, 320, 180, (1, 0, 0), 9, 10, 20, 30), replace(facts, target=(0, 0, 0)))
    assert (asked.target, asked.radius, asked.azimuth_degrees) == ((1, 0, 0), 9, 10)
    assert (asked.elevation_degrees, asked.fov_degrees) == (20, 30)


def test_camera_that_looks_away_still_makes_a_rig() -> None:
    camera = Camera.look_at((0, -4, 0), (0, -8, 0), width=64, height=48, fx=50)
    rig = fit_to_scene(RigRequest(3, 64, 48), SceneFacts(camera, None, ((-1, -1, -1), (1, 1, 1))))
    assert np.allclose(rig.target, (0, -8, 0))
    assert make_rig("arc", rig)


def test_scene_without_camera_is_seen_whole() -> None:
    facts = SceneFacts(bounds=((-3, -1, 0), (5, 1, 2)))
    cameras = make_rig("arc", fit_to_scene(RigRequest(5, 320, 180), facts))
    corners = [(x, y, z) for x in (-3, 5) for y in (-1, 1) for z in (0, 2)]
    for camera in cameras:
        uv, z = camera.project(corners)
        assert (z > 0).all()
        assert ((uv >= 0) & (uv <= (320, 180))).all()
    assert make_rig("arc", fit_to_scene(RigRequest(2, 32, 18), SceneFacts()))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cameras": 0}, "cameras"), ({"cameras": 10**6}, "cameras"), ({"radius": 0}, "radius"),
        ({"radius": math.nan}, "radius"), ({"span_degrees": 400}, "span"), ({"elevation_degrees": 88}, "elevation"),
        ({"fov_degrees": 180}, "field of view"), ({"width": 0}, "width"),
    ],
)  # fmt: skip
def test_impossible_rigs_are_refused(change: dict[str, float], message: str) -> None:
    with pytest.raises(HoloreelError, match=message):
        make_rig("arc", replace(SETTINGS, **change))
    with pytest.raises(HoloreelError, match="no rig"):
        make_rig("helix", SETTINGS)
