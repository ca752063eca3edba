# SPDX-License-Identifier: GPL-3.0-or-later
"""ReRF's layout: numbers written here by hand are read as what they mean, and captures go there and back."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
from holoreel.core.blender import find_blender, run_in_blender
from holoreel.core.camera import Camera
from holoreel.core.capture import LAYOUTS, Capture, read_capture, write_capture
from holoreel.core.capture.convert import convert
from holoreel.core.capture.export import Export, encode_video
from holoreel.core.capture.images import composite
from holoreel.core.capture.layouts import default_held_out
from holoreel.core.capture.rerf import HELD_OUT, names
from holoreel.core.cli import main
from holoreel.core.errors import HoloreelError
from holoreel.core.evaluate import evaluate_player
from holoreel.core.report.evaluation import as_text
from scipy.spatial.transform import Rotation

from .test_videorf_cli import Gray
from .videorf_ball import CENTER, RADIUS, ball_capture, dome

WHITE = (1.0, 1.0, 1.0)
COUNT, FRAMES, WIDTH, HEIGHT = 8, 3, 32, 24
BOX = {"xyz_min": [-0.5, -0.25, -1.0], "xyz_max": [0.5, 0.75, 0.125]}
SUBJECT = (slice(6, 18), slice(8, 24))  # rows and columns of the pictures that it covers


def turn(camera: int) -> np.ndarray:
    """Each camera's own rotation, camera-to-world."""
    return np.asarray(Rotation.from_euler("xyz", [20 * camera, 35 - camera, 7 * camera], degrees=True).as_matrix())


def center(camera: int) -> np.ndarray:
    """A place that tells camera and axis; the largest coordinate's distance from the mean is 35."""
    return np.array([10.0 * camera, 3.0 + camera, 5.0 - camera])


def color(camera: int, frame: int) -> tuple[int, int, int]:
    return 40 + 20 * camera, 60 + 50 * frame, 90


def picture(camera: int, frame: int) -> np.ndarray:
    result = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    result[SUBJECT] = color(camera, frame)
    return result


def mask(frames: int, size: tuple[int, int] = (WIDTH, HEIGHT)) -> list[np.ndarray]:
    result = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    result[SUBJECT] = 255
    return [np.resize(result, (size[1], size[0], 3))] * frames


@pytest.fixture(scope="module")
def released(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene as released, written here by the format's description: numbers encode their places."""
    folder = tmp_path_factory.mktemp("released")
    poses, lenses = [], []
    for c in range(COUNT):
        r = turn(c)
        numbers = [r[:, 2], r[:, 0], r[:, 1], center(c)]
        poses.append(" ".join(f"{number:.6f}" for number in np.concatenate(numbers)))
        lenses.append(f"{c}\n{100 + c}.5 0 {15 + c / 8}\n 0 {110 + c}.25 {11 + c / 8}\n 0 0 1\n\n")
        encode_video(folder / "image" / f"{c:03d}.mp4", (WIDTH, HEIGHT), 25, [picture(c, f) for f in range(FRAMES)])
        encode_video(folder / "mask" / f"{c:03d}.mp4", (WIDTH, HEIGHT), 25, mask(FRAMES))
    (folder / "CamPose.inf").write_text("\n".join(poses))
    (folder / "Intrinsic.inf").write_text("".join(lenses))
    (folder / "bbox.json").write_text(json.dumps(BOX))
    return folder


def expected_box() -> np.ndarray:
    """The box in the cameras' units: 35 of them, from the mean of the centers on, are 2 of bbox.json's."""
    return np.array([35.0, 6.5, 1.5]) + np.array([BOX["xyz_min"], BOX["xyz_max"]]) * 17.5


def assert_lenses(capture: Capture) -> None:
    for c, camera in enumerate(capture.cameras.values()):
        assert (camera.width, camera.height, camera.model) == (WIDTH, HEIGHT, "PINHOLE")
        assert (camera.fx, camera.fy) == (100.5 + c, 110.25 + c)
        assert (camera.cx, camera.cy) == (15 + c / 8, 11 + c / 8)


def assert_pictures(capture: Capture, first: int = 0, tolerance: int = 24) -> None:
    """Every view has its own color inside the subject, white beside it, and alpha where the subject is."""
    for c, name in enumerate(capture.cameras):
        for frame in range(capture.frame_count):
            shown, cut = capture.image(name, frame).astype(int), capture.rgba(name, frame).astype(int)
            inside = np.zeros((HEIGHT, WIDTH), bool)
            inside[SUBJECT] = True
            assert np.abs(shown - picture(c, first + frame)).max() <= tolerance  # at edges, where codecs ring
            assert np.abs(shown - picture(c, first + frame)).mean() < 2
            assert np.array_equal(cut[..., 3] > 127, inside)
            assert np.abs(cut[inside, :3].mean(axis=0) - color(c, first + frame)).max() <= 6
            assert set(np.unique(cut[4:5, :, 3])) == {0}


def test_the_released_form(released: Path) -> None:
    capture = read_capture(released)
    assert list(capture.cameras) == [f"{c:03d}" for c in range(COUNT)]
    assert capture.camera_names("test") == ["006"]
    assert (capture.frame_count, capture.frame_start, capture.fps) == (FRAMES, 0, 25.0)
    assert capture.matte == WHITE
    assert capture.masked
    assert not capture.notes
    assert_lenses(capture)
    assert_pictures(capture)
    for c, camera in enumerate(capture.cameras.values()):
        np.testing.assert_allclose(camera.center, center(c), atol=1e-5)
        right, down, ahead = turn(c).T
        points = [center(c) + 5 * ahead, center(c) + 5 * ahead + right, center(c) + 5 * ahead + down]
        pixels, depth = camera.project(points)
        middle = np.array([15 + c / 8, 11 + c / 8])
        there = middle + np.array([(0, 0), ((100.5 + c) / 5, 0), (0, (110.25 + c) / 5)])
        np.testing.assert_allclose(pixels, there, atol=1e-4)
        np.testing.assert_allclose(depth, 5, atol=1e-5)
    np.testing.assert_allclose(np.array(capture.bounds), expected_box(), atol=1e-4)


def test_frames_and_rate_are_a_choice(released: Path) -> None:
    capture = read_capture(released, frames="1:2", fps=50.0, test_cameras=("001", "002"))
    assert (capture.frame_count, capture.frame_start, capture.fps) == (2, 1, 50.0)
    assert capture.camera_names("test") == ["001", "002"]
    assert_pictures(capture, first=1)


@pytest.fixture
def prepared(released: Path, tmp_path: Path) -> Path:
    """The scene as the authors' tools turn it into pictures, beside the released files; frame numbers begin at 4."""
    folder = Path(shutil.copytree(released, tmp_path / "prepared"))
    centers = np.stack([center(c) for c in range(COUNT)])
    shifted = centers - centers.mean(axis=0)
    shifted *= 2.0 / max(shifted.max(), -shifted.min())
    for f in range(FRAMES):
        frames = []
        for c in reversed(range(COUNT)):
            place = f"{f + 4}/img_{c:04d}.png"
            for kind, pixels in (("image", picture(c, f)), ("mask", mask(1)[0])):
                (folder / kind / str(f + 4)).mkdir(exist_ok=True)
                iio.imwrite(folder / kind / place, pixels)
            pose = np.eye(4)
            pose[:3] = np.concatenate([turn(c), shifted[c][:, None]], axis=1)
            lens = [[100.5 + c, 0, 15 + c / 8], [0, 110.25 + c, 11 + c / 8], [0, 0, 1]]
            entry = {"file": f"/elsewhere/image/{place}", "mask": f"/elsewhere/mask/{place}"}
            frames.append(entry | {"extrinsic": pose.tolist(), "intrinsic": lens})
        (folder / f"cams_{f + 4}.json").write_text(json.dumps({"frames": frames}))
    return folder


def test_the_prepared_form(prepared: Path) -> None:
    assert read_capture(prepared).frame_start == 0  # as long as there are videos, they are it
    for video in (prepared / "image").glob("*.mp4"):
        video.unlink()
    capture = read_capture(prepared)
    assert list(capture.cameras) == [f"{c:03d}" for c in range(COUNT)]
    assert (capture.frame_count, capture.frame_start, capture.camera_names("test")) == (FRAMES, 4, ["006"])
    assert capture.bounds == (tuple(BOX["xyz_min"]), tuple(BOX["xyz_max"]))
    assert_lenses(capture)
    assert_pictures(capture, tolerance=0)
    centers = np.stack([camera.center for camera in capture.cameras.values()])
    np.testing.assert_allclose(centers.mean(axis=0), 0, atol=1e-12)
    assert np.abs(centers).max() == pytest.approx(2)
    np.testing.assert_allclose(capture.cameras["003"].camera_to_world[:3, :3], turn(3), atol=1e-12)
    part = read_capture(prepared, frames="5:6")
    assert (part.frame_start, part.source.name) == (5, "cams_5.json")
    assert_pictures(part, first=1, tolerance=0)


def change_frame(change: Callable[[list], object]) -> Callable[[Path], object]:
    def apply(folder: Path) -> None:
        file = folder / "cams_4.json"
        value = json.loads(file.read_text())
        change(value["frames"])
        file.write_text(json.dumps(value))

    return apply


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda f: (f / "cams_5.json").unlink(), "cams_5.json is missing"),
        (lambda f: (f / "cams_4.json").write_text("[]"), "cams_4.json holds a JSON list"),
        (change_frame(lambda frames: frames.clear()), "frames must be a list"),
        (change_frame(lambda frames: frames[0].pop("file")), "frames[0].file must end in img_CCCC.png"),
        (change_frame(lambda frames: frames[0].update(file="../../img_x.png")), "frames[0].file must end in"),
        (change_frame(lambda frames: frames[1].update(intrinsic=[[1, 2], [3, 4]])), "frames[1].intrinsic must be 3"),
        (change_frame(lambda frames: frames[1].update(extrinsic=[[1e999] * 4] * 4)), "frames[1].extrinsic must be 4"),
        (change_frame(lambda frames: frames[1].update(extrinsic=[[1.0] * 4] * 4)), "frames[1] must be a rotation"),
        (change_frame(lambda frames: frames.append(frames[0])), "is a second one of camera 007"),
        (lambda f: (f / "image/5/img_0003.png").unlink(), "img_0003.png missing"),
        (lambda f: (f / "mask/5/img_0003.png").unlink(), "img_0003.png missing"),
        (lambda f: iio.imwrite(f / "mask/5/img_0003.png", np.zeros((9, 32), np.uint8)), "img_0003.png is 32x9"),
    ],
)
def test_damaged_prepared_sets(prepared: Path, damage: Callable[[Path], object], words: str) -> None:
    for video in (prepared / "image").glob("*.mp4"):
        video.unlink()
    damage(prepared)
    refuse(prepared, words)


def refuse(folder: Path, words: str) -> None:
    """Reading must fail with one sentence that names a file and has these words."""
    with pytest.raises(HoloreelError) as error:
        read_capture(folder)
    said = str(error.value)
    assert "\n" not in said
    assert str(folder) in said
    assert words in said, said


def edit(file: str, change: Callable[[str], str]) -> Callable[[Path], object]:
    return lambda folder: (folder / file).write_text(change((folder / file).read_text()))


def video(file: str, frames: int, size: tuple[int, int] = (WIDTH, HEIGHT)) -> Callable[[Path], object]:
    def write(folder: Path) -> None:
        (folder / file).unlink()
        encode_video(folder / file, size, 25, mask(frames, size))

    return write


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda f: shutil.rmtree(f / "mask"), "mask is missing"),
        (lambda f: (f / "mask/004.mp4").unlink(), "mask/004.mp4 is not there"),
        (lambda f: (f / "image/004.mp4").unlink(), "image/004.mp4 is not there"),
        (lambda f: [file.unlink() for file in f.glob("*/*.mp4")], "image holds no videos"),
        (lambda f: shutil.copy(f / "mask/004.mp4", f / "mask/008.mp4"), "008.mp4 is of a camera that CamPose.inf"),
        (video("mask/004.mp4", FRAMES, (WIDTH, HEIGHT + 2)), "004.mp4: the mask is 32x26, its video 32x24"),
        (video("mask/004.mp4", FRAMES - 1), "mask/004.mp4 has 2 frames, the others have 3"),
        (edit("CamPose.inf", lambda text: text.replace("\n", " 1\n", 1)), "CamPose.inf: row 0 has 13 numbers, not 12"),
        (edit("CamPose.inf", lambda text: text.rsplit("\n", 1)[0]), "Intrinsic.inf has 8 cameras, CamPose.inf has 7"),
        (edit("CamPose.inf", lambda text: "nan" + text[8:]), "CamPose.inf: row 0 holds NaN or infinity"),
        (edit("CamPose.inf", lambda text: text.replace(" ", " x", 1)), "CamPose.inf: row 0 is no row of numbers"),
        (edit("CamPose.inf", lambda text: "9" + text), "CamPose.inf: row 0 must be a rotation"),
        (edit("CamPose.inf", lambda text: ""), "CamPose.inf must have a row for each camera"),
        (edit("CamPose.inf", lambda text: text * 9000), "CamPose.inf is larger than any table of cameras"),
        (edit("Intrinsic.inf", lambda text: text.replace("100.5 0", "100.5")), "row 1 has 2 numbers, not the 3"),
        (edit("Intrinsic.inf", lambda text: text.rstrip().rsplit("\n", 1)[0]), "must have 3 rows of 3 numbers"),
        (
            edit("Intrinsic.inf", lambda text: text.replace("100.5", "-100.5")),
            "camera 000: camera: fx must be positive",
        ),
        (edit("Intrinsic.inf", lambda text: text.replace("100.5 0", "100.5 7")), "camera 000: K must be"),
        (edit("Intrinsic.inf", lambda text: text.replace(" 15.0", " 33.0")), "lies outside of its pictures of 32x24"),
        (edit("Intrinsic.inf", lambda text: text + "\n" * (1 << 22)), "Intrinsic.inf is larger than any table"),
        (lambda f: (f / "Intrinsic.inf").unlink(), "Intrinsic.inf cannot be read"),
        (edit("bbox.json", lambda text: text.replace("0.5, 0.75", "-0.5, 0.75")), "must be smaller than xyz_max"),
        (edit("bbox.json", lambda text: text.replace("0.125", "NaN")), "bbox.json: xyz_max must be 3 finite numbers"),
        (edit("bbox.json", lambda text: text.replace("0.125", "1e300")), "bbox.json: xyz_max must be 3 finite"),
        (edit("bbox.json", lambda text: "{}"), "bbox.json: xyz_min must be 3 finite numbers"),
        (edit("bbox.json", lambda text: text[:-1]), "bbox.json is not valid JSON"),
    ],
)
def test_damaged_sets(released: Path, tmp_path: Path, damage: Callable[[Path], object], words: str) -> None:
    folder = Path(shutil.copytree(released, tmp_path / "scene"))
    damage(folder)
    refuse(folder, words)


def test_short_masks_leave_the_frames_that_all_have(released: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(released, tmp_path / "scene"))
    video("mask/004.mp4", 2)(folder)
    assert_pictures(read_capture(folder, frames="0:1"))


def test_cameras_without_any_video_are_left_out(released: Path, tmp_path: Path) -> None:
    """The poses of the others, and the box, are what they were."""
    folder = Path(shutil.copytree(released, tmp_path / "scene"))
    for kind in ("image", "mask"):
        (folder / kind / "004.mp4").unlink()
    capture = read_capture(folder)
    assert "004" not in capture.cameras
    assert "no videos of 004" in capture.notes[0]
    np.testing.assert_allclose(capture.cameras["005"].center, center(5), atol=1e-5)
    np.testing.assert_allclose(np.array(capture.bounds), expected_box(), atol=1e-4)


def psnr(first: np.ndarray, second: np.ndarray) -> float:
    return float(-10 * np.log10(max(np.mean((first / 255.0 - second / 255.0) ** 2), 1e-12)))


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> tuple[Capture, Path]:
    """A painted ball in 8 cameras as a transforms.json, two frames, and its ReRF folder; cam02 is held out."""
    folder = tmp_path_factory.mktemp("ball")
    bounds = (tuple(CENTER - RADIUS - 0.05), tuple(CENTER + RADIUS + [0.15, 0.05, 0.05]))
    made = ball_capture(
        folder / "ball", 2, dome(COUNT), [CENTER, CENTER + np.array([0.1, 0, 0])], painted=True,
        splits={"cam02": "test"}, fps=24.0, frame_start=101, bounds=bounds,
    )  # fmt: skip
    write_capture(folder / "ball", made)
    capture = read_capture(folder / "ball")
    assert not convert(capture, "rerf", folder / "rerf", {}, Export(background=(1.0, 0.0, 0.0)))
    return capture, folder / "rerf"


def test_there_and_back(ball: tuple[Capture, Path]) -> None:
    capture, folder = ball
    back = read_capture(folder)
    order = ["cam00", "cam01", "cam03", "cam04", "cam05", "cam06", "cam02", "cam07"]
    assert list(back.cameras) == [f"{i:03d}" for i in range(COUNT)]
    assert (back.camera_names("test"), back.fps, back.frame_count) == (["006"], 24.0, 2)
    np.testing.assert_allclose(back.bounds, capture.bounds, atol=1e-12)
    for old, (new, camera) in zip(order, back.cameras.items(), strict=True):
        before = capture.cameras[old]
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (before.fx, before.fy, before.cx, before.cy)
        np.testing.assert_allclose(camera.world_to_camera, before.world_to_camera, atol=1e-12)
        for frame in range(2):
            expected = capture.rgba(old, frame)
            shown, cut = back.image(new, frame), back.rgba(new, frame)
            assert psnr(shown, composite(expected, WHITE)) > 40
            assert psnr(composite(cut, WHITE), composite(expected, WHITE)) > 40
            assert np.mean((cut[..., 3] > 127) != (expected[..., 3] > 127)) < 0.002


def test_there_and_back_again_changes_no_camera(ball: tuple[Capture, Path], tmp_path: Path) -> None:
    """What has this layout's names keeps them, and its numbers are written as they were read."""
    once = read_capture(ball[1], frames="0")
    convert(once, "rerf", tmp_path / "again", {}, Export())
    again = read_capture(tmp_path / "again")
    for name, camera in once.cameras.items():
        np.testing.assert_allclose(again.cameras[name].world_to_camera, camera.world_to_camera, atol=1e-12)
        assert psnr(again.image(name, 0), once.image(name, 0)) > 40
    np.testing.assert_allclose(np.array(again.bounds), np.array(once.bounds), atol=1e-12)


def test_lenses_become_pinholes_with_white_where_they_saw_nothing(tmp_path: Path) -> None:
    made = ball_capture(tmp_path / "ball", 1, dome(2, lens=True))
    bent = {name: replace(camera, distortion=(0.9, 0.0, 0.0, 0.0)) for name, camera in made.cameras.items()}
    notes = convert(replace(made, cameras=bent), "rerf", tmp_path / "rerf", {}, Export())
    assert sum("2 of 2 cameras are resampled" in note for note in notes) == 1
    wide = tmp_path / "wide"
    convert(replace(made, cameras=bent), "rerf", wide, {}, Export(rectify=0.5))
    back = read_capture(wide)
    camera = back.cameras["000"]
    assert (camera.model, camera.fx) == ("PINHOLE", 31.0)
    assert not (wide / "bbox.json").exists()
    assert back.bounds is None
    assert back.image("000", 0)[:3].min() > 250
    assert back.rgba("000", 0)[:3, :, 3].max() == 0


def test_a_capture_without_a_subject_is_refused(tmp_path: Path) -> None:
    iio.imwrite(tmp_path / "a.png", np.zeros((24, 32, 3), np.uint8))
    capture = Capture({"a": Camera(32, 24, 30, 30, 16, 12, name="a")}, {("a", 0): tmp_path / "a.png"})
    with pytest.raises(HoloreelError, match=r"camera 'a' has no mask at frame 1.*make masks"):
        convert(capture, "rerf", tmp_path / "out", {}, Export())


@pytest.mark.parametrize(
    ("count", "test", "places"),
    [
        (45, ["x07", "x20"], {"x07": "006", "x20": "039", "x00": "000", "x06": "007", "x44": "044"}),
        (45, ["x20"], {"x20": "006"}),
        (20, ["x06", "x13"], {"x06": "006", "x13": "000", "x00": "001"}),
        (4, ["x02"], {"x02": "000", "x00": "001", "x03": "003"}),
        (4, [], {"x00": "000", "x03": "003"}),
    ],
)
def test_held_out_cameras_get_the_numbers_that_are_held_out(
    count: int, test: list[str], places: dict[str, str]
) -> None:
    cameras = {f"x{i:02d}": Camera(8, 8, 8, 8, 4, 4, name=f"x{i:02d}") for i in range(count)}
    given = names(Capture(cameras, {}, splits=dict.fromkeys(test, "test")))
    assert list(given.values()) == [f"{i:03d}" for i in range(count)]
    assert set(given) == set(cameras)
    assert {name: given[name] for name in places} == places


def test_names_of_this_layout_are_kept() -> None:
    cameras = {f"{i:03d}": Camera(8, 8, 8, 8, 4, 4, name=f"{i:03d}") for i in range(45)}
    given = names(Capture(cameras, {}, splits={"010": "test"}))
    assert given == {name: name for name in cameras}
    assert default_held_out(LAYOUTS["rerf"], list(cameras)) == ["006", "039"]


def test_losses_are_told_in_the_new_names(tmp_path: Path) -> None:
    made = ball_capture(tmp_path / "ball", 1, dome(8), splits={"cam02": "test", "cam05": "test"})
    steps: list[tuple[int, int]] = []
    told = " ".join(convert(made, "rerf", tmp_path / "out", {}, Export(on_progress=lambda *step: steps.append(step))))
    assert [done for done, _ in steps] == sorted(done for done, _ in steps)
    assert {total for _, total in steps} == {16} == {steps[-1][0]}  # pictures and masks
    assert "Held out were cam02, cam05, but what is read in this layout holds 006 out by default" in told
    assert "read it with --test-cameras 000 006." in told
    assert np.array_equal(
        read_capture(tmp_path / "out").cameras["000"].center.round(9), made.cameras["cam05"].center.round(9)
    )


def test_a_moving_subject_from_blender(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`holoreel synth` on a transparent film, converted and told about by the commands."""
    try:
        blender = find_blender()
    except HoloreelError:
        pytest.skip("no Blender")
    scene = tmp_path / "marks.blend"
    job = {"path": str(scene), "floor": False}
    run_in_blender(blender, "holoreel.tests.core.blender_scene:build", job, log=tmp_path / "log")
    synth = ["synth", str(scene), "--out", str(tmp_path / "made"), "--frames", "1:2", "--rig", "dome"]
    synth += ["--cameras", "3", "--size", "64x48", "--samples", "4", "--film", "transparent", "--radius", "2.5"]
    assert main([*synth, "--seed-points", "0", "--holdout", "1", "--blender", str(blender.path)]) == 0
    assert main(["convert", str(tmp_path / "made"), "--out", str(tmp_path / "rerf"), "--to", "rerf"]) == 0
    assert main(["info", str(tmp_path / "rerf")]) == 0
    said = capsys.readouterr().out
    assert "3 cameras x 2 frames as rerf" in said
    assert "cut out of every picture" in said
    made, back = read_capture(tmp_path / "made"), read_capture(tmp_path / "rerf")
    np.testing.assert_allclose(np.array(back.bounds), np.array(made.bounds), atol=1e-9)
    for old, new in {"cam01": "000", "cam00": "001", "cam02": "002"}.items():
        np.testing.assert_allclose(back.cameras[new].world_to_camera, made.cameras[old].world_to_camera, atol=1e-12)
        for frame in range(2):
            truth = composite(made.rgba(old, frame), WHITE)
            assert psnr(back.image(new, frame), truth) > 40
            assert psnr(composite(back.rgba(new, frame), WHITE), truth) > 40
    first, second = (composite(made.rgba("cam00", frame), WHITE) for frame in range(2))
    assert psnr(first, second) < 40  # it moved


def test_a_frame_of_it_trains(ball: tuple[Capture, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    reel, quick = tmp_path / "ball.reel", ["--resolution", "24", "--rays", "256", "--first-iterations", "60"]
    quick += ["--coarse.iterations", "40", "--coarse.rays", "256", "--qps", "20", "--no-keep-model"]
    assert main(["train", "videorf", str(ball[1]), "--frames", "0", "--out", str(reel), *quick]) == 0
    assert "1 frames in 1 groups" in capsys.readouterr().out
    assert main(["eval", str(reel), str(ball[1]), "--frames", "0", "--out", str(tmp_path / "eval")]) == 0
    metrics = json.loads((tmp_path / "eval" / "metrics.json").read_text())
    assert list(metrics["cameras"]) == ["006"]
    assert metrics["mean"]["psnr"] > 18
    assert "protocol" not in metrics  # of which 039 is a part


@pytest.mark.parametrize(("test", "background", "named"), [
    (HELD_OUT, WHITE, True), (("006",), WHITE, False), (("006", "039", "040"), WHITE, False),
    (HELD_OUT, (0.0, 0.0, 0.0), False),
])  # fmt: skip
def test_eval_names_the_protocol(
    tmp_path: Path, test: tuple[str, ...], background: tuple[float, float, float], named: bool
) -> None:
    iio.imwrite(tmp_path / "a.png", np.full((24, 32, 4), 128, np.uint8))
    cameras = {f"{i:03d}": Camera(32, 24, 30, 30, 16, 12, name=f"{i:03d}") for i in range(41)}
    images = {(name, 0): tmp_path / "a.png" for name in cameras}
    capture = Capture(cameras, images, frame_start=101, splits=dict.fromkeys(test, "test"), source=tmp_path / "a")
    player = Gray(tmp_path / "a.reel")
    player.background = background
    metrics = evaluate_player(player, capture)
    assert ("protocol" in metrics) == named
    sentence = "Protocol of ReRF (held out: 006, 039): PSNR dB, SSIM 11x11."
    assert (sentence in as_text(metrics)) == named
    assert "protocol" not in evaluate_player(player, capture, "all")
