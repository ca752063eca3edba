# SPDX-License-Identifier: GPL-3.0-or-later
"""Training a VideoRF: what each stage hands on, what the switches do, and runs that are stopped anywhere."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from holoreel.core.capture import Capture
from holoreel.core.cli import main
from holoreel.core.errors import HoloreelError
from holoreel.core.videorf.coarse import Coarse, CoarseConfig
from holoreel.core.videorf.config import VideoConfig
from holoreel.core.videorf.draw import draw_field
from holoreel.core.videorf.encode import decoded_rows
from holoreel.core.videorf.field import FieldLattice
from holoreel.core.videorf.fine import (
    FrameTrainer,
    GroupField,
    clamped,
    moved_rows,
    new_network,
    psnr_of,
    rows_from_coarse,
    train_frames,
)
from holoreel.core.videorf.losses import spatial_loss
from holoreel.core.videorf.mapping import build_table
from holoreel.core.videorf.march import Volume
from holoreel.core.videorf.model import FieldVideo, read_field_video
from holoreel.core.videorf.occupancy import Lattice
from holoreel.core.videorf.package import read_video_reel
from holoreel.core.videorf.quantize import Ranges
from holoreel.core.videorf.run import RunPaths, TrainedVideo, VideoProgress, through_codec, train_video
from holoreel.core.videorf.views import FrameViews

from .videorf_ball import CENTER, RADIUS, ball_capture

FRAMES = 4
CENTERS = [CENTER + np.array([0.3 * frame, 0, 0]) for frame in range(FRAMES)]
QUICK = VideoConfig(
    resolution=29,
    headroom=1.15,
    rays=512,
    shading_groups=1,
    first_iterations=150,
    head_iterations=100,
    iterations=80,
    qps=(20, 36),
    coarse=CoarseConfig(iterations=40, rays=512),
)

SHORT = replace(QUICK, first_iterations=40, head_iterations=30, iterations=20)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """Four frames of a painted ball that moves along x, one camera held out."""
    bounds = (tuple(CENTER - RADIUS - 0.05), tuple(CENTERS[-1] + RADIUS + 0.05))
    return ball_capture(
        tmp_path_factory.mktemp("ball") / "ball",
        FRAMES,
        centers=CENTERS,
        painted=True,
        splits={"cam05": "test"},
        fps=24.0,
        frame_start=101,
        bounds=bounds,
    )


@pytest.fixture(scope="module")
def coarse(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of coarse fields that all runs here share."""
    return tmp_path_factory.mktemp("coarse")


@pytest.fixture(scope="module")
def trained(capture: Capture, coarse: Path, tmp_path_factory: pytest.TempPathFactory) -> TrainedVideo:
    """One run; nothing here may be changed."""
    return train_video(capture, tmp_path_factory.mktemp("run") / "ball.reel", SHORT, coarse=coarse)


def held_out_psnr(model: FieldVideo, capture: Capture, frame: int) -> float:
    """The PSNR of the held-out camera on white, drawn from the model's rows."""
    table = model.table_of(frame)
    volume = Volume(FieldLattice(model.lattice, table.lookup(), table.count + 1))
    rows = torch.from_numpy(np.concatenate((model.rows(frame), model.ranges.empty[None])))
    image = draw_field(volume, rows, model.shading, capture.cameras["cam05"]).image
    return psnr_of(float(((image - capture.image("cam05", frame, (1, 1, 1)) / 255.0) ** 2).mean()))


def differences(model: FieldVideo, frame: int) -> float:
    """The mean difference of a frame from the one before, in steps of the quantizer."""
    return float(np.abs((model.rows(frame) - model.rows(frame - 1)) / model.ranges.step).mean())


def variation(model: FieldVideo, frame: int) -> float:
    """The total variation of a frame's image."""
    table = model.table_of(frame)
    image = torch.from_numpy(table.to_image(model.rows(frame)))
    return float(spatial_loss(image, torch.from_numpy(table.valid()), torch.from_numpy(model.ranges.step)))


def test_a_run_ends_in_a_reel_that_shows_the_subject(capture: Capture, coarse: Path, tmp_path: Path) -> None:
    trained = train_video(capture, tmp_path / "ball.reel", QUICK, coarse=coarse)
    model = trained.model
    assert len(model.groups) > 1
    assert model.frame_count == FRAMES
    assert (model.fps, model.frame_start) == (24.0, 101)
    scores = [held_out_psnr(model, capture, frame) for frame in range(FRAMES)]
    assert min(scores) > 21, scores
    reel = read_video_reel(trained.reel.path)
    assert [(rung.qp, rung.codec) for rung in reel.rungs] == [(20, "h264"), (36, "h264")]
    assert [group.frames for group in reel.groups] == [group.count for group in model.groups]
    for frame, _, rows in decoded_rows(reel, 0):
        error = np.abs(rows - model.rows(frame)) / model.ranges.step
        assert np.median(error) < 3
    paths = RunPaths(reel.path)
    assert not paths.checkpoint.exists()
    record = json.loads(paths.record.read_text())
    assert record["config"]["rays"] == 512
    assert [group["vertices"] for group in record["groups"]] == [table.count for table in model.tables]
    assert len(record["psnr"]) == FRAMES
    assert "cam05" not in record["train_cameras"]
    assert set(trained.seconds) == {"coarse", "shading", "frames", "encode"}


def test_the_network_is_learned_from_first_frames_of_groups(
    trained: TrainedVideo, capture: Capture, coarse: Path, tmp_path: Path
) -> None:
    heads = {group.first for group in trained.model.groups}
    heard: dict[str, set[int]] = {}

    def listen(progress: VideoProgress) -> None:
        heard.setdefault(progress.stage, set()).add(progress.frame)

    config = replace(SHORT, shading_groups=2, first_iterations=5, head_iterations=2, iterations=2)
    train_video(capture, tmp_path / "a.reel", config, listen, coarse=coarse)
    assert heard["shading"] == set(sorted(heads)[:2])
    assert heard["frames"] == set(range(FRAMES)) - heard["shading"]


def stop_at(stage: str, frame: int) -> Callable[[VideoProgress], None]:
    """Return a listener that stops a run as Ctrl-C does."""

    def listen(progress: VideoProgress) -> None:
        if (progress.stage, progress.frame) == (stage, frame):
            raise KeyboardInterrupt

    return listen


def test_stopped_anywhere_a_run_ends_in_the_same_bits(trained: TrainedVideo, capture: Capture, tmp_path: Path) -> None:
    out = tmp_path / "ball.reel"

    stops = [("coarse", 2), ("shading", 0), ("frames", 1), ("frames", 3), ("encode", 2)]
    for index, (stage, frame) in enumerate(stops):
        with pytest.raises(KeyboardInterrupt):
            train_video(capture, out, SHORT, stop_at(stage, frame), resume=index > 0)
        assert not out.exists()
    heard: list[VideoProgress] = []
    again = train_video(capture, out, SHORT, heard.append, resume=True)
    assert {progress.stage for progress in heard} == {"encode"}
    assert (heard[-1].iteration, heard[-1].seconds_left) == (heard[-1].iterations, 0)
    for frame in range(FRAMES):
        assert np.array_equal(again.model.rows(frame), trained.model.rows(frame))
    before, after = RunPaths(trained.reel.path), RunPaths(out)
    for name in ("ball.qp20.mp4", "ball.qp36.mp4", "ball.shading", "ball.tables", "ball.reel"):
        assert (after.reel.parent / name).read_bytes() == (before.reel.parent / name).read_bytes(), name


def test_progress_counts_all_steps_up(capture: Capture, tmp_path: Path) -> None:
    heard: list[VideoProgress] = []
    previews: list[np.ndarray] = []

    def listen(progress: VideoProgress) -> None:
        heard.append(progress)
        if progress.preview is not None and not previews:
            previews.append(progress.preview())

    train_video(capture, tmp_path / "a.reel", replace(SHORT, coarse=CoarseConfig(iterations=5)), listen)
    (preview,) = previews
    shown = capture.cameras[(capture.camera_names("test") or capture.camera_names())[0]]
    assert preview.shape == (shown.height, shown.width, 3)
    assert preview.min() < 0.8 < preview.max()  # a subject over white
    done = [progress.iteration for progress in heard]
    assert done == sorted(done)
    assert done[-1] == heard[-1].iterations
    assert list(dict.fromkeys(progress.stage for progress in heard)) == ["coarse", "shading", "frames", "encode"]
    assert all(math.isfinite(progress.seconds_left) for progress in heard)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"spatial": 1e-3}, lambda model, other: variation(model, 1) < 0.8 * variation(other, 1)),
        ({"smooth": 1e-3}, lambda model, other: variation(model, 1) < 0.8 * variation(other, 1)),
        ({"temporal": 1e-2}, lambda model, other: differences(model, 1) < 0.8 * differences(other, 1)),
        ({"grouping": False}, lambda model, other: [group.count for group in model.groups] == [1] * FRAMES),
        ({"image_layout": "rows"}, lambda model, other: model.tables[0].layout == "rows"),
        ({"frequencies": None}, lambda model, other: model.shading.shape.direction_inputs == 0),
        ({"features": 9}, lambda model, other: model.channels == 10),
        ({"density_max": 1.0}, lambda model, other: model.rows(0)[:, 0].max() <= 1 < other.rows(0)[:, 0].max()),
        ({"feature_max": 0.5}, lambda model, other: np.abs(model.rows(0)[:, 1:]).max() <= 0.5),
        ({"image": 96}, lambda model, other: model.tables[0].size == (96, 96) and len(model.groups) == 1),
        ({"seed": 1}, lambda model, other: not np.array_equal(model.rows(0), other.rows(0))),
    ],
    ids=str,
)
def test_a_switch_does_what_it_says(
    trained: TrainedVideo, capture: Capture, coarse: Path, tmp_path: Path, changes: dict, says: Callable
) -> None:
    own = None if "seed" in changes else coarse
    model = train_video(capture, tmp_path / "a.reel", replace(SHORT, qps=(36,), **changes), coarse=own).model
    assert says(model, trained.model)


def test_a_frame_starts_where_it_is_told_to(capture: Capture, coarse: Path, tmp_path: Path) -> None:
    still = replace(SHORT, density_rate=1e-9, feature_rate=1e-9, qps=(36,), longest=2, image=64, iterations=1)
    rows = {}
    for start in ("warm", "coarse_density", "coarse"):
        out = tmp_path / f"{start}.reel"
        rows[start] = train_video(capture, out, replace(still, start=start), coarse=coarse).model.rows
    assert np.allclose(rows["warm"](1), rows["warm"](0), atol=1e-5)
    assert np.allclose(rows["coarse_density"](1)[:, 1:], rows["warm"](0)[:, 1:], atol=1e-5)
    assert np.allclose(rows["coarse_density"](1)[:, 0], rows["coarse"](1)[:, 0], atol=1e-5)
    assert not np.allclose(rows["coarse"](1), rows["coarse"](0), atol=0.1)
    assert np.allclose(rows["warm"](0), rows["coarse"](0), atol=1e-5)  # the network's frame knows no other


def test_rows_move_between_groups_by_place() -> None:
    """Rows that hold their vertex arrive at it; a new vertex takes the features of the nearest old one."""
    old_occupancy, new_occupancy = np.zeros((2, 9, 9, 9), bool)
    old_occupancy[2:5, 3:6, 3:6] = True
    new_occupancy[3:7, 3:6, 3:6] = True
    old, new = build_table(old_occupancy, (16, 16)), build_table(new_occupancy, (32, 16), "rows")
    rows = np.insert(old.vertices.astype(np.float32), 0, 100.0, axis=1)
    fresh = np.full((new.count, 4), -5.0, np.float32)
    moved = moved_rows(rows, old, new, fresh)
    kept = new.vertices[:, 0] < 5
    assert np.array_equal(moved[kept, 1:], new.vertices[kept])
    assert (moved[kept, 0] == 100).all()
    assert (moved[~kept, 0] == -5).all()
    assert (moved[~kept, 1] == 4).all()
    assert np.array_equal(moved[~kept, 2:], new.vertices[~kept, 1:])


def test_rows_from_a_coarse_field_keep_to_the_ranges() -> None:
    lattice = Lattice((4, 5, 6), (0.0, 0.0, 0.0), 1.0)
    density = np.arange(120, dtype=np.float32).reshape(4, 5, 6) - 20
    color = np.stack([np.full((4, 5, 6), value, np.float32) for value in (0.0, 0.5, 1.0)], -1)
    table = build_table(np.ones((4, 5, 6), bool), (16, 16))
    ranges = Ranges((-8.0, -2.0, -2.0, -0.5, -2.0), (16.0, 2.0, 2.0, 0.5, 2.0))
    rows = rows_from_coarse(Coarse(lattice, density, color, density), table, ranges)
    x, y, z = table.vertices.T.astype(int)
    assert np.array_equal(rows[:, 0], np.clip(x * 30 + y * 6 + z - 20, -8, 16).astype(np.float32))
    assert (rows[:, 1:] == [-1, 0, 0.5, 0]).all()


@pytest.fixture
def ready(capture: Capture) -> tuple[GroupField, FrameViews, np.ndarray]:
    """A group of one frame, its views, and rows of a translucent gray."""
    low, high = capture.bounds
    lattice = Lattice.around(np.array(low), np.array(high), 12)
    field = GroupField.of(lattice, build_table(np.ones(lattice.shape, bool), (64, 64)))
    return field, FrameViews(capture, 0), np.zeros((field.table.count, 8), np.float32)


def test_noise_comes_after_half_the_steps_and_is_that_of_rounding(
    ready: tuple[GroupField, FrameViews, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    field, views, start = ready
    trainer = FrameTrainer(field, views, 0, start, None, SHORT, 10)
    seen: list[float] = []
    quantum = torch.from_numpy(SHORT.ranges.step)
    original = FrameTrainer._table

    def spy(self: FrameTrainer) -> torch.Tensor:
        table = original(self)
        offsets = ((table - self.table) / quantum)[:-1]
        assert torch.equal(table[-1], self.table[-1])
        seen.append(float(offsets.abs().max()))
        if len(seen) > 5:
            assert offsets.std() == pytest.approx(12**-0.5, rel=0.05)
        return table

    monkeypatch.setattr(FrameTrainer, "_table", spy)
    train_frames([trainer], new_network(SHORT), False)
    assert seen[:5] == [0] * 5
    assert all(0.45 < value <= 0.5001 for value in seen[5:])


def test_the_empty_row_never_changes(ready: tuple[GroupField, FrameViews, np.ndarray]) -> None:
    field, views, start = ready
    trainer = FrameTrainer(field, views, 0, start, None, SHORT, 5)
    train_frames([trainer], new_network(SHORT), True)
    assert torch.equal(trainer.table[-1], torch.from_numpy(SHORT.ranges.empty))
    assert not np.array_equal(trainer.rows, start)


def test_the_network_changes_only_where_it_learns(ready: tuple[GroupField, FrameViews, np.ndarray]) -> None:
    field, views, start = ready
    network = new_network(SHORT)
    first = [part.clone() for part in network.state_dict().values()]
    train_frames([FrameTrainer(field, views, 0, start, None, SHORT, 3)], network, False)
    assert all(torch.equal(a, b) for a, b in zip(first, network.state_dict().values(), strict=True))
    train_frames([FrameTrainer(field, views, 0, start, None, SHORT, 3)], network, True)
    assert not any(torch.equal(a, b) for a, b in zip(first[-2:], list(network.state_dict().values())[-2:], strict=True))


def test_the_codec_is_asked_as_often_as_told(ready: tuple[GroupField, FrameViews, np.ndarray]) -> None:
    field, views, start = ready
    config = replace(SHORT, codec_from=0.5, codec_every=4, codec_qps=(20, 30), density_rate=0.01)
    asked: list[tuple[int, int]] = []

    def trip(rows: np.ndarray, qp: int) -> np.ndarray:
        asked.append((trainer.iteration, qp))
        return rows + 0.25

    trainer = FrameTrainer(field, views, 0, start, None, config, 20, trip)
    trainer.iteration = 12
    table = trainer._table()
    assert torch.allclose(table[:-1], trainer.table[:-1] + 0.25)
    assert torch.equal(table[-1], trainer.table[-1])
    trainer.iteration, trainer.offset, trainer.trips = 0, None, 0
    asked.clear()
    train_frames([trainer], new_network(config), False)
    assert asked == [(10, 20), (12, 30), (16, 20)]


def test_the_way_through_the_codec_is_that_of_a_reel(trained: TrainedVideo) -> None:
    """What the loop sees of a group's first two frames is what a player decodes of them."""
    model, reel = trained.model, trained.reel
    decoded = {frame: rows for frame, _, rows in decoded_rows(reel, 0)}
    assert model.groups[0].count > 1
    head = through_codec(model.tables[0], None, SHORT)(model.rows(0), 20)
    assert np.array_equal(head, decoded[0])
    second = through_codec(model.tables[0], model.rows(0), SHORT)(model.rows(1), 20)
    assert np.array_equal(second, decoded[1])


def test_clamping_takes_the_nearest_value_in_range() -> None:
    assert clamped(np.array([[-9.0, 3.0]]), Ranges((-8.0, -2.0), (16.0, 2.0))).tolist() == [[-8.0, 2.0]]


def test_a_capture_without_masks_is_refused(recording: object, tmp_path: Path) -> None:
    from holoreel.core.capture import read_capture

    with pytest.raises(HoloreelError, match="not all pictures have masks or transparency"):
        train_video(read_capture(recording.capture), tmp_path / "a.reel", SHORT)  # type: ignore[attr-defined]
    assert not (tmp_path / "a.checkpoint").exists()


def test_what_cannot_be_is_refused_before_hours_are_spent(capture: Capture, coarse: Path, tmp_path: Path) -> None:
    with pytest.raises(HoloreelError, match="a reel's name ends in"):
        train_video(capture, tmp_path / "a.mp4", SHORT)
    with pytest.raises(HoloreelError, match="no checkpoint to resume from"):
        train_video(capture, tmp_path / "a.reel", SHORT, resume=True)
    with pytest.raises(HoloreelError, match="QP of 99"):
        train_video(capture, tmp_path / "a.reel", replace(SHORT, qps=(99,)))
    with pytest.raises(HoloreelError, match=r"Frame 0 occupies .* its image has 256 pixels: raise gamma"):
        train_video(capture, tmp_path / "a.reel", replace(SHORT, image=16), coarse=coarse)
    with pytest.raises(HoloreelError, match="a stopped run lies here; pass --resume"):
        train_video(capture, tmp_path / "a.reel", SHORT)
    # The remedy does not cost what is done: settings may change until the network is trained.
    listen = stop_at("frames", 1)
    with pytest.raises(KeyboardInterrupt):
        train_video(capture, tmp_path / "a.reel", replace(SHORT, gamma=0.1), listen, resume=True, coarse=coarse)
    with pytest.raises(HoloreelError, match=r"a\.checkpoint: was made with another config\.gamma, config\.rays;"):
        train_video(capture, tmp_path / "a.reel", replace(SHORT, rays=7), resume=True, coarse=coarse)
    with pytest.raises(HoloreelError, match=r"was made with another border; pass the same settings"):
        train_video(capture, tmp_path / "b.reel", replace(SHORT, border=2), coarse=coarse)


def test_the_command_trains_and_says_what_it_made(
    capture: Capture, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from holoreel.core.capture import write_capture

    source = write_capture(tmp_path / "capture", capture)
    out = tmp_path / "a.reel"
    flags = ["--resolution", "16", "--rays", "64", "--first-iterations", "3", "--head-iterations", "2"]
    flags += ["--iterations", "2", "--coarse.iterations", "10", "--qps", "30", "--codecs", "h264"]
    command = ["train", "videorf", str(source.parent), "--out", str(out), "--preset", "fast", *flags]
    assert main([*command, "--no-keep-model"]) == 0
    assert "QP 30" in capsys.readouterr().out
    assert read_video_reel(out).frame_count == FRAMES
    assert not RunPaths(out).model.exists()
    assert main(command) == 0
    assert read_field_video(RunPaths(out).model).frame_count == FRAMES
    assert main(["train", "videorf", str(source.parent), "--out", str(out), "--preset", "no"]) == 2
    assert "take one of standard, fast, paper" in capsys.readouterr().err
