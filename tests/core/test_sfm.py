# SPDX-License-Identifier: GPL-3.0-or-later
"""Structure from motion, against a textured corner of a room, cast ray by ray through any lens: surfaces are known."""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from holoreel.core.camera import Camera, invert_rigid
from holoreel.core.capture import Capture, read_points
from holoreel.core.capture.sfm_result import attach, with_cameras
from holoreel.core.errors import HoloreelError
from holoreel.core.sfm.poses import find_poses
from holoreel.core.sfm.run import SfmReport, run_sfm
from holoreel.core.sfm.settings import PoseSettings, SfmSettings
from numpy.typing import NDArray
from PIL import Image

LOW = SfmSettings(quality="low")

Array = NDArray[np.float64]

SIZE = (320, 240)
# The planes of floor and walls: axis, its coordinate there, and the two axes along the plane. Bounded to |x| <= 6.
PLANES = ((2, 0.0, (0, 1)), (1, 3.0, (0, 2)), (0, -3.0, (1, 2)))
_TEXELS_PER_UNIT = 60.0
_LENSES = {
    "OPENCV": (-0.12, 0.03, 0.001, -0.001),
    "FULL_OPENCV": (-0.12, 0.03, 0.001, -0.001, 0.002, 0.01, 0.0, 0.0),
    "OPENCV_FISHEYE": (0.02, -0.005, 0.001, 0.0),
}


def room_cameras(count: int = 6, model: str = "PINHOLE", size: tuple[int, int] = SIZE) -> list[Camera]:
    """Cameras on an arc that look into the corner, each a little higher than the one before, each with its own lens."""
    width, height = size
    cameras = []
    for index in range(count):
        angle = -0.5 + 0.16 * index
        eye = (3 * np.cos(angle) + 1, -3 * np.sin(angle) - 2.5, 1.6 + 0.12 * index)
        focal = (0.42 if model == "OPENCV_FISHEYE" else 0.68 + 0.01 * index) * width
        camera = Camera.look_at(eye, (-1, 1, 0.8), width=width, height=height, fx=focal, name=f"cam{index}")
        cameras.append(replace(camera, model=model, distortion=_LENSES.get(model, ())))
    return cameras


def room_capture(folder: Path, cameras: Sequence[Camera], frames: int = 1, **fields: object) -> Capture:
    """Cast and write the pictures; a ball of its own texture stands elsewhere in every frame."""
    images = {}
    for camera in cameras:
        for frame in range(frames):
            path = folder / camera.name / f"{frame:04d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(cast(camera, frame)).save(path)
            images[camera.name, frame] = path
    by_name = {camera.name: camera for camera in cameras}
    return Capture(by_name, images, frames, source=folder, **fields)  # type: ignore[arg-type]


def cast(camera: Camera, frame: int = 0) -> NDArray[np.uint8]:
    """The picture a camera takes of the room, (H, W, 3)."""
    origins, rays = camera.rays()
    distance = np.full(len(rays), np.inf)
    color = np.full((len(rays), 3), 30.0)
    for index, (axis, place, along) in enumerate(PLANES):
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (place - origins[:, axis]) / rays[:, axis]
            hit = origins + t[:, None] * rays
            ok = (t > 0) & (t < distance) & (np.abs(hit) < 6).all(axis=1) & (hit[:, 2] > -1e-6)
        distance[ok] = t[ok]
        color[ok] = _look_up(index, hit[ok][:, along])
    center = np.array([-1.0 + 0.4 * frame, 1.0, 0.6])
    b = np.einsum("ij,ij->i", origins - center, rays)
    inside = b**2 - ((origins - center) ** 2).sum(axis=1) + 0.6**2
    t = -b - np.sqrt(np.maximum(inside, 0))
    ok = (inside > 0) & (t > 0) & (t < distance)
    local = (origins + t[:, None] * rays - center)[ok]
    color[ok] = _look_up(3, local[:, :2] * 1.5 + local[:, 2:])
    return np.clip(color + 0.5, 0, 255).astype(np.uint8).reshape(camera.height, camera.width, 3)


def distances(points: Array, frame: int = 0) -> Array:
    """How far (N, 3) points are from the nearest surface of the room, (N,)."""
    center = np.array([-1.0 + 0.4 * frame, 1.0, 0.6])
    planes = [np.abs(points[:, axis] - place) for axis, place, _ in PLANES]
    return np.minimum(np.min(planes, axis=0), np.abs(np.linalg.norm(points - center, axis=1) - 0.6))


def turned(camera: Camera, degrees: float, axis: int = 1) -> Camera:
    """The camera turned about one of its own axes: where a wrong calibration says it looks."""
    angle = np.radians(degrees)
    matrix = np.eye(4)
    a, b = [other for other in range(3) if other != axis]
    matrix[[a, b, a, b], [a, b, b, a]] = np.cos(angle), np.cos(angle), -np.sin(angle), np.sin(angle)
    return replace(camera, world_to_camera=invert_rigid(invert_rigid(camera.world_to_camera) @ matrix))


@cache
def _texture(seed: int, size: int = 512) -> Array:
    from scipy.ndimage import gaussian_filter

    random = np.random.default_rng(seed)
    layers = [
        gaussian_filter(random.standard_normal((size, size, 3)), (s, s, 0), mode="wrap") * s for s in (1, 2, 4, 8)
    ]
    values = sum(layers)
    return 255 * (values - values.min()) / (values.max() - values.min())


def _look_up(seed: int, coordinates: Array) -> Array:
    from scipy.ndimage import map_coordinates

    texture = _texture(seed)
    places = (coordinates * _TEXELS_PER_UNIT).T
    return np.stack([map_coordinates(texture[..., c], places, order=1, mode="grid-wrap") for c in range(3)], axis=1)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> tuple[Capture, SfmReport]:
    """Six cameras, two frames, and what was found in them; nothing here may be changed."""
    folder = tmp_path_factory.mktemp("room")
    capture = room_capture(folder, room_cameras(6), frames=2, frame_start=11)
    return capture, run_sfm(capture, folder / "sfm", LOW)


def check_points(capture: Capture, report: SfmReport, frame: int, least: int, close: float) -> None:
    result = report.frames[frame]
    points = read_points(report.folder / result.file)
    off = distances(points.xyz.astype(np.float64), frame)
    assert len(points) == result.points >= least
    assert np.median(off) < close
    assert np.percentile(off, 90) < 10 * close
    assert 0 < result.reprojection_error_px < 0.5
    check_colors(capture, points.xyz, points.rgb, frame)


def check_colors(capture: Capture, xyz: np.ndarray, rgb: np.ndarray, frame: int) -> None:
    """Points have the colors that a camera sees where it sees them (others may be in front of some)."""
    name, camera = next(iter(capture.cameras.items()))
    uv, _ = camera.project(xyz)
    inside = ((uv > 2) & (uv < (camera.width - 2, camera.height - 2))).all(axis=1)
    seen = capture.image(name, frame)[uv[inside, 1].astype(int), uv[inside, 0].astype(int)]
    assert np.median(np.abs(seen.astype(float) - rgb[inside])) < 8


def test_points_lie_on_the_surfaces(room: tuple[Capture, SfmReport]) -> None:
    capture, report = room
    for frame in range(2):
        check_points(capture, report, frame, least=1200, close=0.02)
    assert report.done_now == 2
    assert all(check.residual_px is not None and check.residual_px < 0.3 for check in report.checks)


@pytest.mark.parametrize("model", [pytest.param("OPENCV", marks=pytest.mark.slow), "FULL_OPENCV", "OPENCV_FISHEYE"])
def test_points_through_lenses(tmp_path: Path, model: str) -> None:
    capture = room_capture(tmp_path, room_cameras(4, model, (320, 240)))
    report = run_sfm(capture, tmp_path / "sfm", LOW)
    check_points(capture, report, 0, least=500, close=0.03)


def test_attached_by_number_on_the_timeline(room: tuple[Capture, SfmReport]) -> None:
    capture, report = room
    seeded = attach(capture, report.folder)
    assert sorted(seeded.seeds) == [0, 1]
    assert seeded.seed_points(0).xyz.shape == (report.frames[0].points, 3)
    second = attach(capture.frames(1, 1), report.folder)
    assert second.seeds == {0: seeded.seeds[1]}
    halves = {name: camera.scaled(160, 120) for name, camera in capture.cameras.items()}
    assert len(attach(replace(capture, cameras=halves), report.folder).seeds) == 2
    elsewhere = {name: turned(camera, 0.1) for name, camera in capture.cameras.items()}
    with pytest.raises(HoloreelError, match="'cam0' stood elsewhere"):
        attach(replace(capture, cameras=elsewhere), report.folder)
    with pytest.raises(HoloreelError, match="points of none of the capture's frames 13 to 14"):
        attach(replace(capture, frame_start=13), report.folder)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"version": 2}, "version must be 1"),
        ({"cameras": []}, "cameras must be a list"),
        ({"cameras": [7]}, r"cameras\[0\] must be an object"),
        ({"posed": 3}, "posed must be"),
        ({"frame_count": -1}, "frame_count must be"),
        ({"frames": [{"index": 9, "file": "points_0000.ply", "points": 1}]}, r"frames\[0\].index"),
        ({"frames": [{"index": 0, "file": "../../etc/passwd", "points": 1}]}, r"frames\[0\].file"),
        ({"frames": [{"index": 0, "file": "points_0000.ply", "points": "1"}]}, r"frames\[0\].points"),
        ({"frames": [{"index": 0, "file": "points_9999.ply", "points": 1}]}, "points_9999.ply is missing"),
    ],
)
def test_damaged_results_are_refused(
    room: tuple[Capture, SfmReport], tmp_path: Path, change: dict[str, object], words: str
) -> None:
    capture, report = room
    value = json.loads((report.folder / "sfm.json").read_text())
    (tmp_path / "sfm.json").write_text(json.dumps(value | change))
    with pytest.raises(HoloreelError, match=words):
        attach(capture, tmp_path)


def test_goes_on_where_it_stopped(tmp_path: Path) -> None:
    cameras = room_cameras(3, size=(200, 150))
    capture = room_capture(tmp_path / "a", cameras, frames=3)
    messages: list[str] = []

    def again(settings: SfmSettings = LOW) -> list[tuple[int, str]]:
        report = run_sfm(capture, tmp_path / "sfm", settings, on_message=messages.append)
        return [(report.done_now, ""), *((frame.index, frame.key) for frame in report.frames)]

    class StopError(Exception):
        pass

    def stop(done: int, total: int) -> None:
        assert total == 3
        if done == 1:
            raise StopError

    with pytest.raises(StopError):
        run_sfm(capture, tmp_path / "sfm", LOW, jobs=1, on_progress=stop)
    first = again()
    assert first[0][0] == 2
    assert [index for index, _ in first[1:]] == [0, 1, 2]
    assert again() == [(0, ""), *first[1:]]
    assert messages == []
    (tmp_path / "sfm" / "points_0001.ply").unlink()
    assert again()[0][0] == 1
    messages.clear()
    Image.new("RGB", (200, 150)).save(tmp_path / "a" / "cam1" / "0002.png")
    assert again()[0][0] == 1  # content, not names
    assert "pictures or the cameras have changed" in messages[0]
    assert again(replace(LOW, max_error=1.0))[0][0] == 3
    assert "max_error was 2.0, is 1.0" in messages[1]
    every = again(replace(LOW, max_error=1.0, every=2))
    assert [index for index, _ in every[1:]] == [0, 2]
    assert not (tmp_path / "sfm" / "points_0001.ply").exists()


def test_held_out_views_stay_unseen(tmp_path: Path) -> None:
    cameras = room_cameras(3, size=(200, 150))
    capture = room_capture(tmp_path, cameras, splits={"cam1": "test"})
    for path in (tmp_path / "cam1").iterdir():
        path.write_bytes(b"not to be read")
    report = run_sfm(capture, tmp_path / "sfm", LOW)
    assert [check.name for check in report.checks] == ["cam0", "cam2"]
    with pytest.raises(HoloreelError, match="cannot be read"):
        run_sfm(capture, tmp_path / "sfm", replace(LOW, held_out=True))
    with pytest.raises(HoloreelError, match="needs two cameras and has 1"):
        run_sfm(capture, tmp_path / "sfm", replace(LOW, without=("cam2",)))
    with pytest.raises(HoloreelError, match="no such camera"):
        run_sfm(capture, tmp_path / "sfm", replace(LOW, without=("camera",)))


def test_turned_cameras_are_refused_with_figures(room: tuple[Capture, SfmReport], tmp_path: Path) -> None:
    capture = room[0].frames(0, 1)
    believed = {name: turned(camera, 2) if name == "cam4" else camera for name, camera in capture.cameras.items()}
    wrong = replace(capture, cameras=believed, splits={"cam0": "test", "cam1": "test"})
    with pytest.raises(HoloreelError, match=r"'cam4' misses .* by \d+\.\d px .* --without cam4\.") as refusal:
        run_sfm(wrong, tmp_path, LOW)
    assert str(refusal.value).count("cam") == 3  # the camera, the word, the remedy
    assert not (tmp_path / "sfm.json").exists()
    assert run_sfm(wrong, tmp_path, replace(LOW, without=("cam4",))).frames[0].points > 300


def test_pictures_without_features_are_refused(tmp_path: Path) -> None:
    capture = room_capture(tmp_path, room_cameras(3, size=(120, 90)), frames=2)
    for path in capture.images.values():
        Image.new("RGB", (120, 90), (90, 90, 90)).save(path)
    with pytest.raises(HoloreelError, match=r"no points were found .* without texture"):
        run_sfm(capture, tmp_path / "sfm", LOW)


def test_alpha_is_a_mask(tmp_path: Path) -> None:
    cameras = room_cameras(3, size=(240, 180))
    capture = room_capture(tmp_path, cameras)
    for (name, _), path in capture.images.items():
        picture = np.array(Image.open(path))
        alpha = np.where(_on_floor(capture.cameras[name]), 255, 0).astype(np.uint8)
        Image.fromarray(np.dstack([picture, alpha])).save(path)
    report = run_sfm(capture, tmp_path / "sfm", LOW)
    points = read_points(report.folder / report.frames[0].file)
    assert len(points) > 50
    assert np.percentile(np.abs(points.xyz[:, 2]), 90) < 0.1


def _on_floor(camera: Camera) -> np.ndarray:
    origins, rays = camera.rays()
    with np.errstate(divide="ignore"):
        hit = origins + (-origins[:, 2] / rays[:, 2])[:, None] * rays
    inside = (
        (rays[:, 2] < 0) & (hit[:, 1] < 2.8) & (hit[:, 0] > -2.8) & (np.linalg.norm(hit - (-1, 1, 0), axis=1) > 1.5)
    )
    return inside.reshape(camera.height, camera.width)


def test_poses_are_found(tmp_path: Path) -> None:
    """Full structure from motion, against the truth up to a similarity; up must be up."""
    cameras = room_cameras(4, size=(320, 240))
    capture = room_capture(tmp_path, cameras, frames=2)
    blind = {camera.name: Camera(320, 240, 100, 100, 160, 120, name=camera.name) for camera in cameras}
    blind["blind"] = Camera(320, 240, 100, 100, 160, 120, name="blind")
    images = capture.images | {("blind", frame): tmp_path / "blind.png" for frame in range(2)}
    Image.new("RGB", (320, 240)).save(tmp_path / "blind.png")
    unposed = replace(capture, cameras=blind, images=images)
    found = find_poses(unposed, LOW, PoseSettings(reference=(0,)))
    assert [camera.name for camera in found.cameras] == [camera.name for camera in cameras]
    truth = np.array([camera.center for camera in cameras])
    result = np.array([camera.center for camera in found.cameras])
    ratios = _distances(result) / _distances(truth)
    assert np.std(ratios) / np.mean(ratios) < 0.02
    for camera, true in zip(found.cameras, cameras, strict=True):
        assert camera.fx == pytest.approx(true.fx, rel=0.03)
        up = camera.world_to_camera[:3, :3] @ (0, 0, 1)  # as the camera sees it
        assert up @ (true.world_to_camera[:3, :3] @ (0, 0, 1)) > np.cos(np.radians(3))
    points = run_sfm(with_cameras(unposed, found.cameras), tmp_path / "sfm", LOW, posed_here=True)
    again = attach(unposed, points.folder)
    assert list(again.cameras) == [camera.name for camera in cameras]
    assert ("blind", 0) not in again.images
    assert len(again.seeds) == 2
    seen = [np.linalg.norm(again.seed_points(0).xyz - camera.center, axis=1) for camera in found.cameras]
    assert np.median(seen) == pytest.approx(5.0, rel=0.2)


def _distances(centers: np.ndarray) -> np.ndarray:
    a, b = np.triu_indices(len(centers), 1)
    return np.linalg.norm(centers[a] - centers[b], axis=1)


def test_command_line(
    room: tuple[Capture, SfmReport], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from holoreel.core.capture import write_capture
    from holoreel.core.cli import main

    capture = room[0].frames(0, 1)
    few = {name: camera for name, camera in capture.cameras.items() if name in ("cam0", "cam1", "cam2")}
    images = {view: path for view, path in capture.images.items() if view[0] in few}
    capture = replace(capture, cameras=few, images=images, splits={})
    write_capture(tmp_path, capture)
    assert main(["sfm", str(tmp_path), "--quality", "low"]) == 0
    assert "1 frames, 1 of them now" in capsys.readouterr().out
    assert (tmp_path / "sfm" / "points_0000.ply").is_file()
    wrong = replace(capture, cameras=few | {"cam1": turned(few["cam1"], 5, 0)})
    write_capture(tmp_path, wrong)
    assert main(["sfm", str(tmp_path), "--quality", "low"]) == 2
    assert "'cam1'" in capsys.readouterr().err


@pytest.mark.slow
def test_webcams(shared_data: Callable[[str], Path], tmp_path: Path) -> None:
    """Four real cameras far apart, whose calibration is good to about a pixel."""
    from holoreel.core.capture.layouts import read_capture

    capture = read_capture(shared_data("capture_webcams"), frames="56:56", test_cameras=("none",))
    report = run_sfm(capture, tmp_path, SfmSettings(quality="low"))
    assert report.frames[0].points > 200
    assert report.frames[0].reprojection_error_px < 1.5
    assert not any(check.contradicts for check in report.checks)
