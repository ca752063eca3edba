# SPDX-License-Identifier: GPL-3.0-or-later
"""`holoreel info` and `holoreel doctor`: facts in, facts out."""

import json

import numpy as np
import pytest
from holoreel.core.cli import main
from holoreel.core.gaussians.decoder import Decoder, write_pt
from holoreel.core.gaussians.ply import write_ply
from holoreel.core.reel import SegmentPayload, write_segments


def info(path, capsys) -> dict:
    assert main(["info", str(path), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert main(["info", str(path)]) == 0
    table = capsys.readouterr().out
    assert all(problem in table for problem in facts["problems"])
    return facts


def test_a_reel(recording, capsys):
    facts = info(recording.reel, capsys)
    assert facts["what"] == "a reel of lite Spacetime Gaussians"
    assert facts["gaussians"] == 60
    assert facts["frames"] == "3 from frame 101 at 24 fps"
    assert facts["bytes in memory"] == 60 * 29 * 4
    np.testing.assert_allclose(facts["bounds"], recording.model.bounds())
    payload = recording.reel.with_suffix(".ply")
    assert facts["bytes on disk"] == payload.stat().st_size + recording.reel.stat().st_size


def test_a_ply_with_problems(tmp_path, random_model, capsys):
    model = random_model(20, features=9)
    model.means[4] = float("nan")
    model.quats[7] = model.omegas[7] = 0.0
    write_ply(tmp_path / "a.ply", model)
    facts = info(tmp_path / "a.ply", capsys)
    assert facts["what"] == "full Spacetime Gaussians in a ply file"
    said = " ".join(facts["problems"])
    for words in ("1 row of 20 left out", "1 row with zero quat", "decoder", "50 frames at 30 fps are assumed"):
        assert words in said


def test_a_full_reel_of_segments(tmp_path, random_model, capsys):
    decoder = Decoder(np.zeros((6, 12)), np.zeros((3, 6)), "clamp")
    parts = [SegmentPayload(random_model(20 + i, i, features=9), decoder, 5 * i, 5) for i in range(2)]
    write_segments(tmp_path / "a.reel", parts, fps=24, frame_start=0, suffix=".stgc")
    facts = info(tmp_path / "a.reel", capsys)
    assert facts["what"] == "a reel of full Spacetime Gaussians"
    assert facts["decoder"] == "per pixel, output activation clamp"
    assert facts["gaussians"] == 41
    assert facts["bytes on disk"] == sum(path.stat().st_size for path in tmp_path.iterdir())
    size = sum((tmp_path / f"a.001{suffix}").stat().st_size for suffix in (".stgc", ".decoder.safetensors"))
    assert facts["segments"][1] == f"a.001.stgc: 5 frames from 5, 21 Gaussians, {size:,} bytes"


def test_the_activation_of_bare_files_can_be_said(tmp_path, random_model, capsys):
    write_ply(tmp_path / "a.ply", random_model(5, features=9))
    write_pt(tmp_path / "a.pt", Decoder(np.zeros((6, 12)), np.zeros((3, 6))))
    facts = info(tmp_path / "a.ply", capsys)
    assert facts["decoder"] == "per pixel, output activation sigmoid"
    assert any("a sigmoid is assumed" in problem for problem in facts["problems"])
    assert main(["info", str(tmp_path / "a.ply"), "--decoder-output", "none", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["decoder"] == "per pixel, output activation none"
    assert not any("sigmoid" in problem for problem in facts["problems"])


def test_a_capture(recording, capsys):
    for path in (recording.folder, recording.capture):
        facts = info(path, capsys)
        assert facts["what"] == "a multi-view capture"
        assert facts["cameras"] == {"left": "32x24 PINHOLE, train", "right": "32x24 PINHOLE, test"}
        assert facts["pictures"] == 6
        assert facts["frames"] == "3 from frame 101 at 24 fps"
        assert "seed points" in facts["problems"][0]


@pytest.mark.parametrize(("name", "bad"), [("spinach_4", 0), ("yellow_clip2", 122)])
def test_files_made_by_others(shared_data, capsys, name, bad):
    facts = info(shared_data(f"stg_splatv/{name}.splatv"), capsys)
    assert facts["gaussians"] == {"spinach_4": 62442, "yellow_clip2": 51773 - 122}[name]
    assert any(sentence.startswith(f"{bad} rows of") for sentence in facts["problems"]) == bool(bad)


@pytest.mark.parametrize("name", ["absent.reel", "absent.ply", "empty.ply", "empty.splatv", "notes.txt", "."])
def test_mistakes_get_a_sentence(tmp_path, capsys, name):
    for empty in ("empty.ply", "empty.splatv", "notes.txt"):
        (tmp_path / empty).write_bytes(b"")
    assert main(["info", str(tmp_path / name)]) == 2
    said = capsys.readouterr().err
    assert said.startswith("holoreel info: ")
    assert str(tmp_path) in said
    assert said.count("\n") == 1


def test_doctor_has_a_remedy_for_what_is_missing(tmp_path, capsys):
    assert main(["doctor", "--blender", str(tmp_path / "none"), "--json"]) == 0
    findings = {finding["name"]: finding for finding in json.loads(capsys.readouterr().out)}
    assert findings["torch"]["works"]
    assert not findings["Blender"]["works"]
    assert "bpy" in findings["Blender"]["remedy"]
    assert all(finding["works"] or finding["remedy"] for finding in findings.values())
    assert main(["doctor", "--blender", str(tmp_path / "none")]) == 0
    said = capsys.readouterr().out
    assert "MISSING  Blender" in said
    assert f"→ {findings['Blender']['remedy']}" in said


def test_doctor_refuses_what_is_no_blender(tmp_path, capsys):
    pretender = tmp_path / "blender"
    for script in ("#!/bin/sh\necho hello\n", "#!/bin/sh\nexit 3\n", "#!/bin/sh\necho version 4.1.0\n"):
        pretender.write_text(script)
        pretender.chmod(0o755)
        assert main(["doctor", "--blender", str(pretender), "--json"]) == 0
        finding = json.loads(capsys.readouterr().out)[-1]
        assert not finding["works"]
        assert finding["remedy"]
