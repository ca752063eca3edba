# SPDX-License-Identifier: GPL-3.0-or-later
"""Structure from motion, what of it needs no pictures: calibration, pairs of cameras, up, settings, and the guard."""

import ast
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from holoreel.core.camera import Camera, invert_rigid
from holoreel.core.errors import HoloreelError
from holoreel.core.sfm.calibration import CalibrationCheck, refuse_contradictions
from holoreel.core.sfm.jobs import Found
from holoreel.core.sfm.pairs import choose_pairs, overlaps
from holoreel.core.sfm.poses import upright
from holoreel.core.sfm.settings import SfmSettings
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

ROOT = Path(__file__).resolve().parents[2]


def arc(model: str, count: int = 6) -> list[Camera]:
    """Cameras on a level arc: turned about the vertical, their pictures move along epipolar lines."""
    cameras = []
    for index in range(count):
        angle = 0.15 * index
        eye = (5 * np.sin(angle), -5 * np.cos(angle), 1.0)
        camera = Camera.look_at(eye, (0, 0, 1), width=640, height=480, fx=430, name=f"cam{index}")
        lens = (0.02, -0.005, 0.001, 0.0) if model == "OPENCV_FISHEYE" else ()
        cameras.append(replace(camera, model=model, distortion=lens))
    return cameras


def turned(camera: Camera, degrees: float, axis: int) -> Camera:
    """The camera turned about one of its own axes: where a wrong calibration says it looks."""
    angle, matrix = np.radians(degrees), np.eye(4)
    a, b = [other for other in range(3) if other != axis]
    matrix[[a, b, a, b], [a, b, b, a]] = np.cos(angle), np.cos(angle), -np.sin(angle), np.sin(angle)
    return replace(camera, world_to_camera=invert_rigid(invert_rigid(camera.world_to_camera) @ matrix))


def matched(cameras: list[Camera]) -> Found:
    """Points at random, seen by all cameras with a third of a pixel's error, and one match in eight wrong."""
    random = np.random.default_rng(0)
    points = random.uniform((-1.5, -1.5, 0), (1.5, 1.5, 2), (400, 3))
    keypoints, visible = [], []
    for camera in cameras:
        uv = camera.project(points)[0] + random.normal(0, 0.3, (len(points), 2))
        keypoints.append(uv.astype(np.float32))
        visible.append(((uv > 0) & (uv < (camera.width, camera.height))).all(axis=1))
    matches = {}
    for a, b in choose_pairs(cameras, "exhaustive"):
        rows = np.flatnonzero(visible[a] & visible[b])
        partners = np.where(random.random(len(rows)) < 0.125, random.permutation(rows), rows)
        matches[a, b] = np.stack([rows, partners], axis=1)
    nothing = np.empty(0, np.int64)
    return Found(keypoints, matches, np.empty((0, 3)), np.empty(0), np.zeros(1, np.int64), nothing, nothing, {}, "")


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV_FISHEYE"])
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("count", [3, 4, 6])
def test_turned_camera_is_named(model: str, axis: int, count: int) -> None:
    """One of a few good cameras is believed to look 3 degrees elsewhere."""
    cameras = arc(model, count)
    found = matched(cameras)
    for wrong in (None, *range(count)):
        believed = [turned(camera, 3, axis) if index == wrong else camera for index, camera in enumerate(cameras)]
        check = CalibrationCheck(believed)
        check.add(found)
        checks = check.judge()
        named = [index for index, camera in enumerate(checks) if camera.contradicts]
        if count == 3 and axis == 1 and wrong is not None:  # the triple alone tells: it cannot say whose fault it is
            assert wrong in named
            continue
        assert named == ([] if wrong is None else [wrong])
        if wrong is None:
            continue
        good = [camera.inlier_ratio or 0 for index, camera in enumerate(checks) if index != wrong]
        assert min(good) > 0.8
        with pytest.raises(HoloreelError, match=rf"'cam{wrong}' misses .* by \d+\.\d px .* --without cam{wrong}\."):
            refuse_contradictions(checks, "capture")


def test_a_few_bad_matches_accuse_nobody() -> None:
    cameras = arc("PINHOLE", 4)
    found = matched(cameras)
    random = np.random.default_rng(1)
    nonsense = np.stack([random.permutation(400)[:60], random.permutation(400)[:60]], axis=1)
    few = {
        pair: nonsense if 3 in pair else rows
        for pair, rows in found.matches.items()
        if pair in ((0, 1), (0, 2), (0, 3))
    }
    check = CalibrationCheck(cameras)
    check.add(replace(found, matches=few))
    assert not any(camera.contradicts for camera in check.judge())


def test_contradictions_without_a_culprit() -> None:
    cameras = arc("PINHOLE", 2)
    found = matched(cameras)
    check = CalibrationCheck([turned(cameras[0], 4, 0), cameras[1]])
    check.add(found)
    with pytest.raises(HoloreelError, match="at least one of them is not where its calibration says"):
        refuse_contradictions(check.judge(), "capture")


@given(st.integers(2, 12), st.floats(-60, 60), st.integers(0, 10_000))
@hypothesis_settings(max_examples=30, deadline=None)
def test_up_is_found_whatever_the_cameras_look_at(count: int, pitch: float, seed: int) -> None:
    """Cameras that do not roll, in a world turned at random: those in a ring, and those that look the same way."""
    random = np.random.default_rng(seed)
    world = np.linalg.qr(random.normal(size=(3, 3)))[0]
    world *= np.sign(np.linalg.det(world))
    headings = np.linspace(0, np.pi, count, endpoint=False)
    level = np.cos(np.radians(pitch))
    eyes = [(level * np.cos(h), level * np.sin(h), np.sin(np.radians(pitch))) for h in headings]
    rotations = [Camera.look_at((0, 0, 0), eye, width=4, height=4, fx=4).world_to_camera[:3, :3] for eye in eyes]
    rotation = upright([r @ world.T for r in rotations])
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(rotation) > 0
    assert (rotation @ world)[2] @ (0, 0, 1) > np.cos(np.radians(1))


def test_pairs_share_views() -> None:
    ring = []
    for angle in np.linspace(0, 2 * np.pi, 24, endpoint=False):
        eye = (4 * np.cos(angle), 4 * np.sin(angle), 1.0)
        ring.append(Camera.look_at(eye, (0, 0, 0), width=64, height=48, fx=60))
    shares = overlaps(ring)
    np.testing.assert_array_equal(shares, shares.T)
    assert (np.diag(shares) == 0).all()
    pairs = choose_pairs(ring, "overlap")
    steps = [min(b - a, 24 - b + a) for a, b in pairs]
    assert max(steps) <= 6
    assert sum(step == 1 for step in steps) == 24
    away = [Camera.look_at(camera.center, 2 * camera.center, width=64, height=48, fx=60) for camera in ring[:12:6]]
    assert overlaps(away)[0, 1] == 0
    assert len(choose_pairs(ring, "exhaustive")) == 24 * 23 // 2
    assert max(b - a for a, b in choose_pairs(ring, "sequential")) == 5


@pytest.mark.parametrize(
    "change", [{"every": 0}, {"max_size": 50}, {"min_track": 1}, {"max_error": float("nan")}, {"min_angle": 0.0}]
)
def test_impossible_settings_are_refused(change: dict[str, object]) -> None:
    with pytest.raises(HoloreelError, match="--" + next(iter(change)).replace("_", "-")):
        SfmSettings(**change)  # type: ignore[arg-type]


def test_one_module_imports_pycolmap() -> None:
    """In any other process it makes Pillow's writer of PNG files crash."""
    importers = set()
    for path in (ROOT / "core").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            if any(name.split(".")[0] == "pycolmap" for name in names):
                importers.add(path.relative_to(ROOT).as_posix())
            if isinstance(node, ast.ImportFrom) and any(alias.name == "colmap" for alias in node.names):
                assert path.parent.name != "sfm" or path.name == "child.py", path
    assert importers == {"core/sfm/colmap.py"}
    modules = "holoreel.core.sfm.run, holoreel.core.sfm.poses, holoreel.core.cli.sfm"
    code = f"import sys, {modules}; print('pycolmap' in sys.modules)"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    assert out.stdout.strip() == "False"
