# SPDX-License-Identifier: GPL-3.0-or-later
"""The render engine: its pictures are those of `holoreel render`, and whatever befalls the worker, Blender goes on."""

import json
import math
import os
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import bpy
import holoreel
import numpy as np
import pytest
from holoreel.addon import composite, engine, engine_view, environment, reels, shots, worker
from holoreel.addon.cameras import camera_from_object
from holoreel.addon.compat import enable_nodes, set_input
from holoreel.addon.nodes.show import HULL, POINTS
from holoreel.addon.timeline import PING_PONG, Timeline
from holoreel.core.camera_blender import camera_from_projection
from holoreel.core.errors import HoloreelError
from holoreel.core.gaussians.decoder import Decoder
from holoreel.core.gaussians.model import SpacetimeGaussians
from holoreel.core.reel import save_gaussians
from holoreel.core.worker.client import Client
from mathutils import Euler, Matrix, Quaternion, Vector
from numpy.typing import NDArray

Picture = NDArray[np.float32]

ROOT = Path(holoreel.__file__).parent
FIELD = Path(__file__).parents[1] / "data" / "field" / "ball.reel"
WIDTH, HEIGHT = 96, 64
OUTSIDE = """
import json, sys
from holoreel.core.cli import main
for arguments in json.load(sys.stdin):
    assert not main(arguments), arguments
"""


@pytest.fixture(scope="module")
def core() -> Path:
    """The core environment's Python; skips where there is none."""
    try:
        return environment.find_python("")
    except HoloreelError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module", autouse=True)
def _registered() -> Iterator[None]:
    holoreel.register()
    yield
    holoreel.unregister()
    assert worker.running() is None


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory, random_model: Callable[..., SpacetimeGaussians]) -> dict[str, Path]:
    """A reel of each kind; both models lie where a camera at the origin sees them that looks along +z."""
    folder, random = tmp_path_factory.mktemp("reels"), np.random.default_rng(3)
    facts = {"fps": 24.0, "frame_start": 101, "frame_count": 9}
    save_gaussians(folder / "lite.reel", random_model(80), background=(0.25, 0.5, 0.75), **facts)
    decoder = Decoder(random.normal(size=(6, 12)), random.normal(size=(3, 6)), "sigmoid")
    save_gaussians(folder / "full.reel", random_model(80, features=9), decoder=decoder, **facts)
    return {"lite": folder / "lite.reel", "full": folder / "full.reel", "field": FIELD}


def look(scene: bpy.types.Scene, center: tuple[float, float, float] = (0, 0, 4), distance: float = 4.0) -> None:
    """Give a scene a camera with a shifted lens that looks along +z at a place, and a small format."""
    data = bpy.data.cameras.new("Camera")
    data.lens, data.shift_x, data.shift_y = 40.0, 0.03, -0.05
    scene.camera = bpy.data.objects.new("Camera", data)
    scene.collection.objects.link(scene.camera)
    scene.camera.location = (center[0] + 0.1, center[1], center[2] - distance)
    scene.camera.rotation_euler = (math.pi, 0.02, 0)
    scene.render.resolution_x, scene.render.resolution_y = WIDTH, HEIGHT


def play(path: Path, frame: int = 3) -> bpy.types.Object:
    """Import a reel whose frame 0 is scene frame 1, and go to a frame."""
    played = reels.import_reel(bpy.context, path, start=1)
    bpy.context.scene.frame_set(frame)
    return played


def png(tmp_path: Path, name: str = "render") -> NDArray[np.int64]:
    """Render the scene and return its picture in 255ths, (H, W, channels), top row first."""
    scene = bpy.context.scene
    scene.render.image_settings.file_format = "PNG"
    scene.render.image_settings.color_mode = "RGB"
    scene.render.filepath = str(tmp_path / f"{name}.png")
    bpy.ops.render.render(write_still=True)
    return read(tmp_path / f"{name}.png")


def read(path: Path) -> NDArray[np.int64]:
    image = bpy.data.images.load(str(path), check_existing=False)
    image.colorspace_settings.name = "Non-Color"
    width, height = image.size
    pixels = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(pixels)
    bpy.data.images.remove(image)
    return np.rint(pixels.reshape(height, width, 4)[::-1, :, :3] * 255).astype(int)


def fisheye(camera: bpy.types.Camera) -> None:
    camera.type, camera.panorama_type, camera.fisheye_fov = "PANO", "FISHEYE_EQUIDISTANT", 2.2


def test_pictures_are_those_of_holoreel_render(core: Path, files: dict[str, Path], tmp_path: Path) -> None:
    """Lite, full, VideoRF; pinhole and fisheye; to 1/255."""
    mine, jobs = {}, []
    for kind, path in files.items():
        bpy.ops.wm.read_factory_settings(use_empty=True)
        scene = bpy.context.scene
        look(scene, *(((0.17, 1.11, 1.56), 1.2) if kind == "field" else ()))
        play(path)
        bpy.ops.holoreel.setup_engine()
        for lens in ("pinhole", "fisheye"):
            if lens == "fisheye":
                fisheye(scene.camera.data)
            name = f"{kind}-{lens}"
            mine[name] = png(tmp_path, name)
            camera = camera_from_object(scene.camera, scene)
            (tmp_path / f"{name}.json").write_text(json.dumps(camera.to_json()))
            jobs.append(["render", str(path), "--camera", str(tmp_path / f"{name}.json")])
            jobs[-1] += ["--frame", str(first_frame(path) + 2), "--out", str(tmp_path / f"{name}-core.png")]
    subprocess.run([core, "-c", OUTSIDE], input=json.dumps(jobs), text=True, check=True, capture_output=True)
    for name, picture in mine.items():
        wanted = read(tmp_path / f"{name}-core.png")
        assert wanted.std() > 10, name  # there is something to see
        assert np.abs(picture - wanted).max() <= 1, name


def first_frame(path: Path) -> int:
    return int(json.loads(path.read_text())["frame_start"])


@pytest.mark.usefixtures("core")
def test_moving_and_scaling_everything_changes_nothing(files: dict[str, Path], tmp_path: Path) -> None:
    scene = bpy.context.scene
    look(scene)
    played = play(files["full"])
    bpy.ops.holoreel.setup_engine()
    before = png(tmp_path, "before")
    mover = bpy.data.objects.new("Mover", None)
    scene.collection.objects.link(mover)
    for moved in (played, scene.camera):
        moved.parent = mover
    mover.matrix_world = Matrix.LocRotScale((3, -2, 1), Euler((0.4, 1.1, -2)), (2.5, 2.5, 2.5))
    assert np.abs(png(tmp_path, "after") - before).max() <= 1


@pytest.mark.usefixtures("core")
def test_a_render_region_is_a_part_of_the_whole(files: dict[str, Path], tmp_path: Path) -> None:
    scene = bpy.context.scene
    look(scene)
    play(files["lite"])
    bpy.ops.holoreel.setup_engine()
    whole, render = png(tmp_path, "whole"), scene.render
    render.use_border = True
    render.border_min_x, render.border_max_x, render.border_min_y, render.border_max_y = 0.25, 0.7, 0.2, 0.77
    left, right, top, bottom = 24, 67, HEIGHT - 49, HEIGHT - 12
    inside = png(tmp_path, "region")
    np.testing.assert_array_equal(inside[top:bottom, left:right], whole[top:bottom, left:right])
    assert not inside[:top].any()
    assert not inside[:, right:].any()
    render.use_crop_to_border = True
    np.testing.assert_array_equal(png(tmp_path, "crop"), whole[top:bottom, left:right])


@pytest.mark.usefixtures("core")
def test_animations_show_the_frames_of_the_timeline(files: dict[str, Path], tmp_path: Path) -> None:
    scene = bpy.context.scene
    look(scene)
    played = play(files["lite"])
    reels.set_timeline(played, Timeline(9, start=1.0, speed=2.0))
    bpy.ops.holoreel.setup_engine()
    stills = []
    for frame in (1, 2, 3):
        scene.frame_set(frame)
        stills.append(png(tmp_path, f"still{frame}"))
    scene.frame_start, scene.frame_end = 1, 3
    scene.render.filepath = str(tmp_path / "animation")
    bpy.ops.render.render(animation=True)
    for frame, still in zip((1, 2, 3), stills, strict=True):
        np.testing.assert_array_equal(read(tmp_path / f"animation{frame:04d}.png"), still)
    assert np.abs(stills[0] - stills[2]).max() > 20


def layers(frame: float = 1.0) -> list:
    scene = bpy.context.scene
    scene.frame_set(math.floor(frame), subframe=frame % 1)
    depsgraph = bpy.context.evaluated_depsgraph_get()
    return list(shots.layers_of(depsgraph, camera_from_object(scene.camera, scene, depsgraph)))


def test_steps_follow_keys_and_repeats_and_sub_frames(files: dict[str, Path]) -> None:
    look(bpy.context.scene)
    lite, field = play(files["lite"]), play(files["field"])
    reels.set_timeline(lite, Timeline(9, start=1.0, speed=1.5, first=2, last=6, repeat=PING_PONG))
    for frame in (1.0, 2.25, 3.0, 7.5):
        steps = {layer.path.stem: layer.step for layer in layers(frame)}
        assert steps["lite"] == float(reels.timeline_of(lite).reel_frame(frame))
        assert steps["ball"] == math.floor(min(frame - 1, 8)) == int(steps["ball"])
    assert {layer.path.stem: layer.rung for layer in layers()} == {"lite": None, "ball": field["holoreel"]["rung"]}


def test_what_is_not_rendered_is_not_drawn_and_instances_are(files: dict[str, Path]) -> None:
    scene = bpy.context.scene
    look(scene)
    lite, full = play(files["lite"]), play(files["full"])
    assert [layer.path.stem for layer in layers()] == ["lite", "full"]
    nested = bpy.data.collections.new("Nested")
    nested.objects.link(full)
    nested.instance_offset = (0.5, 0, 0)
    scene.collection.objects.unlink(full)
    for place in ((1, 0, 0), (-1, 0, 2)):
        instancer = bpy.data.objects.new("Instancer", None)
        instancer.instance_type, instancer.instance_collection = "COLLECTION", nested
        instancer.location = place
        scene.collection.objects.link(instancer)
    found = layers()
    assert [layer.path.stem for layer in found] == ["lite", "full", "full"]
    plain = camera_from_object(scene.camera, scene).world_to_camera
    moves = [np.linalg.inv(plain) @ layer.camera.world_to_camera for layer in found]
    np.testing.assert_allclose([move[:3, 3] for move in moves], [(0, 0, 0), (0.5, 0, 0), (-1.5, 0, 2)], atol=1e-5)
    for look_of_reel in (HULL, POINTS):  # whose nodes make many instances, or none
        set_input(reels.modifier_of(lite), "Look", look_of_reel)
        set_input(reels.modifier_of(full), "Look", look_of_reel)
        assert [layer.path.stem for layer in layers()] == ["lite", "full", "full"]
    lite.hide_viewport = True
    assert [layer.path.stem for layer in layers()] == ["full", "full"]
    full.hide_viewport = True
    assert layers() == []


def refusal() -> str:
    with pytest.raises(RuntimeError) as caught:
        bpy.ops.render.render()
    return str(caught.value)


@pytest.mark.usefixtures("core")
def test_what_cannot_be_drawn_is_refused_in_a_sentence_and_the_next_frame_is_fine(
    files: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = bpy.context.scene
    look(scene)
    played = play(files["lite"])
    bpy.ops.holoreel.setup_engine()
    good = png(tmp_path, "good")
    played.scale = (1, 2, 1)
    assert "Reel 'lite' is stretched" in refusal()
    played.scale = (-1, -1, -1)
    assert "mirrored" in refusal()
    played.scale = (0, 0, 0)
    assert "has no size" in refusal()
    played.scale = (1, 1, 1)
    scene.camera.data.type = "ORTHO"
    assert "orthographic" in refusal()
    scene.camera.data.type = "PERSP"
    source, played["holoreel"]["source"] = played["holoreel"]["source"], str(tmp_path / "gone.reel")
    assert "gone.reel" in refusal()
    played["holoreel"]["source"] = source
    monkeypatch.setenv(environment.ENVIRONMENT_VARIABLE, str(tmp_path / "none"))
    assert "there is no Python here" in refusal()
    monkeypatch.delenv(environment.ENVIRONMENT_VARIABLE)
    np.testing.assert_array_equal(png(tmp_path, "again"), good)


MISHAPS = {
    "killed": ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", "SIGKILL"),
    "crashed": ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "SIGSEGV"),
    "babbling": ("print('hello?', flush=True); import time; time.sleep(60)", "no message"),
    "other version": (
        'print(\'{"jsonrpc": "2.0", "id": 1, "result": {"protocol": 0, "version": "0.0.1"}}\', flush=True);'
        "import time; time.sleep(60)",
        "0.0.1",
    ),
    "absent": ("import sys; sys.exit(\"No module named 'holoreel'\")", "has no Holoreel"),
}


@pytest.mark.parametrize("mishap", MISHAPS)
def test_what_happens_to_the_worker_is_a_sentence_on_that_frame(
    mishap: str, core: Path, files: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    look(bpy.context.scene)
    play(files["lite"])
    bpy.ops.holoreel.setup_engine()
    code, sentence = MISHAPS[mishap]
    hello = "import sys; sys.stdin.readline(); "
    client = Client(core, log=tmp_path / "log", command=[str(core), "-I", "-c", hello + code])
    with monkeypatch.context() as patched:
        patched.setattr(worker, "worker", lambda: client)
        assert sentence in refusal()
    assert png(tmp_path).std() > 10
    client.close()


@pytest.mark.slow
@pytest.mark.usefixtures("core")
def test_a_worker_killed_between_frames_is_started_again(files: dict[str, Path], tmp_path: Path) -> None:
    look(bpy.context.scene)
    play(files["lite"])
    bpy.ops.holoreel.setup_engine()
    before, killed = png(tmp_path), worker.running()
    assert killed is not None
    os.kill(killed, 9)
    while worker.running() is not None:
        time.sleep(0.01)
    np.testing.assert_array_equal(png(tmp_path), before)
    assert worker.running() not in (None, killed)


class Taker:
    """A pass of a render result that keeps what it is given."""

    def __init__(self, name: str):
        self.name = name
        self.rect = SimpleNamespace(foreach_set=self.take)

    def take(self, values: Picture) -> None:
        self.values = np.array(values)


@pytest.mark.usefixtures("core")
def test_passes_are_color_depth_and_alpha(files: dict[str, Path]) -> None:
    """With a transparent film, Combined is premultiplied and its alpha is the pass Alpha; depth is in scene units."""
    scene = bpy.context.scene
    look(scene)
    play(files["lite"]).scale = (2, 2, 2)
    scene.camera.location *= 2
    scene.render.film_transparent = True
    depsgraph = bpy.context.evaluated_depsgraph_get()
    camera = camera_from_object(scene.camera, scene, depsgraph)
    passes = [Taker("Combined"), Taker("Depth"), Taker("Alpha")]
    result = SimpleNamespace(layers=[SimpleNamespace(passes=passes)], resolution_x=WIDTH, resolution_y=HEIGHT)
    caller = SimpleNamespace(
        update_stats=lambda *_: None, test_break=lambda: False, report=lambda *_: None, _progress=lambda *_: None
    )
    engine.HOLOREEL_RE_engine._fill(caller, result, depsgraph, camera, None)
    rgba, depth, alpha = (found.values for found in passes)
    rgba = rgba.reshape(-1, 4)
    np.testing.assert_array_equal(rgba[:, 3], alpha)
    assert 0 < alpha.mean() < 1
    assert not rgba[alpha == 0].any()
    assert (depth[alpha == 0] == np.float32(1e10)).all()
    assert 2 * 2.0 < np.median(depth[alpha > 0.1]) < 2 * 7.0


def test_a_scene_without_reels_is_its_background(tmp_path: Path) -> None:
    """And needs no worker."""
    scene = bpy.context.scene
    look(scene)
    bpy.ops.holoreel.setup_engine()
    assert not png(tmp_path).any()
    scene.holoreel_engine.background, scene.holoreel_engine.background_color = "COLOR", (0.2, 0.4, 1.0)
    assert (png(tmp_path) == (51, 102, 255)).all()


@pytest.mark.parametrize("kind", ["lite", "field"])
def test_the_engine_does_not_wait_for_looks_but_viewports_have_them(
    kind: str, files: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The engine draws reels from their files, so that in its renders their nodes make nothing."""
    look(bpy.context.scene)
    played = play(FIELD if kind == "field" else files[kind])
    set_input(reels.modifier_of(played), "Look", POINTS)

    def count(depsgraph: bpy.types.Depsgraph) -> int:
        geometry = played.evaluated_get(depsgraph).evaluated_geometry()  # its parts live as long as it does
        return 0 if geometry.pointcloud is None else len(geometry.pointcloud.points)

    rendered = []
    monkeypatch.setattr(engine, "shot_of", lambda depsgraph, camera, **_: rendered.append(count(depsgraph)))
    bpy.ops.holoreel.setup_engine()
    bpy.ops.render.render()
    assert rendered == [0]
    assert count(bpy.context.evaluated_depsgraph_get()) > 0


# --- Together with Cycles -------------------------------------------------------------------------------------------


def wall(z: float) -> bpy.types.Object:
    """A red plane that fills the picture of `look` at a depth."""
    mesh = bpy.data.meshes.new("Wall")
    mesh.from_pydata([(-9, -9, z), (9, -9, z), (9, 9, z), (-9, 9, z)], [], [(0, 1, 2, 3)])
    material = bpy.data.materials.new("Red")
    nodes = enable_nodes(material)
    nodes.nodes.clear()
    emission = nodes.nodes.new("ShaderNodeEmission")
    emission.inputs["Color"].default_value = (1, 0, 0, 1)
    nodes.links.new(emission.outputs[0], nodes.nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])
    mesh.materials.append(material)
    made = bpy.data.objects.new("Wall", mesh)
    bpy.context.scene.collection.objects.link(made)
    return made


@pytest.mark.usefixtures("core", "gpu")
def test_composites_merge_by_depth(files: dict[str, Path], tmp_path: Path) -> None:
    """Before a wall the reel is what it is over red; behind the wall it is not seen. Doing it again adds nothing."""
    scene = bpy.context.scene
    look(scene)
    played = play(files["lite"])
    bpy.ops.holoreel.setup_engine()
    scene.holoreel_engine.color = "LINEAR"
    scene.render.film_transparent = True
    alone = png(tmp_path, "alone")
    scene.render.film_transparent = False
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = 1, False
    red = wall(20.0)
    for _ in range(2):
        assert bpy.ops.holoreel.setup_composite() == {"FINISHED"}
    assert len(bpy.data.scenes) == 2
    twin = next(candidate for candidate in bpy.data.scenes if candidate != scene)
    assert [link.from_node.name for link in tree_of(scene).links].count(composite.REELS) == 2
    assert played.visible_get()
    before = png(tmp_path, "before")
    assert twin.frame_current == scene.frame_current
    assert (np.abs(before - (255, 0, 0)).max(-1) > 30).mean() > 0.2  # much of it is the reel
    opaque = (before[..., 0] > 0) & (alone.min(-1) > 60)  # where green and blue come from the reel alone
    assert np.abs(before[opaque] - alone[opaque])[:, 1:].max() < 90
    red.location.z = -19.5
    assert (png(tmp_path, "behind") == (255, 0, 0)).all()


def tree_of(scene: bpy.types.Scene) -> bpy.types.NodeTree:
    return scene.compositing_node_group if hasattr(scene, "compositing_node_group") else scene.node_tree


def test_composites_refuse_in_a_sentence(files: dict[str, Path]) -> None:
    scene = bpy.context.scene
    with pytest.raises(RuntimeError, match="has no reel"):
        bpy.ops.holoreel.setup_composite()
    play(files["lite"])
    with pytest.raises(RuntimeError, match="has no camera"):
        bpy.ops.holoreel.setup_composite()
    bpy.ops.holoreel.setup_engine()
    with pytest.raises(RuntimeError, match="choose Cycles or EEVEE"):
        bpy.ops.holoreel.setup_composite()
    assert len(bpy.data.scenes) == 1
    assert not scene.collection.children


# --- The viewport, as far as it goes without a window ---------------------------------------------------------------


@pytest.mark.usefixtures("core")
def test_viewports_get_a_small_picture_first_and_begin_again_on_change(files: dict[str, Path], tmp_path: Path) -> None:
    """In the end they show what F12 renders."""
    scene = bpy.context.scene
    look(scene)
    play(files["lite"])
    bpy.ops.holoreel.setup_engine()
    scene.holoreel_engine.color = "DISPLAY"
    scene.view_settings.view_transform = "Raw"
    rendered = png(tmp_path)
    depsgraph = bpy.context.evaluated_depsgraph_get()
    camera = camera_from_object(scene.camera, scene, depsgraph)
    progress, client = engine_view.Progressive(), worker.worker()

    def pictures(shot: shots.Shot) -> list[Picture]:
        found = []
        while progress.finest < len(engine_view.SHARES) or progress.is_waiting or not found:
            picture = progress.step(client, shot)
            if picture is not None:
                found.append(picture)
            time.sleep(0.005)
        return found

    one, other = (shots.shot_of(depsgraph, camera, transparent=clear) for clear in (False, True))
    small, full = pictures(one)
    assert small.shape == (HEIGHT // 4, WIDTH // 4, 4)
    assert full.shape == (HEIGHT, WIDTH, 4)
    assert np.abs(full[::-1, :, :3] * 255 - rendered).max() <= 1
    blocks = full.reshape(HEIGHT // 4, 4, WIDTH // 4, 4, 4).mean((1, 3))
    assert np.abs(blocks - small).mean() < 0.05
    assert progress.step(client, one) is None
    assert not progress.is_waiting
    progress.step(client, other)
    assert progress.finest == 0
    assert pictures(other)[-1][..., 3].min() == 0
    gone = shots.Shot((type(one.layers[0])(Path("/gone.reel"), 0.0, 9, camera),))
    with pytest.raises(HoloreelError, match=r"gone\.reel"):
        pictures(gone)
    assert progress.step(client, gone) is None  # said once
    assert not progress.is_waiting
    progress.close()


def test_viewport_matrices_are_cameras() -> None:
    scene = bpy.context.scene
    look(scene)
    depsgraph = bpy.context.evaluated_depsgraph_get()
    window = scene.camera.calc_matrix_camera(depsgraph, x=WIDTH, y=HEIGHT)
    view = scene.camera.matrix_world.inverted()
    found = camera_from_projection(np.array(view), np.array(window), WIDTH, HEIGHT)
    wanted = camera_from_object(scene.camera, scene)
    points = np.random.default_rng(0).uniform((-1, -1, 3), (1, 1, 6), (20, 3))
    np.testing.assert_allclose(found.project(points)[0], wanted.project(points)[0], atol=1e-3)


# --- Fisheye cameras ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "size", "settings"),
    [
        ("FISHEYE_EQUIDISTANT", (120, 60), {"fisheye_fov": 2.0, "shift_x": 0.1, "shift_y": 0.05}),
        ("FISHEYE_EQUISOLID", (60, 120), {"fisheye_lens": 15, "fisheye_fov": 3.0, "sensor_fit": "HORIZONTAL"}),
        (
            "FISHEYE_LENS_POLYNOMIAL",
            (120, 60),
            {"fisheye_polynomial_k0": 0, "fisheye_polynomial_k1": -0.06, "fisheye_polynomial_k2": -1e-5,
             "fisheye_polynomial_k3": 0, "fisheye_polynomial_k4": 0, "fisheye_fov": 3.0},
        ),
    ],
)  # fmt: skip
def test_fisheye_cameras_see_what_cycles_sees(
    kind: str, size: tuple[int, int], settings: dict, render: Callable[[], Picture]
) -> None:
    """Three little balls at known angles; their centers of light, to a quarter of a pixel."""
    scene = bpy.context.scene
    scene.render.engine, scene.render.film_transparent = "CYCLES", True
    scene.cycles.samples, scene.cycles.use_denoising = 16, False
    scene.render.resolution_x, scene.render.resolution_y = size
    data = bpy.data.cameras.new("Fisheye")
    data.type, data.panorama_type, data.clip_start = "PANO", kind, 0.01
    for name, value in settings.items():
        setattr(data, name, value)
    scene.camera = bpy.data.objects.new("Fisheye", data)
    scene.collection.objects.link(scene.camera)
    scene.camera.rotation_euler = (0.5, -0.3, 1.0)
    bpy.context.view_layer.update()
    turn: Quaternion = scene.camera.matrix_world.to_quaternion()
    places = []
    for channel, (theta, phi) in enumerate([(0.0, 0.0), (0.45, 0.1), (0.4, 1.6)]):
        bpy.ops.mesh.primitive_uv_sphere_add(radius=0.06)
        ball = bpy.context.object
        along = (math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), -math.cos(theta))
        ball.location = turn @ (2 * Vector(along))
        places.append(tuple(ball.location))
        material = bpy.data.materials.new("Light")
        nodes = enable_nodes(material)
        nodes.nodes.clear()
        emission = nodes.nodes.new("ShaderNodeEmission")
        emission.inputs["Color"].default_value = (*np.eye(3)[channel], 1)
        nodes.links.new(emission.outputs[0], nodes.nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])
        ball.data.materials.append(material)
    picture = render()
    v, u = np.mgrid[: size[1], : size[0]] + 0.5
    light = picture[..., :3] * (picture[..., 3:] > 0) * (picture[..., :3].sum(-1, keepdims=True) < 1.01)
    light = np.where(light == picture[..., :3].max(-1, keepdims=True), light, 0)
    seen = [[(lit * u).sum() / lit.sum(), (lit * v).sum() / lit.sum()] for lit in np.moveaxis(light, 2, 0)]
    camera = camera_from_object(scene.camera, scene)
    np.testing.assert_allclose(seen, camera.project(places)[0], atol=0.25)


# --- The end ---------------------------------------------------------------------------------------------------------


def test_blender_ends_and_takes_the_worker_with_it(core: Path, files: dict[str, Path], tmp_path: Path) -> None:
    """Though nobody unregisters the engine: as a module, Blender 4.5 would wait forever."""
    code = f"""
        import bpy, holoreel
        from holoreel.addon import worker
        holoreel.register()
        bpy.ops.wm.read_factory_settings(use_empty=True)
        bpy.ops.holoreel.import_reel(filepath={str(files["lite"])!r})
        scene = bpy.context.scene
        scene.camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
        scene.collection.objects.link(scene.camera)
        scene.render.resolution_x = scene.render.resolution_y = 16
        bpy.ops.holoreel.setup_engine()
        bpy.ops.render.render()
        print("worker", worker.running(), flush=True)
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr
    pid = int(done.stdout.rpartition("worker ")[2].split()[0])
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
