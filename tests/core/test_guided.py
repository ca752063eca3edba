# SPDX-License-Identifier: GPL-3.0-or-later
"""Guided sampling: the worst patches are found, and what is added lies on their rays, as far as they reach."""

import math

import numpy as np
import pytest
from holoreel.core.camera import Camera
from holoreel.core.gaussians.config import GuidedConfig
from holoreel.core.gaussians.guided import (
    Patches,
    Stability,
    depth_range,
    measure_patches,
    new_gaussians,
    sample_rays,
    with_seeds,
    worst_patches,
)

SIZE = 8


def picture_with_a_hole() -> tuple[np.ndarray, np.ndarray]:
    """A picture of 40 × 60 pixels, and the same with a black hole in the patch of row 2, column 5."""
    truth = np.random.default_rng(0).uniform(0.4, 0.6, (43, 60, 3)).astype(np.float32)
    picture = truth + 0.01
    picture[16:24, 40:48] = 0.0
    return picture, truth


def test_a_hole_is_the_worst_patch_and_nothing_else_is() -> None:
    picture, truth = picture_with_a_hole()
    patches = measure_patches(picture, truth, SIZE)
    assert len(patches.errors) == 5 * 7  # the rest of 43 × 60 fills no patch
    np.testing.assert_allclose(np.delete(patches.errors, 2 * 7 + 5), 0.01, rtol=1e-4)
    same = measure_patches(truth + 0.01, truth, SIZE)
    first, second = worst_patches([same, patches], share=0.1, contrast=2.0)
    assert len(first.errors) == 0
    np.testing.assert_array_equal(second.centers, [[44.0, 20.0]])
    np.testing.assert_allclose(second.colors[0], truth[16:24, 40:48].mean(axis=(0, 1)), rtol=1e-5)


def test_the_share_limits_and_even_errors_are_left_alone() -> None:
    errors = np.linspace(1.0, 1.9, 100).astype(np.float32)
    even = Patches(np.zeros((100, 2)), errors, np.zeros((100, 3), np.float32), np.ones(100, bool))
    assert len(worst_patches([even], 0.5, 2.0)[0].errors) == 0
    steep = Patches(np.zeros((100, 2)), errors**9, np.zeros((100, 3), np.float32), np.ones(100, bool))
    chosen = worst_patches([steep], 0.05, 2.0)[0]
    np.testing.assert_array_equal(chosen.errors, np.sort(errors**9)[-5:])
    assert worst_patches([even.take(np.arange(0))], 0.5, 2.0)[0].errors.size == 0


def test_patches_full_of_seeds_are_left_to_density_control() -> None:
    picture, truth = picture_with_a_hole()
    picture[0:8, 0:8] = 1.0  # as wrong as the hole
    camera = Camera(60, 43, 60.0, 60.0, 30.0, 21.5)
    patches = measure_patches(picture, truth, SIZE)
    rng = np.random.default_rng(3)
    pixels = rng.uniform([0, 0], [60, 43], (4000, 2))
    hole = ((pixels >= (40, 16)) & (pixels < (48, 24))).all(axis=1)
    seeds = camera.unproject(pixels[~hole], rng.uniform(2, 9, int((~hole).sum()))).astype(np.float32)
    behind = np.float32([[0, 0, -3], [0.2, 0.1, -1]])  # would fall into the middle if depth were forgotten
    known = with_seeds(patches, SIZE, camera, np.concatenate([seeds, behind]), 0.25)
    assert np.flatnonzero(known.sparse).tolist() == [2 * 7 + 5]
    (chosen,) = worst_patches([known], share=0.1, contrast=2.0)
    np.testing.assert_array_equal(chosen.centers, [[44.0, 20.0]])
    assert len(worst_patches([patches], share=0.1, contrast=2.0)[0].errors) == 2
    assert with_seeds(patches, SIZE, camera, behind, 0.25).sparse.all()


def test_patches_with_invalid_pixels_are_left_out() -> None:
    picture, truth = picture_with_a_hole()
    valid = np.ones(picture.shape[:2], dtype=bool)
    valid[23, 47] = False
    patches = measure_patches(picture, truth, SIZE, valid)
    assert len(patches.errors) == 34
    assert patches.errors.max() < 0.02


def test_rays_begin_and_end_by_the_farthest_that_is_seen() -> None:
    depth = np.tile(np.linspace(2.0, 6.0, 100, dtype=np.float32), (40, 1))
    alpha = np.ones_like(depth)
    alpha[:, 90:] = 0.2  # nearly nothing there: its depth says nothing
    depth[0, 89] = np.nan
    near, far = depth_range(depth, alpha, 0.7, 7.5)
    farthest = depth[1, 87]  # all but 2 % of what is known lies nearer
    assert near == pytest.approx(0.7 * farthest, rel=0.01)
    assert far == pytest.approx(7.5 * farthest, rel=0.01)
    assert depth_range(depth, 0 * alpha, 0.7, 7.5) is None


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e4])
def test_new_gaussians_lie_on_the_rays_and_within_reach(unit: float) -> None:
    eye, target = np.array([3.0, -4.0, 2.0]) * unit, np.array([0.5, 0.2, 0.1]) * unit
    camera = Camera.look_at(tuple(eye), tuple(target), width=60, height=43, fx=70.0)
    centers = np.array([[44.0, 20.0], [4.0, 36.0]])
    patches = Patches(centers, np.ones(2, np.float32), np.eye(3, dtype=np.float32)[:2], np.ones(2, bool))
    config = GuidedConfig(samples=16, noise=0.05)
    near, far = 2.0 * unit, 9.0 * unit
    points, sizes = sample_rays(camera, patches, SIZE, (near, far), config, np.random.default_rng(0))
    uv, depth = camera.project(points)
    assert points.shape == (32, 3)
    off = np.abs(uv - np.repeat(centers, 16, axis=0))
    assert off.max() < 5 * 0.05 * SIZE
    assert off.max() > 0
    # One in each sixteenth of the reach's logarithm: uniform, and no stretch is left out.
    stretch = np.floor(np.log(depth / near) / np.log(far / near) * 16).reshape(2, 16)
    np.testing.assert_array_equal(stretch, np.tile(np.arange(16.0), (2, 1)))
    # Three standard deviations to each side cover the patch, and not much more.
    np.testing.assert_allclose(sizes * 70.0 / depth, SIZE / 4)


def test_new_gaussians_are_faint_and_stand_still() -> None:
    points = np.random.default_rng(0).normal(size=(5, 3))
    colors = np.random.default_rng(1).random((5, 3)).astype(np.float32)
    gaussians = new_gaussians(points, np.full(5, 0.3), colors, time=0.25, width=1.5, opacity=0.1)
    now = gaussians.evaluate(0.25)
    np.testing.assert_allclose(now.opacities, 0.1, rtol=1e-5)
    np.testing.assert_allclose(now.means, points, rtol=1e-6)
    np.testing.assert_array_equal(now.features, colors)
    np.testing.assert_allclose(now.scales, 0.3, rtol=1e-6)
    np.testing.assert_array_equal(gaussians.evaluate(0.9).means, now.means)
    assert gaussians.evaluate(0.9).opacities.min() > 0.05


def test_the_loss_is_stable_once_it_falls_no_more() -> None:
    losses = [max(1.0 - 0.02 * step, 0.3) for step in range(80)]
    stability = Stability(window=5, tolerance=0.05)
    stable = [step for step, loss in enumerate(losses) if stability.add(loss)]
    assert stable[0] == 44  # 35 to 39 is the first window at 0.3, the one after it the first that is no better
    assert stable == list(range(44, 80, 5))
    halves = [Stability(5, 0.05), Stability(5, 0.05)]
    first = [halves[0].add(loss) for loss in losses[:33]]
    halves[1].load_state(halves[0].state())
    assert [i for i, hit in enumerate(first + [halves[1].add(loss) for loss in losses[33:]]) if hit] == stable
    stability.reset()
    assert not any(stability.add(0.3) for _ in range(9))
    assert stability.add(0.3)
    assert math.isinf(Stability(3, 0.1).before)
