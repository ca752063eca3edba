# SPDX-License-Identifier: GPL-3.0-or-later
"""Long videos in segments: how they are cut, how clocks change, what neighbors share."""

import numpy as np
import pytest
from holoreel.core.capture import Points
from holoreel.core.gaussians.config import TrainConfig
from holoreel.core.gaussians.model import ROWS, SpacetimeGaussians
from holoreel.core.gaussians.segments import (
    inherited,
    plan_segments,
    retime,
    static_rows,
    to_played,
    warm_seeds,
)
from hypothesis import given
from hypothesis import strategies as st


def random_gaussians(count: int, channels: int, seed: int = 0) -> SpacetimeGaussians:
    rng = np.random.default_rng(seed)
    fields = {name: rng.normal(size=(count, *row)) for name, (row, _, _) in ROWS.items() if name != "features"}
    fields["trbf_centers"] = rng.uniform(0, 1, count)
    return SpacetimeGaussians(features=rng.normal(size=(count, channels)), **fields)


@given(frames=st.integers(1, 400), length=st.integers(0, 120), overlap=st.integers(0, 5))
def test_segments_follow_each_other_without_gap(frames: int, length: int, overlap: int) -> None:
    plans = plan_segments(frames, length, overlap)
    played = [frame for plan in plans for frame in range(plan.start, plan.start + plan.count)]
    assert played == list(range(frames))
    counts = [plan.count for plan in plans]
    assert max(counts) <= (length or frames)
    assert max(counts) - min(counts) <= 1
    assert len(plans) == (-(-frames // length) if length else 1)
    for plan in plans:
        assert plan.train_start == max(plan.start - overlap, 0)
        assert plan.train_start + plan.train_count == min(plan.start + plan.count + overlap, frames)


@pytest.mark.parametrize("channels", [3, 9])
def test_another_clock_shows_the_same(channels: int) -> None:
    gaussians = random_gaussians(50, channels)
    other = retime(gaussians, -0.15, 1.3)
    for time in (-0.2, 0.0, 0.31, 0.9, 1.1):
        before, after = gaussians.evaluate(time), other.evaluate(1.3 * time - 0.15)
        for name in ("means", "quats", "scales", "opacities", "features"):
            assert np.allclose(getattr(before, name), getattr(after, name), rtol=2e-4, atol=2e-5), name


def test_played_frames_have_the_times_a_reader_expects() -> None:
    plan = plan_segments(30, 10, 2)[1]  # plays 10..19, learns from 8..21
    gaussians = random_gaussians(20, 3)
    played = to_played(gaussians, plan)
    for frame in (10, 14, 19):
        trained = gaussians.evaluate((frame - 8) / 14)
        assert np.allclose(played.evaluate((frame - 10) / 10).means, trained.means, rtol=2e-4, atol=2e-5)
    whole = plan_segments(30, 10, 0)[1]
    assert to_played(gaussians, whole) is gaussians


def test_what_stands_still_is_handed_on_as_it_stands() -> None:
    gaussians = random_gaussians(3, 9)
    gaussians.motions[:] = 0
    gaussians.motions[1, 0, 0] = 5.0  # moves
    gaussians.trbf_log_scales[:] = np.log([0.8, 2.0, 0.1])  # the last one only flashes
    assert static_rows(gaussians, 1.0).tolist() == [True, False, False]
    config = TrainConfig()
    kept = inherited(gaussians, 1.0, config)
    now, then = kept.evaluate(0.9), gaussians.evaluate(0.5)
    assert len(kept) == 1
    assert np.allclose(now.means[0], then.means[0])
    assert np.allclose(now.quats[0], then.quats[0], atol=1e-6)
    assert np.exp(kept.trbf_log_scales[0]) == pytest.approx(config.static_width)


def test_inherited_surfaces_are_not_seeded_again() -> None:
    rng = np.random.default_rng(0)
    wall = np.stack([*(a.ravel() for a in np.mgrid[0:20, 0:20]), np.zeros(400)], 1).astype(np.float32)
    ball = rng.normal(scale=0.5, size=(100, 3)).astype(np.float32) + np.float32([10, 10, 8])
    frames = []
    for frame in range(6):
        xyz = np.concatenate([wall, ball + np.float32([0, 0, 4 * frame])])
        frames.append(Points(xyz, np.full((500, 3), 90, np.uint8)))
    config = TrainConfig()
    cold = warm_seeds(frames, random_gaussians(0, 3), config, np.random.default_rng(1))
    left = cold.take((cold.means[:, 2] == 0) & (cold.means[:, 0] < 9.5))  # half of the wall
    warm = warm_seeds(frames, left, config, np.random.default_rng(1))
    on_wall = warm.means[:, 2] == 0
    assert int((on_wall & (warm.means[:, 0] < 9.5)).sum()) == len(left)
    assert int((on_wall & (warm.means[:, 0] > 10.5)).sum()) == int(
        ((cold.means[:, 2] == 0) & (cold.means[:, 0] > 10.5)).sum()
    )
    assert int((~on_wall).sum()) == int((cold.means[:, 2] != 0).sum())
