# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs that render reels and save scenes; a real model in Blender against the rasterizer, across the two processes."""

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy
import holoreel
import numpy as np
import pytest
from holoreel.addon import render as jobs
from holoreel.core.camera import Camera
from holoreel.core.errors import HoloreelError
from holoreel.core.gaussians.model import SpacetimeGaussians
from holoreel.core.reel import save_gaussians
from holoreel.tests.blender import oracle
from numpy.typing import NDArray

Model = Callable[..., SpacetimeGaussians]
CORE_PYTHON = Path(holoreel.__file__).parent / ".venv" / "bin" / "python"


def make_camera(width: int = 64, height: int = 48, focal: float = 60.0, x: float = 0.0) -> Camera:
    """A camera at (x, 0, 0) that looks along +z."""
    pose = np.eye(4)
    pose[0, 3] = -x
    return Camera(width=width, height=height, fx=focal, fy=focal, cx=width / 2 + 3, cy=height / 2, world_to_camera=pose)


def view_of(camera: Camera) -> oracle.View:
    return oracle.View(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, camera.world_to_camera)


def load(path: Path) -> NDArray[np.float32]:
    """Read a picture as it is in the file, top row first."""
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.name = "Non-Color"
    width, height = image.size
    pixels = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(pixels)
    return pixels.reshape(height, width, 4)[::-1]


@pytest.fixture
def reel(random_model: Model, tmp_path: Path) -> tuple[Path, SpacetimeGaussians]:
    """A reel on disk, with frames from 5, and its model."""
    model = random_model(120)
    save_gaussians(tmp_path / "walk.reel", model, fps=24, frame_start=5, frame_count=10)
    return tmp_path / "walk.reel", model


def test_shots_are_what_their_cameras_see_at_their_times(reel: tuple[Path, SpacetimeGaussians], tmp_path: Path) -> None:
    path, model = reel
    cameras, times = [make_camera(), make_camera(80, 40, 70.0, 0.3)], [0.0, 0.137, 1.0]
    wanted = [(camera, time) for camera in cameras for time in times]
    shots = [
        {"camera": camera.to_json(), "time": time, "out": str(tmp_path / f"out/{index}.exr")}
        for index, (camera, time) in enumerate(wanted)
    ]
    events: list[dict[str, Any]] = []
    result = jobs.main({"setting": {"reel": str(path)}, "shots": shots}, events.append)
    assert result["gaussians"] == 120
    assert [event["index"] for event in events] == list(range(6))
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [f"{index}.exr" for index in range(6)]
    for index, (camera, time) in enumerate(wanted):
        truth = oracle.splat(model.evaluate(time), view_of(camera))
        assert oracle.psnr(load(tmp_path / f"out/{index}.exr"), truth) >= 60


def test_png_over_a_background(reel: tuple[Path, SpacetimeGaussians], tmp_path: Path) -> None:
    path, model = reel
    background, camera = [0.2, 0.5, 0.8], make_camera()
    shot = {"camera": camera.to_json(), "time": 0.5, "out": str(tmp_path / "a.png")}
    jobs.main({"setting": {"reel": str(path), "background": background}, "shots": [shot]}, lambda event: None)
    truth = oracle.splat(model.evaluate(0.5), view_of(camera))
    over = truth[..., :3] + (1 - truth[..., 3:]) * background
    picture = load(tmp_path / "a.png")
    np.testing.assert_array_equal(picture[..., 3], 1)
    assert np.abs(picture[..., :3] - over.clip(0, 1)).max() < 1.5 / 255


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"engine": "LUX"}, "engine"),
        ({"look": "Blobs"}, "look"),
        ({"color": "Sepia"}, "color"),
        ({"reel": "no.ply"}, "no.ply"),
    ],
)
def test_bad_settings_are_refused(change: dict[str, str], named: str, reel: tuple[Path, SpacetimeGaussians]) -> None:
    with pytest.raises(HoloreelError, match=named):
        jobs.main({"setting": {"reel": str(reel[0]), **change}, "shots": []}, lambda event: None)


def test_unknown_ending_is_refused(reel: tuple[Path, SpacetimeGaussians], tmp_path: Path) -> None:
    shot = {"camera": make_camera().to_json(), "time": 0.5, "out": str(tmp_path / "a.gif")}
    with pytest.raises(HoloreelError, match="gif"):
        jobs.main({"setting": {"reel": str(reel[0])}, "shots": [shot]}, lambda event: None)


def test_saved_scene_opens_ready_to_play(reel: tuple[Path, SpacetimeGaussians], tmp_path: Path) -> None:
    path, model = reel
    cameras = {frame: make_camera(x=0.1 * frame) for frame in (5, 9, 14)}
    stage = {"out": str(tmp_path / "scene.blend"), "path": [[f, c.to_json()] for f, c in cameras.items()]}
    setting = {"reel": str(path), "background": [0.0, 0.0, 0.0]}
    assert jobs.save_scene({"setting": setting, "stage": stage}, lambda event: None)["bytes"] > 0
    path.with_suffix(".ply").unlink()  # the data is inside the .blend
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "scene.blend"))
    scene = bpy.context.scene
    assert (scene.frame_start, scene.frame_end, scene.frame_current, scene.render.fps) == (5, 14, 5, 24)
    assert len(bpy.data.objects["walk"].data.points) == 120
    spaces = [space for screen in bpy.data.screens for area in screen.areas for space in area.spaces]
    assert {space.shading.type for space in spaces if space.type == "VIEW_3D"} == {"MATERIAL"}
    scene.frame_set(9)
    scene.render.filepath = str(tmp_path / "frame.exr")
    scene.render.image_settings.file_format = "OPEN_EXR"
    bpy.ops.render.render(write_still=True)
    truth = oracle.splat(model.evaluate(0.4), view_of(cameras[9]))
    assert oracle.psnr(load(tmp_path / "frame.exr")[..., :3], truth[..., :3]) >= 55


@pytest.mark.parametrize(("engine", "least"), [("CYCLES", 60), pytest.param("EEVEE", 45, marks=pytest.mark.slow)])
def test_real_model_matches_the_rasterizer(
    engine: str, least: float, shared_data: Callable[[str], Path], tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    if not CORE_PYTHON.exists():
        pytest.skip(".venv is absent: `make setup` makes it")
    if engine == "EEVEE":
        request.getfixturevalue("gpu")
    path = shared_data("stg_splatv/spinach_4.splatv")
    camera = Camera(width=240, height=180, fx=216.0, fy=216.0, cx=120.0, cy=90.0, world_to_camera=np.eye(4))
    (tmp_path / "camera.json").write_text(json.dumps(camera.to_json()))
    command = [CORE_PYTHON, "-m", "holoreel.core", "render", path, "--camera", tmp_path / "camera.json"]
    subprocess.run([*command, "--time", "0.5", "--out", tmp_path / "core.exr"], check=True, capture_output=True)
    shot = {"camera": camera.to_json(), "time": 0.5, "out": str(tmp_path / "blender.exr")}
    jobs.main({"setting": {"reel": str(path), "engine": engine}, "shots": [shot]}, lambda event: None)
    ours, truth = load(tmp_path / "blender.exr")[..., :3], load(tmp_path / "core.exr")[..., :3]
    assert truth.mean() > 0.3
    assert oracle.psnr(ours, truth) >= least
