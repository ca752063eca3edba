# SPDX-License-Identifier: GPL-3.0-or-later
"""Cameras: projection and its inverse, look-at, scaling, files, and everything that is no camera."""

import json
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from holoreel.core.camera import Camera, focal_from_fov, read_camera, write_camera
from holoreel.core.errors import HoloreelError
from holoreel.core.lens import brown_limit, fisheye_limit
from hypothesis import example, given, settings
from hypothesis import strategies as st

numbers = st.floats(-20, 20, allow_nan=False)
vectors = st.tuples(numbers, numbers, numbers).map(np.array)


def rotation_from_quaternion(w: float, x: float, y: float, z: float) -> np.ndarray:
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


@st.composite
def cameras(draw: st.DrawFn) -> Camera:
    quat = np.array(draw(st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1)))
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_from_quaternion(*(quat / np.linalg.norm(quat)))
    matrix[:3, 3] = draw(vectors)
    focal, center = st.floats(20, 3000), st.floats(-500, 1500)
    return Camera(
        draw(st.integers(1, 2000)), draw(st.integers(1, 2000)),
        draw(focal), draw(focal), draw(center), draw(center), matrix,
    )  # fmt: skip


@given(cameras(), st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_project_undoes_unproject_and_rays_hit(camera: Camera, seed: int) -> None:
    rng = np.random.default_rng(seed)
    uv = rng.uniform(0, 1, (30, 2)) * (camera.width, camera.height)
    z = rng.uniform(0.1, 50, 30)
    points = camera.unproject(uv, z)
    uv_back, z_back = camera.project(points)
    assert np.allclose(uv_back, uv, atol=1e-6, rtol=1e-9)
    assert np.allclose(z_back, z, atol=1e-8, rtol=1e-9)
    origins, directions = camera.rays(uv)
    assert np.allclose(np.linalg.norm(directions, axis=1), 1)
    distance = np.linalg.norm(points - origins, axis=1)
    assert np.allclose(origins + directions * distance[:, None], points, atol=1e-7 * (1 + distance.max()))
    homogeneous = np.concatenate([points, np.ones((30, 1))], 1) @ camera.world_to_camera.T
    expected = homogeneous[:, :3] @ camera.K.T
    assert np.allclose(expected[:, :2] / expected[:, 2:], uv, atol=1e-6)


def lens(model: str, distortion: tuple[float, ...], width: int = 640, height: int = 480) -> Camera:
    view = Camera.look_at((1, -4, 1), (0.2, 0, 0), width=width, height=height, fx=0.55 * width)
    return replace(view, cx=0.47 * width, cy=0.54 * height, model=model, distortion=distortion)


@st.composite
def lenses(draw: st.DrawFn) -> Camera:
    """What calibrations find: mild and strong, barrel and cushion, with and without tangential parts."""
    model = draw(st.sampled_from(["OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"]))

    def decimals(low: float, high: float) -> st.SearchStrategy[float]:  # no calibration finds 1e-139
        return st.floats(low, high).map(lambda value: round(value, 6))

    first, others, tangential = decimals(-0.5, 0.5), decimals(-0.2, 0.2), decimals(-0.02, 0.02)
    if model == "OPENCV_FISHEYE":
        return lens(model, tuple(draw(st.tuples(decimals(-0.1, 0.2), *[decimals(-0.05, 0.05)] * 3))))
    values = draw(st.tuples(first, others, tangential, tangential))
    return lens(model, values if model == "OPENCV" else (*values, *draw(st.tuples(others, first, others, others))))


@given(lenses(), st.integers(0, 2**32 - 1))
@example(lens("FULL_OPENCV", (0, 0, 0, 0, 0.125, 0, 0, 0)), 0)  # a seventh power: pixels of 1e17
@example(lens("FULL_OPENCV", (-0.4, 0, 0, 0, 0.1, 0.5, 0.1, -0.1)), 0)  # a pole, whose value rounding makes negative
@settings(max_examples=100, deadline=None)
def test_lenses_are_invertible_where_they_see(camera: Camera, seed: int) -> None:
    """Pixels to points and back to 1e-9 px; what a lens sees it sees at one pixel, and that pixel sees it."""
    rng = np.random.default_rng(seed)
    uv = rng.uniform(-0.2, 1.2, (200, 2)) * (camera.width, camera.height)
    _, rays = camera.rays(uv)
    seen = np.isfinite(rays).all(axis=1)
    assert seen[np.linalg.norm(uv - (camera.cx, camera.cy), axis=1) < 40].all()
    z = rng.uniform(0.1, 50, 200)
    points = camera.unproject(uv, z)
    ahead = np.isfinite(points).all(axis=1)
    assert not (ahead & ~seen).any()
    back, depth = camera.project(points[ahead])
    assert np.abs(back - uv[ahead]).max(initial=0) < 1e-9
    assert np.allclose(depth, z[ahead])
    back, _ = camera.project(camera.center + rays[seen] * z[seen, None])
    assert np.abs(back - uv[seen]).max() < 1e-8
    # From points: only those within the lens's range get pixels, and those pixels lead back to them.
    local = np.concatenate([rng.uniform(-3, 3, (200, 2)), rng.uniform(-1, 1, (200, 1))], axis=1)
    world = local @ camera.world_to_camera[:3, :3] + camera.center
    uv, depth = camera.project(world)
    has_pixel = np.isfinite(uv).all(axis=1)
    if camera.model == "OPENCV_FISHEYE":
        inside = np.arctan2(np.hypot(*local.T[:2]), local[:, 2]) < fisheye_limit(camera.distortion)
        near_limit = 0.999 * fisheye_limit(camera.distortion)
        well_inside = np.arctan2(np.hypot(*local.T[:2]), local[:, 2]) < near_limit
    else:
        slope = np.hypot(*local.T[:2]) / local[:, 2]
        inside = (local[:, 2] > 0) & (slope < brown_limit(camera.distortion))
        well_inside = inside & (slope < 0.98 * brown_limit(camera.distortion))
    assert np.array_equal(has_pixel, inside)
    _, rays = camera.rays(uv[well_inside])
    assert np.isfinite(rays).all()
    truth = (world - camera.center)[well_inside]
    truth /= np.linalg.norm(truth, axis=1, keepdims=True)
    pixels, _ = camera.project(camera.center + rays)
    assert np.abs(pixels - uv[well_inside]).max(initial=0) < 1e-8 * (1 + np.abs(uv[well_inside]).max(initial=0))
    assert (np.linalg.norm(rays - truth, axis=1) < 1e-4).all()  # near the limit pixels say little about angles


def test_a_fold_is_not_seen() -> None:
    """A lens that turns back: points beyond the turn would land in the picture again."""
    camera = Camera(640, 480, 300, 300, 320, 240, model="OPENCV", distortion=(-0.3, 0, 0, 0))
    limit = 1 / math.sqrt(0.9)  # of r (1 - 0.3 r²)
    assert math.isclose(brown_limit(camera.distortion), limit)
    slopes = np.array([0.5 * limit, 0.999 * limit, 1.001 * limit, 1.5 * limit])
    uv, _ = camera.project(np.stack([slopes, np.zeros(4), np.ones(4)], axis=1))
    assert np.isfinite(uv).all(axis=1).tolist() == [True, True, False, False]
    _, rays = camera.rays([[320 + 300 * limit * (1 - 0.3 * limit**2) + 1, 240], [320, 240]])
    assert np.isfinite(rays).all(axis=1).tolist() == [False, True]
    fisheye = Camera(640, 480, 300, 300, 320, 240, model="OPENCV_FISHEYE", distortion=(0, 0, 0, 0))
    behind = np.array([[1.0, 0, -0.5]])
    uv, z = fisheye.project(behind)
    assert np.allclose(uv, [[320 + 300 * math.atan2(1, -0.5), 240]])
    assert z[0] < 0
    assert np.allclose(fisheye.rays(uv)[1], behind / np.linalg.norm(behind))
    assert np.isnan(fisheye.unproject(uv, [1.0])).all()
    assert np.allclose(fisheye.project([[0, 0, 2.0]])[0], [[320, 240]])
    assert np.isnan(fisheye.project([[0, 0, -2.0], [0, 0, 0]])[0]).all()


COLMAP = """
import json, sys
import numpy as np, pycolmap
answers = []
for model, width, height, params, points in json.load(sys.stdin):
    camera = pycolmap.Camera(model=model, width=width, height=height, params=params)
    pixels = camera.img_from_cam(np.array(points))
    answers.append([pixels.tolist(), camera.cam_from_img(pixels).tolist()])
json.dump(answers, sys.stdout)
"""


def test_agrees_with_colmap() -> None:
    """Their own code, in a process of its own: it does not get along with other libraries."""
    cases = [
        lens("PINHOLE", ()), lens("OPENCV", (-0.28, 0.07, 0.001, -0.002)), lens("OPENCV", (0.2, 0.05, 0.01, 0.02)),
        lens("FULL_OPENCV", (0.5, 0.1, 0.001, -0.002, 0.02, 0.8, 0.2, 0.03)),
        lens("OPENCV_FISHEYE", (0.05, -0.01, 0.002, -0.003)), lens("OPENCV_FISHEYE", (-0.03, 0.01, 0.0, 0.0)),
    ]  # fmt: skip
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-0.9, 0.9, (60, 2)), np.ones((60, 1))], axis=1) * rng.uniform(0.5, 5, (60, 1))
    questions = [(c.model, c.width, c.height, [c.fx, c.fy, c.cx, c.cy, *c.distortion], points.tolist()) for c in cases]
    run = subprocess.run(
        [sys.executable, "-c", COLMAP], input=json.dumps(questions), capture_output=True, text=True, check=True
    )
    for camera, (pixels, planes) in zip(cases, json.loads(run.stdout), strict=True):
        world = points @ camera.world_to_camera[:3, :3] + camera.center
        assert np.allclose(camera.project(world)[0], pixels, atol=1e-9, rtol=0)
        local = (camera.unproject(pixels, np.ones(60)) - camera.center) @ camera.world_to_camera[:3, :3].T
        assert np.allclose(local[:, :2], planes, atol=1e-6)  # they iterate to less
        assert np.allclose(local, points / points[:, 2:], atol=1e-10)


def test_distortion_must_suit_the_model(tmp_path: Path) -> None:
    path = tmp_path / "CAMERA.json"
    write_camera(path, lens("OPENCV", (0.1, 0.2, 0.3, 0.4)))
    good = json.loads(path.read_text())
    assert good["distortion"] == [0.1, 0.2, 0.3, 0.4]
    assert read_camera(path).distortion == (0.1, 0.2, 0.3, 0.4)
    assert read_camera(path).scaled(320, 240).distortion == (0.1, 0.2, 0.3, 0.4)
    for wrong in ([], [0.1], [0.1] * 5, [0.1, 0.2, 0.3, "a"], [0.1, 0.2, 0.3, 1e300], "abcd", None, {"k1": 1}):
        path.write_text(json.dumps(good | {"distortion": wrong}))
        with pytest.raises(HoloreelError, match=r"CAMERA\.json.*distortion of a OPENCV camera must be 4 numbers"):
            read_camera(path)
    path.write_text(json.dumps(good | {"model": "PINHOLE"}))
    with pytest.raises(HoloreelError, match="distortion is not a field of a PINHOLE camera"):
        read_camera(path)
    with pytest.raises(HoloreelError, match="Blender knows PINHOLE alone"):
        lens("OPENCV", (0.1, 0.2, 0.3, 0.4)).require_pinhole("Blender")


def test_scaled_lenses_see_the_same() -> None:
    camera = lens("OPENCV_FISHEYE", (0.05, -0.01, 0.002, -0.003))
    points = camera.unproject([[100.0, 50.0], [600.0, 400.0]], [2.0, 3.0])
    assert np.allclose(camera.scaled(1280, 240).project(points)[0], camera.project(points)[0] * (2, 0.5))


@given(cameras())
@settings(max_examples=30, deadline=None)
def test_json_round_trip_is_exact(camera: Camera) -> None:
    back = Camera.from_json(json.loads(json.dumps(replace(camera, name="a").to_json())))
    assert back.name == "a"
    assert np.array_equal(back.world_to_camera, camera.world_to_camera)
    assert (back.fx, back.fy, back.cx, back.cy, back.width) == (
        camera.fx, camera.fy, camera.cx, camera.cy, camera.width,
    )  # fmt: skip
    assert np.allclose(camera.camera_to_world @ camera.world_to_camera, np.eye(4), atol=1e-9)
    assert np.allclose(camera.world_to_camera[:3, :3] @ camera.center + camera.world_to_camera[:3, 3], 0, atol=1e-9)


@given(vectors, vectors, vectors)
@settings(max_examples=80, deadline=None)
def test_look_at_centers_target_and_keeps_up_up(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> None:
    if np.linalg.norm(eye - target) < 1e-3 or np.linalg.norm(up) < 1e-3:
        return
    camera = Camera.look_at(eye, target, up, width=320, height=180, fx=300.0)
    uv, z = camera.project([target])
    assert np.allclose(uv, [[160, 90]], atol=1e-6)
    assert np.isclose(z[0], np.linalg.norm(eye - target))
    assert np.allclose(camera.center, eye, atol=1e-9)
    view, upward = (target - eye) / z[0], up / np.linalg.norm(up)
    if np.linalg.norm(np.cross(view, upward)) > 1e-3:
        higher, _ = camera.project([target + 1e-3 * z[0] * upward])
        assert abs(higher[0, 0] - 160) < 1e-6
        assert higher[0, 1] < 90


def test_look_straight_down() -> None:
    camera = Camera.look_at((0, 0, 5), (0, 0, 0), width=10, height=10, fx=10)
    assert np.allclose(camera.project([[0, 1, 0]])[0], [[5, 3]])


def test_convention_by_hand() -> None:
    """x right, y down, z forward; the middle of the image is (W/2, H/2)."""
    camera = Camera(4, 2, 10, 20, 2, 1)
    uv, z = camera.project([[0, 0, 2], [0.2, 0, 2], [0, 0.1, 2]])
    assert np.allclose(uv, [[2, 1], [3, 1], [2, 2]])
    assert np.allclose(z, 2)
    centers = camera.pixel_centers()
    assert centers[:5].tolist() == [[0.5, 0.5], [1.5, 0.5], [2.5, 0.5], [3.5, 0.5], [0.5, 1.5]]
    assert camera.rays()[1].shape == (8, 3)


def test_scaled_sees_the_same() -> None:
    camera = Camera.look_at((3, -4, 2), (0, 0, 0), width=320, height=180, fx=300)
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    big = camera.scaled(640, 90)
    assert np.allclose(big.project(points)[0], camera.project(points)[0] * (2, 0.5))
    assert (big.width, big.height) == (640, 90)


def test_focal_from_fov() -> None:
    assert math.isclose(focal_from_fov(90, 200), 100)
    with pytest.raises(HoloreelError):
        focal_from_fov(180, 200)


def test_small_rounding_is_mended_and_matrix_is_read_only() -> None:
    camera = Camera(8, 8, 5, 5, 4, 4, np.diag([1 + 1e-4, 1, 1, 1]))
    assert np.allclose(camera.world_to_camera, np.eye(4), atol=1e-15)
    with pytest.raises(ValueError, match="read-only"):
        camera.world_to_camera[0, 0] = 2


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("width", 0), ("width", -1), ("width", 2.5), ("width", 10**9), ("height", math.nan), ("height", "8"),
        ("fx", 0), ("fx", -3), ("fx", math.inf), ("fy", math.nan), ("fy", None), ("cx", math.nan), ("cy", "a"),
        ("cx", True), ("model", "THIN_PRISM"), ("model", None), ("world_to_camera", np.eye(3)),
        ("world_to_camera", np.diag([2, 2, 2, 1])), ("world_to_camera", np.diag([1, 1, -1, 1])),
        ("world_to_camera", np.full((4, 4), math.nan)), ("world_to_camera", "abc"), ("world_to_camera", [[1], [1, 2]]),
        ("world_to_camera", np.zeros((4, 4))), ("world_to_camera", np.ones((4, 4))),
    ],
)  # fmt: skip
def test_impossible_fields_are_named(key: str, value: object) -> None:
    good = {"width": 8, "height": 8, "fx": 5, "fy": 5, "cx": 4, "cy": 4}
    with pytest.raises(HoloreelError, match=key):
        Camera(**(good | {key: value}))


def test_no_value_of_a_file_causes_a_traceback() -> None:
    good = Camera(8, 8, 5, 5, 4, 4).to_json() | {"name": "a"}
    for key in good:
        for strange in (None, [], {}, [1], 10**400, -(10**400), "x", [[10**400] * 4] * 4, True):
            if (key, strange) != ("name", "x"):
                with pytest.raises(HoloreelError, match=key):
                    Camera.from_json(good | {key: strange}, "CAMERA.json")


def test_camera_file(tmp_path: Path) -> None:
    path = tmp_path / "CAMERA.json"
    camera = Camera.look_at((1, 2, 3), (0, 0, 0), width=32, height=18, fx=30, name="middle")
    write_camera(path, camera)
    assert np.array_equal(read_camera(path).world_to_camera, camera.world_to_camera)
    good = json.loads(path.read_text())
    for change, field in [
        ({"model": "FOV"}, "model"), ({"model": "OPENCV"}, "distortion is missing"),
        ({"fx": -1}, "fx"), ({"k1": 0.1}, "k1"), ({"world_to_camera": [[1]]}, "world"),
    ]:  # fmt: skip
        path.write_text(json.dumps(good | change))
        with pytest.raises(HoloreelError, match=rf"CAMERA\.json.*{field}"):
            read_camera(path)
    path.write_text(json.dumps({key: good[key] for key in good if key != "cy"}))
    with pytest.raises(HoloreelError, match=r"CAMERA\.json.*cy is missing"):
        read_camera(path)
    for text in ("[1]", "{", '{"a":' * 100000):
        path.write_text(text)
        with pytest.raises(HoloreelError, match=r"CAMERA\.json"):
            read_camera(path)
