# SPDX-License-Identifier: GPL-3.0-or-later
"""`holoreel render`: the right picture at the right place, or one sentence and nothing on disk."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from holoreel.core.camera import Camera
from holoreel.core.cli import main
from holoreel.core.draw import open_player
from holoreel.core.gaussians.model import SpacetimeGaussians
from holoreel.core.images import read_exr, read_image
from holoreel.core.reel import Segment, read_reel, save_gaussians, write_reel


def render(*arguments: object) -> int:
    return main(["render", *(str(argument) for argument in arguments), "--backend", "reference"])


def test_one_picture_is_the_one_the_capture_has(recording, tmp_path, capsys):
    for index, frame in enumerate((101, 102, 103)):
        out = tmp_path / "new" / f"{frame}.png"
        assert render(recording.reel, "--camera", recording.camera, "--frame", frame, "--out", out) == 0
        assert str(out) in capsys.readouterr().out
        truth = read_image(recording.folder / "pictures" / "left" / f"0{frame}.png")
        np.testing.assert_array_equal(read_image(out), truth)
        timed = tmp_path / "timed.png"
        assert render(recording.reel, "--camera", recording.camera, "--time", index / 3, "--out", timed) == 0
        np.testing.assert_array_equal(read_image(timed), truth)


def test_exr_has_floats_alpha_and_depth(recording, tmp_path):
    out = tmp_path / "a.exr"
    look = ("--camera", recording.camera, "--frame", 102.5, "--out", out)
    assert render(recording.reel, *look, "--background", "0,0,0") == 0
    drawing = open_player(recording.reel, "reference").draw(recording.cameras["left"], 102.5, (0.0, 0.0, 0.0))
    image, depth = read_exr(out)
    np.testing.assert_array_equal(image[:, :, :3], drawing.image)
    np.testing.assert_array_equal(image[:, :, 3], drawing.alpha)
    np.testing.assert_array_equal(depth, drawing.depth)
    assert render(recording.reel, *look, "--background", "1,0.5,0") == 0
    lit = image[:, :, :3] + (1 - image[:, :, 3:]) * np.array([1, 0.5, 0])
    np.testing.assert_allclose(read_exr(out)[0][:, :, :3], lit, atol=1e-5)


def test_a_capture_gives_every_camera_and_frame(recording, tmp_path):
    assert render(recording.reel, "--cameras", recording.capture, "--out", tmp_path) == 0
    made = sorted(path.relative_to(tmp_path) for path in tmp_path.rglob("*.png"))
    truth = recording.folder / "pictures"
    assert made == sorted(path.relative_to(truth) for path in truth.rglob("*.png"))
    assert len(made) == 6
    for path in made:
        np.testing.assert_array_equal(read_image(tmp_path / path), read_image(truth / path), err_msg=str(path))


def test_a_split_at_one_time(recording, tmp_path):
    arguments = ("--cameras", recording.folder, "--split", "test", "--time", 0.5, "--format", "exr", "--out", tmp_path)
    assert render(recording.reel, *arguments) == 0
    assert [path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.exr")] == ["right/102.5.exr"]


def test_bare_files_follow_the_captures_times(recording, tmp_path):
    assert render(recording.reel.with_suffix(".ply"), "--cameras", recording.capture, "--background", "0.25,0.5,0.75",
                  "--out", tmp_path) == 0  # fmt: skip
    for name in ("left/0101.png", "right/0103.png"):
        np.testing.assert_array_equal(read_image(tmp_path / name), read_image(recording.folder / "pictures" / name))


def test_frames_find_their_segment(tmp_path):
    """A Gaussian that crosses the picture once in each of two segments, from left and from above."""
    still = np.zeros((1, 3, 3))
    across, down = still.copy(), still.copy()
    across[0, 0, 0], down[0, 0, 1] = 2.0, 2.0
    for name, motion in (("a", across), ("b", down)):
        model = SpacetimeGaussians(
            [[0, 0, 4.0]], motion, [[1, 0, 0, 0]], np.zeros((1, 4)), np.full((1, 3), np.log(0.2)), [9.0],
            [[1, 1, 1]], [0.5], [10.0],
        )  # fmt: skip
        save_gaussians(tmp_path / f"{name}.reel", model, fps=24, frame_start=11, frame_count=4)
    reel = replace(read_reel(tmp_path / "a.reel"), segments=(Segment("a.ply", 11, 4), Segment("b.ply", 15, 4)),
                   frame_count=8)  # fmt: skip
    write_reel(reel)
    player = open_player(tmp_path / "a.reel", "reference")
    camera = Camera(64, 48, 60.0, 60.0, 32.0, 24.0)
    for frame in (11, 12, 13.5, 15, 17, 18, 12):
        alpha = player.draw(camera, frame).alpha
        v, u = np.mgrid[:48, :64] + 0.5
        center = (u * alpha).sum() / alpha.sum(), (v * alpha).sum() / alpha.sum()
        dt = (frame - 11) % 4 / 4 - 0.5
        x, y = (2 * dt, 0) if frame < 15 else (0, 2 * dt)
        assert center == pytest.approx((32 + 60 * x / 4, 24 + 60 * y / 4), abs=0.2), frame


@pytest.mark.parametrize("name", ["spinach_4", "coffee10"])
def test_files_made_by_others_give_a_picture(shared_data, tmp_path, name, capsys):
    camera = {"model": "PINHOLE", "width": 64, "height": 48, "fx": 58, "fy": 58, "cx": 32, "cy": 24,
              "world_to_camera": np.eye(4).tolist()}  # fmt: skip
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    out = tmp_path / "a.png"
    path = shared_data(f"stg_splatv/{name}.splatv")
    assert (
        main(["render", str(path), "--camera", str(tmp_path / "camera.json"), "--time", "0.5", "--out", str(out)]) == 0
    )
    assert "50 frames at 30 fps are assumed" in capsys.readouterr().err
    image = read_image(out)
    assert image.std() > 0.05
    if name == "spinach_4":  # light blinds above, dark cook below
        assert image[:20].mean() > image[28:].mean() + 0.1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("REEL --frame 1 --out OUT/a.png", "--camera CAMERA.json or --cameras"),
        ("REEL --camera CAMERA --cameras CAPTURE --frame 1 --out OUT/a.png", "--camera CAMERA.json or --cameras"),
        ("REEL --camera CAMERA --out OUT/a.png", "--time from 0 to 1, or --frame"),
        ("REEL --camera CAMERA --time 0 --frame 1 --out OUT/a.png", "--time from 0 to 1, or --frame"),
        ("REEL --camera CAMERA --time nan --out OUT/a.png", "finite"),
        ("REEL --camera CAMERA --frame 1 --out OUT/a.jpg", ".png or .exr"),
        ("REEL --camera CAMERA --frame 1 --out OUT/a.png --background red", "three numbers"),
        ("REEL --camera CAMERA --frame 1 --out OUT/a.png --background 0,0,2", "three numbers"),
        ("REEL --camera CAMERA --frame 1 --out FILE/a.png", "cannot be written"),
        ("REEL --camera CAMERA --frame 1 --out FILE/a.exr", "cannot be written"),
        ("REEL --camera OUT/none.json --frame 1 --out OUT/a.png", "none.json"),
        ("REEL --camera REEL --frame 1 --out OUT/a.png", "a.reel"),
        ("OUT/none.reel --camera CAMERA --frame 1 --out OUT/a.png", "none.reel"),
        ("CAMERA --camera CAMERA --frame 1 --out OUT/a.png", ".reel, .ply, .stgc or .splatv"),
        ("LATE --cameras CAPTURE --out OUT", "frames 102 to 104"),
    ],
)
def test_mistakes_get_a_sentence_and_leave_nothing(recording, tmp_path, capsys, arguments, words):
    out = tmp_path / "out"
    out.mkdir()
    (tmp_path / "file").write_text("")
    save_gaussians(tmp_path / "late.reel", recording.model, fps=24, frame_start=102, frame_count=3)
    names = {"REEL": recording.reel, "CAMERA": recording.camera, "CAPTURE": recording.capture, "OUT": out,
             "FILE": tmp_path / "file", "LATE": tmp_path / "late.reel"}  # fmt: skip
    for name, path in names.items():
        arguments = re.sub(rf"\b{name}\b", str(path), arguments)
    assert render(*arguments.split()) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert said.startswith("holoreel render: ")
    assert words in said
    assert list(out.rglob("*")) == []
