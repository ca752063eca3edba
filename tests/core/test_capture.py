# SPDX-License-Identifier: GPL-3.0-or-later
"""Captures: round trip through transforms.json, nerfstudio's own rules, foreign files, and files that lie."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
import OpenEXR
import pytest
from holoreel.core.camera import Camera
from holoreel.core.capture import Capture, Points, read_capture, read_points, write_capture, write_points
from holoreel.core.errors import HoloreelError

WIDTH, HEIGHT, FRAMES = 6, 4, 3


def pixel(camera: int, frame: int) -> tuple[int, int, int]:
    """A color that says where it belongs."""
    return 10 + camera, 100 + frame, 7


@pytest.fixture
def capture(tmp_path: Path) -> Capture:
    """Three cameras × three frames on disk, one camera of another size, one held out, with depth and seeds."""
    cameras, images, depths, seeds = {}, {}, {}, {}
    for index, name in enumerate(("left", "middle", "right")):
        width = WIDTH + 2 * (index == 2)
        eye = (index - 1, -4, 0.3 * index)
        cameras[name] = Camera.look_at(eye, (0, 0, 0), width=width, height=HEIGHT, fx=7.5, name=name)
        for frame in range(FRAMES):
            path = tmp_path / "images" / name / f"{frame:06d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            imageio.imwrite(path, np.full((HEIGHT, width, 3), pixel(index, frame), np.uint8))
            images[name, frame] = path
            depth = np.full((HEIGHT, width), 1 + index + frame / 10, np.float32)
            depth[0, 0] = 1e10
            depths[name, frame] = tmp_path / "depth" / name / f"{frame:06d}.exr"
            depths[name, frame].parent.mkdir(parents=True, exist_ok=True)
            OpenEXR.File({}, {"V": depth}).write(str(depths[name, frame]))
    for frame in range(FRAMES):
        seeds[frame] = tmp_path / "seeds" / f"{frame:06d}.ply"
        write_points(seeds[frame], Points(np.float32([[frame, 1, 2]]), np.uint8([[200 + frame, 1, 2]])))
    return Capture(cameras, images, FRAMES, {"middle": "test"}, 24.0, 5, depths, seeds)


def edited(path: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    meta = json.loads(path.read_text())
    change(meta)
    path.write_text(json.dumps(meta))
    return path


def foreign(meta: dict[str, Any]) -> None:
    """Take out what only our own files have."""
    del meta["holoreel"]
    for frame in meta["frames"]:
        del frame["holoreel"]


def test_round_trip(tmp_path: Path, capture: Capture) -> None:
    path = write_capture(tmp_path, capture)
    assert path == tmp_path / "transforms.json"
    back = read_capture(tmp_path)
    assert list(back.cameras) == ["left", "middle", "right"]
    assert (back.frame_count, back.fps, back.frame_start) == (FRAMES, 24.0, 5)
    assert back.camera_names("test") == ["middle"]
    assert back.views() == capture.views()
    assert np.allclose(back.times, [0, 1 / 3, 2 / 3])
    for index, (name, camera) in enumerate(capture.cameras.items()):
        other = back.cameras[name]
        assert np.allclose(other.world_to_camera, camera.world_to_camera, atol=1e-14)
        assert np.array_equal(other.K, camera.K)
        assert (other.width, other.height, other.name) == (camera.width, camera.height, name)
        for frame in range(FRAMES):
            assert back.image(name, frame)[1, 2].tolist() == list(pixel(index, frame))
            depth = back.depth(name, frame)
            assert np.isinf(depth[0, 0])
            assert np.isclose(depth[1, 1], 1 + index + frame / 10)
    assert back.seed_points(2).xyz.tolist() == [[2, 1, 2]]
    assert back.seed_points(2).rgb.tolist() == [[202, 1, 2]]
    write_capture(tmp_path / "again.json", back)
    assert read_capture(tmp_path / "again.json").views("train") == capture.views("train")


def test_a_run_of_frames_is_a_capture(capture: Capture) -> None:
    part = capture.frames(1, 2)
    assert (part.frame_count, part.frame_start, part.times.tolist()) == (2, 6, [0, 0.5])
    assert part.views("test") == [("middle", 0), ("middle", 1)]
    assert part.image("right", 1)[1, 2].tolist() == list(pixel(2, 2))
    assert np.isclose(part.depth("left", 0)[1, 1], 1.1)
    assert part.seed_points(0).rgb.tolist() == [[201, 1, 2]]
    with pytest.raises(HoloreelError, match="no 3 frames from frame 1 on; it has 3"):
        capture.frames(1, 3)


def test_nerfstudio_reads_it_as_it_is(tmp_path: Path, capture: Capture) -> None:
    """An independent reader that does what nerfstudio's dataparser does, step by step."""
    meta = json.loads(write_capture(tmp_path, capture).read_text())
    assert meta["camera_model"] in ("OPENCV", "OPENCV_FISHEYE")
    frames = sorted(meta["frames"], key=lambda frame: frame["file_path"])
    for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):  # at the top, or in all frames
        assert (key in meta) != all(key in frame for frame in frames)
        assert key in meta or not any(key in meta for _ in frames)
    assert "w" not in meta  # one camera is wider here
    assert meta["fl_x"] == 7.5
    files = [frame["file_path"] for frame in frames]
    assert all((tmp_path / file).is_file() and not Path(file).is_absolute() for file in files)
    assert sum("depth_file_path" in frame for frame in frames) in (0, len(frames))
    for split in ("train", "val", "test"):  # one of them present: all must be
        assert set(meta[f"{split}_filenames"]) <= set(files)
    assert not set(meta["train_filenames"]) & set(meta["test_filenames"])
    assert "applied_transform" not in meta
    assert (tmp_path / meta["ply_file_path"]).read_bytes().startswith(b"ply\n")
    point = np.array([0.3, -0.2, 0.1, 1.0])
    for frame in frames:
        assert 0 <= frame["time"] < 1
        pose = np.array(frame["transform_matrix"])
        assert pose.shape == (4, 4)
        x, y, z, _ = np.linalg.inv(pose) @ point  # OpenGL: looks along -z, y up
        u = meta["fl_x"] * x / -z + frame.get("cx", meta.get("cx"))
        v = -meta["fl_y"] * y / -z + frame.get("cy", meta.get("cy"))
        camera = capture.cameras[frame["holoreel"]["camera"]]
        assert np.allclose(camera.project([point[:3]])[0], [[u, v]], atol=1e-9)


def test_shared_lens_goes_to_the_top(tmp_path: Path, capture: Capture) -> None:
    cameras = {name: capture.cameras[name] for name in ("left", "middle")}
    images = {view: path for view, path in capture.images.items() if view[0] in cameras}
    meta = json.loads(write_capture(tmp_path, Capture(cameras, images, FRAMES)).read_text())
    assert (meta["w"], meta["h"], meta["cx"]) == (WIDTH, HEIGHT, 3)
    assert set(meta["frames"][0]) == {"file_path", "transform_matrix", "time", "holoreel"}
    assert "train_filenames" not in meta


def test_lenses(tmp_path: Path, capture: Capture) -> None:
    """All models at once, and what nerfstudio reads of them."""
    lenses: dict[str, tuple[str, tuple[float, ...]]] = {
        "left": ("OPENCV", (0.1, -0.02, 0.003, -0.004)),
        "middle": ("OPENCV_FISHEYE", (0.01, 0.02, -0.03, 0.004)),
        "right": ("FULL_OPENCV", (0.1, 0.2, 0.003, 0.004, 0.5, 0.6, 0.7, 0.8)),
    }
    cameras = {
        name: replace(camera, model=lenses[name][0], distortion=lenses[name][1])
        for name, camera in capture.cameras.items()
    }
    path = write_capture(tmp_path, replace(capture, cameras=cameras))
    back = read_capture(path)
    assert {name: (camera.model, camera.distortion) for name, camera in back.cameras.items()} == lenses
    entries = {frame["holoreel"]["camera"]: frame for frame in json.loads(path.read_text())["frames"]}
    assert (entries["left"]["camera_model"], entries["left"]["p2"]) == ("OPENCV", -0.004)
    assert (entries["middle"]["camera_model"], entries["middle"]["k4"]) == ("OPENCV_FISHEYE", 0.004)
    assert entries["right"]["camera_model"] == "FULL_OPENCV"
    brown = replace(cameras["left"], model="FULL_OPENCV", distortion=(0.1, 0, 0, 0, 0.2, 0, 0, 0))
    path = write_capture(tmp_path, replace(capture, cameras=dict.fromkeys(cameras, brown)))
    meta = json.loads(path.read_text())
    assert (meta["camera_model"], meta["k1"], meta["k3"]) == ("OPENCV", 0.1, 0.2)
    assert "k4" not in meta

    lens = replace(cameras["left"], distortion=(0.1, 0, 0, 0))
    path = write_capture(
        tmp_path, replace(capture, cameras={name: replace(lens, world_to_camera=c.world_to_camera, name=name)
                                            for name, c in cameras.items()})
    )  # fmt: skip
    meta = json.loads(path.read_text())
    for key in ("k2", "p1", "p2"):
        del meta[key]
    meta["camera_model"] = "SIMPLE_RADIAL"
    path.write_text(json.dumps(meta))
    assert read_capture(path).cameras["middle"].distortion == (0.1, 0, 0, 0)


@pytest.mark.parametrize("ends_at_one", [False, True])
def test_foreign_file_with_times(tmp_path: Path, capture: Capture, ends_at_one: bool) -> None:
    """Without our keys: cameras from poses and folders, frames from times, as D-NeRF writes them too."""

    def change(meta: dict[str, Any]) -> None:
        foreign(meta)
        for frame in meta["frames"]:
            if ends_at_one:
                frame["time"] *= FRAMES / (FRAMES - 1)

    back = read_capture(edited(write_capture(tmp_path, capture), change))
    assert set(back.cameras) == {"left", "middle", "right"}
    assert back.views() == [(name, frame) for frame in range(FRAMES) for name in back.cameras]
    assert back.images == capture.images
    assert back.camera_names("test") == ["middle"]
    assert back.seed_points(1).xyz.tolist() == [[0, 1, 2]]


def test_foreign_static_file(tmp_path: Path, capture: Capture) -> None:
    def change(meta: dict[str, Any]) -> None:
        foreign(meta)
        meta["frames"] = [frame for frame in meta["frames"] if frame["time"] == 0]
        for frame in meta["frames"]:
            del frame["time"]
            frame["file_path"] = frame["file_path"].removesuffix(".png")  # as NeRF writes them

    back = read_capture(edited(write_capture(tmp_path, capture), change))
    assert back.frame_count == 1
    assert len(back.cameras) == 3
    assert back.image("left", 0).shape == (HEIGHT, WIDTH, 3)


def test_applied_transform_is_undone(tmp_path: Path, capture: Capture) -> None:
    turn = np.array([[1.0, 0, 0, 2], [0, 0, 1, 3], [0, -1, 0, 4]])

    def change(meta: dict[str, Any]) -> None:
        foreign(meta)
        meta["applied_transform"] = turn.tolist()
        for frame in meta["frames"]:
            frame["transform_matrix"] = (np.vstack([turn, [0, 0, 0, 1]]) @ frame["transform_matrix"]).tolist()

    back = read_capture(edited(write_capture(tmp_path, capture), change))
    for name, camera in capture.cameras.items():
        assert np.allclose(back.cameras[name].world_to_camera, camera.world_to_camera, atol=1e-12)


def test_alpha_and_other_pictures(tmp_path: Path, capture: Capture) -> None:
    back = read_capture(write_capture(tmp_path, capture))
    path = back.images["left", 0]
    rgba = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    rgba[:, :2] = (200, 100, 50, 255)
    rgba[:, 2:4] = (200, 100, 50, 51)
    imageio.imwrite(path, rgba)
    assert back.image("left", 0).shape == (HEIGHT, WIDTH, 4)
    over = back.image("left", 0, background=(1, 1, 0))
    assert over[0, 0].tolist() == [200, 100, 50]
    assert over[0, 2].tolist() == [244, 224, 10]
    assert over[0, 5].tolist() == [255, 255, 0]
    imageio.imwrite(path, np.full((HEIGHT, WIDTH), 65535, np.uint16))
    assert (back.image("left", 0) == 255).all()
    imageio.imwrite(path, np.zeros((HEIGHT, WIDTH + 1, 3), np.uint8))
    with pytest.raises(HoloreelError, match="7x4, its camera says 6x4"):
        back.image("left", 0)
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(HoloreelError, match="cannot be read"):
        back.image("left", 0)
    back.depths["left", 0].write_bytes(b"no exr")
    with pytest.raises(HoloreelError, match="cannot be read as an EXR"):
        back.depth("left", 0)


def test_missing_files_are_counted(tmp_path: Path, capture: Capture) -> None:
    path = write_capture(tmp_path, capture)
    for frame in range(FRAMES):
        capture.images["right", frame].unlink()
    with pytest.raises(HoloreelError, match=r"right/000000\.png and 2 more files"):
        read_capture(path)


def set_pose(value: Any) -> Callable[[dict[str, Any]], None]:
    return lambda meta: meta["frames"][4].update(transform_matrix=value)


def entry(**values: Any) -> Callable[[dict[str, Any]], None]:
    return lambda meta: meta["frames"][4].update(values)


def top(**values: Any) -> Callable[[dict[str, Any]], None]:
    return lambda meta: meta.update(values)


def drop(key: str) -> Callable[[dict[str, Any]], None]:
    return lambda meta: meta["frames"][4].pop(key)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (top(camera_model="EQUIRECTANGULAR"), "camera_model 'EQUIRECTANGULAR'"),
        (top(camera_model="EQUIRECTANGULAR"), "camera_model"),
        (top(k4=0.1), "k4 is not a parameter of OPENCV"),
        (top(camera_model="OPENCV_FISHEYE", p1=0.1), "p1 is not a parameter of OPENCV_FISHEYE"),
        (top(k2="a"), "k2 must be a finite number"),
        (top(frames=[]), "frames"),
        (top(frames={}), "frames"),
        (top(frames=[3]), r"frames\[0\]"),
        (top(fl_x=-5), "fx"),
        (top(fl_x="7"), "fx"),
        (top(h=10**12), "height"),
        (top(h=4.5), "height"),
        (top(applied_scale=2), "applied_scale"),
        (top(applied_transform=[[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0]]), "applied_transform"),
        (top(applied_transform=3), "applied_transform"),
        (top(holoreel={"version": 99}), "version"),
        (top(holoreel=3), "version"),
        (top(test_filenames="a"), "test_filenames"),
        (lambda meta: meta.pop("h"), r"frames\[0\]: h is missing"),
        (lambda meta: meta["holoreel"].update(frame_count=2), "time of .* must be 1/2"),
        (lambda meta: meta["holoreel"].update(frame_count=10**15), "frame_count"),
        (lambda meta: meta["holoreel"].update(fps=0), "fps"),
        (lambda meta: meta["holoreel"].update(fps="a"), "fps"),
        (lambda meta: meta["holoreel"].update(frame_start=None), "frame_start"),
        (lambda meta: meta["holoreel"].update(seeds=["a"]), "seeds"),
        (lambda meta: meta["frames"].append(meta["frames"][0]), "second picture"),
        (set_pose([[math.nan] * 4] * 4), r"frames\[4\]\.transform_matrix"),
        (set_pose(np.diag([1, 2, 1, 1]).tolist()), r"frames\[4\]\.transform_matrix"),
        (set_pose(np.diag([1, 1, -1, 1]).tolist()), r"frames\[4\]\.transform_matrix"),
        (set_pose(np.diag([2, 2, 2, 1]).tolist()), r"frames\[4\]\.transform_matrix"),
        (set_pose([[1, 2], [3]]), r"frames\[4\]\.transform_matrix"),
        (set_pose("x"), r"frames\[4\]\.transform_matrix"),
        (set_pose(np.eye(4).tolist()), "another pose"),
        (drop("transform_matrix"), r"frames\[4\]\.transform_matrix"),
        (drop("file_path"), r"frames\[4\]\.file_path"),
        (drop("time"), "time"),
        (entry(time=0.9), "time"),
        (entry(time=math.inf), "time"),
        (entry(file_path="../../nothing.png"), "nothing.png missing"),
        (entry(camera_model="FISHEYE"), "camera_model"),
        (entry(p1=math.nan), "p1"),
    ],
)
def test_lying_files_are_refused(
    tmp_path: Path, capture: Capture, change: Callable[[dict[str, Any]], None], message: str
) -> None:
    path = edited(write_capture(tmp_path, capture), change)
    with pytest.raises(HoloreelError, match=message) as error:
        read_capture(path)
    assert "transforms.json" in str(error.value)
    assert "\n" not in str(error.value)


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The paths of everything inside a JSON value."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [*([path] if path else []), *(place for key, item in inner for place in places(item, (*path, key)))]


STRANGE = [
    None, True, -1, 0, 10**400, 1e308, math.nan, math.inf, "", "a" * 5000, "\0", "..", [], {}, [[]], [None], {"a": 1},
    [[0] * 4] * 4, {"version": 1}, ["a"] * 3,
]  # fmt: skip


def test_no_value_anywhere_causes_a_traceback(tmp_path: Path, capture: Capture) -> None:
    """Every value of a file replaced by every strange one, or taken out: a capture or one sentence, nothing else."""
    text = write_capture(tmp_path, capture).read_text()
    everywhere = [place for place in places(json.loads(text)) if not (place[0] == "frames" and place[1:2] > (1,))]
    refused = 0
    for place in everywhere:
        for strange in [*STRANGE, "take out"]:
            meta = json.loads(text)
            inner = meta
            for key in place[:-1]:
                inner = inner[key]
            if strange == "take out":
                del inner[place[-1]]
            else:
                inner[place[-1]] = strange
            (tmp_path / "transforms.json").write_text(json.dumps(meta))
            try:
                read_capture(tmp_path)
            except HoloreelError as error:
                refused += "transforms.json" in str(error)
    assert refused > len(everywhere) * len(STRANGE) / 2


def test_foreign_times_that_cannot_be_frames(tmp_path: Path, capture: Capture) -> None:
    path = edited(write_capture(tmp_path, capture), foreign)
    with pytest.raises(HoloreelError, match="time is missing"):
        read_capture(edited(path, lambda meta: [frame.pop("time") for frame in meta["frames"]]))
    path = edited(write_capture(tmp_path, capture), foreign)
    with pytest.raises(HoloreelError, match="evenly spaced"):
        read_capture(edited(path, entry(time=0.05)))


def test_contradicting_parts_are_refused(capture: Capture) -> None:
    for values in (
        {"cameras": {}}, {"frame_count": 0}, {"frame_count": 10**9}, {"fps": math.nan}, {"frame_count": 2},
        {"splits": {"left": "validation"}}, {"splits": {"nobody": "test"}}, {"seeds": {7: Path("a")}},
    ):  # fmt: skip
        parts = {"cameras": capture.cameras, "images": capture.images, "frame_count": FRAMES} | values
        with pytest.raises(HoloreelError):
            Capture(**parts)


def test_points_without_positions_or_with_nan(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    write_points(path, Points(np.float32([[math.nan, 0, 0]]), np.uint8([[0, 0, 0]])))
    with pytest.raises(HoloreelError, match="NaN"):
        read_points(path)
    path.write_bytes(path.read_bytes().replace(b"float x", b"float a"))
    with pytest.raises(HoloreelError, match="'x' is missing"):
        read_points(path)
