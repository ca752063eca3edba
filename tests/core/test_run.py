# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs on disk: segments become one reel, and what was stopped anywhere ends as if it had not been."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from holoreel.core.capture import Capture, Points, read_capture, write_points
from holoreel.core.errors import HoloreelError
from holoreel.core.gaussians.config import DensityConfig, TrainConfig
from holoreel.core.gaussians.run import RunPaths, train_reel
from holoreel.core.gaussians.train import Progress
from holoreel.core.reel import load_gaussians, read_reel
from holoreel.core.render import get_backend

QUICK = TrainConfig(
    iterations=30, checkpoint_every=10, segment=2, overlap=1, density=DensityConfig(prune_every=7, events=2)
)


@pytest.fixture(scope="module")
def capture(recording: Any, tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """Three frames with the true places as seed points."""
    folder = tmp_path_factory.mktemp("seeds")
    seeds = {}
    for frame in range(3):
        now = recording.model.evaluate(frame / 3)
        seeds[frame] = folder / f"{frame}.ply"
        write_points(seeds[frame], Points(now.means, np.full((len(now), 3), 100, np.uint8)))
    return replace(read_capture(recording.capture), seeds=seeds)


def run(
    capture: Capture,
    out: Path,
    config: TrainConfig,
    resume: bool = False,
    stop: Callable[[Progress], bool] | None = None,
) -> list[Progress]:
    """Train; stop as Ctrl-C would when `stop` says so."""
    heard: list[Progress] = []

    def listen(progress: Progress) -> None:
        heard.append(progress)
        if stop and stop(progress):
            raise KeyboardInterrupt

    train_reel(capture, out, config, get_backend(), listen, resume)
    return heard


def payloads(reel: Path) -> list[bytes]:
    folder, segments = reel.parent, read_reel(reel).segments
    files = [name for segment in segments for name in (segment.file, segment.decoder) if name]
    return [(folder / name).read_bytes() for name in files]


@pytest.mark.parametrize("model", ["lite", "full"])
def test_segments_make_one_reel_however_often_they_were_stopped(capture: Capture, tmp_path: Path, model: str) -> None:
    config = replace(QUICK, model=model)
    straight, stopped = tmp_path / "straight.reel", tmp_path / "stopped.reel"
    heard = run(capture, straight, config)
    assert (heard[-1].iteration, heard[-1].iterations) == (60, 60)
    assert heard[-1].seconds_left == 0
    reel = read_reel(straight)
    assert [(part.frame_start, part.frame_count) for part in reel.segments] == [(101, 2), (103, 1)]
    assert all((part.decoder is not None) == (model == "full") for part in reel.segments)
    record = json.loads(RunPaths(straight).record.read_text())
    assert [part["frame_start"] for part in record["segments"]] == [101, 103]
    assert [row["iteration"] for row in record["history"]][-1] == 60
    assert record["gaussians"] == sum(len(load_gaussians(straight, index).gaussians) for index in range(2))

    for at in (20, 50):
        with pytest.raises(KeyboardInterrupt):
            run(capture, stopped, config, resume=at > 20, stop=lambda progress, at=at: progress.iteration >= at)
        assert not stopped.exists()
    run(capture, stopped, config, resume=True)
    assert payloads(stopped) == payloads(straight)
    assert not RunPaths(stopped).checkpoint.exists()


def test_a_segment_begins_with_what_stood_still_before(capture: Capture, tmp_path: Path) -> None:
    still = replace(QUICK, iterations=1, overlap=0, motion=0, density=DensityConfig(prune_opacity=0.0, prune_depth=0.0))
    twins = {}
    for shared in (True, False):
        out = tmp_path / f"{shared}.reel"
        run(capture, out, replace(still, share_static=shared))
        one, two = (load_gaussians(out, index).gaussians.means for index in range(2))
        nearest = np.abs(one[:, None] - two[None]).max(axis=2).min(axis=1)
        twins[shared] = float((nearest < 0.05).mean())  # one step moves nothing farther
    assert twins[False] < 0.1
    assert twins[True] > 0.4


def test_a_finished_segment_of_other_settings_is_refused(capture: Capture, tmp_path: Path) -> None:
    out = tmp_path / "a.reel"
    with pytest.raises(KeyboardInterrupt):
        run(capture, out, QUICK, stop=lambda progress: progress.iteration > 30)
    assert RunPaths(out).segment(0).exists()
    with pytest.raises(HoloreelError, match=r"segment_000\.pt: was written with another overlap"):
        run(capture, out, replace(QUICK, overlap=0), resume=True)
    RunPaths(out).segment(0).write_bytes(b"torn")
    with pytest.raises(HoloreelError, match=r"segment_000\.pt: not a readable checkpoint; delete"):
        run(capture, out, QUICK, resume=True)
