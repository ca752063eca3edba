# SPDX-License-Identifier: GPL-3.0-or-later
"""`holoreel eval`: a reel measured against pictures of itself, and against others'."""

import json
from dataclasses import replace

import numpy as np
import pytest
from holoreel.core.capture import read_capture
from holoreel.core.cli import main
from holoreel.core.draw import open_player
from holoreel.core.evaluate import evaluate, sizes
from holoreel.core.gaussians.decoder import Decoder, write_pt
from holoreel.core.gaussians.player import GaussianPlayer
from holoreel.core.gaussians.ply import write_ply
from holoreel.core.images import read_image
from holoreel.core.metrics import score
from holoreel.core.reel import SegmentPayload, save_gaussians, write_segments


def test_the_truth_scores_what_8_bits_allow(recording, tmp_path, capsys):
    out = tmp_path / "eval"
    assert main(["eval", str(recording.reel), str(recording.capture), "--out", str(out), "--backend", "reference"]) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["mean"]["psnr"] > 55
    assert metrics["mean"]["ssim"] > 0.999
    assert metrics["split"] == "test"
    assert list(metrics["cameras"]) == ["right"]
    assert list(metrics["frames"]) == ["101", "102", "103"]
    assert [(view["camera"], view["frame"]) for view in metrics["views"]] == [("right", f) for f in (101, 102, 103)]
    for frame in (101, 102, 103):
        made, truth = (
            read_image(folder / "right" / f"0{frame}.png") for folder in (out, recording.folder / "pictures")
        )
        np.testing.assert_array_equal(made, truth)
    said = capsys.readouterr().out
    assert f"{metrics['mean']['psnr']:.2f}" in said
    assert "right" in said


def test_every_view_gets_its_own_score(recording, tmp_path):
    """A gray model: the score of each view is that of its picture against plain gray, computed without the renderer."""
    model = recording.model.take([0])
    model.opacity_logits[:] = -30.0
    save_gaussians(tmp_path / "gray.reel", model, fps=24, frame_start=101, frame_count=3, background=(0.5, 0.5, 0.5))
    capture = read_capture(recording.capture)
    calls, pictures = [], []
    metrics = evaluate(tmp_path / "gray.reel", capture, "all", "reference", lambda *done: calls.append(done),
                       lambda name, frame, drawing: pictures.append((name, frame, drawing.image.mean())))  # fmt: skip
    assert calls == [(done, 6) for done in range(1, 7)]
    assert {(name, frame) for name, frame, _ in pictures} == {
        (n, f) for n in ("left", "right") for f in (101, 102, 103)
    }
    assert [value for *_, value in pictures] == pytest.approx([0.5] * 6)
    gray = np.full((24, 32, 3), 0.5)
    expected = {
        (name, frame): score(gray, read_image(recording.folder / "pictures" / name / f"0{frame}.png"))._asdict()
        for name in ("left", "right")
        for frame in (101, 102, 103)
    }
    for view in metrics["views"]:
        assert {key: view[key] for key in ("psnr", "ssim", "dssim1", "dssim2")} == pytest.approx(
            expected[view["camera"], view["frame"]], abs=1e-6
        )
    left = np.mean([expected["left", frame]["psnr"] for frame in (101, 102, 103)])
    middle = np.mean([expected[name, 102]["ssim"] for name in ("left", "right")])
    assert metrics["cameras"]["left"]["psnr"] == pytest.approx(left, abs=1e-5)
    assert metrics["frames"]["102"]["ssim"] == pytest.approx(middle, abs=1e-5)
    assert metrics["mean"]["psnr"] == pytest.approx(np.mean([e["psnr"] for e in expected.values()]), abs=1e-5)


def test_bare_files_are_matched_by_time(recording):
    capture = read_capture(recording.capture)
    metrics = evaluate(recording.reel.with_suffix(".ply"), capture, "test", "reference")
    with_background = evaluate(recording.reel, capture, "test", "reference")
    assert metrics["mean"]["psnr"] < with_background["mean"]["psnr"]  # a bare file does not know its background
    assert len(metrics["views"]) == 3


def test_mistakes_get_a_sentence(recording, tmp_path, capsys):
    save_gaussians(tmp_path / "short.reel", recording.model, fps=24, frame_start=101, frame_count=2)
    assert main(["eval", str(tmp_path / "short.reel"), str(recording.capture), "--out", str(tmp_path / "out")]) == 2
    assert "short.reel holds frames 101 to 102" in capsys.readouterr().err
    assert main(["eval", str(recording.reel), str(tmp_path)]) == 2
    assert "transforms.json" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    assert main(["eval", str(recording.reel), str(recording.capture), "--out", str(tmp_path / "file")]) == 2
    assert "cannot be written" in capsys.readouterr().err
    transforms = json.loads(recording.capture.read_text())
    for key in ("train_filenames", "val_filenames", "test_filenames"):
        del transforms[key]
    for frame in transforms["frames"]:
        frame["file_path"] = str(recording.folder / frame["file_path"])
    (tmp_path / "transforms.json").write_text(json.dumps(transforms))
    assert main(["eval", str(recording.reel), str(tmp_path)]) == 2
    assert "no pictures in the split 'test'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_sizes_count_every_payload(recording, tmp_path):
    """Two segments with decoders, whose files are as large as they are told to be."""
    decoder = Decoder(np.zeros((6, 12)), np.zeros((3, 6)), "none")
    model = make_full(recording.model)
    reel = write_segments(
        tmp_path / "two.reel",
        [SegmentPayload(model, decoder, 101, 2), SegmentPayload(model.take([0, 1]), decoder, 103, 1)],
        fps=24.0,
        frame_start=101,
    )
    files = [*tmp_path.glob("*.ply"), *tmp_path.glob("*.safetensors")]
    assert len(files) == 4
    size = sizes(open_player(reel.path, "reference"))
    total = sum(file.stat().st_size for file in files)
    assert size["bytes"] == total
    assert size["bytes_per_frame"] == pytest.approx(total / 3, abs=0.1)
    assert size["bytes_per_300_frames"] == pytest.approx(total * 100, abs=1)


def test_a_bare_models_decoder_ends_as_it_is_told(recording, tmp_path):
    ply = tmp_path / "point_cloud.ply"
    write_ply(ply, make_full(recording.model))
    write_pt(tmp_path / "point_cloud.pt", Decoder(np.zeros((6, 12)), np.zeros((3, 6)), "sigmoid"))
    capture = read_capture(recording.capture)
    drawn: dict = {None: [], "sigmoid": [], "clamp": []}
    for output, pictures in drawn.items():
        metrics = evaluate(
            ply, capture, "test", "reference", None, lambda *view, to=pictures: to.append(view[2].image), output
        )
    np.testing.assert_array_equal(drawn[None], drawn["sigmoid"])
    np.testing.assert_allclose(drawn["sigmoid"], 1 / (1 + np.exp(-np.array(drawn["clamp"]))), atol=1e-6)
    size = sum(file.stat().st_size for file in tmp_path.iterdir())
    assert metrics["size"]["bytes"] == size


def test_pixels_out_of_a_lens_reach_do_not_count(recording, monkeypatch):
    """With half of the picture out of reach, the score is that of the other half."""
    capture = read_capture(recording.capture)
    half = np.zeros((24, 32), bool)
    half[:, 16:] = True
    monkeypatch.setattr(GaussianPlayer, "reach", lambda player, camera: half)
    model = recording.model.take([0])
    model.opacity_logits[:] = -30.0
    reel = recording.folder / "out" / "gray-half.reel"
    save_gaussians(reel, model, fps=24, frame_start=101, frame_count=3, background=(0.5, 0.5, 0.5))
    shown = []

    class Spy:
        name, input_range = "lpips_alex", "paper"

        def __call__(self, image, truth):
            shown.append((image, truth))
            return 0.25

    metrics = evaluate(reel, capture, "test", "reference", lpips=[Spy()])
    truth = read_image(recording.folder / "pictures" / "right" / "0101.png")
    expected = -10 * np.log10(np.mean((truth[:, 16:] - 0.5) ** 2))
    assert metrics["views"][0]["psnr"] == pytest.approx(expected, abs=1e-4)
    assert metrics["mean"]["lpips_alex"] == 0.25
    assert metrics["lpips_input"] == "paper"
    image, picture = shown[0]
    np.testing.assert_array_equal(image[:, :16], picture[:, :16])
    np.testing.assert_allclose(image[:, 16:], 0.5)


def test_only_distorted_lenses_are_masked(recording):
    camera = recording.cameras["left"]
    player = open_player(recording.reel, "reference")
    assert player.reach(camera) is None
    fisheye = replace(camera, model="OPENCV_FISHEYE", fx=8.0, fy=8.0, distortion=(0.0, 0.0, 0.0, 0.0))
    valid = player.reach(fisheye)
    assert valid.shape == (24, 32)
    assert valid[12, 16]
    assert not valid[0, 0]  # 143 degrees off the axis: behind the lens


def test_scenes_are_merged_and_pages_written(recording, tmp_path, capsys):
    reel, capture, merged = str(recording.reel), str(recording.capture), tmp_path / "all.json"
    command = ["eval", reel, capture, "--out", str(tmp_path / "out"), "--backend", "reference", "--json", str(merged)]
    assert main([*command, "--speed"]) == 0
    said = capsys.readouterr().out
    assert "LPIPS was not measured" in said
    assert "frames per second" in said
    page = (tmp_path / "out" / "index.html").read_text()
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert all(text in page for text in ("DSSIM2", "<td>103</td>", f"{metrics['frames']['103']['psnr']:.2f}"))
    other = json.loads(merged.read_text())
    scene = next(iter(other["scenes"].values()))
    other["scenes"]["worse"] = {**scene, "mean": {name: value - 10 for name, value in scene["mean"].items()}}
    merged.write_text(json.dumps(other))
    assert main(command) == 0
    result = json.loads(merged.read_text())
    assert len(result["scenes"]) == 2
    assert result["mean"]["psnr"] == pytest.approx(metrics["mean"]["psnr"] - 5, abs=1e-5)
    merged.write_text('{"scenes": [1]}')
    assert main(command) == 2
    assert "name another file with --json" in capsys.readouterr().err


def make_full(model):
    features = np.concatenate([model.features, np.zeros((len(model), 6), np.float32)], axis=1)
    return replace(model, features=features)
