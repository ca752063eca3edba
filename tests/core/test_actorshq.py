# SPDX-License-Identifier: GPL-3.0-or-later
"""ActorsHQ's layout: numbers written here by hand are read as what they mean, and captures go there and back."""

import csv
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
from holoreel.core.capture.actorshq import HELD_OUT, names, protocol_views
from holoreel.core.capture.convert import convert
from holoreel.core.capture.export import Export
from holoreel.core.capture.images import composite
from holoreel.core.capture.layouts import default_held_out, named_protocol
from holoreel.core.cli import main
from holoreel.core.errors import HoloreelError
from holoreel.core.evaluate import evaluate_player
from holoreel.core.report.evaluation import as_text
from scipy.spatial.transform import Rotation

from .conftest import Recording
from .test_videorf_cli import Gray
from .videorf_ball import CENTER, RADIUS, ball_capture, dome

BLACK = (0.0, 0.0, 0.0)
CAMERAS = ("Cam001", "Cam002", "Cam014", "Cam127")  # the last one is upright
FRAMES = (15, 16, 17)
HEADINGS = "name, w, h, rx, ry, rz, tx, ty, tz, fx, fy, px, py"
SUBJECT = (slice(8, 24), slice(8, 16))  # rows and columns of the smaller pictures that it covers
HALF = (slice(8, 24), slice(16, 24))  # and of which it covers a half


def size_of(camera: int, times: int = 1) -> tuple[int, int]:
    width, height = (32, 40) if CAMERAS[camera] == "Cam127" else (40, 32)
    return width * times, height * times


def row_of(camera: int, times: int) -> list[float]:
    """What calibration.csv says of a camera after its name: every number tells its place."""
    turn = [0.1 + camera, 0.2 - camera / 8, 0.3 * camera]
    center = [10.0 + camera, 20.0 + camera, 30.0 + camera]
    return [*size_of(camera, times), *turn, *center, 1.5 + camera / 16, 1.75 + camera / 16, 0.5, 0.4375]


def color(camera: int, frame: int) -> tuple[int, int, int]:
    return 40 + 20 * camera, 60 + 50 * (frame - FRAMES[0]), 90


def picture(camera: int, frame: int) -> np.ndarray:
    """The subject over black, as a JPEG holds it."""
    width, height = size_of(camera)
    result = np.zeros((height, width, 3), np.uint8)
    result[SUBJECT] = color(camera, frame)
    result[HALF] = np.rint(np.array(color(camera, frame)) * (128 / 255))
    return result


def mask(camera: int) -> np.ndarray:
    width, height = size_of(camera)
    result = np.zeros((height, width), np.uint8)
    result[SUBJECT], result[HALF] = 255, 128
    return result


def box(frame: int) -> list[float]:
    """The box of one frame; those of others are larger in one direction each."""
    return [-1.0 - frame / 100, -2.0, -3.0 + frame / 100, 1.0, 2.0 + frame / 100, 3.0]


def write_size(folder: Path, times: int) -> None:
    lines = [HEADINGS]
    for c, name in enumerate(CAMERAS):
        lines.append(", ".join([name, *(f"{number:g}" for number in row_of(c, times))]))
        for frame in FRAMES:
            for kind, pixels in (("rgb", picture(c, frame)), ("mask", mask(c))):
                file = folder / f"{kind}s" / name / f"{name}_{kind}{frame:06d}.{'jpg' if kind == 'rgb' else 'png'}"
                file.parent.mkdir(parents=True, exist_ok=True)
                large = pixels.repeat(times, axis=0).repeat(times, axis=1)
                iio.imwrite(file, large, **({"quality": 95, "subsampling": 0} if kind == "rgb" else {}))
    lines.append(", ".join(["Cam128", *(f"{number:g}" for number in row_of(1, times))]))  # without any pictures
    (folder / "rgbs" / "Cam128").mkdir()
    (folder / "calibration.csv").write_text("\n".join(lines) + "\n")
    (folder / "light_annotations.csv").write_text("camera,x,y,r\nCam001,3,4,5\n")


@pytest.fixture(scope="module")
def released(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sequence of two sizes as released, written here by the format's description; boxes of more frames than it."""
    folder = tmp_path_factory.mktemp("released") / "Actor03" / "Sequence1"
    for times, name in ((1, "4x"), (2, "2x")):
        write_size(folder / name, times)
    boxes = ["frame_number,aabb_min_x,aabb_min_y,aabb_min_z,aabb_max_x,aabb_max_y,aabb_max_z"]
    boxes += [",".join(map(str, [frame, *box(frame)])) for frame in range(30)]
    (folder / "aabbs.csv").write_text("\r\n".join(boxes) + "\r\n")
    (folder / "scene.json").write_text('{"num_frames": 30}')
    return folder


@pytest.fixture
def small(released: Path, tmp_path: Path) -> Path:
    """A copy of the sequence with its smaller size alone, to be damaged."""
    shutil.copytree(released / "4x", tmp_path / "Sequence1" / "4x")
    shutil.copy(released / "aabbs.csv", tmp_path / "Sequence1")
    return tmp_path / "Sequence1"


def assert_cameras(capture: Capture, times: int) -> None:
    """Cameras are what the numbers say, by SciPy's rotations and a projection written out."""
    assert list(capture.cameras) == list(CAMERAS)
    for c, (name, camera) in enumerate(capture.cameras.items()):
        width, height, *turn = row_of(c, times)[:5]
        center, fx, fy = np.array(row_of(c, times)[5:8]), 1.5 + c / 16, 1.75 + c / 16
        assert (camera.name, camera.width, camera.height, camera.model) == (name, width, height, "PINHOLE")
        rotation = Rotation.from_rotvec(turn).as_matrix()
        point = rotation @ (0.1, -0.2, 2.0) + center
        pixels, depth = camera.project(point[None])
        there = (width * (fx * 0.05 + 0.5), height * (fy * -0.1 + 0.4375))
        np.testing.assert_allclose(pixels[0], there, atol=1e-9)
        np.testing.assert_allclose(depth, 2, atol=1e-12)
        np.testing.assert_allclose(camera.center, center, atol=1e-12)


def assert_pictures(capture: Capture, first: int = FRAMES[0]) -> None:
    """Every view has its own colors; what is half covered has them too, once black is taken out."""
    for c, name in enumerate(CAMERAS):
        for j in range(capture.frame_count):
            expected = picture(c, first + j).astype(int)
            cut = capture.rgba(name, j).astype(int)
            assert np.abs(capture.image(name, j).astype(int) - expected).max() <= 4
            np.testing.assert_array_equal(cut[..., 3], mask(c))
            for part, tolerance in ((SUBJECT, 4), (HALF, 8)):
                assert np.abs(cut[part][..., :3] - color(c, first + j)).max() <= tolerance
            assert np.abs(composite(cut.astype(np.uint8), BLACK) - expected).max() <= 5
            assert cut[:8].max() == 0


def test_one_size_of_a_sequence(released: Path) -> None:
    capture = read_capture(released / "4x")
    assert_cameras(capture, 1)
    assert_pictures(capture)
    assert (capture.frame_count, capture.frame_start, capture.fps) == (3, 15, 25.0)
    assert capture.camera_names("test") == ["Cam001", "Cam014", "Cam127"]
    assert (capture.name, capture.matte, capture.masked) == ("Actor03_Sequence1", BLACK, True)
    assert capture.notes == (f"{released / '4x'}: no pictures of Cam128; these cameras are left out.",)
    assert capture.bounds == ((-1.17, -2.0, -2.85), (1.0, 2.17, 3.0))


def test_a_sequence_is_read_at_its_finest(released: Path) -> None:
    fine = read_capture(released)
    assert_cameras(fine, 2)
    assert "has the sizes 2x, 4x; 2x is read" in fine.notes[0]
    assert fine.image("Cam002", 0).shape == (64, 80, 3)
    halved = read_capture(released, scale=2)
    assert_cameras(halved, 1)
    assert_pictures(halved)


def test_a_size_without_pictures_is_passed_over(released: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(released, tmp_path / "scene"))
    shutil.rmtree(folder / "2x" / "rgbs")
    assert_cameras(read_capture(folder), 1)


def test_frames_are_chosen_by_the_files_numbers(released: Path) -> None:
    capture = read_capture(released / "4x", frames="16:17", fps=30.0, test_cameras=("Cam002",))
    assert (capture.frame_count, capture.frame_start, capture.fps) == (2, 16, 30.0)
    assert capture.camera_names("test") == ["Cam002"]
    assert_pictures(capture, first=16)
    assert read_capture(released / "4x", frames="16").bounds == ((-1.16, -2.0, -2.84), (1.0, 2.16, 3.0))


def test_a_path_may_be_relative(small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(small / "4x")
    capture = read_capture(".")
    assert (capture.name, capture.bounds is None) == ("Sequence1", False)


def test_masks_of_one_bit_a_pixel(small: Path) -> None:
    from PIL import Image

    file = small / "4x/masks/Cam001/Cam001_mask000015.png"
    Image.fromarray(mask(0) > 0).save(file)
    assert set(np.unique(read_capture(small).rgba("Cam001", 0)[..., 3])) == {0, 255}


def edit(file: str, change: Callable[[str], str]) -> Callable[[Path], object]:
    return lambda folder: (folder / file).write_text(change((folder / file).read_text()))


def first_row(old: str, new: str) -> Callable[[Path], object]:
    return edit("4x/calibration.csv", lambda text: text.replace(old, new, 1))


RGB, MASK = "4x/rgbs/Cam002/Cam002_rgb000016.jpg", "4x/masks/Cam002/Cam002_mask000016.png"


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda f: (f / MASK).unlink(), "Cam002_mask000016.png missing"),
        (lambda f: shutil.rmtree(f / "4x/masks"), "Cam001_mask000015.png and 11 more files missing"),
        (lambda f: iio.imwrite(f / MASK, np.zeros((32, 30), np.uint8)), "Cam002_mask000016.png is 30x32, but camera"),
        (lambda f: iio.imwrite(f / RGB, np.zeros((40, 32, 3), np.uint8)), "Cam002_rgb000016.jpg is 32x40, but camera"),
        (lambda f: (f / RGB).write_bytes(b"none"), "Cam002_rgb000016.jpg cannot be read as a picture"),
        (lambda f: (f / RGB).unlink(), "Cam002_rgb000016.jpg is missing; fetch what is missing, or choose other"),
        (lambda f: shutil.rmtree(f / "4x/rgbs"), "rgbs is missing: pictures lie there as CAM/CAM_rgbFFFFFF.jpg"),
        (lambda f: [file.unlink() for file in f.glob("4x/rgbs/*/*")], "rgbs holds no pictures CAM/CAM_rgbFFFFFF.jpg"),
        (lambda f: (f / "4x/calibration.csv").unlink(), "calibration.csv cannot be read (No such file"),
        (edit("4x/calibration.csv", lambda t: ""), "calibration.csv has no column name (it has none)"),
        (edit("4x/calibration.csv", lambda t: t.split("\n")[0]), "must have a row for each camera"),
        (first_row(", px", ", cx"), "calibration.csv has no column px (it has name, w, h"),
        (edit("4x/calibration.csv", lambda t: t + "\n" * (1 << 26)), "calibration.csv is larger than 64 MiB"),
        (first_row("Cam002", "Cam001"), "line 3 is a second one of Cam001"),
        (first_row("Cam002", "Cam999"), "rgbs/Cam002 has pictures of a camera without a row in calibration.csv"),
        (first_row("Cam002", "../Cam002"), "line 3: the name '../Cam002' is no camera's"),
        (first_row(" 0.1,", " nan,"), "line 2: rx is 'nan', no finite number"),
        (first_row(" 10,", " 1e999,"), "line 2: tx is '1e999', no finite number"),
        (
            first_row(" 10,", " 1e99,"),
            "line 2: camera 'Cam001': world_to_camera holds NaN, infinity or a number beyond",
        ),
        (first_row(" 10,", " ten,"), "line 2: tx is 'ten', no finite number"),
        (first_row(" 0.1,", " 1e300,"), "line 2: is no rotation"),
        (first_row("Cam001, 40", "Cam001, 40.5"), "line 2: camera 'Cam001': width must be a whole number"),
        (first_row("Cam001, 40", "Cam001, 4000000"), "line 2: camera 'Cam001': width must be a whole number"),
        (first_row(" 1.5,", " -1.5,"), "line 2: camera 'Cam001': fx must be positive"),
        (first_row(" 0.5,", " 20,"), "line 2: the principal point (20, 0.4375) must lie within 0 and 1"),
        (first_row(", 0.4375\n", "\n"), "line 2: py is '', no finite number"),
        (edit("aabbs.csv", lambda t: t.replace("\n16,", "\n99,")), "aabbs.csv has no row for frame 16"),
        (edit("aabbs.csv", lambda t: t.replace("aabb_max_z", "max_z")), "aabbs.csv has no column aabb_max_z"),
        (edit("aabbs.csv", lambda t: t.replace("\n16,-1.16,", "\n16,inf,")), "aabb_min_x is 'inf', no finite number"),
        (edit("aabbs.csv", lambda t: t.replace("\n16,-1.16,", "\n16,2,")), "aabb_min must be smaller than aabb_max"),
    ],
)
def test_damaged_sets(small: Path, damage: Callable[[Path], object], words: str) -> None:
    """Reading fails with one sentence that names a file and has these words."""
    damage(small)
    with pytest.raises(HoloreelError) as error:
        read_capture(small)
    said = str(error.value)
    assert "\n" not in said
    assert str(small) in said
    assert words in said, said


def test_a_size_of_nothing(tmp_path: Path) -> None:
    (tmp_path / "scene" / "4x").mkdir(parents=True)
    with pytest.raises(HoloreelError, match="holds 1 folders, none of the captures that can be read"):
        read_capture(tmp_path / "scene")
    with pytest.raises(HoloreelError, match="is an empty folder, no actorshq capture"):
        read_capture(tmp_path / "scene" / "4x", layout="actorshq")


def test_without_boxes_there_are_no_bounds(small: Path) -> None:
    (small / "aabbs.csv").unlink()
    assert read_capture(small).bounds is None


def psnr(first: np.ndarray, second: np.ndarray) -> float:
    return float(-10 * np.log10(max(np.mean((first / 255.0 - second / 255.0) ** 2), 1e-12)))


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> tuple[Capture, Path]:
    """A painted ball in 16 cameras as a transforms.json, two frames, and its ActorsHQ folder; two are held out."""
    folder = tmp_path_factory.mktemp("ball")
    bounds = (tuple(CENTER - RADIUS - 0.05), tuple(CENTER + RADIUS + [0.15, 0.05, 0.05]))
    made = ball_capture(
        folder / "ball", 2, dome(16), [CENTER, CENTER + np.array([0.1, 0, 0])], painted=True,
        splits={"cam02": "test", "cam05": "test"}, fps=25.0, frame_start=101, bounds=bounds,
    )  # fmt: skip
    write_capture(folder / "ball", made)
    capture = read_capture(folder / "ball")
    assert not convert(capture, "actorshq", folder / "hq", {}, Export(background=(1.0, 0.0, 0.0)))
    return capture, folder / "hq"


def test_there_and_back(ball: tuple[Capture, Path]) -> None:
    capture, folder = ball
    back = read_capture(folder)
    given = names(capture)
    assert (given["cam02"], given["cam05"], given["cam00"]) == ("Cam001", "Cam014", "Cam002")
    assert list(back.cameras) == [f"Cam{i:03d}" for i in range(1, 17)]
    assert (back.camera_names("test"), back.fps, back.frame_start) == (["Cam001", "Cam014"], 25.0, 101)
    np.testing.assert_array_equal(back.bounds, capture.bounds)
    for old, new in given.items():
        before, camera = capture.cameras[old], back.cameras[new]
        for key in ("width", "height", "fx", "fy", "cx", "cy"):
            assert getattr(camera, key) == pytest.approx(getattr(before, key), rel=1e-15)
        np.testing.assert_allclose(camera.world_to_camera, before.world_to_camera, atol=1e-12)
        for frame in range(2):
            expected = capture.rgba(old, frame)
            assert psnr(back.image(new, frame), composite(expected, BLACK)) > 40
            np.testing.assert_array_equal(back.rgba(new, frame)[..., 3], expected[..., 3])


def test_what_is_written_is_what_the_format_says(ball: tuple[Capture, Path]) -> None:
    """The files read without this project's code."""
    capture, folder = ball
    given = {new: old for old, new in names(capture).items()}
    with (folder / "1x" / "calibration.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == HEADINGS.split(", ")
    assert [row["name"] for row in rows] == list(given)
    for row in rows:
        camera = capture.cameras[given[row["name"]]]
        pose = np.linalg.inv(camera.world_to_camera)
        rotation = Rotation.from_rotvec([float(row[key]) for key in ("rx", "ry", "rz")]).as_matrix()
        np.testing.assert_allclose(rotation, pose[:3, :3], atol=1e-12)
        np.testing.assert_allclose([float(row[key]) for key in ("tx", "ty", "tz")], pose[:3, 3], atol=1e-12)
        assert (int(row["w"]), int(row["h"])) == (camera.width, camera.height)
        assert float(row["fy"]) * camera.height == pytest.approx(camera.fy)
        assert float(row["px"]) * camera.width == pytest.approx(camera.cx)
    with (folder / "aabbs.csv").open(newline="") as file:
        boxes = [[float(value) for value in row.values()] for row in csv.DictReader(file)]
    assert boxes == [[frame, *capture.bounds[0], *capture.bounds[1]] for frame in (101, 102)]
    assert json.loads((folder / "scene.json").read_text()) == {"num_frames": 103}
    picture = iio.imread(folder / "1x" / "rgbs" / "Cam003" / "Cam003_rgb000102.jpg")
    alpha = iio.imread(folder / "1x" / "masks" / "Cam003" / "Cam003_mask000102.png")
    assert (picture.shape, alpha.shape, alpha.dtype) == ((*alpha.shape, 3), alpha.shape, np.uint8)
    assert picture[alpha == 0].max() < 40 < picture[alpha == 255].max()


def test_there_and_back_again_changes_no_camera(released: Path, tmp_path: Path) -> None:
    """What has this layout's names keeps them, and cameras of differing sizes their sizes."""
    once = read_capture(released / "4x", frames="16:17")
    assert not convert(once, "actorshq", tmp_path / "again", {}, Export())
    again = read_capture(tmp_path / "again")
    assert_cameras(again, 1)
    assert_pictures(again, first=16)
    assert (again.bounds, again.frame_start) == (once.bounds, 16)


def test_losses_are_told(ball: tuple[Capture, Path], tmp_path: Path) -> None:
    capture = replace(ball[0].frames(0, 1), fps=24.0, bounds=None, splits={"cam02": "test"})
    told = " ".join(convert(capture, "actorshq", tmp_path / "out", {}, Export()))
    assert "no aabbs.csv" in told
    assert "read it with --fps 24." in told
    assert "Held out were cam02, but what is read in this layout holds Cam001, Cam014 out by default" in told
    with pytest.raises(HoloreelError, match=r"numbers frames from 0: give --frame-start 0"):
        convert(replace(capture, frame_start=-1), "actorshq", tmp_path / "minus", {}, Export())
    part = replace(capture, images={view: file for view, file in capture.images.items() if view[0] != "cam03"})
    with pytest.raises(HoloreelError, match=r"camera 'cam03' has no picture of frame 101, and this layout needs all"):
        convert(part, "actorshq", tmp_path / "part", {}, Export())


def test_a_capture_without_a_subject_is_refused(tmp_path: Path) -> None:
    iio.imwrite(tmp_path / "a.png", np.zeros((24, 32, 3), np.uint8))
    capture = Capture({"a": Camera(32, 24, 30, 30, 16, 12, name="a")}, {("a", 0): tmp_path / "a.png"})
    with pytest.raises(HoloreelError, match=r"camera 'a' has no mask at frame 1.*make masks"):
        convert(capture, "actorshq", tmp_path / "out", {}, Export())


def test_a_stopped_conversion_goes_on(ball: tuple[Capture, Path], tmp_path: Path) -> None:
    """Stopped among the masks, it ends as one that was not stopped; progress counts pictures and masks."""
    capture = ball[0].frames(0, 1)
    steps: list[tuple[int, int]] = []

    def stop(done: int, total: int) -> None:
        steps.append((done, total))
        if done == 20:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        convert(capture, "actorshq", tmp_path / "out", {}, Export(on_progress=stop))
    assert steps == [(done, 32) for done in (*range(17), *range(16, 21))]
    convert(capture, "actorshq", tmp_path / "out", {}, Export())
    read_capture(tmp_path / "out")
    assert len(list((tmp_path / "out").rglob("*_mask*.png"))) == 16


def humanrfs_own() -> list[int]:
    """Its test cameras, counted from 0."""
    return [0, 13, 24, 30, 43, 57, 63, 64, 70, 84, 97, 103, 114, 126]


def all_round(folder: Path, frames: int, test: tuple[str, ...]) -> Capture:
    iio.imwrite(folder / "a.png", np.full((24, 32, 4), 128, np.uint8))
    cameras = {f"Cam{i:03d}": Camera(32, 24, 30, 30, 16, 12, name=f"Cam{i:03d}") for i in range(1, 161)}
    images = {(name, frame): folder / "a.png" for name in cameras for frame in range(frames)}
    splits = dict.fromkeys(test, "test")
    return Capture(cameras, images, frames, splits=splits, frame_start=101, source=folder / "a")


def test_held_out_cameras() -> None:
    assert [int(name[3:]) - 1 for name in HELD_OUT] == humanrfs_own()
    every = [f"Cam{i:03d}" for i in range(1, 161)]
    assert default_held_out(LAYOUTS["actorshq"], every) == list(HELD_OUT)
    assert default_held_out(LAYOUTS["actorshq"], every[1:13]) == ["Cam002"]


def test_the_frames_that_humanrf_looks_at(tmp_path: Path) -> None:
    """The portrait every third frame; landscape cameras by turns, in its order, every fifth."""
    views = protocol_views(all_round(tmp_path, 70, HELD_OUT))
    assert [frame for name, frame in views if name == "Cam127"] == list(range(0, 70, 3))
    turns = [(int(name[3:]) - 1, frame) for name, frame in views if name != "Cam127"]
    order = [0, 63, 97, 30, 13, 70, 114, 24, 84, 43, 64, 103, 57, 0]
    assert turns == list(zip(order, range(0, 70, 5), strict=True))
    assert len(views) == len(set(views)) == 24 + 14


def test_eval_keeps_the_protocol(tmp_path: Path) -> None:
    capture = all_round(tmp_path, 5, HELD_OUT)
    player = Gray(tmp_path / "a.reel")
    seen: list[object] = []
    draw = player.draw
    player.draw = lambda camera, frame, background=None: seen.append(background) or draw(camera, frame, background)
    plain = evaluate_player(player, capture)
    assert (len(plain["views"]), "protocol" in plain, set(seen)) == (70, False, {None})
    seen.clear()
    kept = evaluate_player(player, capture, protocol=named_protocol("humanrf", capture))
    assert [(view["camera"], view["frame"]) for view in kept["views"]] == [
        ("Cam001", 101), ("Cam127", 101), ("Cam127", 104),
    ]  # fmt: skip
    assert set(seen) == {BLACK}
    truth = 0.5 - np.rint(128 * 128 / 255) / 255  # gray of 0.5 was drawn, half covered gray lies over black
    assert kept["mean"]["psnr_mask"] == pytest.approx(-20 * np.log10(truth), abs=0.01)
    assert plain["mean"]["psnr_mask"] < kept["mean"]["psnr_mask"]
    assert f"Protocol of HumanRF (held out: {', '.join(HELD_OUT)}): PSNR mask dB, SSIM crop." in as_text(kept)
    json.dumps(kept, allow_nan=False)


def test_eval_keeps_the_protocol_by_command(
    recording: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Gaussians too; what they are compared with stays as it is."""
    cameras = {name: replace(recording.cameras["left"], name=name) for name in (*HELD_OUT, "Cam002")}
    images = {(name, frame): tmp_path / f"{name}_{frame}.png" for name in cameras for frame in range(3)}
    for file in images.values():
        iio.imwrite(file, np.full((24, 32, 4), 128, np.uint8))
    capture = Capture(cameras, images, 3, dict.fromkeys(HELD_OUT, "test"), frame_start=101, source=tmp_path)
    folder = write_capture(tmp_path / "capture", capture)
    command = ["eval", str(recording.reel), str(folder), "--out", str(tmp_path / "out"), "--no-pictures"]
    assert main([*command, "--protocol", "humanrf"]) == 0
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert [(view["camera"], view["frame"]) for view in metrics["views"]] == [("Cam001", 101), ("Cam127", 101)]
    assert metrics["protocol"]["name"] == "HumanRF"
    assert "Protocol of HumanRF" in capsys.readouterr().out
    assert main([*command, "--protocol", "humanrf", "--split", "all"]) == 2
    assert "leave --split all out" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "words"),
    [("humanrf", f"here it is Cam001; read it with --test-cameras {' '.join(HELD_OUT)}."), ("rerf", "it has no 006.")],
)
def test_a_protocol_needs_its_cameras(tmp_path: Path, name: str, words: str) -> None:
    with pytest.raises(HoloreelError) as error:
        named_protocol(name, all_round(tmp_path, 1, ("Cam001",)))
    assert words in str(error.value)


def test_a_subject_from_blender(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
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
    assert main(["convert", str(tmp_path / "made"), "--out", str(tmp_path / "hq"), "--to", "actorshq"]) == 0
    assert main(["info", str(tmp_path / "hq")]) == 0
    said = capsys.readouterr().out
    assert "3 cameras x 2 frames as actorshq" in said
    assert "cut out of every picture" in said
    made, back = read_capture(tmp_path / "made"), read_capture(tmp_path / "hq")
    assert (back.bounds, back.frame_start, back.camera_names("test")) == (made.bounds, made.frame_start, ["Cam001"])
    for old, new in names(made).items():
        np.testing.assert_allclose(back.cameras[new].world_to_camera, made.cameras[old].world_to_camera, atol=1e-12)
        for frame in range(2):
            truth = made.rgba(old, frame)
            assert 0 < np.count_nonzero(truth[..., 3]) < truth[..., 3].size
            assert psnr(back.image(new, frame), composite(truth, BLACK)) > 40
            np.testing.assert_array_equal(back.rgba(new, frame)[..., 3], truth[..., 3])
