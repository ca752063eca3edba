# SPDX-License-Identifier: GPL-3.0-or-later
"""Seeds: what stands still is told from what moves, nothing is invented, and limits hold."""

import numpy as np
import pytest
from holoreel.core.capture import Points
from holoreel.core.gaussians.config import TrainConfig
from holoreel.core.gaussians.model import sigmoid
from holoreel.core.gaussians.seeds import as_trained, chosen_points, gaussians_from_points, neighbor_distances

FRAMES = 8


def wall_and_ball(rng: np.random.Generator) -> list[Points]:
    """A gray wall at y = 0 that stays, and a red ball above it that moves its own size per frame."""
    frames = []
    for frame in range(FRAMES):
        wall = np.column_stack([rng.uniform(-2, 2, 3000), np.zeros(3000), rng.uniform(-2, 2, 3000)])
        ball = rng.normal(size=(200, 3))
        ball = 0.2 * ball / np.linalg.norm(ball, axis=1, keepdims=True) + [0.5 * frame - 2.0, 2.0, 0.0]
        rgb = np.concatenate([np.full((3000, 3), 128), np.tile([255, 0, 0], (200, 1))]).astype(np.uint8)
        frames.append(Points(np.concatenate([wall, ball]).astype(np.float32), rgb))
    return frames


def test_still_and_moving_points_are_told_apart() -> None:
    points = wall_and_ball(np.random.default_rng(0))
    config = TrainConfig()
    gaussians = gaussians_from_points(points, config, np.random.default_rng(1))
    long_lived = np.isclose(gaussians.trbf_log_scales, np.log(config.static_width))
    is_ball = gaussians.features[:, 0] == 1.0
    assert not (long_lived & is_ball).any()
    assert (long_lived | is_ball).mean() > 0.95  # the wall's border cuts voxels
    assert long_lived.sum() > 2000
    # Moving seeds are centered at the time of the frame in which they lie where they lie.
    ball_x = gaussians.means[is_ball, 0]
    np.testing.assert_allclose(ball_x, 0.5 * gaussians.trbf_centers[is_ball] * FRAMES - 2.0, atol=0.21)


def test_seeds_are_points_of_the_capture_and_the_limit_holds() -> None:
    points = wall_and_ball(np.random.default_rng(0))
    gaussians = gaussians_from_points(points, TrainConfig(max_seeds=1500), np.random.default_rng(1))
    given = {tuple(row) for frame in points for row in frame.xyz.tolist()}
    assert len(gaussians) <= 1500
    assert all(tuple(row) in given for row in gaussians.means.tolist())


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e4])
def test_the_unit_of_the_scene_does_not_matter(unit: float) -> None:
    points = wall_and_ball(np.random.default_rng(0))
    one = gaussians_from_points(points, TrainConfig(), np.random.default_rng(1))
    scaled = [Points((frame.xyz * unit).astype(np.float32), frame.rgb) for frame in points]
    other = gaussians_from_points(scaled, TrainConfig(), np.random.default_rng(1))
    assert abs(len(one) - len(other)) < 0.02 * len(one)
    assert np.median(np.exp(other.log_scales)) == pytest.approx(unit * np.median(np.exp(one.log_scales)), rel=0.05)


def test_neighbor_distances_on_a_grid_and_alone() -> None:
    grid = np.stack(np.meshgrid(*[np.arange(5.0)] * 3), axis=-1).reshape(-1, 3).astype(np.float32)
    np.testing.assert_allclose(neighbor_distances(grid), 1.0)
    assert neighbor_distances(np.zeros((1, 3), np.float32)).shape == (1,)


def test_a_single_frame_is_static() -> None:
    frames = wall_and_ball(np.random.default_rng(0))[:1]
    gaussians = gaussians_from_points(frames, TrainConfig(), np.random.default_rng(0))
    assert np.allclose(np.exp(gaussians.trbf_log_scales), TrainConfig().static_width)


def test_some_frames_give_all_their_points_and_some_the_lonely_ones() -> None:
    rng = np.random.default_rng(0)
    dense, lonely = rng.uniform(0, 1, (300, 3)), 50 + 20.0 * np.stack(np.mgrid[:5, :5, :4], axis=-1).reshape(100, 3)
    frames = [
        Points(np.concatenate([dense, lonely]).astype(np.float32), np.full((400, 3), frame, np.uint8))
        for frame in range(6)
    ]
    config = TrainConfig(seed_frames=2, sparse_share=0.25)
    chosen = chosen_points(frames, config).reshape(6, 400)
    assert chosen[0].all()
    for frame in (2, 4):
        assert chosen[frame, 300:].all()
        assert not chosen[frame, :300].any()
    assert not chosen[1::2].any()
    assert chosen_points(frames, TrainConfig()).all()


def test_without_the_split_every_point_belongs_to_its_frame() -> None:
    points = wall_and_ball(np.random.default_rng(0))
    config = TrainConfig(split_static=False, moving_width=0.135, seed_frames=4)
    gaussians = gaussians_from_points(points, config, np.random.default_rng(1))
    assert len(gaussians) == 2 * 3200
    assert np.unique(gaussians.trbf_centers).tolist() == [0.0, 0.5]
    np.testing.assert_allclose(np.exp(gaussians.trbf_log_scales), 0.135, rtol=1e-5)
    frame_of = {tuple(row): index / FRAMES for index, frame in enumerate(points) for row in frame.xyz.tolist()}
    centers = [frame_of[tuple(row)] for row in gaussians.means.tolist()]
    np.testing.assert_array_equal(gaussians.trbf_centers, np.array(centers, np.float32))


def test_seeds_become_what_the_run_trains() -> None:
    lite = gaussians_from_points(wall_and_ball(np.random.default_rng(0)), TrainConfig(), np.random.default_rng(1))
    lite.motions[:], lite.omegas[:] = 1.0, 1.0
    full = as_trained(lite, TrainConfig(model="full", decoder_output="sigmoid", motion=1, rotation=0))
    assert full.variant == "full"
    np.testing.assert_allclose(sigmoid(full.features[:, :3]), np.clip(lite.features, 0.02, 0.98), atol=1e-6)
    assert not full.features[:, 3:].any()
    assert (full.motions[:, 0] == 1).all()
    assert not full.motions[:, 1:].any()
    assert not full.omegas.any()
    again = as_trained(full, TrainConfig(model="full", temporal_opacity=False))
    np.testing.assert_array_equal(again.features, full.features)
    assert (again.evaluate(-100.0).opacities == again.evaluate(3.0).opacities).all()
    assert lite.omegas.all()  # what was given stays as it is
