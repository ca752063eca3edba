# SPDX-License-Identifier: GPL-3.0-or-later
"""Damaged and contradictory datasets: each is refused in one sentence that names the file and the remedy."""

import json
import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
from holoreel.core.camera import Camera
from holoreel.core.capture import Capture, CaptureOptions, read_capture
from holoreel.core.capture.export import Export, encode_video
from holoreel.core.capture.layouts import LAYOUTS
from holoreel.core.capture.sync import synchronize
from holoreel.core.capture.videos import read_unposed
from holoreel.core.errors import HoloreelError

COUNT = 3  # cameras


def shade(camera: int, frame: int) -> np.ndarray:
    """A flat picture whose red tells the camera, whose green the frame."""
    return np.broadcast_to(np.uint8([40 * camera, 20 * frame, 90]), (16, 32, 3))


def make_video(path: Path, camera: int, frames: int, fps: float = 6.0, size: tuple[int, int] = (32, 16)) -> None:
    pictures = (np.resize(shade(camera, frame), (size[1], size[0], 3)) for frame in range(frames))
    path.unlink(missing_ok=True)
    encode_video(path, size, fps, pictures)


@pytest.fixture(scope="module")
def originals(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One whole little scene in every layout, in a folder of its name: 3 cameras of 32x16, 5 frames."""
    folder = tmp_path_factory.mktemp("originals")
    cameras, images = {}, {}
    for index in range(COUNT):
        name = f"cam{index:02d}"
        cameras[name] = Camera.look_at((index, -4, 1), (0, 0, 0), width=32, height=16, fx=30.0, name=name)
        for frame in range(5):
            images[name, frame] = folder / "pictures" / f"{name}_{frame}.png"
            images[name, frame].parent.mkdir(exist_ok=True)
            opaque = np.full((16, 32, 1), 255, np.uint8)
            iio.imwrite(images[name, frame], np.concatenate([shade(index, frame), opaque], axis=2))
    box = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    capture = Capture(cameras, images, 5, {"cam00": "test"}, fps=6.0, frame_start=0, bounds=box)
    for name, layout in LAYOUTS.items():
        layout.write(capture, folder / name, Export())
    return folder


@pytest.fixture
def scene(originals: Path, tmp_path: Path) -> Callable[[str], Path]:
    """`scene(layout)` is a copy of one scene, to be damaged."""

    def copy(layout: str) -> Path:
        return Path(shutil.copytree(originals / layout, tmp_path / layout))

    return copy


def refuse(path: Path, *words: str, **options: object) -> str:
    """Reading must fail with one sentence that has all these words."""
    with pytest.raises(HoloreelError) as error:
        read_capture(path, **options)
    said = str(error.value)
    assert "\n" not in said
    assert str(path) in said
    for word in words:
        assert word in said, said
    return said


def edit_json(path: Path, change: Callable[[list], object]) -> None:
    value = json.loads(path.read_text())
    change(value["cameras"] if isinstance(value, dict) else value)
    path.write_text(json.dumps(value))


VIDEO_NAMES = {"n3v": "cam01.mp4", "immersive": "camera_0002.mp4", "videos": "cam01.mp4", "rerf": "image/001.mp4"}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_whole_scenes_are_read(scene: Callable[[str], Path], layout: str) -> None:
    capture = read_capture(scene(layout))
    assert (len(capture.cameras), capture.frame_count) == (COUNT, 5)
    assert len(capture.camera_names("test")) == 1


@pytest.mark.parametrize("layout", VIDEO_NAMES)
def test_a_missing_video(scene: Callable[[str], Path], layout: str) -> None:
    folder = scene(layout)
    (folder / VIDEO_NAMES[layout]).unlink()
    said = refuse(folder, "fetch the missing")
    assert ("has 3 cameras, but there are 2 videos" in said) or (Path(VIDEO_NAMES[layout]).stem in said)


@pytest.mark.parametrize("layout", VIDEO_NAMES)
def test_a_video_too_many(scene: Callable[[str], Path], layout: str) -> None:
    folder = scene(layout)
    make_video((folder / VIDEO_NAMES[layout]).with_name("cam07.mp4"), 1, 5)
    refuse(folder, "cam07")


@pytest.mark.parametrize("layout", VIDEO_NAMES)
def test_differing_frame_counts(scene: Callable[[str], Path], layout: str) -> None:
    folder = scene(layout)
    make_video(folder / VIDEO_NAMES[layout], 1, 4)
    refuse(folder, f"{VIDEO_NAMES[layout]} has 4 frames, the others have 5", "--frames 0:3")
    part = read_capture(folder, frames="1:3", scale=1)
    assert (part.frame_count, part.frame_start) == (3, 1)
    assert np.abs(part.image(list(part.cameras)[2], 0, (0, 0, 0)).astype(int) - shade(2, 1)).max() < 6
    refuse(folder, "has the frames 0:3, not all of --frames 1:4", frames="1:4")


@pytest.mark.parametrize("layout", VIDEO_NAMES)
def test_differing_sizes(scene: Callable[[str], Path], layout: str) -> None:
    folder = scene(layout)
    make_video(folder / VIDEO_NAMES[layout], 1, 5, size=(40, 16))
    refuse(folder, "32x16", "40x16", Path(VIDEO_NAMES[layout]).stem)


@pytest.mark.parametrize("layout", VIDEO_NAMES)
def test_differing_rates(scene: Callable[[str], Path], layout: str) -> None:
    folder = scene(layout)
    make_video(folder / VIDEO_NAMES[layout], 1, 5, fps=5.0)
    refuse(folder, "has 5 frames per second, the others 6 frames per second", "--fps")
    assert read_capture(folder, fps=6.0).fps == 6.0


@pytest.mark.parametrize("layout", VIDEO_NAMES)
@pytest.mark.parametrize("content", [b"", b"no video at all" * 100])
def test_a_damaged_video(scene: Callable[[str], Path], layout: str, content: bytes) -> None:
    folder = scene(layout)
    (folder / VIDEO_NAMES[layout]).write_bytes(content)
    refuse(folder, VIDEO_NAMES[layout])


@pytest.mark.parametrize("layout", ["immersive", "videos"])
def test_the_first_camera_is_the_first_by_name(scene: Callable[[str], Path], layout: str) -> None:
    """Whatever the order in the file."""
    folder = scene(layout)
    before = read_capture(folder)
    edit_json(
        folder / ("models.json" if layout == "immersive" else "cameras_opencv.json"), lambda entries: entries.reverse()
    )
    after = read_capture(folder)
    assert list(after.cameras) == list(before.cameras)
    assert after.camera_names("test") == [next(iter(before.cameras))]
    for name, camera in before.cameras.items():
        np.testing.assert_array_equal(after.cameras[name].world_to_camera, camera.world_to_camera)
        assert after.images[name, 2] == before.images[name, 2]


def test_videos_of_half_the_size_that_the_poses_were_made_for(scene: Callable[[str], Path]) -> None:
    """LLFF's poses scale along with the pictures; other layouts' lenses say for which size they hold."""
    folder = scene("n3v")
    for index in range(COUNT):
        make_video(folder / f"cam{index:02d}.mp4", index, 5, size=(64, 32))
    camera = read_capture(folder, scale=1).cameras["cam01"]
    assert (camera.width, camera.fx, camera.cx) == (64, 60.0, 32.0)


@pytest.mark.parametrize(
    "rows",
    [
        np.zeros((3, 16)),
        np.zeros((0, 17)),
        np.zeros(17),
        np.zeros((3, 17), np.int64),
        np.array([[None] * 17] * 3, dtype=object),
        np.full((3, 17), np.nan),
        np.zeros((3, 17)),
        np.full((3, 17), 1e300),
    ],
)
def test_a_bad_poses_bounds(scene: Callable[[str], Path], rows: np.ndarray) -> None:
    folder = scene("n3v")
    np.save(folder / "poses_bounds.npy", rows, allow_pickle=True)
    refuse(folder, "poses_bounds.npy", "fetch")


def test_a_poses_bounds_that_claims_too_much(scene: Callable[[str], Path]) -> None:
    """A header of a table that would not fit into any memory, with a few bytes behind it."""
    folder = scene("n3v")
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 17), }"
    header += b" " * (118 - len(header) - 1) + b"\n"
    (folder / "poses_bounds.npy").write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", 118) + header + b"\0" * 99)
    refuse(folder, "poses_bounds.npy")
    (folder / "poses_bounds.npy").write_bytes(b"\x93NUMPY")
    refuse(folder, "poses_bounds.npy")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda text: text.replace("0.0", "zero", 1), "row 0 is no row of numbers"),
        (lambda text: text.replace("0.0", "nan", 1), "row 0"),
        (lambda text: "\n".join(line.rsplit(" ", 1)[0] for line in text.splitlines()), "has 11 numbers"),
        (lambda text: "", "a row per camera"),
        (lambda text: "\n".join(text.splitlines()[:-1]), "pictures of camera 2, but cameras_parameters.txt has 2 rows"),
        (lambda text: text + text.splitlines()[-1] + "\n", "scene_undist_00000_03.png and 4 more pictures are missing"),
        (lambda text: text.replace("30.0", "-30.0", 1), "fx must be positive"),
        (lambda text: text.replace("1.0 0.0", "1.0 9.0", 1), "row 0 has a skew of 9"),
    ],
)
def test_bad_technicolor_parameters(scene: Callable[[str], Path], change: Callable[[str], str], words: str) -> None:
    folder = scene("technicolor")
    for path in folder.glob("*.png"):
        path.rename(path.with_name(path.name.replace("technicolor", "scene")))
    file = folder / "cameras_parameters.txt"
    file.write_text(change(file.read_text()))
    refuse(folder, words)


def test_missing_technicolor_pictures(scene: Callable[[str], Path]) -> None:
    folder = scene("technicolor")
    (folder / "technicolor_undist_00002_01.png").unlink()
    refuse(folder, "technicolor_undist_00002_01.png is missing")
    assert read_capture(folder, frames="3:4").frame_count == 2
    (folder / "other_undist_00002_01.png").write_bytes(b"")
    refuse(folder, "of the scenes other, technicolor")
    for path in folder.glob("*.png"):
        path.unlink()
    refuse(folder, "of no scene")


def test_technicolor_pictures_of_another_size_or_none(scene: Callable[[str], Path]) -> None:
    folder = scene("technicolor")
    iio.imwrite(folder / "technicolor_undist_00003_01.png", np.zeros((17, 32, 3), np.uint8))
    refuse(folder, "technicolor_undist_00003_01.png is 32x17, but camera 'cam01' is 32x16")
    (folder / "technicolor_undist_00003_01.png").write_bytes(b"not a picture")
    refuse(folder, "technicolor_undist_00003_01.png cannot be read as a picture")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda entries: entries[1].pop("name"), "[1].name is missing"),
        (lambda entries: entries[1].update(name="camera_0001"), "'camera_0001' is there twice"),
        (lambda entries: entries[1].update(focal_length="long"), "[1].focal_length must be 1 finite numbers, not long"),
        (lambda entries: entries[1].update(focal_length=0), "fx must be positive"),
        (lambda entries: entries[1].update(principal_point=[1]), "[1].principal_point must be 2"),
        (lambda entries: entries[1].update(position=[1, 2, 1e400]), "[1].position must be 3"),
        (lambda entries: entries[1].update(position=[1, 2, 1e200]), "[1].position must be 3"),
        (lambda entries: entries[1].update(orientation=[1, 2, 1e12]), "[1]: is no rotation"),
        (lambda entries: entries[1].update(width=1e9), "width"),
        (lambda entries: entries[1].update(projection_type="perspective"), "projection_type must be fisheye"),
        (lambda entries: entries.clear(), "must be a list of 1 to"),
        (lambda entries: entries.pop(), "is not described in models.json"),
        (lambda entries: entries.append(entries[0] | {"name": "camera_0009"}), "describes camera_0009, but no video"),
    ],
)
def test_bad_immersive_models(scene: Callable[[str], Path], change: Callable[[list], object], words: str) -> None:
    folder = scene("immersive")
    edit_json(folder / "models.json", change)
    refuse(folder, words)


@pytest.mark.parametrize("text", ["", "{", "[1]", '{"a": 1}', "[" * 100_000])
def test_models_that_are_no_list_of_cameras(scene: Callable[[str], Path], text: str) -> None:
    folder = scene("immersive")
    (folder / "models.json").write_text(text)
    refuse(folder, "models.json")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda cameras: cameras[1].pop("K"), "camera cam01 has no K or matrix"),
        (lambda cameras: cameras[1].update(K=[[1, 2], [3, 4]]), "K must be 3x3 finite numbers"),
        (lambda cameras: cameras[1].update(K="many"), "K must be 3x3 finite numbers"),
        (lambda cameras: cameras[1]["K"][0].__setitem__(1, 5.0), "skew of 5"),
        (lambda cameras: cameras[1].update(R=[[2, 0, 0], [0, 2, 0], [0, 0, 2]]), "must be a rotation"),
        (lambda cameras: cameras[1].update(R=[1e12, 0, 0]), "is no rotation"),
        (lambda cameras: cameras[1].update(t=[0, 0, None]), "t must be 3 finite numbers"),
        (lambda cameras: cameras[1].update(dist=[0.1] * 6), "dist must be 0 or 4 or 5 or 8"),
        (lambda cameras: cameras[1].update(dist=[0.1] * 12), "thin prism and tilt"),
        (lambda cameras: cameras[1].update(dist=[0.1] * 5, fisheye=True), "a fisheye has 4 distortion coefficients"),
        (lambda cameras: cameras[1].update(size=[64, 16]), "cam01 was calibrated at 64x16, its video is 32x16"),
        (lambda cameras: cameras[1].update(name="cam05"), "describes cam05, but no video of that name"),
        (lambda cameras: cameras[1].update(name="cam00"), "two cameras mean the video cam00"),
        (lambda cameras: cameras.pop(), "is not described in cameras_opencv.json"),
        (lambda cameras: cameras.clear(), "describes no cameras"),
    ],
)
def test_bad_calibrations(scene: Callable[[str], Path], change: Callable[[list], object], words: str) -> None:
    folder = scene("videos")
    edit_json(folder / "cameras_opencv.json", change)
    refuse(folder, words)


def test_videos_of_unknown_cameras(scene: Callable[[str], Path]) -> None:
    folder = scene("videos")
    (folder / "cameras_opencv.json").unlink()
    refuse(folder, "camera_array.toml or cameras_opencv.json", f"`holoreel sfm {folder}`")
    capture = read_unposed(folder, CaptureOptions(frames="1:2"))
    assert (list(capture.cameras), capture.frame_count) == (["cam00", "cam01", "cam02"], 2)


def timestamps(folder: Path, moments: dict[str, list[float]]) -> None:
    rows = [f"{i},{camera},{moment}" for camera, times in moments.items() for i, moment in enumerate(times)]
    (folder / "timestamps.csv").write_text("sync_index,cam_id,frame_time\n" + "\n".join(rows) + "\n")


EVEN = [10.0, 10.2, 10.4, 10.6, 10.8]


def test_frames_meet_on_a_common_clock(scene: Callable[[str], Path]) -> None:
    """Camera 1 started a frame earlier, and all of its moments are 10 ms late; camera 2 dropped its last frame."""
    folder = scene("videos")
    make_video(folder / "cam02.mp4", 2, 4)
    timestamps(folder, {"0": EVEN, "1": [t - 0.19 for t in EVEN], "2": EVEN[:4]})
    capture = read_capture(folder)
    assert (capture.frame_count, capture.fps) == (4, pytest.approx(5.0))
    assert [capture.images["cam01", j].index for j in range(4)] == [1, 2, 3, 4]
    assert [capture.images["cam00", j].index for j in range(4)] == [0, 1, 2, 3]
    assert "cam01 +10.0 (at most 10.0)" in capture.notes[0]
    assert "cam00 +0.0" in capture.notes[0]


def test_frames_that_do_not_meet(scene: Callable[[str], Path]) -> None:
    folder = scene("videos")
    timestamps(folder, {"0": EVEN, "1": [t + 0.08 for t in EVEN], "2": EVEN})
    refuse(folder, "camera cam01 is +80.0 ms from the common clock, 0.40 of a frame", "--sync-tolerance 0.4")
    assert read_capture(folder, sync_tolerance=0.41).frame_count == 5
    timestamps(folder, {"0": EVEN, "1": [*EVEN[:2], 10.8, 11.0, 11.2], "2": EVEN})  # two frames were dropped
    refuse(folder, "cam01", "of a frame interval")
    timestamps(folder, {"0": EVEN, "1": [t + 50 for t in EVEN], "2": EVEN})
    refuse(folder, "camera cam01 starts 49.200 s after camera cam00 ends")
    timestamps(folder, {"0": EVEN, "1": EVEN[:4], "2": EVEN})
    refuse(folder, "has 4 moments of cam01.mp4, which has 5 frames")
    timestamps(folder, {"0": EVEN, "2": EVEN})
    refuse(folder, "says nothing about cam01.mp4")
    timestamps(folder, {"0": EVEN, "1": EVEN[::-1], "2": EVEN})
    refuse(folder, "frame_time of camera 1 must increase")


BAD_ROWS = ["", "\n0,soon\n", "\n0,nan\n", "\n0\n", "\n0,1e300\n", "\n0,1\n"]


@pytest.mark.parametrize("text", ["", "a,b\n1,2\n", *[f"cam_id,frame_time{rows}" for rows in BAD_ROWS]])
def test_bad_timestamps(scene: Callable[[str], Path], text: str) -> None:
    folder = scene("videos")
    (folder / "timestamps.csv").write_text(text)
    refuse(folder, "timestamps.csv")


def test_a_long_recording_does_not_drift() -> None:
    """An hour at 29.97 with jitter and dropped frames: every tick has its own frame, however long it goes on."""
    random = np.random.default_rng(3)
    even = np.arange(100_000) / 29.97
    times = {}
    for name, offset in {"a": 0.0, "b": 0.004, "c": -0.006}.items():
        moments = even + offset + random.normal(0, 0.001, len(even))
        times[name] = np.delete(moments, random.integers(1, 99_999, 5)) if name == "b" else moments
    clock = synchronize(Path("t"), times)
    assert 1 / clock.interval_s == pytest.approx(29.97, rel=1e-6)
    assert clock.ticks == 100_000
    np.testing.assert_array_equal(clock.frames["a"], np.arange(100_000))
    assert np.abs(clock.offsets_s["c"] + 0.006).max() < 0.01
    assert (np.abs(clock.offsets_s["b"]) > 0.02).sum() == 5


def test_absurd_spans_of_time() -> None:
    with pytest.raises(HoloreelError, match="frames are more than"):
        synchronize(Path("t"), {name: np.array([0.0, 1e-3, 2e-3, 1e9]) for name in "ab"})


def damage(file: str, change: Callable[[bytes], bytes]) -> Callable[[Path], object]:
    return lambda folder: (folder / file).write_bytes(change((folder / file).read_bytes()))


MODEL = "colmap_0/sparse/0/"


@pytest.mark.parametrize(
    ("break_it", "words"),
    [
        (lambda folder: shutil.rmtree(folder / "colmap_2"), "colmap_2 is missing"),
        (lambda folder: shutil.rmtree(folder / "colmap_0" / "sparse"), "holds no sparse/0/cameras.bin"),
        (lambda folder: (folder / "colmap_3/images/cam01.png").unlink(), "cam01.png"),
        (lambda folder: (folder / "colmap_3/images/cam01.png").write_bytes(b""), "cannot be read as a picture"),
        (
            damage(MODEL + "cameras.bin", lambda data: data[:16] + struct.pack("<Q", 48) + data[24:]),
            "32x16, but camera",
        ),
        (damage(MODEL + "cameras.bin", lambda data: data[:-1]), "ends at byte"),
        (damage(MODEL + "cameras.bin", lambda data: struct.pack("<Q", 2**60) + data[8:]), "more than it can hold"),
        (damage(MODEL + "cameras.bin", lambda data: data[:12] + struct.pack("<i", 7) + data[16:]), "model number 7"),
        (damage(MODEL + "cameras.bin", lambda data: data[:16] + struct.pack("<Q", 2**40) + data[24:]), "width"),
        (damage(MODEL + "images.bin", lambda data: data[:-1]), "ends at byte"),
        (damage(MODEL + "images.bin", lambda data: data[:8]), "more than it can hold"),
        (damage(MODEL + "images.bin", lambda data: struct.pack("<Q", 0)), "holds no images"),
        (damage(MODEL + "images.bin", lambda data: data.replace(b"cam01.png", b"cam00.png")), "is there twice"),
        (damage(MODEL + "images.bin", lambda data: data.replace(b"cam01.png", b"../01.png")), "no name of a picture"),
        (damage(MODEL + "images.bin", lambda data: data[:12] + b"\0" * 32 + data[44:]), "a quaternion is 4 finite"),
        (damage(MODEL + "images.bin", lambda data: data[:68] + struct.pack("<I", 9) + data[72:]), "has camera 9"),
    ],
)
def test_bad_colmap_models(scene: Callable[[str], Path], break_it: Callable[[Path], object], words: str) -> None:
    folder = scene("colmap")
    break_it(folder)
    refuse(folder, words)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("cameras", "1 PINHOLE 32 16 30 30 16\n"),
        ("cameras", "1 FOV 32 16 30 30 16 8 1\n"),
        ("cameras", "one PINHOLE 32 16 30 30 16 8\n"),
        ("images", "1 1 0 0 0 0 0 0 1\n"),
        ("images", "1 1 0 0 0 0 0\n\n"),
        ("images", "1 nan 0 0 0 0 0 0 1 a.png\n\n"),
    ],
)
def test_bad_colmap_texts(tmp_path: Path, name: str, text: str) -> None:
    good = {"cameras": "# a comment\n1 PINHOLE 32 16 30 30 16 8\n", "images": "1 1 0 0 0 0 0 0 1 a.png\n\n"}
    (tmp_path / "images").mkdir()
    iio.imwrite(tmp_path / "images" / "a.png", shade(0, 0))
    (tmp_path / "sparse").mkdir()
    for key, value in good.items():
        (tmp_path / "sparse" / f"{key}.txt").write_text(value)
    assert read_capture(tmp_path).cameras["a"].fx == 30
    (tmp_path / "sparse" / f"{name}.txt").write_text(text)
    refuse(tmp_path, f"{name}.txt")


def point(x: float, track: int) -> bytes:
    return struct.pack("<QQ3d3BdQ", 1, 1, x, 0, 0, 1, 2, 3, 0, track)


@pytest.mark.parametrize("data", [b"", struct.pack("<Q", 2**50), point(0, 2**50), point(np.nan, 0)])
def test_bad_colmap_points(scene: Callable[[str], Path], data: bytes) -> None:
    folder = scene("colmap")
    (folder / MODEL / "points3D.bin").write_bytes(data)
    with pytest.raises(HoloreelError, match=r"points3D.bin"):
        read_capture(folder).seed_points(0)


TABLES = {
    "n3v": ["poses_bounds.npy"],
    "technicolor": ["cameras_parameters.txt"],
    "immersive": ["models.json"],
    "videos": ["cameras_opencv.json", "timestamps.csv"],
    "rerf": ["CamPose.inf", "Intrinsic.inf", "bbox.json"],
    "actorshq": ["1x/calibration.csv", "aabbs.csv"],
    "colmap": [f"{MODEL}cameras.bin", f"{MODEL}images.bin", f"{MODEL}points3D.bin"],
}


@pytest.mark.parametrize(("layout", "file"), [(layout, file) for layout, files in TABLES.items() for file in files])
def test_no_damage_is_a_surprise(scene: Callable[[str], Path], layout: str, file: str) -> None:
    """Whatever happens to a file, reading works or says why it does not."""
    folder = scene(layout)
    timestamps(folder, {"0": EVEN, "1": EVEN, "2": EVEN})
    if file.endswith("points3D.bin"):
        (folder / file).write_bytes(point(1.5, 2) + bytes(16))
    whole = (folder / file).read_bytes()
    random = np.random.default_rng(5)
    refusals = []
    for _ in range(120):
        data = bytearray(whole)
        for place in random.integers(0, max(len(data) - 60, 1), random.integers(1, 4)):
            match random.integers(4):
                case 0:
                    data[place] ^= 1 << random.integers(8)
                case 1:
                    data[place : place + 8] = random.bytes(8)
                case 2:
                    data[place : place + 1] = [b"9", b"-", b"e99", b"null", b"[", b"nan", b"\n"][random.integers(7)]
                case _:
                    del data[place : place + random.integers(1, 20)]
        (folder / file).write_bytes(data)
        try:
            read_capture(folder).seed_points(0)
        except HoloreelError as error:
            refusals.append(str(error))
    assert refusals
    assert not any("\n" in sentence for sentence in refusals)
