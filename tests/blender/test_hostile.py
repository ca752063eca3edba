# SPDX-License-Identifier: GPL-3.0-or-later
"""Damaged, lying and incomplete files: each is imported, or refused in one sentence with nothing left half-made."""

import json
import random
import shutil
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import bpy
import holoreel
import numpy as np
import pytest
from holoreel.addon import compat, reels
from holoreel.core.camera import Camera
from holoreel.core.gaussians.model import SpacetimeGaussians
from holoreel.core.gaussians.ply import write_ply
from holoreel.core.gaussians.splatv import write_splatv
from holoreel.core.reel import save_gaussians

Model = Callable[..., SpacetimeGaussians]
FIELD = Path(__file__).parents[1] / "data" / "field"
SHARED = ["coffee10.splatv", "spinach_4.splatv", "yellow_clip2.splatv"]
CAMERA = Camera(width=64, height=48, fx=60.0, fy=60.0, cx=32.0, cy=24.0, world_to_camera=np.eye(4))
FLIPS = 12


@pytest.fixture(autouse=True)
def _registered() -> Iterator[None]:
    holoreel.register()
    yield
    holoreel.unregister()


def inventory() -> dict[str, int]:
    """Count all data-blocks."""
    return {prop.identifier: len(getattr(bpy.data, prop.identifier))
            for prop in bpy.data.bl_rna.properties if prop.type == "COLLECTION"}  # fmt: skip


def attempt(path: Path, *names: str) -> bool:
    """Import; return whether that was done. A refusal is one sentence naming the file or one of `names`."""
    before = inventory()
    try:
        assert bpy.ops.holoreel.import_reel(filepath=str(path)) == {"FINISHED"}
    except RuntimeError as error:
        sentence = str(error).strip()
        assert sentence.startswith("Error: "), sentence
        assert "Traceback" not in sentence, sentence
        assert "\n" not in sentence, sentence
        assert sentence.endswith("."), sentence
        assert any(name in sentence for name in (path.name, *names)), sentence
        assert inventory() == before
        return False
    imported = bpy.context.object
    for frame in (1, 7):
        bpy.context.scene.frame_set(frame)
        assert np.isfinite(positions(imported)).all()
    bpy.data.objects.remove(imported)
    bpy.data.orphans_purge(do_recursive=True)
    assert inventory() == before
    return True


def positions(played: bpy.types.Object) -> np.ndarray:
    """Return the evaluated points' or corners' positions."""
    evaluated = played.evaluated_get(bpy.context.evaluated_depsgraph_get()).evaluated_geometry()
    shown = [part for part in (evaluated.pointcloud, evaluated.mesh) if part is not None]
    found = [np.empty((0, 3), np.float32)]
    for part in shown:
        if "position" in part.attributes:
            data = part.attributes["position"].data
            values = np.empty(3 * len(data), np.float32)
            data.foreach_get("vector", values)
            found.append(values.reshape(-1, 3))
    return np.concatenate(found)


def cuts(whole: bytes) -> Iterator[bytes]:
    """Yield the file cut off at each tenth."""
    for tenth in range(10):
        yield whole[: len(whole) * tenth // 10]


def flips(whole: bytes, head: int, count: int = FLIPS) -> Iterator[bytes]:
    """Yield the file with one byte of its head inverted, at places of one sequence of chance."""
    chance = random.Random(5)
    for _ in range(count):
        place = chance.randrange(min(head, len(whole)))
        yield whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :]


def lies(path: Path) -> Iterator[bytes]:
    """Yield the file with absurd counts."""
    whole = path.read_bytes()
    if path.suffix == ".ply":
        for count in (b"-1", b"0", b"31", b"4294967296", b"9" * 30, b"1e3", b""):
            yield whole.replace(b"element vertex 30", b"element vertex " + count, 1)
    if path.suffix == ".splatv":
        length = struct.unpack("<I", whole[4:8])[0]
        for other in (0, 1, length - 1, length + 1, 0xFFFFFFFF):
            yield whole[:4] + struct.pack("<I", other) + whole[8:]
        chunks = json.loads(whole[8 : 8 + length])
        for key in ("size", "texwidth", "texheight"):
            for value in (-1, 0, 2**31, 10**18, 1e308, "many", None, [], float("nan")):
                text = json.dumps([chunks[0] | {key: value}, *chunks[1:]]).encode()
                yield whole[:4] + struct.pack("<I", len(text)) + text + whole[8 + length :]
    if path.suffix == ".reel":
        manifest = json.loads(whole)
        for key in manifest:
            for value in (-1, 0, 10**18, 1e308, float("nan"), "many", None, [], [{}], {}, "../../../../etc/passwd"):
                yield json.dumps(manifest | {key: value}).encode()


def small_files(folder: Path, random_model: Model) -> dict[str, Path]:
    """Write 30 Gaussians in every kind of file."""
    model = random_model(30)
    write_ply(folder / "a.ply", model)
    write_splatv(folder / "b.splatv", model, CAMERA)
    save_gaussians(folder / "c.reel", model, fps=24, frame_start=1, frame_count=10)
    return {path.suffix: path for path in (folder / "a.ply", folder / "b.splatv", folder / "c.reel")}


@pytest.mark.parametrize("count", [30, pytest.param(1000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("suffix", [".ply", ".splatv", ".reel"])
def test_mutated_small_files(suffix: str, count: int, random_model: Model, tmp_path: Path) -> None:
    path = small_files(tmp_path, random_model)[suffix]
    assert attempt(path)
    whole = path.read_bytes()
    done = []
    mutants = [*cuts(whole), *flips(whole, 400, 40), *lies(path)]
    for mutant in random.Random(3).sample(mutants, min(count, len(mutants))):
        path.write_bytes(mutant)
        done.append(attempt(path, "c.ply"))
    assert not all(done)


def mutate_shared(original: Path, tmp_path: Path, count: int) -> None:
    assert attempt(original)
    copy = tmp_path / original.name
    whole = original.read_bytes()
    head = 8 + struct.unpack("<I", whole[4:8])[0]
    copy.write_bytes(whole)
    refused = 0
    for mutant in (*cuts(whole), *flips(whole, head, count), *lies(original)):
        copy.write_bytes(mutant)
        refused += not attempt(copy)
    assert refused > 10


def test_mutated_real_file(shared_data: Callable[[str], Path], tmp_path: Path) -> None:
    mutate_shared(shared_data(f"stg_splatv/{SHARED[0]}"), tmp_path, FLIPS)


@pytest.mark.slow
@pytest.mark.parametrize("name", SHARED)
def test_mutated_real_files(name: str, shared_data: Callable[[str], Path], tmp_path: Path) -> None:
    mutate_shared(shared_data(f"stg_splatv/{name}"), tmp_path, 100)


@pytest.mark.parametrize("count", [5, pytest.param(200, marks=pytest.mark.slow)])
def test_mutated_video_reel(count: int, tmp_path: Path) -> None:
    shutil.copytree(FIELD, tmp_path / "field")
    path = tmp_path / "field" / "ball.reel"
    names = [file.name for file in path.parent.iterdir()]
    assert attempt(path)
    chance = random.Random(7)
    for file in (path, *(path.parent / payload for payload in ("ball.qp18.mp4", "ball.tables", "ball.shading"))):
        kept = file.read_bytes()
        mutants = [*cuts(kept), *flips(kept, 400, 4 * count), *(lies(path) if file == path else ())]
        for mutant in chance.sample(mutants, min(count, len(mutants))):
            file.write_bytes(mutant)
            attempt(path, *names)
        file.write_bytes(kept)
    assert attempt(path)


def test_video_reel_without_its_movie(tmp_path: Path) -> None:
    shutil.copytree(FIELD, tmp_path / "field")
    for movie in (tmp_path / "field").glob("*.mp4"):
        movie.unlink()
    assert not attempt(tmp_path / "field" / "ball.reel", "ball.qp18.mp4")


def test_reel_without_its_payload(random_model: Model, tmp_path: Path) -> None:
    path = small_files(tmp_path, random_model)[".reel"]
    for payload in tmp_path.glob("c*.ply"):
        payload.unlink()
    assert not attempt(path, "c.ply")


@pytest.mark.parametrize("name", ["", "x.ply", "folder.reel", "text.splatv", "empty.reel", "picture.png"])
def test_what_is_no_reel(name: str, tmp_path: Path) -> None:
    (tmp_path / "folder.reel").mkdir()
    (tmp_path / "text.splatv").write_text("hello")
    (tmp_path / "empty.reel").touch()
    (tmp_path / "picture.png").write_bytes(b"\x89PNG")
    assert not attempt(tmp_path / name)


def test_frames_without_gaussians_are_empty(random_model: Model, tmp_path: Path) -> None:
    model = random_model(20)
    model.trbf_centers[:] = 0.0
    model.trbf_log_scales[:] = -4.0
    save_gaussians(tmp_path / "gone.reel", model, fps=24, frame_start=1, frame_count=10)
    bpy.ops.holoreel.import_reel(filepath=str(tmp_path / "gone.reel"))
    scene, played = bpy.context.scene, bpy.context.object
    scene.camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(scene.camera)
    scene.camera.rotation_euler = (np.pi, 0.0, 0.0)
    counts = {}
    for look in ("Points", "Splats"):
        compat.set_input(reels.modifier_of(played), "Look", look)
        for frame in (1, 9):
            scene.frame_set(frame)
            counts[look, frame] = len(positions(played))
    assert counts["Points", 1] > 0
    assert counts["Splats", 1] > 0
    assert counts["Points", 9] == counts["Splats", 9] == 0
    scene.render.engine = "CYCLES"
    scene.cycles.samples = 1
    scene.render.resolution_x = scene.render.resolution_y = 16
    assert bpy.ops.render.render() == {"FINISHED"}


@pytest.mark.parametrize(
    "inputs",
    [
        {"First Frame": 500, "Last Frame": 900},
        {"First Frame": 9, "Last Frame": 2},
        {"Speed": -1e9, "Repeat": "Ping-Pong"},
        {"Speed": 1e30, "Repeat": "Loop"},
        {"Offset": -1e20, "Repeat": "Loop"},
        {"Frame Count": 0},
    ],
)
def test_ranges_beyond_the_reel_show_one_of_its_frames(
    inputs: dict[str, float | str], random_model: Model, tmp_path: Path
) -> None:
    model = random_model(20)
    model.trbf_log_scales[:] = 4.0  # all are visible throughout
    model.opacity_logits[:] = 3.0
    save_gaussians(tmp_path / "walk.reel", model, fps=24, frame_start=1, frame_count=10)
    bpy.ops.holoreel.import_reel(filepath=str(tmp_path / "walk.reel"))
    modifier = reels.modifier_of(bpy.context.object)
    compat.set_input(modifier, "Look", "Points")
    for name, value in inputs.items():
        compat.set_input(modifier, name, value)
    for frame in (-1000, 1, 5, 1_000_000):
        bpy.context.scene.frame_set(frame)
        found = positions(bpy.context.object)
        assert len(found) == 20
        assert np.isfinite(found).all()
        assert np.abs(found).max() < 20.0
