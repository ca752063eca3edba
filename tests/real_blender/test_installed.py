# SPDX-License-Identifier: GPL-3.0-or-later
"""The built extension in a real Blender: installed into an empty profile, used, commanded, rendered, taken out again.

`make test-blender BLENDER=/path/to/blender` runs these; without it they are skipped.
"""

import json
import os
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from holoreel.core.capture.images import load_picture
from holoreel.core.gaussians.model import SpacetimeGaussians
from holoreel.core.reel import save_gaussians

ROOT = Path(__file__).resolve().parents[2]
INSIDE = Path(__file__).with_name("inside.py")
PATIENCE_SECONDS = 600

Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def executable() -> str:
    """The Blender to test with."""
    if not os.environ.get("BLENDER"):
        pytest.skip("no Blender was given: make test-blender BLENDER=/path")
    return os.environ["BLENDER"]


@pytest.fixture(scope="module")
def package() -> Path:
    """The zip that `make extension` has built."""
    (found,) = sorted(ROOT.glob("dist/holoreel-*.zip"))
    return found


@pytest.fixture(scope="module")
def blender(executable: str, package: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """`blender(*arguments)` runs Blender with a profile of its own, where the extension is installed and enabled."""
    profile = tmp_path_factory.mktemp("profile")

    def run(*arguments: str | Path, status: int = 0, **variables: str) -> subprocess.CompletedProcess[str]:
        environment = {**os.environ, "BLENDER_USER_RESOURCES": str(profile), **variables}
        done = subprocess.run(
            [executable, *map(str, arguments)], env=environment, capture_output=True, text=True,
            timeout=PATIENCE_SECONDS, check=False,
        )  # fmt: skip
        assert done.returncode == status, done.stdout + done.stderr
        assert "Traceback" not in done.stderr + done.stdout, done.stdout + done.stderr
        return done

    run("--command", "extension", "validate", package)
    run("--command", "extension", "install-file", "--repo", "user_default", "--enable", package)
    return run


@pytest.fixture(scope="module")
def reel(tmp_path_factory: pytest.TempPathFactory, random_model: Callable[..., SpacetimeGaussians]) -> Path:
    """A reel of ten frames."""
    path = tmp_path_factory.mktemp("reel") / "walk.reel"
    save_gaussians(path, random_model(80), fps=24, frame_start=5, frame_count=10)
    return path


def size_of(png: Path) -> tuple[int, int]:
    """Read width and height of a PNG."""
    head = png.read_bytes()[:24]
    assert head[:4] == b"\x89PNG"
    return struct.unpack(">II", head[16:24])


def test_operators_work_and_nothing_stays_behind(blender: Run, reel: Path, tmp_path: Path) -> None:
    picture = tmp_path / "picture.png"
    done = blender("--background", "--python-exit-code", "1", "--python", INSIDE, "--", reel, picture)
    assert "all is well" in done.stdout
    assert size_of(picture) == (48, 32)


def test_commands(blender: Run, reel: Path, tmp_path: Path) -> None:
    scene = tmp_path / "scene.blend"
    command = ("--background", "--command", "holoreel")
    assert "usage: holoreel COMMAND" in blender(*command, "--help").stdout
    assert "--set-scene-timing" in blender(*command, "import", "--help").stdout
    save = f"import bpy; bpy.ops.wm.save_as_mainfile(filepath={str(tmp_path / 'stage.blend')!r})"
    blender("--background", "--factory-startup", "--python-exit-code", "1", "--python-expr", save)
    words = ["--into", tmp_path / "stage.blend", "--set-scene-timing", "--look", "points"]
    blender(*command, "import", reel, "--out", scene, *words)
    blender("--background", scene, "--render-output", tmp_path / "saved-####", "--render-frame", "7")
    assert (tmp_path / "saved-0007.png").is_file()
    absent = blender(*command, "import", tmp_path / "absent.reel", "--out", scene, status=2)
    assert "absent.reel" in absent.stderr + absent.stdout


def test_the_engine_renders_an_animation(blender: Run, reel: Path, tmp_path: Path) -> None:
    """As a render farm would call it; the worker runs in $HOLOREEL_PYTHON, or else in this very environment."""
    python = os.environ.get("HOLOREEL_PYTHON", sys.executable)
    seen = blender("--background", "--python-expr", f"import os; print('seen:', os.access({python!r}, os.X_OK))")
    if "seen: True" not in seen.stdout:  # it may live in a room of its own
        pytest.skip(f"this Blender cannot see {python}")
    scene = tmp_path / "scene.blend"
    blender("--background", "--command", "holoreel", "import", reel, "--out", scene, "--set-scene-timing")
    prepare = f"""
import bpy
scene = bpy.context.scene
camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
camera.rotation_euler = (3.141592653589793, 0.0, 0.0)
scene.collection.objects.link(camera)
scene.camera = camera
bpy.ops.holoreel.setup_engine()
scene.render.resolution_x, scene.render.resolution_y = 48, 32
bpy.ops.wm.save_as_mainfile(filepath={str(scene)!r})
"""
    blender("--background", scene, "--python-exit-code", "1", "--python-expr", prepare)
    frames = ["--render-output", tmp_path / "frame-####", "--frame-start", "6", "--frame-end", "7", "--render-anim"]
    blender("--background", scene, *frames, HOLOREEL_PYTHON=python)
    pictures = [load_picture(tmp_path / f"frame-000{frame}.png")[..., :3] for frame in (6, 7)]
    assert all(picture.shape == (32, 48, 3) and picture.max() > 30 for picture in pictures)
    assert np.abs(np.subtract(*pictures, dtype=int)).max() > 2
    failed = blender("--background", scene, *frames, HOLOREEL_PYTHON="/none", status=1)
    assert "/none" in failed.stderr + failed.stdout


def test_command_render(blender: Run, reel: Path, tmp_path: Path) -> None:
    pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    camera = {"model": "PINHOLE", "width": 40, "height": 24, "fx": 30, "fy": 30, "cx": 20, "cy": 12}
    (tmp_path / "camera.json").write_text(json.dumps(camera | {"world_to_camera": pose}))
    out = tmp_path / "picture.png"
    words = ["render", reel, "--engine", "cycles", "--camera", tmp_path / "camera.json", "--frame", "7", "--out", out]
    blender("--background", "--command", "holoreel", *words)
    assert size_of(out) == (40, 24)


def test_command_passes_on_what_blender_cannot_do(blender: Run, tmp_path: Path) -> None:
    python, heard = tmp_path / "python", tmp_path / "heard"
    python.write_text(f'#!/bin/sh\n[ "$2" = -c ] && exit 0\nprintf "%s\\n" "$@" >"{heard}"\nexit 3\n')
    python.chmod(0o755)
    words = ["train", "stg", "capture", "--out", "x"]
    blender("--background", "--command", "holoreel", *words, status=3, HOLOREEL_PYTHON=str(python))
    assert heard.read_text().split() == ["-I", "-m", "holoreel.core", *words]
    missing = blender("--background", "--command", "holoreel", "info", "x", status=2, HOLOREEL_PYTHON="/none")
    assert "/none" in missing.stderr + missing.stdout
