# SPDX-License-Identifier: GPL-3.0-or-later
"""The loop: its camera path, its care for other people's folders, and (slow) one small round with real Blender."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from holoreel.core.blender import find_blender
from holoreel.core.camera import Camera
from holoreel.core.cli import main
from holoreel.core.demo.path import common_target, orbit
from holoreel.core.errors import HoloreelError


def arc(count: int = 5) -> list[Camera]:
    angles = np.radians(np.linspace(-20, 20, count))
    order = [count // 2, *(index for index in range(count) if index != count // 2)]
    return [
        Camera.look_at(
            (1 + 4 * math.sin(angles[index]), 2 - 4 * math.cos(angles[index]), 1.5),
            (1, 2, 0.5),
            width=64,
            height=36,
            fx=70.0,
        )
        for index in order
    ]


def test_common_target_is_where_all_cameras_look() -> None:
    np.testing.assert_allclose(common_target(arc()), (1, 2, 0.5), atol=1e-9)
    one = Camera.look_at((0, -3, 0), (0, 0, 0), width=64, height=36, fx=70.0)
    assert common_target([one])[1] > -3  # somewhere ahead


def test_orbit_starts_at_the_first_camera_stays_between_the_outer_ones_and_closes() -> None:
    cameras = arc()
    path = orbit(cameras, 24)
    np.testing.assert_allclose(path[0].center, cameras[0].center, atol=1e-9)
    low, high = (pick([camera.center[0] for camera in cameras]) for pick in (min, max))
    assert all(low < camera.center[0] < high for camera in path)
    steps = [np.linalg.norm(a.center - b.center) for a, b in zip(path, path[1:] + path[:1], strict=True)]
    assert max(steps) < 0.5
    for camera in path:
        uv, depth = camera.project([(1, 2, 0.5)])
        np.testing.assert_allclose(uv[0], (32, 18), atol=1e-6)
        assert depth[0] > 0


def test_demo_leaves_other_peoples_folders_alone(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    (tmp_path / "thesis.txt").write_text("years of work")
    try:
        find_blender()
    except HoloreelError:
        pytest.skip("no Blender here")
    assert main(["demo", "--out", str(tmp_path)]) == 2
    assert "choose another --out" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


@pytest.mark.slow
def test_a_small_round_of_the_loop(tmp_path: Path) -> None:
    try:
        find_blender()
    except HoloreelError:
        pytest.skip("no Blender here")
    out = tmp_path / "demo"
    arguments = ["--cameras", "5", "--frames", "1:3", "--size", "160x90", "--samples", "2", "--iterations", "150"]
    assert main(["demo", "--out", str(out), *arguments]) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["heldout_psnr"] > 20
    assert metrics["cycles_vs_raster_psnr"] >= 60
    assert metrics["eevee_vs_raster_psnr"] >= 40
    page = (out / "report.html").read_text()
    for source in {part.split('"')[0] for part in page.split('src="')[1:]}:
        assert (out / source).stat().st_size > 0, source
    assert (out / "scene.blend").stat().st_size > 0
