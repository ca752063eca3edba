# SPDX-License-Identifier: GPL-3.0-or-later
"""The look Splats of a real model against Holoreel's own rasterizer; see benchmarks/blender_looks.py for more views."""

import ctypes
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from holoreel.core.blender import find_blender, run_in_blender
from holoreel.core.camera import Camera
from holoreel.core.draw import open_player
from holoreel.core.errors import HoloreelError
from holoreel.core.images import read_image

VIEWS = {
    "plain": Camera(128, 96, 115.0, 115.0, 64.0, 48.0, np.eye(4)),
    "wide angle, shifted lens": Camera(128, 96, 52.0, 52.0, 84.0, 36.0, np.eye(4)),
}


@pytest.mark.slow
@pytest.mark.parametrize(("engine", "least"), [("CYCLES", 60.0), ("EEVEE", 45.0)])
def test_splats_of_a_real_model_are_the_rasterizers(
    engine: str, least: float, shared_data: Callable[[str], Path], tmp_path: Path
) -> None:
    path = shared_data("stg_splatv/spinach_4.splatv")
    try:
        blender = find_blender()
    except HoloreelError:
        pytest.skip("there is no Blender")
    if engine == "EEVEE":
        try:
            ctypes.CDLL("libEGL.so.1")
        except OSError:
            pytest.skip("libEGL.so.1 is absent (Debian package libegl1)")
    shots = [
        {"camera": camera.to_json(), "time": 0.5, "out": str(tmp_path / f"{index}.exr")}
        for index, camera in enumerate(VIEWS.values())
    ]
    job = {"setting": {"reel": str(path), "engine": engine}, "shots": shots}
    run_in_blender(blender, "holoreel.addon.render:main", job, log=tmp_path / "log")
    player = open_player(path, "cpu")
    for shot, camera in zip(shots, VIEWS.values(), strict=True):
        truth = player.draw(camera, player.frame_at(0.5), (0.0, 0.0, 0.0)).image
        error = np.mean(np.square(read_image(shot["out"])[..., :3].astype(np.float64) - truth))
        assert truth.mean() > 0.1
        assert -10 * np.log10(error) >= least
