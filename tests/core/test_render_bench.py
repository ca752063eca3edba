# SPDX-License-Identifier: GPL-3.0-or-later
"""The measuring code measures what it says; no time is judged."""

import json

import pytest
from holoreel.core.bench import raster as bench
from holoreel.core.bench import render
from holoreel.core.bench import train as train_bench
from holoreel.core.cli import main


@pytest.fixture
def small(monkeypatch):
    """A table of two quick rows."""
    monkeypatch.setattr(bench, "SIZES", ((64, 48),))
    monkeypatch.setattr(bench, "COUNTS", (500,))
    monkeypatch.setattr(bench, "CHANNELS", (3,))


def test_table_and_json(small, tmp_path, capsys):
    out = tmp_path / "figures.json"
    assert main(["bench", "raster", "--no-reference", "--rounds", "2", "--json", str(out)]) == 0
    figures = json.loads(out.read_text())
    assert figures["machine"]["cores"] >= 1
    assert [row["setup"]["threads"] for row in figures["rows"]] == [1, 2]
    for row in figures["rows"]:
        assert row["intersections"] > 0
        assert 0 < row["raster"] < row["total"]
        assert row["best_total"] <= row["total"]
    assert "64x48" in capsys.readouterr().out


def test_reference_row():
    row = bench.measure_reference(bench.Setup(64, 48, 200, 3, 1))
    assert row.backend == "reference"
    assert row.total > 0


def test_missing_folder_is_named(tmp_path, capsys):
    assert main(["bench", "raster", "--json", str(tmp_path / "nowhere" / "figures.json")]) == 2
    assert "--json" in capsys.readouterr().err


def test_split_of_a_training_iteration(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(train_bench, "SETUPS", (train_bench.Setup(48, 32, 200),))
    out = tmp_path / "train.json"
    for preset in ("lite", "full"):
        assert main(["bench", "train", "--preset", preset, "--rounds", "2", "--json", str(out)]) == 0
        (row,) = json.loads(out.read_text())["rows"]
        parts = row["parts"]
        assert tuple(parts) == train_bench.STAGES
        assert all(parts[stage] > 0 for stage in train_bench.STAGES if stage not in ("density", "rest"))
        assert 0 < row["raster"] < row["total"]
        assert row["ratio"] == pytest.approx(row["total"] / row["raster"])
    assert "times the raster kernels'" in capsys.readouterr().out


@pytest.mark.parametrize("view", ["camera", "capture"])
def test_frames_per_second_of_a_reel(recording, view, tmp_path, capsys):
    out = tmp_path / "render.json"
    command = ["bench", "render", str(recording.reel), "--view", str(getattr(recording, view)), "--json", str(out)]
    assert main([*command, "--size", "64x48"]) == 0
    figures = json.loads(out.read_text())
    assert (figures["width"], figures["height"], figures["frames"]) == (64, 48, 3)
    assert all(speed["fps"] > 0 and speed["authors_fps"] > 0 for speed in figures["speeds"].values())
    assert tuple(figures["speeds"]) == tuple(render.METHODS)
    assert "temporal culling is" in capsys.readouterr().out
    assert main([*command, "--size", "64"]) == 2
    assert "--size 64" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments", [["--help"], *([what, "--help"] for what in ("raster", "train", "seams", "ablation"))]
)
def test_help(arguments):
    with pytest.raises(SystemExit) as stopped:
        main(["bench", *arguments])
    assert stopped.value.code == 0


def test_the_authors_protocol_leaves_out_the_first_frames_and_averages_seconds():
    passes = [[9.0] * 11 + [0.1, 0.3], [9.0] * 11 + [0.2, 0.2]]
    assert render._speed(passes).authors_fps == pytest.approx(5.0)
    assert render._speed([[0.1, 0.3]]).authors_fps == pytest.approx(5.0)  # too few frames to leave any out
