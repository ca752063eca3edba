# SPDX-License-Identifier: GPL-3.0-or-later
"""The ablation's rows, its table, and that finished rows are kept."""

import json
from dataclasses import replace

import numpy as np
import pytest
from holoreel.core.bench import ablation
from holoreel.core.bench.ablation import (
    PARTS,
    Finished,
    ablate,
    as_text,
    default_config,
    fingerprint,
    run_ablation,
    table,
    worst_place,
)
from holoreel.core.capture import Points, read_capture, write_capture, write_points
from holoreel.core.errors import HoloreelError
from holoreel.core.render import get_backend


@pytest.fixture(scope="module")
def scene(recording, tmp_path_factory):
    """The recording with the true places as seed points, as a folder."""
    folder = tmp_path_factory.mktemp("scenes") / "tiny"
    capture = read_capture(recording.capture)
    seeds = {}
    for frame in range(3):
        now = recording.model.evaluate(frame / 3)
        seeds[frame] = folder / "seeds" / f"{frame}.ply"
        seeds[frame].parent.mkdir(parents=True, exist_ok=True)
        write_points(seeds[frame], Points(now.means, np.full((len(now), 3), 100, np.uint8)))
    write_capture(folder, replace(capture, seeds=seeds))
    return folder


def test_each_row_goes_without_one_part():
    config = default_config(100, 1000)
    changed = {part.key: part.change(config) for part in PARTS}
    assert changed["full"] == config
    assert (config.model, config.motion, config.rotation, config.temporal_opacity) == ("full", 3, 1, True)
    assert config.guided.times > 0
    assert changed["temporal_opacity"] == replace(config, temporal_opacity=False)
    assert changed["motion"] == replace(config, motion=0)
    assert changed["rotation"] == replace(config, rotation=0)
    assert changed["features"] == replace(config, model="lite")
    assert changed["guided"].guided == replace(config.guided, times=0)
    assert replace(changed["guided"], guided=config.guided) == config


def test_a_table_is_made_and_finished_rows_are_kept(scene, tmp_path, monkeypatch):
    backend = get_backend("reference")
    trained = []
    original = ablation.train_reel
    monkeypatch.setattr(
        ablation, "train_reel", lambda *args, **more: trained.append(args[1]) or original(*args, **more)
    )
    said = list(run_ablation([scene], tmp_path, 3, 60, ("features", "full"), (), backend))
    assert [path.parent.name for path in trained] == ["full", "features"]
    results = json.loads((tmp_path / "ablation.json").read_text())["scenes"]["tiny"]
    assert list(results) == ["features", "full"]
    difference = results["features"]["psnr"] - results["full"]["psnr"]
    assert f"({difference:+.2f})" in said[0]
    assert (tmp_path / "index.html").is_file()
    assert len(list((tmp_path / "tiny" / "crops").glob("*.png"))) == 3
    assert json.loads((tmp_path / "tiny/features/model.reel").read_text())["variant"] == "lite"
    assert json.loads((tmp_path / "tiny/full/model.reel").read_text())["variant"] == "full"

    again = list(run_ablation([scene], tmp_path, 3, 60, ("features", "full"), (), backend))
    assert again == said
    assert len(trained) == 2
    list(run_ablation([scene], tmp_path, 4, 60, ("full",), (), backend))  # another budget is another row
    assert len(trained) == 3


def test_another_recording_is_another_capture(scene, recording):
    capture = read_capture(scene)
    assert fingerprint(capture) == fingerprint(read_capture(scene))
    assert fingerprint(capture) != fingerprint(read_capture(recording.capture))
    assert fingerprint(capture) != fingerprint(replace(capture, splits={"left": "test"}))


def test_differences_are_against_full():
    def row(key, **mean):
        return Finished(next(part for part in PARTS if part.key == key), mean, 10, 1.0)

    rows = {
        "motion": row("motion", psnr=29.5, dssim1=0.05, lpips_alex=0.2),
        "full": row("full", psnr=30.75, dssim1=0.04, lpips_alex=0.15),
    }
    lines = table(rows)
    assert lines[0] == ("Method", "PSNR dB", "DSSIM1", "LPIPS alex", "Gaussians", "seconds")
    assert lines[1][:4] == ("w/o Polynomial Motion", "29.50 (-1.25)", "0.0500 (+0.0100)", "0.2000 (+0.0500)")
    assert lines[2][:2] == ("Ours Full", "30.75")
    assert "LPIPS" not in as_text(table(rows | {"full": row("full", psnr=30.0, dssim1=0.04)}))


def test_crops_show_where_rows_differ_most():
    same, other = np.ones((40, 80)), np.ones((40, 80))
    other[20:30, 50:60] = 9.0
    (row, column), side = worst_place([same, other])
    assert side == 20
    assert row <= 20
    assert row + side >= 30
    assert column <= 50
    assert column + side >= 60


def test_mistakes_get_a_sentence(scene, recording, tmp_path):
    backend = get_backend("reference")
    with pytest.raises(HoloreelError, match="no such row"):
        ablate(scene, tmp_path, default_config(1, 10), backend, ("colour",))
    with pytest.raises(HoloreelError, match="another name"):
        list(run_ablation([scene, scene], tmp_path, 1, 10, (), (), backend))
    with pytest.raises(HoloreelError, match="--iterations"):
        list(run_ablation([scene], tmp_path, 0, 10, (), (), backend))
