# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line from inside Blender: what Blender does itself, and what it passes on."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import bpy
import pytest
from holoreel.addon import commands, compat, reels
from holoreel.core.gaussians.model import SpacetimeGaussians
from holoreel.core.reel import save_gaussians
from mathutils import Vector


@pytest.fixture
def reel(random_model: Callable[..., SpacetimeGaussians], tmp_path: Path) -> Path:
    """A reel of ten frames from 5."""
    save_gaussians(tmp_path / "walk.reel", random_model(60), fps=24, frame_start=5, frame_count=10)
    return tmp_path / "walk.reel"


@pytest.fixture
def listener(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A core environment that writes down what it was asked, and ends with status 3."""
    if os.name == "nt":
        pytest.skip("the stand-in is a shell script")
    heard = tmp_path / "heard.json"
    python = tmp_path / "python"
    python.write_text(
        f'#!/bin/sh\n[ "$2" = -c ] && exit 0\nprintf "%s\\n" "$HOLOREEL_BLENDER" "$@" >"{heard}"\nexit 3\n'
    )
    python.chmod(0o755)
    monkeypatch.setenv("HOLOREEL_PYTHON", str(python))
    return heard


def test_import_saves_a_scene_that_plays(reel: Path, tmp_path: Path) -> None:
    out = tmp_path / "new" / "scene.blend"
    words = ["--look", "points", "--color", "display-referred", "--up=-Y", "--scale", "2", "--set-scene-timing"]
    assert commands.run(["import", str(reel), str(reel), "--out", str(out), *words]) == 0
    bpy.ops.wm.open_mainfile(filepath=str(out))
    assert [o.name for o in bpy.data.objects] == ["walk", "walk.001"]
    modifier = reels.modifier_of(bpy.data.objects["walk"])
    assert compat.get_input(modifier, "Look") == "Points"
    assert compat.get_input(modifier, "Color") == "Display-Referred (Exact)"
    assert (bpy.context.scene.frame_start, bpy.context.scene.frame_end) == (5, 14)
    turned = bpy.data.objects["walk"].matrix_world @ Vector((0.0, -1.0, 0.0))
    assert tuple(turned) == pytest.approx((0.0, 0.0, 2.0), abs=1e-6)


def test_import_adds_to_a_scene(reel: Path, tmp_path: Path) -> None:
    bpy.context.collection.objects.link(bpy.data.objects.new("Here First", None))
    bpy.context.scene.frame_end = 77
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "old.blend"))
    out = tmp_path / "both.blend"
    assert commands.run(["import", str(reel), "--into", str(tmp_path / "old.blend"), "--out", str(out)]) == 0
    bpy.ops.wm.open_mainfile(filepath=str(out))
    assert {o.name for o in bpy.data.objects} == {"Here First", "walk"}
    assert bpy.context.scene.frame_end == 77


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["import", "{absent}", "--out", "{out}.blend"], "absent"),
        (["import", "{reel}", "--out", "{out}.reel"], "saved as a .blend"),
        (["import", "{reel}", "--into", "{absent}", "--out", "{out}.blend"], "--into"),
        (["import", "{reel}", "--out", "{reel}/x.blend"], "cannot be written"),
        (["import", "{reel}", "--out", "{out}.blend", "--detail", "0"], "--detail"),
        (["import", "{reel}"], "--out"),
        (["render", "{reel}", "--engine", "cycles", "--out", "{out}.png", "--camera", "{absent}"], "say when"),
        (["render", "{reel}", "--engine", "cycles", "--out", "{out}.png", "--camera", "{absent}", "--time=0"], "abs"),
        (["render", "{reel}", "--engine", "workbench", "--out", "{out}.png"], "--engine"),
        (["render", "{reel}", "--engine=eevee", "--out", "o.png", "--camera", "c", "--background", "2,0,0"], "0 to 1"),
        (["render", "{reel}", "--engine=eevee", "--out", "o", "--cameras", "{absent}"], "absent"),
    ],
)
def test_mistakes_are_told_in_one_sentence(
    arguments: list[str], sentence: str, reel: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    names = {"reel": reel, "out": tmp_path / "out", "absent": tmp_path / "absent"}
    assert commands.run([word.format(**names) for word in arguments]) == 2
    said = capfd.readouterr().err
    assert sentence in said
    assert "Traceback" not in said
    assert not list(tmp_path.glob("out*"))


def test_what_blender_cannot_do_is_passed_on(listener: Path) -> None:
    for arguments in (["train", "stg", "a b", "--out", "x"], ["synth"], ["render", "a.reel", "--time", "0"], ["info"]):
        assert commands.run(arguments) == 3
        blender, *heard = listener.read_text().splitlines()
        assert heard == ["-I", "-m", "holoreel.core", *arguments]
        assert Path(blender) == Path(bpy.app.binary_path or sys.executable)


def test_without_a_core_environment_it_says_what_to_do(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("HOLOREEL_PYTHON", str(tmp_path / "none"))
    assert commands.run(["train", "stg"]) == 2
    assert "HOLOREEL_PYTHON" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("script", "said"), [("echo 'it has another version.' >&2; exit 1", "another"), ("exit 7", "7")]
)
def test_an_environment_of_another_version_is_refused(
    script: str, said: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    python = tmp_path / "python"
    python.write_text(f"#!/bin/sh\n{script}\n")
    python.chmod(0o755)
    monkeypatch.setenv("HOLOREEL_PYTHON", str(python))
    assert commands.run(["info", "x"]) == 2
    sentence = capfd.readouterr().err.strip()
    assert said in sentence
    assert "\n" not in sentence


def test_help_names_what_there_is(capfd: pytest.CaptureFixture[str]) -> None:
    assert commands.run(["--help"]) == 0
    assert commands.run([]) == 2
    assert commands.run(["import", "--help"]) == 0
    assert commands.run(["render", "--engine", "cycles", "--help"]) == 0
    said = capfd.readouterr().out
    assert all(word in said for word in ("train", "synth", "--set-scene-timing", "--background", "CAMERA.json"))


def test_runner_draws_with_cycles(reel: Path, tmp_path: Path) -> None:
    pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    camera = {"model": "PINHOLE", "width": 24, "height": 16, "fx": 20, "fy": 20, "cx": 12, "cy": 8}
    (tmp_path / "camera.json").write_text(json.dumps(camera | {"world_to_camera": pose}))
    out = tmp_path / "frames" / "picture.png"
    words = ["render", reel, "--engine", "cycles", "--camera", tmp_path / "camera.json", "--frame", "7", "--out", out]
    command = [sys.executable, "-m", "holoreel.addon", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.strip().splitlines()[-1] == str(out)
    assert [file.name for file in out.parent.iterdir()] == ["picture.png"]
    image = bpy.data.images.load(str(out))
    assert tuple(image.size) == (24, 16)
    assert max(image.pixels) > 0.05
