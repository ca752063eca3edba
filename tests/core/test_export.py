# SPDX-License-Identifier: GPL-3.0-or-later
"""`holoreel export`: files that other programs read, by readers written from those programs' descriptions."""

import json
import re
import struct

import numpy as np
import pytest
import torch
from holoreel.core.camera import Camera, write_camera
from holoreel.core.cli import main
from holoreel.core.gaussians.decoder import Decoder, write_pt
from holoreel.core.gaussians.flat import flat_colors
from holoreel.core.gaussians.model import SpacetimeGaussians, sigmoid
from holoreel.core.gaussians.player import GaussianPlayer
from holoreel.core.gaussians.ply import read_ply, write_ply
from holoreel.core.gaussians.splatv import read_splatv
from holoreel.core.plyfile import read_vertices
from holoreel.core.reel import SegmentPayload, load_gaussians, save_gaussians, write_segments


def export(*arguments: object) -> int:
    return main(["export", *(str(argument) for argument in arguments)])


@pytest.fixture
def camera(tmp_path):
    pose = np.eye(4)
    pose[:3, 3] = (0.1, -0.2, 0.3)
    write_camera(tmp_path / "camera.json", Camera(64, 48, 60.0, 60.0, 32.0, 24.0, pose, name="cam07"))
    return Camera(64, 48, 60.0, 60.0, 32.0, 24.0, pose)


@pytest.fixture
def decoder():
    random = np.random.default_rng(2)
    return Decoder(random.normal(0, 0.5, (6, 12)), random.normal(0, 0.5, (3, 6)), "sigmoid")


def words_of(path) -> tuple[dict, np.ndarray]:
    """Read a .splatv as splaTV does: the chunk, and its texture as (N', 16) words, padding included."""
    data = path.read_bytes()
    _, length = struct.unpack("<II", data[:8])
    assert data[:4] == b"\x4b\x67\x00\x00"
    (chunk,) = json.loads(data[8 : 8 + length])
    assert (chunk["type"], chunk["texwidth"]) == ("splat", 4096)
    payload = data[8 + length :]
    assert len(payload) == chunk["size"] == chunk["texwidth"] * chunk["texheight"] * 16
    return chunk, np.frombuffer(payload, "<u4").reshape(-1, 16)


def half2(words: np.ndarray) -> np.ndarray:
    """Two halves of each word, the first in its low bits."""
    pairs = np.stack([words & 0xFFFF, words >> 16], axis=-1).astype(np.uint16)
    return pairs.view(np.float16).astype(np.float64)


def test_splatv_has_what_its_viewer_expects(tmp_path, random_model, camera):
    model = random_model(1500)
    model.quats[:700] = 0.0
    model.omegas[:600] = 0.0
    model.trbf_log_scales[10:20] = 1e30
    model.log_scales[20:25] = -1e30
    model.motions[30, 0] = 1e9
    model.means[40] = np.nan
    save_gaussians(tmp_path / "a.reel", model, fps=24, frame_start=1, frame_count=12)
    out = tmp_path / "new" / "a.splatv"
    assert export(tmp_path / "a.reel", "--to", "splatv", "--out", out, "--camera", tmp_path / "camera.json") == 0
    chunk, words = words_of(out)
    assert chunk["texheight"] == 2
    assert len(words) == 2048
    assert not words[1499:].any()
    (view,) = chunk["cameras"]
    assert (view["width"], view["height"], view["fx"], view["fy"], view["img_name"]) == (64, 48, 60, 60, "cam07")
    np.testing.assert_allclose(view["position"], camera.center)
    np.testing.assert_allclose(view["rotation"], np.eye(3))

    words = words[:1499]
    position = words[:, :3].copy().view(np.float32)
    quats, scales = half2(words[:, 3:5]).reshape(-1, 4), half2(words[:, 5:7]).reshape(-1, 4)
    rgba = words[:, 7:8].copy().view(np.uint8)
    motion, omegas, temporal = half2(words[:, 8:13]), half2(words[:, 13:15]), half2(words[:, 15:])
    for part in (position, quats, scales, motion, omegas, temporal):
        assert np.isfinite(part).all()
    np.testing.assert_allclose(np.linalg.norm(quats, axis=1), 1.0, atol=2e-3)
    assert (quats == [1, 0, 0, 0]).all(axis=1).sum() == 599
    assert (scales[:, :3] > 0).all()
    assert (temporal[:, 0, 1] > 0).all()
    volume = scales[:, :3].prod(axis=1)
    most, least = volume * (rgba[:, 3] + 0.5) * 1.01, volume * (rgba[:, 3] - 0.5) / 1.01
    assert (least[1:] <= np.minimum.accumulate(most)[:-1] + 1e-9).all()

    # The same Gaussians, at any time: half precision of numbers up to 8.
    ours, _ = read_splatv(out)
    model = model.without_bad_rows()
    original = model.take(np.abs(model.means[:, None] - ours.means[None]).max(axis=2).argmin(axis=0))
    calm = (np.abs(original.motions).max(axis=(1, 2)) < 1e3) & np.isfinite(original.log_scales).all(axis=1)
    calm &= np.abs(original.means - ours.means).max(axis=1) < 0.01
    assert calm.sum() > 1400
    for time in (0.0, 0.4, 1.0):
        before, after = original.take(calm).evaluate(time), ours.take(calm).evaluate(time)
        np.testing.assert_allclose(after.means, before.means, atol=0.01)
        np.testing.assert_allclose(after.opacities, before.opacities, atol=0.01)
        np.testing.assert_allclose(after.features, before.features, atol=0.6 / 255)


def test_splatv_without_a_camera_sees_the_model(tmp_path, random_model):
    save_gaussians(tmp_path / "a.reel", random_model(50), fps=24, frame_start=1, frame_count=12, up="-Y")
    assert export(tmp_path / "a.reel", "--to", "splatv", "--out", tmp_path / "a.splatv") == 0
    view = words_of(tmp_path / "a.splatv")[0]["cameras"][0]
    to_world = np.array(view["rotation"])
    np.testing.assert_allclose(to_world @ to_world.T, np.eye(3), atol=1e-9)
    away = (random_model(50).means - view["position"]) @ to_world
    assert (away[:, 2] > 0).all()
    assert np.abs(away[:, :2] / away[:, 2:] * view["fx"]).max() < view["width"] / 2
    assert to_world[1, 1] > 0.9  # picture's down is +Y


def test_a_moment_is_an_ordinary_gaussian_ply(tmp_path, random_model):
    model = random_model(80)
    model.opacity_logits[3] = 60.0
    model.trbf_log_scales[3] = 30.0
    save_gaussians(tmp_path / "a.reel", model, fps=24, frame_start=11, frame_count=8, background=(0.0, 0.0, 0.0))
    out = tmp_path / "moment.ply"
    assert export(tmp_path / "a.reel", "--to", "3dgs", "--frame", 14.5, "--out", out) == 0
    table = read_vertices(out)
    assert " ".join(table.dtype.names) == (
        "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    )
    time = 3.5 / 8
    dt = time - model.trbf_centers.astype(float)
    opacity = 1 / (1 + np.exp(-model.opacity_logits.astype(float)))
    opacity *= np.exp(-((dt / np.exp(model.trbf_log_scales.astype(float))) ** 2))
    alive = opacity >= 1 / 255
    assert 0 < alive.sum() < 80
    assert len(table) == alive.sum()
    np.testing.assert_allclose(1 / (1 + np.exp(-table["opacity"].astype(float))), opacity[alive], atol=1e-5)
    np.testing.assert_allclose(table["f_dc_1"] * 0.28209479 + 0.5, model.features[alive, 1], atol=1e-5)
    np.testing.assert_allclose(table["scale_2"], model.log_scales[alive, 2], atol=1e-5)
    lengths = sum(table[f"rot_{i}"].astype(float) ** 2 for i in range(4))
    np.testing.assert_allclose(lengths, 1.0, atol=1e-5)
    camera = Camera(64, 48, 60.0, 60.0, 32.0, 24.0)
    moving = GaussianPlayer(tmp_path / "a.reel", "reference").draw(camera, 14.5).image
    np.testing.assert_allclose(GaussianPlayer(out, "reference").draw(camera, 20).image, moving, atol=2e-4)


def test_a_range_of_moments_goes_over_a_seam(tmp_path, random_model, capsys):
    models = [random_model(20, seed) for seed in (1, 2)]
    parts = [SegmentPayload(model, None, 5 + 3 * i, 3) for i, model in enumerate(models)]
    write_segments(tmp_path / "a.reel", parts, fps=24, frame_start=5)
    assert export(tmp_path / "a.reel", "--to", "3dgs", "--frames", "6:9", "--out", tmp_path / "moments") == 0
    assert [path.name for path in sorted((tmp_path / "moments").iterdir())] == [
        f"000{frame}.ply" for frame in range(6, 10)
    ]
    for frame in range(6, 10):
        second = frame >= 8
        truth = models[second].evaluate((frame - (8 if second else 5)) / 3)
        read, _ = read_ply(tmp_path / "moments" / f"000{frame}.ply")
        np.testing.assert_allclose(read.means, truth.means[truth.alive], atol=1e-6)
    assert export(tmp_path / "a.reel", "--to", "3dgs", "--frames", "6:12", "--out", tmp_path / "none") == 2
    assert "no frame 11: take 5 to 10" in capsys.readouterr().err.replace("12", "11")
    assert not (tmp_path / "none").exists()


def test_flat_colors_are_those_of_opaque_pixels(tmp_path, decoder):
    """One huge opaque Gaussian: the picture seen from the viewpoint is its flat color, where its center is."""
    features = np.random.default_rng(1).normal(0, 1, (1, 9))
    model = SpacetimeGaussians(
        [[0.4, -0.3, 5.0]], np.zeros((1, 3, 3)), [[1, 0, 0, 0]], np.zeros((1, 4)), np.zeros((1, 3)), [20.0], features,
        [0.5], [10.0],
    )  # fmt: skip
    pose = np.eye(4)
    pose[:3, 3] = (0.1, -0.2, 0.3)
    camera = Camera(64, 64, 60.0, 60.0, 32.0, 32.0, pose)
    save_gaussians(tmp_path / "a.reel", model, decoder=decoder, fps=24, frame_start=0, frame_count=4)
    image = GaussianPlayer(tmp_path / "a.reel", "reference").draw(camera, 3).image
    (u, v), _ = (part[0] for part in camera.project(model.means))
    flat = flat_colors(model, decoder, camera.center, 0.75)[0]
    assert np.abs(flat - image[int(v), int(u)]).max() < 0.02  # alpha is at most 0.99
    base = 1 / (1 + np.exp(-model.features[0, :3]))  # without a viewpoint, the network adds nothing
    np.testing.assert_allclose(flat_colors(model, decoder, None, 0.75)[0], base, atol=1e-6)
    assert np.abs(flat - base).max() > 0.02
    assert np.abs(flat - flat_colors(model, decoder, camera.center)[0]).max() > 0.02
    np.testing.assert_array_equal(flat_colors(model, None)[0], model.features[0, :3])


@pytest.mark.parametrize("form", ["splatv", "3dgs"])
def test_full_models_are_exported_with_flat_colors(tmp_path, random_model, decoder, camera, form, capsys):
    model = random_model(30, features=9)
    save_gaussians(tmp_path / "a.reel", model, decoder=decoder, fps=24, frame_start=0, frame_count=4)
    out = tmp_path / ("a.splatv" if form == "splatv" else "b.ply")
    time = ("--frame", 2) if form == "3dgs" else ()
    assert export(tmp_path / "a.reel", "--to", form, *time, "--out", out) == 0
    assert "no viewpoint is known" in capsys.readouterr().err
    assert export(tmp_path / "a.reel", "--to", form, *time, "--out", out, "--camera", tmp_path / "camera.json") == 0
    assert "viewpoint" not in capsys.readouterr().err
    read = load_gaussians(out).gaussians
    at = 0.5 if form == "3dgs" else None
    colors = flat_colors(model, decoder, camera.center, at)
    places = model.evaluate(0.5).means if form == "3dgs" else model.means
    nearest = np.abs(places[:, None] - read.means[None]).max(axis=2).argmin(axis=0)
    np.testing.assert_allclose(read.features, colors[nearest], atol=0.6 / 255)


def test_the_authors_files_come_back(tmp_path, random_model, decoder):
    """Bytes of the PLY and weights of the .pt, zero quaternions kept."""
    model = random_model(40, features=9)
    model.quats[:9] = 0.0
    write_ply(tmp_path / "point_cloud.ply", model)
    write_pt(tmp_path / "point_cloud.pt", decoder)
    reel, out = tmp_path / "a.reel", tmp_path / "back" / "point_cloud.ply"
    assert export(tmp_path / "point_cloud.ply", "--to", "ply", "--out", reel, "--decoder-output", "clamp") == 0
    assert load_gaussians(reel).decoder.activation == "clamp"
    assert export(reel, "--to", "ply", "--out", out) == 0
    assert out.read_bytes() == (tmp_path / "point_cloud.ply").read_bytes()
    state = torch.load(out.with_suffix(".pt"), weights_only=True)
    assert {name: (tensor.dtype, tuple(tensor.shape)) for name, tensor in state.items()} == {
        "mlp1.weight": (torch.float32, (6, 12, 1, 1)),
        "mlp2.weight": (torch.float32, (3, 6, 1, 1)),
    }
    np.testing.assert_array_equal(state["mlp1.weight"][:, :, 0, 0], decoder.hidden)


def test_compact_reels_are_whole_reels(tmp_path, random_model, decoder):
    parts = [SegmentPayload(random_model(200, i, features=9), decoder, 1 + 4 * i, 4) for i in range(2)]
    write_segments(tmp_path / "a.reel", parts, fps=25, frame_start=1, up="Y", viewpoint=(1.0, 2.0, 3.0))
    assert export(tmp_path / "a.reel", "--to", "compact", "--out", tmp_path / "small" / "b.reel") == 0
    small = load_gaussians(tmp_path / "small" / "b.reel", 1)
    assert (small.fps, small.frame_start, small.up, small.viewpoint) == (25.0, 5, "Y", (1.0, 2.0, 3.0))
    assert [segment.file for segment in small.reel.segments] == ["b.000.stgc", "b.001.stgc"]
    assert small.decoder is not None
    assert export(tmp_path / "a.reel", "--to", "compact", "--segment", 1, "--out", tmp_path / "c.stgc") == 0
    np.testing.assert_array_equal(load_gaussians(tmp_path / "c.stgc").gaussians.means, small.gaussians.means)
    assert load_gaussians(tmp_path / "c.stgc").decoder.activation == "sigmoid"
    camera = Camera(64, 48, 60.0, 60.0, 32.0, 24.0)
    exact, read = (
        GaussianPlayer(path, "reference").draw(camera, 6).image
        for path in (tmp_path / "a.reel", tmp_path / "small" / "b.reel")
    )
    assert np.abs(exact - exact.mean()).max() > 0.1
    assert np.mean((exact - read) ** 2) < 1e-4


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("REEL --to 3dgs --out OUT/a.ply", "needs --frame"),
        ("REEL --to 3dgs --frame 1 --frames 1:2 --out OUT/a.ply", "needs --frame"),
        ("REEL --to ply --frame 1 --out OUT/a.ply", "others need neither"),
        ("REEL --to 3dgs --frame 1 --segment 0 --out OUT/a.ply", "without --segment"),
        ("REEL --to 3dgs --frames 3:2 --out OUT", "like 1:50"),
        ("REEL --to 3dgs --frames 1:9999999999 --out OUT", "like 1:50"),
        ("REEL --to 3dgs --frames one --out OUT", "like 1:50"),
        ("REEL --to 3dgs --frame 99 --out OUT/a.ply", "no frame 99: take 1 to 8"),
        ("REEL --to 3dgs --frame nan --out OUT/a.ply", "no frame nan"),
        ("REEL --to ply --out OUT/a.ply", "2 segments"),
        ("REEL --to splatv --out OUT/a.splatv", "--segment from 0 to 1"),
        ("REEL --to splatv --segment 2 --out OUT/a.splatv", "no segment 2"),
        ("REEL --to splatv --out OUT/a.ply", ".splatv"),
        ("REEL --to compact --out OUT/a.ply", ".stgc or .reel"),
        ("REEL --to compact --out REEL", "choose another name"),
        ("REEL --to compact --out OUT/a.reel --decoder-output none", "leave --decoder-output away"),
        ("OUT/none.reel --to compact --out OUT/a.reel", "none.reel"),
        ("REEL --to splatv --segment 0 --out OUT/a.splatv --camera OUT/none.json", "none.json"),
        ("REEL --to compact --out FILE/a.reel", "cannot be written"),
    ],
)
def test_mistakes_get_a_sentence_and_leave_nothing(tmp_path, random_model, capsys, arguments, words):
    out = tmp_path / "out"
    out.mkdir()
    (tmp_path / "file").write_text("")
    parts = [SegmentPayload(random_model(5, i), None, 1 + 4 * i, 4) for i in range(2)]
    reel = write_segments(tmp_path / "a.reel", parts, fps=25, frame_start=1)
    for name, path in {"REEL": reel.path, "OUT": out, "FILE": tmp_path / "file"}.items():
        arguments = re.sub(rf"\b{name}\b", str(path), arguments)
    assert export(*arguments.split()) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert said.startswith("holoreel export: ")
    assert words in said
    assert list(out.rglob("*")) == []


def test_third_party_models_survive_the_round_trip(shared_data, tmp_path):
    """Another's .splatv, read and written again: as good as it was."""
    source = shared_data("stg_splatv/coffee10.splatv")
    assert export(source, "--to", "splatv", "--out", tmp_path / "a.splatv") == 0
    before, after = read_splatv(source)[0], read_splatv(tmp_path / "a.splatv")[0]
    assert len(before) == len(after)
    before, after = (m.take(np.lexsort(m.means.T)) for m in (before, after))
    peaks = sigmoid(before.opacity_logits), sigmoid(after.opacity_logits)
    np.testing.assert_allclose(*peaks, atol=0.6 / 255)
