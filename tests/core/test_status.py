# SPDX-License-Identifier: GPL-3.0-or-later
"""What a long command says of itself, and what becomes of it where the file is in the way or foreign."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from holoreel.core.capture import Points, read_capture, write_capture, write_points
from holoreel.core.cli import main
from holoreel.core.cli.synth import small_picture
from holoreel.core.errors import HoloreelError
from holoreel.core.images import read_image, write_png
from holoreel.core.reel import load_gaussians
from holoreel.core.status import EVERY_SECONDS, PREVIEW_SECONDS, Status, StatusWriter, preview_path, read_status


class Clock:
    """A clock that stands still unless it is told otherwise."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def test_a_status_is_written_now_and_then_and_at_the_end(tmp_path: Path) -> None:
    clock, path, drawn = Clock(), tmp_path / "status.json", []

    def preview() -> np.ndarray:
        drawn.append(clock.now)
        clock.now += 1.0  # previews are dear here
        return np.full((2, 3, 3), 0.2 * len(drawn))

    writer = StatusWriter(path, clock)
    assert read_status(path) == Status()
    writer.tell("train", 1, 100, 9.5, {"loss": "0.5"}, preview)
    assert read_status(path) == Status("train", 1, 100, 9.5, {"loss": "0.5"}, 1)
    assert read_status(path).share == 0.01
    writer.tell("train", 2, 100)
    assert read_status(path).done == 1
    clock.now += EVERY_SECONDS
    writer.tell("train", 3, 100, float("inf"), preview=preview)
    assert read_status(path) == Status("train", 3, 100, None, {}, 1)
    clock.now += PREVIEW_SECONDS
    writer.tell("train", 4, 100, preview=preview)
    assert len(drawn) == 1  # one second of drawing is to be a fiftieth
    writer.tell("train", 100, 100, preview=preview)
    assert read_status(path) == Status("train", 100, 100, None, {}, 2)
    np.testing.assert_allclose(read_image(preview_path(path)), 0.4, atol=1e-3)


def test_without_a_path_nothing_is_drawn() -> None:
    StatusWriter(None).tell("train", 1, 1, preview=lambda: 1 / 0)  # type: ignore[arg-type]


def test_a_file_that_cannot_be_made_is_said_at_once_and_later_troubles_end_nothing(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(HoloreelError, match=r"status\.json cannot be written"):
        StatusWriter(tmp_path / "file" / "status.json")
    path = tmp_path / "folder" / "status.json"
    writer = StatusWriter(path)
    path.unlink()
    path.parent.rmdir()
    path.parent.touch()
    writer.tell("train", 1, 1)
    assert path.parent.is_file()


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"stage": 1}', '{"stage": "a", "figures": {}, "done": 1.5, "total": 2, "previews": 0}']
)
def test_a_foreign_file_is_no_status(tmp_path: Path, text: str) -> None:
    path = tmp_path / "status.json"
    path.write_text(text)
    with pytest.raises(HoloreelError, match=r"status\.json"):
        read_status(path)
    path.write_text(json.dumps({"stage": "a" * 70000, "figures": {}, "done": 1, "total": 2, "previews": 0}))
    with pytest.raises(HoloreelError, match=r"status\.json is no status"):
        read_status(path)


def test_training_says_how_far_it_is_and_learns_the_same(recording: Any, tmp_path: Path, capfd: Any) -> None:
    """The previews change nothing: a run with a status file ends in the same Gaussians."""
    seeds = {}
    for frame in range(3):
        now = recording.model.evaluate(frame / 3)
        seeds[frame] = tmp_path / f"{frame}.ply"
        write_points(seeds[frame], Points(now.means, np.full((len(now), 3), 100, np.uint8)))
    capture = str(write_capture(tmp_path, replace(read_capture(recording.capture), seeds=seeds)))
    status = tmp_path / "status.json"
    for name, more in (("plain", []), ("told", ["--status", str(status)])):
        reel = str(tmp_path / f"{name}.reel")
        assert main(["train", "stg", capture, "--out", reel, "--iterations", "40", *more]) == 0
        assert ("40/40" in capfd.readouterr().err) == (name == "plain")  # a progress line, or a status file
    told = read_status(status)
    assert (told.stage, told.done, told.total, told.seconds_left) == ("train", 40, 40, 0.0)
    assert set(told.figures) == {"loss", "PSNR", "Gaussians"}
    assert told.previews >= 1
    assert read_image(preview_path(status)).shape == (24, 32, 3)
    plain, same = (load_gaussians(tmp_path / f"{name}.reel").gaussians for name in ("plain", "told"))
    np.testing.assert_array_equal(plain.means, same.means)


@pytest.mark.parametrize(("size", "small"), [((24, 32), (24, 32)), ((144, 256), (144, 256)), ((300, 514), (100, 171))])
def test_previews_of_views_are_small(tmp_path: Path, size: tuple[int, int], small: tuple[int, int]) -> None:
    picture = np.zeros((*size, 3), np.uint8)
    picture[: size[0] // 2] = 255
    write_png(tmp_path / "view.png", picture / 255)
    shown = small_picture(tmp_path / "view.png")
    assert shown.shape == (*small, 3)
    assert shown[0, 0, 0] == 1
    assert shown[-1, -1, 0] == 0
