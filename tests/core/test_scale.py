# SPDX-License-Identifier: GPL-3.0-or-later
"""Lengths of a scene: what cameras see says how far a step may go, however they stand."""

import numpy as np
import pytest
import torch
from holoreel.core.camera import Camera
from holoreel.core.capture import Capture
from holoreel.core.errors import HoloreelError
from holoreel.core.gaussians.scale import measure_scene


def capture_of(cameras: list[Camera]) -> Capture:
    return Capture({f"cam{index}": camera for index, camera in enumerate(cameras)}, {})


def look(eye: tuple[float, float, float], target: tuple[float, float, float], fx: float = 50.0) -> Camera:
    return Camera.look_at(eye, target, width=40, height=40, fx=fx)


def outward() -> list[Camera]:
    """Six cameras back to back, looking out."""
    angles = np.radians(np.arange(0, 360, 60))
    return [look((0.1 * np.cos(a), 0.1 * np.sin(a), 0), (9 * np.cos(a), 9 * np.sin(a), 0), 20.0) for a in angles]


def test_a_pixel_covers_more_the_farther_away_it_is() -> None:
    camera = look((0, 0, 0), (0, 10, 0))
    points = np.array([[0, depth, 0] for depth in np.geomspace(1, 100, 20)])
    scene = measure_scene(capture_of([camera]), points)
    footprints = scene.footprints(torch.tensor(points, dtype=torch.float32))
    np.testing.assert_allclose(footprints, points[:, 1] / 50.0, rtol=1e-5)
    assert scene.footprint == pytest.approx(np.median(points[:, 1]) / 50.0)
    assert scene.nearest == pytest.approx(1.0, rel=0.1)
    assert scene.extents(torch.zeros(3, 3)).tolist() == [pytest.approx(scene.footprint * 50.0)] * 3  # one camera


def test_the_nearest_camera_that_sees_a_point_counts() -> None:
    near, far, away = look((0, 8, 0), (0, 10, 0)), look((0, 0, 0), (0, 10, 0)), look((0, 9.5, 0), (0, 0, 0))
    points = np.array([[0.0, 10.0, 0.0], [0.3, 9.9, 0.1]])
    means = torch.tensor(points[:1], dtype=torch.float32)
    assert float(measure_scene(capture_of([far]), points).footprints(means)) == pytest.approx(0.2)
    assert float(measure_scene(capture_of([far, near]), points).footprints(means)) == pytest.approx(0.04)
    # One that looks the other way is nearer still, but does not see it.
    assert float(measure_scene(capture_of([far, near, away]), points).footprints(means)) == pytest.approx(0.04)
    # Where nobody looks, the nearest camera says something, too.
    behind = torch.tensor([[0.0, -5.0, 0.0]])
    assert float(measure_scene(capture_of([far, near]), points).footprints(behind)) == pytest.approx(0.1)


def test_cameras_that_look_outward_measure_what_they_see() -> None:
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(500, 3)) * (1, 1, 0.2)
    points = directions / np.linalg.norm(directions, axis=1, keepdims=True) * rng.uniform(3, 300, (500, 1))
    scene = measure_scene(capture_of(outward()), points)
    footprints = scene.footprints(torch.tensor(points, dtype=torch.float32)).numpy()
    np.testing.assert_allclose(footprints, np.linalg.norm(points, axis=1) / 20.0, rtol=0.05)
    assert scene.extent == pytest.approx(0.11, rel=0.01)
    assert 2.5 < scene.nearest < 6.0


def test_nothing_is_so_near_that_it_cannot_move() -> None:
    camera = look((0, 0, 0), (0, 10, 0))
    points = np.array([[0, depth, 0] for depth in np.linspace(5, 10, 100)])
    scene = measure_scene(capture_of([camera]), points)
    assert float(scene.footprints(torch.zeros(1, 3))) == pytest.approx(0.1 * 5.0 / 50.0, rel=0.02)


def test_points_that_no_camera_sees_are_refused() -> None:
    with pytest.raises(HoloreelError, match="no training camera sees"):
        measure_scene(capture_of([look((0, 0, 0), (0, 10, 0))]), np.array([[0.0, -5.0, 0.0]]))
