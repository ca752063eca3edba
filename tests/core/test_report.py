# SPDX-License-Identifier: GPL-3.0-or-later
"""Reports: everything given is on the page and escaped; pictures say what they claim."""

import re
from pathlib import Path

import numpy as np
from holoreel.core.camera import Camera
from holoreel.core.report import Card, Picture, Report, Row, Section, Table, write_report
from holoreel.core.report.figures import (
    contact_sheet,
    difference,
    height_time_slice,
    plot_frames,
    plot_rig,
    plot_training,
    write_animation,
)
from PIL import Image


def test_page_holds_everything_and_escapes_it(tmp_path: Path) -> None:
    report = Report(
        title="A <title> & more",
        intro="intro text",
        cards=(Card("held-out PSNR", "31.4 dB", "12 frames"),),
        sections=(
            Section(
                "Comparison",
                rows=(Row("frame 3", (Picture("left", "a.png"), Picture("right", "b.png", "x8"))),),
                figures=(Picture("curve", "c.svg", "over time"),),
                table=Table(("step", "seconds"), (("synth", "3.1"), ("<script>", "2"))),
            ),
        ),
    )
    write_report(tmp_path / "report.html", report)
    page = (tmp_path / "report.html").read_text()
    for text in ("held-out PSNR", "31.4 dB", "frame 3", "over time", "seconds", "A &lt;title&gt; &amp; more"):
        assert text in page
    assert "<script>" not in page
    assert re.findall(r'<img src="([^"]+)"', page) == ["a.png", "b.png", "c.svg"]


def test_difference_is_black_where_equal_and_bright_where_not() -> None:
    a = np.full((2, 2, 3), 0.5, np.float32)
    b = a.copy()
    b[0, 0, 2] = 0.9
    heat = difference(a, b)
    assert heat[1, 1].max() < 0.02
    assert heat[0, 0].sum() > 2


def test_slice_puts_height_down_and_time_right() -> None:
    pictures = [np.full((4, 5, 3), time, np.float32) + np.arange(5)[None, :, None] for time in (0.0, 10.0, 20.0)]
    strip = height_time_slice(pictures, column=2, width=3)
    assert strip.shape == (4, 9, 3)
    np.testing.assert_array_equal(strip[0, :, 0], np.repeat([2.0, 12.0, 22.0], 3))


def test_contact_sheet_places_pictures_row_by_row() -> None:
    pictures = [np.full((2, 3, 3), value, np.float32) for value in (0.1, 0.2, 0.3)]
    sheet = contact_sheet(pictures, columns=2, gap=1)
    assert sheet.shape == (5, 7, 3)
    assert sheet[0, 0, 0] == np.float32(0.1)
    assert sheet[0, 4, 0] == np.float32(0.2)
    assert sheet[3, 0, 0] == np.float32(0.3)
    assert sheet[3, 4, 0] == 1.0


def test_animation_and_plots_are_files_others_read(tmp_path: Path) -> None:
    write_animation(tmp_path / "a.webp", [np.full((8, 8, 3), v, np.float32) for v in (0.0, 0.5, 1.0)], fps=10)
    assert Image.open(tmp_path / "a.webp").n_frames == 3
    plot_training(tmp_path / "t.svg", [{"iteration": i, "psnr": 20 + i, "gaussians": 100} for i in range(5)])
    plot_frames(tmp_path / "f.svg", [1, 2], [30.0, 31.0], [0.9, 0.95])
    camera = Camera.look_at((0, -3, 1), (0, 0, 0), width=32, height=18, fx=40.0, name="cam00")
    plot_rig(tmp_path / "r.svg", [camera], {"cam00"}, np.zeros((4, 3), np.float32))
    for name in "tfr":
        assert "<svg" in (tmp_path / f"{name}.svg").read_text()
