# SPDX-License-Identifier: GPL-3.0-or-later
"""Synthesis end to end: a real Blender in a child process, and what a capture must then be true to."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
from holoreel.core.blender import Blender, find_blender, run_in_blender
from holoreel.core.capture import Capture, read_capture
from holoreel.core.cli import main
from holoreel.core.cli.synth import parse_frames, parse_size
from holoreel.core.errors import HoloreelError
from holoreel.core.rig import RigRequest
from holoreel.core.synth import SynthJob, synthesize

HELPERS = "holoreel.tests.core.blender_scene"
MARKS = {"red": (-0.8, 0.1, 0.6), "green": (0.7, -0.3, 1.1), "blue": (0.1, 0.5, 0.25)}  # as in blender_scene.py
RED_STEP = 0.4


@pytest.fixture(scope="module")
def blender() -> Blender:
    try:
        return find_blender()
    except HoloreelError:
        pytest.skip("no Blender")


@pytest.fixture(scope="module")
def scene(blender: Blender, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scene")
    run_in_blender(blender, f"{HELPERS}:build", {"path": str(folder / "marks.blend")}, log=folder / "log")
    return folder / "marks.blend"


@pytest.fixture(scope="module")
def job(scene: Path) -> SynthJob:
    rig = RigRequest(cameras=3, width=120, height=80, span_degrees=40)
    return SynthJob(scene, rig, (3, 4), samples=12, denoise=False, depth=True, seed_points=300)


@pytest.fixture(scope="module")
def made(blender: Blender, job: SynthJob, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The capture that most tests look at; copied where one changes it."""
    out = tmp_path_factory.mktemp("capture") / "out"
    seen: list[tuple[int, int]] = []
    result = synthesize(job, out, lambda: blender, on_progress=lambda *counts: seen.append(counts))
    assert seen == [(done, 6) for done in range(7)]
    assert (result.rendered, result.warnings) == (6, [])
    assert not (out / ".work").exists()
    return out


@pytest.fixture(scope="module", params=[".venv-bpy45", ".venv-bpy52"])
def capture(request: pytest.FixtureRequest, job: SynthJob, tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """The same job by each supported Blender."""
    environment = Path(__file__).parents[2] / request.param
    if not environment.is_dir():
        pytest.skip(f"no {request.param}")
    out = tmp_path_factory.mktemp("capture")
    synthesize(job, out, lambda: find_blender(environment))
    return read_capture(out)


def test_capture_is_whole(capture: Capture) -> None:
    assert list(capture.cameras) == ["cam00", "cam01", "cam02"]
    assert (capture.frame_count, capture.frame_start, capture.fps) == (2, 3, 25.0)
    assert capture.camera_names("test") == ["cam00"]
    assert len(capture.views()) == 6
    assert capture.images["cam02", 1].parts[-3:] == ("images", "cam02", "000004.png")
    assert all(camera.width == 120 for camera in capture.cameras.values())
    target = [camera.project([(0, 0, 0.5)])[0][0] for camera in capture.cameras.values()]
    assert np.allclose(target, (60, 40), atol=1e-4)  # all aim at the object called Holoreel Target
    assert np.allclose(capture.cameras["cam00"].center, (0.3, -4, 2), atol=1e-5)  # where the scene's camera is


def test_marks_land_where_the_cameras_say(capture: Capture) -> None:
    """The centroid of each mark's light is where its middle projects to; the red one moves by the frame."""
    for name, frame in capture.views():
        linear = (capture.image(name, frame) / 255.0) ** 2.2
        for channel, (mark, place) in enumerate(MARKS.items()):
            x, y, z = place
            place = (x + RED_STEP * (frame + 2), y, z) if mark == "red" else place
            uv, _ = capture.cameras[name].project([place])
            light = linear[..., channel] - linear.mean(axis=2)
            light[light < 0.02] = 0
            v, u = np.mgrid[:80, :120] + 0.5
            centroid = [(light * u).sum() / light.sum(), (light * v).sum() / light.sum()]
            assert np.abs(centroid - uv[0]).max() <= 0.5, (name, frame, mark)


def test_depth_is_planar_and_exact(capture: Capture) -> None:
    """Every pixel that sees the floor comes back to z = 0, whatever its distance from the middle."""
    for name, frame in capture.views():
        camera = capture.cameras[name]
        depth = capture.depth(name, frame)
        picture = capture.image(name, frame).astype(int)
        floor = (np.ptp(picture, axis=2) <= 1) & (picture[..., 0] > 10) & np.isfinite(depth)
        assert floor.mean() > 0.5
        v, u = np.nonzero(floor)
        points = camera.unproject(np.stack([u + 0.5, v + 0.5], 1), depth[v, u])
        away = np.abs(points[:, 2]) / depth[v, u]
        assert np.median(away) < 1e-5
        assert np.quantile(away, 0.99) < 1e-4


def test_seeds_lie_on_surfaces_and_come_from_training_cameras(capture: Capture) -> None:
    for frame in range(2):
        seeds = capture.seed_points(frame)
        assert len(seeds) == 300
        seen = []
        for camera in capture.cameras.values():
            uv, z = camera.project(seeds.xyz)
            seen.append(np.abs((uv - 0.5) - np.round(uv - 0.5)).max(axis=1) < 1e-2)
        assert (seen[1] | seen[2]).all()  # each is the center of a training camera's pixel
        assert seen[0].mean() < 0.1
        distances = [np.abs(seeds.xyz[:, 2])]
        for mark, (x, y, z) in MARKS.items():
            place = (x + RED_STEP * (frame + 2) * (mark == "red"), y, z)
            distances.append(np.abs(np.linalg.norm(seeds.xyz - np.float32(place), axis=1) - 0.06))
        assert np.min(distances, axis=0).max() < 0.01


def test_look_is_standard(capture: Capture) -> None:
    """0.02 linear is 38.6/255 through the sRGB curve, whatever view transform the scene had; no dither, no blur."""
    picture = capture.image("cam00", 0)
    assert np.abs(np.median(picture.reshape(-1, 3), axis=0) - 39).max() <= 1
    corner = picture[60:, :20].reshape(-1, 3)
    assert np.ptp(corner, axis=0).max() == 0


def test_repeating_renders_nothing(made: Path, job: SynthJob) -> None:
    def no_blender() -> Blender:
        raise AssertionError("there is nothing to render")

    before = (made / "transforms.json").read_text()
    (made / "transforms.json").unlink()
    assert synthesize(job, made, no_blender).rendered == 0
    assert (made / "transforms.json").read_text() == before


def test_broken_and_missing_views_are_rendered_again(
    made: Path, job: SynthJob, blender: Blender, tmp_path: Path
) -> None:
    out = tmp_path / "copy"
    shutil.copytree(made, out)
    (out / "images/cam01/000003.png").unlink()
    picture = out / "images/cam02/000004.png"
    picture.write_bytes(picture.read_bytes()[:100])
    kept = (out / "images/cam00/000003.png").stat().st_mtime_ns
    assert synthesize(job, out, lambda: blender).rendered == 2
    assert (out / "images/cam00/000003.png").stat().st_mtime_ns == kept
    for path in made.rglob("*.png"):
        assert np.array_equal(imageio.imread(path), imageio.imread(out / path.relative_to(made)))


def test_another_job_is_refused_unless_told(made: Path, job: SynthJob, blender: Blender, tmp_path: Path) -> None:
    out = tmp_path / "copy"
    shutil.copytree(made, out)
    with pytest.raises(HoloreelError, match=r"samples was 12, is 2.*--overwrite"):
        synthesize(replace(job, samples=2), out, lambda: blender)
    with pytest.raises(HoloreelError, match=r"span_degrees was 40"):
        synthesize(replace(job, rig=replace(job.rig, span_degrees=30)), out, lambda: blender)
    small = replace(
        job, rig=RigRequest(1, 16, 16), frames=(3, 3), samples=1, holdout=(), film="transparent", depth=False
    )
    assert synthesize(small, out, lambda: blender, overwrite=True).rendered == 1
    back = read_capture(out)
    assert back.views() == [("cam00", 0)]
    assert back.image("cam00", 0).shape == (16, 16, 4)
    assert len(list(out.rglob("*.png"))) == 1
    assert not list(out.rglob("*.exr"))


def command(job: SynthJob, out: Path) -> list[str]:
    rig = job.rig
    return [
        "synth", str(job.scene), "--out", str(out), "--frames", f"{job.frames[0]}:{job.frames[1]}",
        "--cameras", str(rig.cameras), "--size", f"{rig.width}x{rig.height}", "--samples", str(job.samples),
        "--span", str(rig.span_degrees), "--depth", "--no-denoise", "--seed-points", str(job.seed_points),
    ]  # fmt: skip


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_killed_in_the_middle_and_resumed(
    made: Path, job: SynthJob, blender: Blender, tmp_path: Path, how: signal.Signals
) -> None:
    """What was rendered stays, nothing else runs on, the rest follows, and the result is the same to the bit."""
    out = tmp_path / "out"
    code = "import sys; from holoreel.core.cli import main; sys.exit(main(sys.argv[1:]))"
    environment = os.environ | {"HOLOREEL_BLENDER": str(blender.path)}
    process = subprocess.Popen(
        [sys.executable, "-c", code, *command(job, out)],
        stderr=subprocess.DEVNULL,
        env=environment,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),  # a background job ignores it
    )
    while len(list(out.glob("images/cam*/??????.png"))) < 2:
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(how)
    assert process.wait(20) in (130, -signal.SIGKILL)
    assert not (out / "transforms.json").exists()
    result = None
    for _ in range(100):  # Blender holds the lock as long as it lives
        with suppress(HoloreelError):
            result = synthesize(job, out, lambda: blender)
            break
        time.sleep(0.1)
    assert result
    assert 0 < result.rendered <= 4
    for path in [*made.rglob("*.png"), *made.rglob("*.ply"), *made.rglob("*.exr")]:
        assert path.read_bytes() == (out / path.relative_to(made)).read_bytes() or path.suffix == ".png"
        if path.suffix == ".png":
            assert np.array_equal(imageio.imread(path), imageio.imread(out / path.relative_to(made)))
    assert json.loads((made / "transforms.json").read_text()) == json.loads((out / "transforms.json").read_text())


def test_cameras_that_see_nothing_are_named(job: SynthJob, blender: Blender, tmp_path: Path) -> None:
    rig = RigRequest(2, 16, 16, target=(0, 0, 30), radius=1, fov_degrees=20, elevation_degrees=0)
    blind = replace(job, rig=rig, frames=(3, 3), samples=1, seed_points=0, depth=False)
    result = synthesize(blind, tmp_path, lambda: blender)
    assert result.warnings == ["cam00 sees a single color at frame 3", "cam01 sees a single color at frame 3"]


def test_two_at_once_are_refused(job: SynthJob, blender: Blender, tmp_path: Path) -> None:
    def second() -> Blender:
        with pytest.raises(HoloreelError, match="being rendered by another process"):
            synthesize(job, tmp_path, lambda: blender)
        raise HoloreelError("enough")

    with pytest.raises(HoloreelError, match="enough"):
        synthesize(job, tmp_path, second)


def test_command_line_refuses(
    job: SynthJob, made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    garbage = tmp_path / "garbage.blend"
    garbage.write_bytes(b"no blend file")
    good = command(job, tmp_path / "out")

    def refusal(*extra: str, scene: Path = job.scene, out: Path = tmp_path / "out") -> str:
        arguments = ["synth", str(scene), "--out", str(out), *good[4:], *extra]
        assert main(arguments) == 2
        return capsys.readouterr().err

    assert "garbage.blend cannot be opened" in refusal(scene=garbage)
    assert "nothing.blend is not there" in refusal(scene=tmp_path / "nothing.blend")
    assert "--size" in refusal("--size", "320")
    assert "--size" in refusal("--size", "0x0")
    assert "--frames" in refusal("--frames", "a")
    assert "--frames" in refusal("--frames", "5:3")
    assert "--holdout 3" in refusal("--holdout", "3")
    assert "no camera to train" in refusal("--holdout", "0", "1", "2")
    assert "--samples" in refusal("--samples", "0")
    assert "no Blender at" in refusal("--blender", str(tmp_path / "nothing"))
    assert "cannot be written" in refusal(out=garbage / "below")
    monkeypatch.setenv("HOLOREEL_BLENDER", sys.executable)
    assert "has no bpy" in refusal()
    stranger = tmp_path / "stranger"
    (stranger / "images").mkdir(parents=True)
    assert "already holds images" in refusal(out=stranger)


def test_parsing() -> None:
    assert parse_size("320x180") == (320, 180)
    assert parse_frames("1:12") == (1, 12)
    assert parse_frames("7") == (7, 7)
    for wrong in ("", "1:", "1:2:3", "-1:3", "1.5"):
        with pytest.raises(HoloreelError, match="--frames"):
            parse_frames(wrong)
