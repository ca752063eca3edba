# SPDX-License-Identifier: GPL-3.0-or-later
"""Every layout there and back: a capture from Blender is written as each dataset lays its files out, and read again."""

import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
from holoreel.core.blender import find_blender, run_in_blender
from holoreel.core.camera import Camera
from holoreel.core.capture import LAYOUTS, Capture, CaptureOptions, Points, read_capture, write_points
from holoreel.core.capture.colmap_model import write_model
from holoreel.core.capture.convert import convert
from holoreel.core.capture.export import Export
from holoreel.core.capture.immersive import target as fisheye_target
from holoreel.core.capture.n3v import camera_of, read_poses, row_of
from holoreel.core.capture.resample import lens_map
from holoreel.core.cli import main
from holoreel.core.errors import HoloreelError
from holoreel.core.files import write_json
from holoreel.core.rig import RigRequest
from holoreel.core.synth import SynthJob, synthesize

START = 151  # of the capture's frames on the timeline
HELD_OUT = "cam01"


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """Three wide cameras, three frames, 160x120, from the scene of glowing marks; the second camera is held out."""
    try:
        blender = find_blender()
    except HoloreelError:
        pytest.skip("no Blender")
    folder = tmp_path_factory.mktemp("small")
    helper = "holoreel.tests.core.blender_scene:build"
    run_in_blender(blender, helper, {"path": str(folder / "marks.blend")}, log=folder / "log")
    rig = RigRequest(cameras=3, width=160, height=120, fov_degrees=80, radius=2.0, span_degrees=40)
    job = SynthJob(folder / "marks.blend", rig, (1, 3), samples=4, denoise=False, seed_points=100)
    synthesize(job, folder / "capture", lambda: blender)
    capture = read_capture(folder / "capture", test_cameras=(HELD_OUT,), frame_start=START)
    for index, camera in enumerate(capture.cameras.values()):  # marks are small: let every picture tell whose it is
        for frame in range(3):
            path = capture.images[camera.name, frame]
            picture = iio.imread(path)
            picture[:40, :, :3] = gradient(index, frame)
            iio.imwrite(path, picture)
    return capture


def gradient(camera: int, frame: int) -> np.ndarray:
    """A smooth strip whose colors tell camera and frame."""
    across = np.linspace(0, 1, 160)
    strip = np.stack([across * 255, 255 * (1 - across), np.full(160, 20 + 70 * frame)], axis=1)
    strip[:, 0] *= (1 + camera) / 3
    return np.broadcast_to(strip, (40, 160, 3)).astype(np.uint8)


def there_and_back(capture: Capture, to: str, folder: Path, **options: object) -> Capture:
    convert(capture, to, folder / "scene", {}, Export())
    return read_capture(folder / "scene", scale=1, **options)


def psnr(first: np.ndarray, second: np.ndarray) -> float:
    return float(-10 * np.log10(max(np.mean((first / 255.0 - second / 255.0) ** 2), 1e-12)))


def assert_same_cameras(back: Capture, capture: Capture, names: dict[str, str], tolerance: float = 1e-6) -> None:
    assert sorted(back.cameras) == sorted(names.values())
    for old, new in names.items():
        before, after = capture.cameras[old], back.cameras[new]
        assert (after.width, after.height, after.model) == (before.width, before.height, before.model)
        for key in ("fx", "fy", "cx", "cy", "distortion"):
            assert getattr(after, key) == pytest.approx(getattr(before, key), abs=tolerance)
        np.testing.assert_allclose(after.world_to_camera, before.world_to_camera, atol=tolerance)


def assert_same_pictures(back: Capture, capture: Capture, names: dict[str, str], least: float) -> None:
    """Each picture is its original's, and nearer to it than to any other view of the capture."""
    originals = {view: capture.image(*view, (0, 0, 0)) for view in capture.views()}
    for old, new in names.items():
        for frame in range(capture.frame_count):
            picture = back.image(new, frame, (0, 0, 0))
            likeness = {view: psnr(picture, original) for view, original in originals.items()}
            assert max(likeness, key=lambda view: likeness[view]) == (old, frame)
            assert likeness[old, frame] > least


# Layout, the names that the cameras get (the held-out one first), first frame, least PSNR of the pictures.
CASES = {
    "nerfstudio": (("cam01", "cam00", "cam02"), START, 99.0),
    "n3v": (("cam00", "cam01", "cam02"), 0, 38.0),
    "technicolor": (("cam00", "cam01", "cam02"), START, 99.0),
    "colmap": (("cam01", "cam00", "cam02"), START, 99.0),
    "videos": (("cam01", "cam00", "cam02"), 0, 38.0),
}


@pytest.mark.parametrize("layout", CASES)
def test_there_and_back(small: Capture, tmp_path: Path, layout: str) -> None:
    new_names, start, least = CASES[layout]
    names = dict(zip([HELD_OUT, "cam00", "cam02"], new_names, strict=True))
    test = () if new_names[0] == "cam00" or layout == "nerfstudio" else (HELD_OUT,)
    back = there_and_back(small, layout, tmp_path, test_cameras=test)
    assert (back.frame_count, back.frame_start) == (3, start)
    assert back.camera_names("test") == [names[HELD_OUT]]
    assert_same_cameras(back, small, names)
    assert_same_pictures(back, small, names, least)
    back.check_files()


@pytest.mark.parametrize("layout", ["nerfstudio", "colmap"])
def test_seed_points_come_along(small: Capture, tmp_path: Path, layout: str) -> None:
    back = there_and_back(small, layout, tmp_path)
    for frame in range(3):
        assert len(small.seed_points(frame)) > 50
        np.testing.assert_array_equal(back.seed_points(frame).xyz, small.seed_points(frame).xyz)
        np.testing.assert_array_equal(back.seed_points(frame).rgb, small.seed_points(frame).rgb)


@pytest.fixture(scope="module")
def fisheye(small: Capture, tmp_path_factory: pytest.TempPathFactory) -> tuple[Capture, Path]:
    """The small capture seen through fisheyes whose k1 and k2 are not zero, and its Immersive folder."""
    folder = tmp_path_factory.mktemp("fisheye")
    lenses = {
        name: replace(fisheye_target(camera), distortion=(0.02, -0.005, 0.0, 0.0), cx=79.0, cy=61.5)
        for name, camera in small.cameras.items()
    }
    lenses = {name: replace(lens, fx=lens.fx * 1.08, fy=lens.fx * 1.08) for name, lens in lenses.items()}
    for name, lens in lenses.items():
        seen = lens_map(small.cameras[name], lens)
        assert seen.seen.all()
        for frame in range(3):
            path = folder / "pictures" / f"{name}_{frame}.png"
            path.parent.mkdir(exist_ok=True)
            iio.imwrite(path, seen.apply(small.image(name, frame, (0, 0, 0))))
    images = {(n, j): folder / "pictures" / f"{n}_{j}.png" for n, j in small.images}
    capture = replace(small, cameras=lenses, images=images)
    convert(capture, "immersive", folder / "scene", {}, Export())
    return capture, folder / "scene"


IMMERSIVE = {HELD_OUT: "camera_0001", "cam00": "camera_0002", "cam02": "camera_0003"}


def test_immersive(fisheye: tuple[Capture, Path]) -> None:
    capture, folder = fisheye
    back = read_capture(folder, scale=1)
    assert back.camera_names("test") == ["camera_0001"]
    assert_same_cameras(back, capture, IMMERSIVE)
    assert_same_pictures(back, capture, IMMERSIVE, 38.0)
    entries = json.loads((folder / "models.json").read_text())
    assert entries[0]["radial_distortion"] == [0.02, -0.005]
    np.testing.assert_allclose(entries[0]["position"], capture.cameras[HELD_OUT].center)


def test_pinholes_become_fisheyes_that_see_no_more(small: Capture, tmp_path: Path) -> None:
    back = there_and_back(small, "immersive", tmp_path)
    for old, new in IMMERSIVE.items():
        assert lens_map(small.cameras[old], back.cameras[new]).seen.all()
        _, before = small.cameras[old].rays([(0.0, 0.0)])
        _, after = back.cameras[new].rays([(0.0, 0.0)])
        np.testing.assert_allclose(after, before, atol=1e-6)


def test_a_mark_lands_where_the_fisheyes_say(fisheye: tuple[Capture, Path]) -> None:
    """The centroid of the blue mark's light is where each fisheye camera projects the mark."""
    back = read_capture(fisheye[1], scale=1)
    rows, columns = np.mgrid[48:120, :160] + 0.5  # under the strip
    for name, camera in back.cameras.items():
        picture = back.image(name, 0, (0, 0, 0)).astype(float)[48:]
        light = np.clip(picture[..., 2] - picture[..., :2].max(axis=2) - 30, 0, None)
        center = np.array([(columns * light).sum(), (rows * light).sum()]) / light.sum()
        place, _ = camera.project([(0.1, 0.5, 0.25)])
        assert np.abs(center - place[0]).max() < 0.5


@pytest.mark.parametrize("layout", ["n3v", "immersive"])
def test_half_resolution_is_the_protocol(small: Capture, tmp_path: Path, layout: str) -> None:
    whole = there_and_back(small, layout, tmp_path)
    half = read_capture(tmp_path / "scene")
    for name, camera in half.cameras.items():
        assert (camera.width, camera.height) == (80, 60)
        assert camera.fx == pytest.approx(whole.cameras[name].fx / 2)
        expected = whole.image(name, 1, (0, 0, 0)).reshape(60, 2, 80, 2, 3).mean(axis=(1, 3))
        assert np.abs(half.image(name, 1, (0, 0, 0)) - expected).max() <= 1
    quarter = read_capture(tmp_path / "scene", scale=4)
    assert {(camera.width, camera.height) for camera in quarter.cameras.values()} == {(40, 30)}


@pytest.mark.parametrize("layout", ["nerfstudio", "technicolor", "colmap", "n3v", "videos"])
def test_frames_are_chosen_by_the_files_numbers(small: Capture, tmp_path: Path, layout: str) -> None:
    whole = there_and_back(small, layout, tmp_path)
    start = whole.frame_start
    part = read_capture(tmp_path / "scene", frames=f"{start + 1}:{start + 2}", scale=1)
    assert (part.frame_count, part.frame_start) == (2, start + 1)
    for view in part.views():
        np.testing.assert_array_equal(part.image(*view, (0, 0, 0)), whole.image(view[0], view[1] + 1, (0, 0, 0)))
    assert read_capture(tmp_path / "scene", frames=f"{start}", frame_start=7).frame_start == 7
    for wrong in (f"{start}:{start + 3}", "3:1", "a", "-1:2", "1:99999999"):
        with pytest.raises(HoloreelError, match="frames"):
            read_capture(tmp_path / "scene", frames=wrong)


def test_technicolor_holds_cam10_out(small: Capture, tmp_path: Path) -> None:
    many = {f"x{i:02d}": replace(small.cameras["cam00"], name=f"x{i:02d}", cx=80.0 + i) for i in range(12)}
    images = {(name, 0): small.images["cam00", 0] for name in many}
    capture = Capture(many, images, 1, {"x03": "test"}, frame_start=7)
    back = there_and_back(capture, "technicolor", tmp_path)
    assert back.camera_names("test") == ["cam10"]
    assert back.cameras["cam10"].cx == pytest.approx(83.0)
    assert sorted(camera.cx for camera in back.cameras.values()) == [80.0 + i for i in range(12)]
    assert (tmp_path / "scene" / "scene_undist_00007_10.png").is_file()
    first = (tmp_path / "scene" / "cameras_parameters.txt").read_text().splitlines()
    assert first[0] == "f cu cv ar sk qw qx qy qz tx ty tz"
    assert len(first) == 13


def test_test_cameras_are_a_choice(small: Capture, tmp_path: Path) -> None:
    there_and_back(small, "technicolor", tmp_path)
    read = {"cam01", "cam02"}, set()
    for names, expected in zip((("cam01", "cam02"), ("none",)), read, strict=True):
        assert set(read_capture(tmp_path / "scene", test_cameras=names).camera_names("test")) == expected
    with pytest.raises(HoloreelError, match="no camera 'cam7' to hold out; it has cam00"):
        read_capture(tmp_path / "scene", test_cameras=("cam7",))


def test_a_real_poses_bounds(shared_data: Callable[[str], Path]) -> None:
    """LLFF's own example: poses are rigid, the cameras look the same way as the scene, and rows come back exactly."""
    rows = read_poses(shared_data("formats/poses_bounds.npy"))
    assert rows.shape == (26, 17)
    cameras = [camera_of(row) for row in rows]
    forward = np.array([camera.camera_to_world[:3, 2] for camera in cameras])
    assert (forward @ forward.mean(axis=0) > 0).all()
    for row, camera in zip(rows, cameras, strict=True):
        assert (camera.width, camera.height, camera.fx, camera.cx) == (640, 480, 612.0, 320.0)
        np.testing.assert_allclose(camera.center, row[:15].reshape(3, 5)[:, 3])
        np.testing.assert_allclose(camera.camera_to_world[:3, 1], row[:15].reshape(3, 5)[:, 0], atol=1e-7)  # y is down
        np.testing.assert_allclose(row_of(camera, *row[15:]), row, atol=1e-6)


def test_convert_by_command(small: Capture, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, out = str(small.source.parent), tmp_path / "out"
    command = ["convert", source, "--out", str(out), "--to", "colmap", "--frames", "2:3", "--scale", "2"]
    assert main(command) == 0
    assert "3 cameras x 2 frames as colmap" in capsys.readouterr().out
    assert sorted(path.name for path in out.iterdir()) == ["colmap_2", "colmap_3"]
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert main(command) == 2
    assert "is there already" in capsys.readouterr().err


def test_a_stopped_conversion_goes_on(small: Capture, tmp_path: Path) -> None:
    class StopError(Exception):
        pass

    def stop(done: int, total: int) -> None:
        if done == 5:
            raise StopError

    out = tmp_path / "out"
    with pytest.raises(StopError):
        convert(small, "nerfstudio", out, {"a": 1}, Export(on_progress=stop))
    assert not out.exists()
    made = {path: path.stat().st_mtime_ns for path in (tmp_path / ".out.part").rglob("*.png")}
    assert len(made) == 5
    with pytest.raises(HoloreelError, match="unfinished conversion with other settings"):
        convert(small, "nerfstudio", out, {"a": 2}, Export())
    convert(small, "nerfstudio", out, {"a": 1}, Export())
    kept = {path: (out / path.relative_to(tmp_path / ".out.part" / "out")).stat().st_mtime_ns for path in made}
    assert kept == made
    assert len(read_capture(out).views()) == 9
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_losses_are_told(small: Capture, tmp_path: Path) -> None:
    off_center = {n: replace(c, cx=70.0) for n, c in small.cameras.items()}
    capture = replace(small, cameras=off_center, splits={"cam00": "test", "cam02": "test"})
    told = " ".join(convert(capture, "n3v", tmp_path / "out", {}, Export()))
    assert "holds cam00 out by default: read it with --test-cameras cam01." in " ".join(
        convert(small, "videos", tmp_path / "videos", {}, Export())
    )
    assert not convert(small, "nerfstudio", tmp_path / "same", {}, Export())
    for words in ("resampled", "Seed points are not", "Held out were cam00, cam02, but", "--test-cameras cam00 cam01"):
        assert words in told
    assert read_capture(tmp_path / "out", scale=1).cameras["cam00"].cx == 80.0


COLMAP = {
    "PINHOLE": (),
    "OPENCV": (0.1, -0.02, 0.003, -0.004),
    "OPENCV_FISHEYE": (0.02, -0.01, 0.003, -0.001),
    "FULL_OPENCV": (0.1, -0.02, 0.003, -0.004, 0.01, 0.02, -0.03, 0.004),
}


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
@pytest.mark.parametrize("model", COLMAP)
def test_colmap_models(small: Capture, tmp_path: Path, model: str, suffix: str) -> None:
    """Both forms of a model, of every lens there is an equal for."""
    cameras = {
        f"{name} a.png": replace(camera, model=model, distortion=COLMAP[model], fx=101.0 + i, cy=59.0 + i)
        for i, (name, camera) in enumerate(small.cameras.items())
    }
    write_model(tmp_path / "sparse" / "0", cameras, small.seed_points(0), suffix)
    (tmp_path / "images").mkdir()
    for name in cameras:
        iio.imwrite(tmp_path / "images" / name, small.image(name[:5], 0, (0, 0, 0)))
    back = read_capture(tmp_path)
    names = {name: f"{name} a" for name in small.cameras}
    expected = replace(small, cameras={name[:5]: replace(c, name=name[:5]) for name, c in cameras.items()})
    assert_same_cameras(back, expected, names)
    np.testing.assert_array_equal(back.seed_points(0).rgb, small.seed_points(0).rgb)
    np.testing.assert_allclose(back.seed_points(0).xyz, small.seed_points(0).xyz, rtol=1e-6)


SIMPLER = {
    "SIMPLE_PINHOLE": (0, (100.0, 40.0, 30.0), "PINHOLE", ()),
    "SIMPLE_RADIAL": (2, (100.0, 40.0, 30.0, 0.1), "OPENCV", (0.1, 0, 0, 0)),
    "RADIAL": (3, (100.0, 40.0, 30.0, 0.1, 0.2), "OPENCV", (0.1, 0.2, 0, 0)),
    "SIMPLE_RADIAL_FISHEYE": (8, (100.0, 40.0, 30.0, 0.1), "OPENCV_FISHEYE", (0.1, 0, 0, 0)),
}


@pytest.mark.parametrize("name", SIMPLER)
def test_colmaps_simpler_lenses(tmp_path: Path, name: str) -> None:
    number, parameters, model, distortion = SIMPLER[name]
    folder = tmp_path / "sparse" / "0"
    folder.mkdir(parents=True)
    (folder / "cameras.bin").write_bytes(struct.pack(f"<QiiQQ{len(parameters)}d", 1, 3, number, 80, 60, *parameters))
    pose = struct.pack("<QI7dI", 1, 9, 1, 0, 0, 0, 1, 2, 3, 3)
    observed = struct.pack("<Q", 2) + struct.pack("<ddq", 1.5, 2.5, -1) * 2
    (folder / "images.bin").write_bytes(pose + b"a.png\0" + observed)
    (tmp_path / "images").mkdir()
    iio.imwrite(tmp_path / "images" / "a.png", np.zeros((60, 80, 3), np.uint8))
    capture = read_capture(tmp_path)
    camera = capture.cameras["a"]
    assert (camera.model, camera.distortion) == (model, distortion)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (100, 100, 40, 30)
    np.testing.assert_array_equal(camera.world_to_camera[:3, 3], (1, 2, 3))
    assert capture.seeds == {}


def test_every_layout_is_found_and_named(small: Capture, tmp_path: Path) -> None:
    assert set(LAYOUTS) == {*CASES, "immersive", "rerf", "actorshq"}
    with pytest.raises(HoloreelError, match=r"is not there, none of the captures"):
        read_capture(tmp_path / "absent")
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(HoloreelError, match=r"holds 1 .txt, none of the captures .*poses_bounds.npy"):
        read_capture(tmp_path)
    with pytest.raises(HoloreelError, match=r"holds 1 .txt, no technicolor capture \(SCENE_undist"):
        read_capture(tmp_path, layout="technicolor")
    with pytest.raises(HoloreelError, match="cannot be read"):
        read_capture(tmp_path / ("a" * 400))
    with pytest.raises(HoloreelError, match="no such layout"):
        read_capture(tmp_path, layout="llff")
    assert CaptureOptions().layout == "auto"


def test_scale_must_divide(small: Capture) -> None:
    odd = replace(small, cameras={n: Camera(161, 120, 90, 90, 80, 60, name=n) for n in small.cameras})
    from holoreel.core.capture.layouts import finish

    with pytest.raises(HoloreelError, match="161x120, which --scale 2 does not divide"):
        finish(odd, CaptureOptions(scale=2), LAYOUTS["videos"])


def test_rectified_fisheyes_are_what_a_pinhole_sees(
    small: Capture, fisheye: tuple[Capture, Path], tmp_path: Path
) -> None:
    """The undistorted protocol: pictures of half the focal length, black where the fisheye saw nothing."""
    out = tmp_path / "out"
    command = ["convert", str(fisheye[1]), "--out", str(out), "--to", "nerfstudio", "--rectify", "0.5", "--scale", "1"]
    assert main(command) == 0
    back = read_capture(out)
    assert back.camera_names("test") == ["camera_0001"]
    for old, new in IMMERSIVE.items():
        lens, camera = fisheye[0].cameras[old], back.cameras[new]
        assert (camera.model, camera.cx, camera.cy) == ("PINHOLE", lens.cx, lens.cy)
        assert camera.fx == pytest.approx(lens.fx / 2)
        seen = lens_map(lens, camera).seen
        assert 0.2 < seen.mean() < 0.9
        expected = lens_map(small.cameras[old], camera).apply(small.image(old, 1, (0, 0, 0)))
        picture = back.image(new, 1, (0, 0, 0))
        assert psnr(picture[seen], expected[seen]) > 30
        assert not picture[~seen].any()
    assert main([*command[:-4], "--rectify", "0"]) == 2


def write_sfm(folder: Path, cameras: list[Camera], frames: int, start: int = 0) -> None:
    """Write what `holoreel sfm` would: for frame j a point at (start + j, 0, 0)."""
    found = []
    for j in range(frames):
        write_points(folder / f"points_{j:04d}.ply", Points(np.float32([[start + j, 0, 0]]), np.uint8([[1, 2, 3]])))
        found.append({"index": j, "file": f"points_{j:04d}.ply", "points": 1})
    meta = {"version": 1, "frame_start": start, "frame_count": frames, "posed": "sfm", "frames": found}
    write_json(folder / "sfm.json", meta | {"cameras": [camera.to_json() for camera in cameras]})


def test_structure_from_motion_is_attached(small: Capture, tmp_path: Path) -> None:
    """Videos without a calibration get their cameras from it, and frames keep their points when some are chosen."""
    there_and_back(small, "videos", tmp_path)
    scene = tmp_path / "scene"
    (scene / "cameras_opencv.json").unlink()
    registered = [small.cameras["cam01"], small.cameras["cam02"]]  # cam00 could not be placed
    write_sfm(scene / "sfm", registered, 3)
    capture = read_capture(scene, frames="1:2", scale=2, frame_start=40)
    assert list(capture.cameras) == ["cam01", "cam02"]
    assert capture.camera_names("test") == ["cam01"]
    assert capture.frame_start == 40
    assert capture.cameras["cam02"].width == 80
    np.testing.assert_allclose(capture.cameras["cam02"].world_to_camera, small.cameras["cam02"].world_to_camera)
    assert [capture.seed_points(j).xyz[0, 0] for j in range(2)] == [1, 2]
    (scene / "sfm").rename(tmp_path / "elsewhere")
    with pytest.raises(HoloreelError, match="holoreel sfm"):
        read_capture(scene)
    assert read_capture(scene, sfm=tmp_path / "elsewhere").seeds.keys() == {0, 1, 2}


def test_real_webcams(shared_data: Callable[[str], Path], tmp_path: Path) -> None:
    """Four webcams with jittery timestamps: both forms of their calibration say the same, and the clock fits."""
    folder = shared_data("capture_webcams")
    capture = read_capture(folder, scale=4)
    assert (capture.frame_count, len(capture.views())) == (57, 4 * 57)
    assert capture.fps == pytest.approx(6.0, abs=0.01)
    assert capture.camera_names("test") == ["cam_0"]
    assert all(capture.images[name, j].index == j for name, j in capture.images)
    assert "57 frames on a common clock of 166.6" in capture.notes[0]
    assert capture.image("cam_3", 56).shape == (180, 320, 3)
    again = read_capture(folder, scale=4, calibration=folder / "cameras_opencv.json")
    for name, camera in capture.cameras.items():
        assert camera.model == "FULL_OPENCV"
        assert camera.distortion == again.cameras[name].distortion
        np.testing.assert_allclose(camera.world_to_camera, again.cameras[name].world_to_camera, atol=1e-12)
        np.testing.assert_allclose(camera.K, again.cameras[name].K)
    with pytest.raises(HoloreelError, match=r"camera cam_2 is \+18.1 ms from the common clock.*--sync-tolerance 0.11"):
        read_capture(folder, sync_tolerance=0.05)


@pytest.mark.parametrize("model", COLMAP)
def test_a_lens_seen_through_itself(model: str) -> None:
    """Nothing changes; and through a lens shifted by whole pixels, the picture is shifted, black where it ends."""
    lens = Camera(40, 30, 60.0, 61.0, 18.5, 16.0, model=model, distortion=COLMAP[model])
    picture = np.random.default_rng(2).integers(0, 255, (30, 40, 3), dtype=np.uint8)
    np.testing.assert_array_equal(lens_map(lens, lens).apply(picture), picture)
    shifted = lens_map(lens, replace(lens, cx=18.5 + 3, cy=16.0 - 2)).apply(picture)
    np.testing.assert_array_equal(shifted[:28, 3:], picture[2:, :37])
    assert not shifted[:, :3].any()
    assert not shifted[28:].any()
