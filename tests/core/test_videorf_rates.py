# SPDX-License-Identifier: GPL-3.0-or-later
"""The comparison of VideoRF's variants: what they change, how they are coded, what is kept and said."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from holoreel.core.bench import coding as coding_module
from holoreel.core.bench import curves, videorf
from holoreel.core.bench.bdrate import bd_rate
from holoreel.core.bench.coding import coded_rungs, measure, measure_model
from holoreel.core.bench.split import measure_splits, table
from holoreel.core.bench.variants import FIGURE_7, VARIANTS, Coding, find_variant, training_of
from holoreel.core.bench.videorf import Finished, compare, run_videorf
from holoreel.core.camera import Camera
from holoreel.core.capture import Capture, write_capture
from holoreel.core.cli import main
from holoreel.core.errors import HoloreelError
from holoreel.core.images import write_png
from holoreel.core.videorf.codec import CODECS
from holoreel.core.videorf.config import VideoConfig
from holoreel.core.videorf.encode import RungSpec, reel_size, write_reel
from holoreel.core.videorf.player import FieldPlayer
from holoreel.core.videorf.run import RunPaths, TrainedVideo

from .videorf_ball import CENTER, ball_capture
from .videorf_model import ball_model

CONFIG = VideoConfig()


@pytest.fixture(scope="module")
def model():
    return ball_model(frames=4)


@pytest.fixture(scope="module")
def capture(model, tmp_path_factory):
    """Pictures of the model itself, as two cameras see it; one is held out."""
    folder = tmp_path_factory.mktemp("seen")
    player, images, cameras = FieldPlayer(model), {}, {}
    for name, place in {"left": (3, 0.5, 0.4), "right": (0.3, 3, -0.5)}.items():
        camera = Camera.look_at(np.array(place), np.zeros(3), width=40, height=32, fx=45, name=name)
        cameras[name] = camera
        for frame in range(model.frame_count):
            drawn = player.draw(camera, model.frame_start + frame, (0.0, 0.0, 0.0))
            color = drawn.image / np.maximum(drawn.alpha, 1e-3)[..., None]
            images[name, frame] = folder / name / f"{frame:04d}.png"
            write_png(images[name, frame], np.concatenate((color.clip(0, 1), drawn.alpha[..., None]), -1))
    seen = Capture(
        cameras,
        images,
        model.frame_count,
        frame_start=model.frame_start,
        splits={"right": "test"},
        source=folder / "transforms.json",
    )
    write_capture(folder, seen)
    return seen


def test_every_variant_changes_something_that_exists():
    keys = [variant.key for variant in VARIANTS]
    assert len(set(keys)) == len(keys)
    for variant in VARIANTS:
        same = variant.config(CONFIG) == CONFIG and variant.how == Coding()
        assert same == (variant.key == "full")
        assert len(variant.settings) + len(variant.coding) <= 2
    assert FIGURE_7[0] == "full"
    assert [find_variant(key).config(CONFIG) == CONFIG for key in FIGURE_7] == [True] + [False] * 5
    assert find_variant("no_grouping").config(CONFIG) == replace(CONFIG, grouping=False)


def test_variants_are_joined():
    both = find_variant("superblocks+av1")
    assert both.config(CONFIG) == replace(CONFIG, image_layout="superblocks")
    assert both.how == find_variant("av1").how
    assert (both.key, training_of(both)) == ("superblocks+av1", "superblocks")
    assert training_of(find_variant("hevc+percentile")) == "full"
    assert training_of(find_variant("hevc+warm+key_frames+density_16")) == "warm+density_16"
    assert find_variant("full+hevc") == find_variant("hevc")
    with pytest.raises(HoloreelError, match="there is no row 'colour'; take some of full, no_spatial_loss"):
        find_variant("hevc+colour")


def test_rungs_are_those_of_the_reel_and_lose_more_and_more(model, capture, tmp_path):
    reel = tmp_path / "a.reel"
    found = list(coded_rungs(model, Coding(qps=(8, 36, 48)), reel))
    scores = [measure(player, capture) for _, _, player in found]
    assert [qp for qp, _, _ in found] == [8, 36, 48]
    for index, (qp, size, player) in enumerate(found):
        assert size == reel_size(player.source.reel, index)
        assert size.total == sum(
            (tmp_path / name).stat().st_size for name in ("a.reel", "a.tables", "a.shading", f"a.qp{qp}.mp4")
        )
    uncoded = measure_model(model, capture)["pooled"]["psnr"]
    psnr = [part["pooled"]["psnr"] for part in scores]
    assert uncoded > psnr[0] + 1 > psnr[1] + 5 > psnr[2] + 8
    assert list(scores[0]["frames"]) == ["101", "102", "103", "104"]


def test_key_frames_elsewhere_cost_what_they_cost(model, capture, tmp_path):
    """A video of one group has its IDR frame where a reel has it: every byte and every score is the same."""
    whole = replace(model, groups=model.groups[:1], tables=model.tables[:1])
    assert whole.frame_count > 1
    part = replace(
        capture,
        images={view: media for view, media in capture.images.items() if view[1] < whole.frame_count},
        frame_count=whole.frame_count,
    )
    found = {
        heads: next(coded_rungs(whole, Coding(qps=(30,), heads=heads), tmp_path / heads / "a.reel"))
        for heads in ("groups", "video", "frames")
    }
    bytes_of = {heads: size.video for heads, (_, size, _) in found.items()}
    assert found["groups"][1] == found["video"][1]
    assert measure(found["groups"][2], part) == measure(found["video"][2], part)
    assert bytes_of["frames"] > bytes_of["groups"]

    coding = Coding(qps=(30,), heads="video")
    _, size, player = next(coded_rungs(model, coding, tmp_path / "c.reel"))  # one IDR frame for several tables
    assert size.tables == sum(len(mapping.bitmask()) for mapping in model.tables)
    errors = [
        abs(player.source.rows(frame) - model.rows(frame)).mean() / model.ranges.step.mean()
        for frame in range(model.frame_count)
    ]
    assert max(errors) < 8


def test_ranges_by_percentile_leave_outliers_out(model, tmp_path):
    _, _, player = next(coded_rungs(model, Coding(qps=(30,), percentile=10), tmp_path / "a.reel"))
    ranges = player.source.ranges
    assert ranges.low[0] == model.ranges.low[0]
    narrower = ranges.step / model.ranges.step
    assert (narrower <= 1).all()
    assert (narrower < 0.99).sum() >= 4


class Trainer:
    """In place of a training: leaves the model; `calls` are the variants' folders and whether they were resumed."""

    def __init__(self, model):
        self.model, self.calls, self.stops = model, [], 0

    def __call__(self, capture, out, config, on_progress, resume, coarse):
        paths = RunPaths(out)
        self.calls.append((out.parent.name, resume, coarse.name))
        paths.checkpoint.mkdir(parents=True, exist_ok=True)
        if self.stops:
            self.stops -= 1
            raise KeyboardInterrupt
        shutil.rmtree(paths.checkpoint)
        self.model.write(paths.model)
        return TrainedVideo(None, self.model, {"coarse": 50.0, "shading": 3.0, "frames": 5.0, "encode": 7.0})


@pytest.fixture
def trainer(model, monkeypatch):
    fake = Trainer(model)
    monkeypatch.setattr(videorf, "train_video", fake)
    return fake


def test_rows_share_trainings_and_are_kept(trainer, capture, tmp_path, monkeypatch):
    folder, heard = capture.source.parent, []
    small = {name: replace(find_variant(name), coding=find_variant(name).coding | {"qps": (30, 40)}) for name in
             ("full", "percentile", "warm", "key_frames")}  # fmt: skip
    monkeypatch.setattr(videorf, "find_variant", small.__getitem__)
    names = ("percentile", "warm", "key_frames")
    rows = run_videorf(folder, tmp_path, CONFIG, names, lambda *now: heard.append(now))
    assert list(rows) == ["full", *names]
    assert [(name, resume) for name, resume, _ in trainer.calls] == [("full", False), ("warm", False)]
    assert len({coarse for *_, coarse in trainer.calls}) == 1
    assert rows["full"].seconds == 8.0
    assert rows["full"].frames == 4
    assert ("warm: QP 40", 1, 2) in heard
    assert (tmp_path / "rows/key_frames/right/0103.png").is_file()

    monkeypatch.setattr(videorf, "coded_rungs", None)
    assert run_videorf(folder, tmp_path, CONFIG, names, print) == rows
    with monkeypatch.context() as patch:  # another way of encoding is another row
        slower = CODECS["h264"]._replace(options=CODECS["h264"].options | {"preset": "veryslow"})
        patch.setitem(CODECS, "h264", slower)
        with pytest.raises(TypeError):
            run_videorf(folder, tmp_path, CONFIG, names, print)
    monkeypatch.setattr(videorf, "coded_rungs", coding_module.coded_rungs)
    run_videorf(folder, tmp_path, replace(CONFIG, rays=100), ("percentile",), lambda *now: None)
    run_videorf(folder, tmp_path, replace(CONFIG, rays=100, gamma=0.1), ("percentile",), lambda *now: None)
    coarse = [name for *_, name in trainer.calls]
    assert [name for name, *_ in trainer.calls[2:]] == ["full", "full"]
    assert coarse[0] == coarse[2] != coarse[3]


def test_a_stopped_training_goes_on(trainer, capture, tmp_path):
    bench = videorf.VideoBench(capture, tmp_path, CONFIG)
    full = find_variant("full")
    trainer.stops = 2
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            bench.training(full)
    again = bench.training(find_variant("hevc"))
    assert [resume for _, resume, _ in trainer.calls] == [False, True, True]
    assert again.seconds["frames"] == 5.0
    trainer.stops = 1
    with pytest.raises(KeyboardInterrupt):
        replace(bench, base=replace(CONFIG, rays=1)).training(full)  # begins anew, and is stopped
    bench.training(full)  # what was stopped had other settings
    assert [resume for _, resume, _ in trainer.calls[3:]] == [False, False]


def scores_of(psnr, frames=(30.0,)):
    mean = {"psnr": psnr + 1, "psnr_mask": psnr - 5, "ssim": psnr / 40}
    return {
        "mean": mean,
        "pooled": {"psnr": psnr, "psnr_mask": psnr - 6},
        "pooled_cameras": {"cam06": {"psnr": psnr, "psnr_mask": psnr - 6}},
        "cameras": {},
        "frames": {str(place): {"psnr": value, "ssim": 0.9} for place, value in enumerate(frames)},
    }


def finished(key, points, groups=((2, 10), (3, 12)), frames=(30.0, 29.0, 31.0, 32.0, 29.5)):
    rungs = [
        {
            "qp": 16 + 4 * place,
            "size": {
                "video": 0,
                "tables": 500,
                "shading": 1,
                "manifest": 2,
                "total": 5000 * rate,
                "per_frame": 1000.0 * rate,
            },
            "scores": scores_of(psnr, frames),
        }
        for place, (rate, psnr) in enumerate(points)
    ]
    return Finished(find_variant(key), rungs, scores_of(points[0][1] + 0.05), [list(group) for group in groups], 10.0)


BASE = [(40, 33.0), (25, 32.8), (12, 32.0), (6, 30.5)]


def test_rows_are_compared_by_bd_rate():
    full = finished("full", BASE)
    worse = finished("no_blocks", [(1.5 * rate, psnr) for rate, psnr in BASE])
    assert compare(full, worse, "psnr").change == pytest.approx(0.5)
    assert compare(full, worse, "psnr_mask") == bd_rate(full.curve("psnr_mask"), worse.curve("psnr_mask"))
    assert [point.quality for point in full.curve("psnr_mask")] == pytest.approx([27.0, 26.8, 26.0, 24.5])
    assert full.curve("ssim")[0] == (40.0, 33.0 / 40)
    rows = {"full": full, "no_blocks": worse, "warm": finished("warm", [(2 * rate, psnr) for rate, psnr in BASE])}
    heading, *lines = curves.overview(rows)
    cells = [dict(zip(heading, line, strict=True)) for line in lines]
    assert [line["at PSNR"] for line in cells] == ["-", "+50.0 %", "+100.0 %"]
    assert [line["vs warm"] for line in cells] == ["-50.0 %", "-25.0 %", "-"]
    assert cells[0] | {"kB": "25.0", "tables": "0.10", "GOFs": "2", "s/frame": "2.0", "uncoded": "33.05"} == cells[0]
    assert curves.as_dict(rows, "no_blocks")["against"]["full"]["psnr"] == {
        "change": pytest.approx(0.5),
        "low": 30.5,
        "high": 33.0,
    }
    far = finished("hevc", [(5, 20.0), (4, 19.0)])
    assert curves.overview({"full": full, "hevc": far})[2][1] == "apart"
    assert curves.as_dict({"full": full, "hevc": far}, "hevc")["against"] == {"full": {}}


def test_the_top_rung_is_judged():
    full = finished("full", BASE)
    assert curves.drift(full) == [(30.0, 29.0), (31.0, 29.5)]
    assert curves.drift(finished("no_grouping", BASE, ((1, 10),) * 5)) == []
    assert curves.positions(full)[1:] == [
        ("0", "2", "30.50", "0.9000"),
        ("1", "2", "30.50", "0.9000"),
        ("2", "1", "29.50", "0.9000"),
    ]
    rungs = curves.ladder(full)
    assert rungs[1][:4] == ("16", "40.00", "1.60", "33.00")
    assert rungs[2][rungs[0].index("loss dB")] == "0.25"
    said = " ".join(curves.remarks(full))
    assert "cam06 32.80 / 26.80 dB" in said
    assert "30.00 to 29.00, 31.00 to 29.50 dB; at most 1.50 dB are lost" in said
    assert 12 / 25 < float(said.split("0.5 dB below QP 20 takes ")[1].split()[0]) < 1


def test_mistakes_get_a_sentence(trainer, capture, tmp_path):
    with pytest.raises(HoloreelError, match="no row 'colour'"):
        run_videorf(capture.source.parent, tmp_path, CONFIG, ("colour",), print)
    write_capture(tmp_path / "all", replace(capture, splits={}))
    with pytest.raises(HoloreelError, match="hold one out"):
        run_videorf(tmp_path / "all", tmp_path, CONFIG, (), print)
    assert trainer.calls == []
    assert main(["bench", "videorf", "--scene", str(tmp_path), "--preset", "best"]) == 2
    assert main(["bench", "march", "--repeats", "0"]) == 2


def test_from_a_capture_to_tables_and_a_page(tmp_path, capsys):
    centers = [CENTER + np.array([0.1 * frame, 0, 0]) for frame in range(3)]
    scene, out = tmp_path / "ball", tmp_path / "out"
    write_capture(scene, ball_capture(scene, 3, centers=centers, painted=True, splits={"cam05": "test"}))
    few = "--resolution 16 --rays 256 --first-iterations 30 --head-iterations 20 --iterations 15 --coarse.iterations 20"
    command = ["bench", "videorf", "--scene", str(scene), "--out", str(out), "--size", "32x24", *few.split()]
    assert main([*command, "--rows", "no_grouping", "hevc"]) == 0
    said = capsys.readouterr().out
    results = json.loads((out / "videorf.json").read_text())
    assert list(results["rows"]) == ["full", "no_grouping", "hevc"]
    assert [rung["qp"] for rung in results["rows"]["hevc"]["rungs"]] == list(Coding().qps)
    assert {split["quality"] for split in results["speed"]} == {"full", "fast", "draft"}
    assert len(results["rows"]["no_grouping"]["groups"]) == 3 > len(results["rows"]["full"]["groups"])
    assert "no_grouping" in said
    page = (out / "index.html").read_text()
    assert "curves.svg" in page
    assert (out / "curves.svg").read_text().lstrip().startswith("<?xml")
    assert len(list((out / "rows/crops").glob("*.png"))) == 4


def test_the_split_of_a_played_frame(model, capture, tmp_path, capsys):
    reel = tmp_path / "a.reel"
    write_reel(model, reel, [RungSpec(30), RungSpec(20, "hevc")])
    splits = measure_splits(reel, capture.cameras["right"], "hevc:20")
    assert [split.rung for split in splits] == ["hevc:20"] * 3
    for split in splits:
        assert min(split.decode, split.unpack, split.render) > 0
        assert split.fps <= split.overlapped_fps
    assert [line[0] for line in table(splits)] == ["quality", "full", "fast", "draft"]
    quick = replace(splits[0], decode=4.0, unpack=1.0, render=3.0, rest=2.0)
    assert (quick.fps, quick.overlapped_fps) == (100.0, pytest.approx(1000 / 7))
    view = ["--view", str(capture.source.parent), "--size", "16x12", "--rung", "30", "--json", str(tmp_path / "a.json")]
    assert main(["bench", "render", str(reel), *view]) == 0
    assert "Playing rung h264:30 at 16x12" in capsys.readouterr().out
    assert json.loads((tmp_path / "a.json").read_text())["splits"][2]["quality"] == "draft"
