# SPDX-License-Identifier: GPL-3.0-or-later
"""The bench of the kernels measures something; how much is not a test's business."""

from holoreel.core.videorf.bench import bench_drawing, bench_march, bench_step


def test_bench_reports_speeds():
    speed = bench_march(edge=20, rays=256, twin_rays=64, repeats=1)
    assert speed.vertices > 500
    assert 5 < speed.samples_per_ray < 100
    assert min(speed.forward, speed.training, speed.twin_ratio) > 0


def test_bench_splits_a_step():
    step = bench_step(edge=20, rays=256, repeats=2)
    assert min(step) > 0
    assert step.total == sum(step)


def test_bench_draws_in_every_quality():
    pictures = bench_drawing(edge=20, width=32, height=18, repeats=1)
    assert list(pictures) == ["full", "fast", "draft"]
    assert min(pictures.values()) > 0
