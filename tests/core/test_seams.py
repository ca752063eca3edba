# SPDX-License-Identifier: GPL-3.0-or-later
"""The measure of seams: blind to a reel that hands over well, and exact about one that does not."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from holoreel.core.bench.seams import measure_seams
from holoreel.core.capture import Capture
from holoreel.core.cli import main
from holoreel.core.gaussians.model import SpacetimeGaussians
from holoreel.core.gaussians.player import draw, to_tensors
from holoreel.core.images import write_png
from holoreel.core.reel import SegmentPayload, write_segments
from holoreel.core.render import get_backend

SEGMENTS, LENGTH, FIRST = 3, 4, 7


def still(model: SpacetimeGaussians, lighter: float) -> SpacetimeGaussians:
    """The model at rest, its colors lighter."""
    return replace(
        model,
        motions=np.zeros_like(model.motions),
        omegas=np.zeros_like(model.omegas),
        trbf_log_scales=np.full_like(model.trbf_log_scales, 10.0),
        features=np.clip(model.features, 0.2, 0.7) + lighter,
    )


@pytest.fixture
def still_capture(recording: Any, tmp_path: Path) -> Capture:
    """Twelve frames in which nothing moves, seen by one camera that is held out."""
    camera, images = recording.cameras["left"], {}
    picture = draw(to_tensors(still(recording.model, 0.0)), 0.0, camera, get_backend())
    for frame in range(SEGMENTS * LENGTH):
        images["left", frame] = tmp_path / f"{frame}.png"
        write_png(images["left", frame], picture.image)
    return Capture({"left": camera}, images, SEGMENTS * LENGTH, {"left": "test"}, frame_start=FIRST)


def reel_of(recording: Any, path: Path, steps: tuple[float, ...]) -> Path:
    """A reel whose segments differ in lightness alone."""
    parts = [
        SegmentPayload(still(recording.model, step), None, FIRST + LENGTH * index, LENGTH)
        for index, step in enumerate(steps)
    ]
    write_segments(path, parts, fps=24.0, frame_start=FIRST)
    return path


def test_a_jump_is_measured_where_it_is(recording: Any, still_capture: Capture, tmp_path: Path) -> None:
    seams = measure_seams(reel_of(recording, tmp_path / "a.reel", (0.0, 0.0, 0.1)), still_capture)
    calm, jump = seams.seams
    assert (calm.frame, jump.frame) == (FIRST + LENGTH, FIRST + 2 * LENGTH)
    assert max(calm.pop, calm.flicker, jump.flicker) < 1e-4
    drawn = seams.drawn.astype(np.float64)
    assert jump.pop > 2.0
    assert np.abs(drawn[:, 8] - drawn[:, 7]).mean() > 0.0
    assert np.abs(drawn[:, 4] - drawn[:, 3]).max() < 1e-6
    assert calm.near_psnr == pytest.approx(calm.segment_psnr, abs=0.1)
    assert jump.near_psnr == pytest.approx(jump.segment_psnr, abs=0.1)  # half of each, far and near alike
    assert jump.segment_psnr < calm.segment_psnr - 10


def test_command(recording: Any, still_capture: Capture, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    from holoreel.core.capture import write_capture

    reel = reel_of(recording, tmp_path / "b.reel", (0.0, 0.05, 0.0))
    folder = write_capture(tmp_path, still_capture).parent
    assert main(["bench", "seams", str(reel), str(folder), "--out", str(tmp_path / "out")]) == 0
    assert "slice.png" in capsys.readouterr().out
    assert [row["frame"] for row in json.loads((tmp_path / "out" / "seams.json").read_text())["seams"]] == [11, 15]
    assert main(["bench", "seams", str(recording.reel), str(recording.capture.parent)]) == 2
    assert "has one segment, and so no seam" in capsys.readouterr().err
