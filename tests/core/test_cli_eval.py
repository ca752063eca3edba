# SPDX-License-Identifier: GPL-3.0-or-later
"""`holoreel eval`: a reel measured against pictures of itself, and against others'."""

import json

import numpy as np
import pytest
from holoreel.core.capture import read_capture
from holoreel.core.cli import main
from holoreel.core.evaluate import evaluate
from holoreel.core.images import read_image
from holoreel.core.metrics import score
from holoreel.core.reel import save_gaussians


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
