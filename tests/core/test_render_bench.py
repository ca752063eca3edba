# SPDX-License-Identifier: GPL-3.0-or-later
"""The measuring code measures what it says; no time is judged."""

import json

import pytest
from holoreel.core.cli import main
from holoreel.core.render import bench


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
