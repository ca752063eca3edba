# SPDX-License-Identifier: GPL-3.0-or-later
"""The bench of the ray march measures something; how much is not a test's business."""

from holoreel.core.videorf.bench import bench_march


def test_bench_reports_speeds():
    speed = bench_march(edge=20, rays=256, twin_rays=64, repeats=1)
    assert speed.vertices > 500
    assert 5 < speed.samples_per_ray < 100
    assert min(speed.forward, speed.training, speed.twin_ratio) > 0
