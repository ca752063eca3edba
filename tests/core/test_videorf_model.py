# SPDX-License-Identifier: GPL-3.0-or-later
"""The trained model on disk: written, read back lazily, and judged as a foreign file."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from holoreel.core.errors import HoloreelError
from holoreel.core.videorf.config import ABLATIONS, PRESETS, VideoConfig, without
from holoreel.core.videorf.grouping import group_frames
from holoreel.core.videorf.mapping import build_table
from holoreel.core.videorf.model import FieldVideo, in_memory, read_field_video, write_rows
from holoreel.core.videorf.occupancy import Lattice
from holoreel.core.videorf.quantize import Ranges
from holoreel.core.videorf.shading import Shading, ShadingShape


def small_model() -> FieldVideo:
    """Three frames in two groups; the row of vertex (x, y, z) at frame t is [x, y, z, t]."""
    frames = [np.zeros((5, 6, 7), bool) for _ in range(3)]
    for t, frame in enumerate(frames):
        frame[1:4, 1:5, 1 + t : 4 + t] = True
    groups = tuple(group_frames(frames, 48))
    tables = tuple(build_table(group.union, (16, 16), "macroblocks") for group in groups)
    shape = ShadingShape(3, None, 4)
    random = np.random.default_rng(0)
    layers = tuple(
        (random.normal(size=(o, i)).astype(np.float32), random.normal(size=o).astype(np.float32))
        for o, i in shape.layers
    )
    owner = [table for group, table in zip(groups, tables, strict=True) for _ in range(group.count)]
    rows = [np.insert(table.vertices, 3, t, axis=1).astype(np.float32) for t, table in enumerate(owner)]
    return FieldVideo(
        Lattice((5, 6, 7), (-1.0, 0.0, 0.5), 0.25),
        groups,
        tables,
        Shading(shape, layers),
        Ranges((-8.0, -2.0, -2.0, -2.0), (16.0, 7.0, 7.0, 7.0)),
        in_memory(rows),
        fps=30.0,
        frame_start=101,
        up=None,
        background=(0.0, 0.5, 1.0),
        step=0.25,
        transmittance_min=0.01,
        provenance={"capture": "a"},
    )


def test_a_model_comes_back_as_it_was(tmp_path: Path) -> None:
    model = small_model()
    assert len(model.groups) == 2
    back = read_field_video(model.write(tmp_path / "a.model"))
    for name in ("lattice", "ranges", "fps", "frame_start", "up", "background", "step", "transmittance_min"):
        assert getattr(back, name) == getattr(model, name), name
    assert back.provenance == {"capture": "a"}
    assert (back.frame_count, back.channels) == (3, 4)
    assert [(group.first, group.count) for group in back.groups] == [(0, 2), (2, 1)]
    for one, other in zip(back.shading.layers, model.shading.layers, strict=True):
        assert all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))
    for frame in range(3):
        assert np.array_equal(back.table_of(frame).pixels, model.table_of(frame).pixels)
        assert np.array_equal(back.rows(frame)[:, :3], back.table_of(frame).vertices)
        assert (back.rows(frame)[:, 3] == frame).all()
    with pytest.raises(HoloreelError, match="no frame 3 in this model: take 0 to 2"):
        back.rows(3)


def test_rows_are_read_when_they_are_asked_for(tmp_path: Path) -> None:
    back = read_field_video(small_model().write(tmp_path))
    (tmp_path / "rows_000001.npy").unlink()
    back.rows(0)
    with pytest.raises(HoloreelError, match=r"rows_000001\.npy cannot be read"):
        back.rows(1)


def test_foreign_rows_are_refused(tmp_path: Path) -> None:
    back = read_field_video(small_model().write(tmp_path))
    rows = np.array(back.rows(0))
    write_rows(tmp_path, 0, rows[:-1])
    with pytest.raises(HoloreelError, match=r"rows_000000\.npy does not hold 48 x 4 finite"):
        back.rows(0)
    rows[3, 2] = np.inf
    write_rows(tmp_path, 0, rows)
    with pytest.raises(HoloreelError, match=r"rows_000000\.npy does not hold 48 x 4 finite"):
        back.rows(0)
    np.save(tmp_path / "rows_000000.npy", np.array([{"a": 1}], object), allow_pickle=True)
    with pytest.raises(HoloreelError, match=r"rows_000000\.npy cannot be read"):
        back.rows(0)


@pytest.mark.parametrize(
    ("part", "value", "message"),
    [
        ("kind", "videorf", "'kind' is 'videorf', not 'videorf-model'"),
        ("up", "W", "'up' is 'W'"),
        ("groups.0.vertices", 47, r"'groups\[0\]\.vertices' is 47, not 48"),
        ("groups.0.frames", 0, r"'groups\[0\]\.frames' is 0"),
        ("groups.1.file", "../x", r"'groups\[1\]\.file' is '../x', not a path below"),
        ("image.layout", "spiral", r"'image\.layout' is 'spiral'"),
        ("ranges.low", [0, 1], r"'ranges\.low' is \[0, 1\], not 4 finite numbers"),
        ("shading.hidden", 5, r"model\.shading does not hold"),
        ("lattice.spacing", 0, r"'lattice\.spacing' is 0"),
    ],
)
def test_a_foreign_header_is_refused(tmp_path: Path, part: str, value: object, message: str) -> None:
    path = small_model().write(tmp_path) / "model.json"
    header = json.loads(path.read_text())
    *way, last = part.split(".")
    target = header
    for key in way:
        target = target[int(key) if key.isdigit() else key]
    target[last] = value
    path.write_text(json.dumps(header))
    with pytest.raises(HoloreelError, match=message):
        read_field_video(tmp_path)


def test_a_model_of_parts_that_contradict_each_other_is_no_model() -> None:
    model = small_model()
    with pytest.raises(ValueError, match="one table"):
        replace(model, tables=model.tables[:1])
    with pytest.raises(ValueError, match="without gap"):
        replace(model, groups=model.groups[1:], tables=model.tables[1:])
    with pytest.raises(ValueError, match="one range"):
        replace(model, ranges=Ranges((0.0, 0.0), (1.0, 1.0)))


def test_settings_name_what_is_wrong_with_them() -> None:
    for name, value in (
        ("rays", 0),
        ("noise_from", 1.5),
        ("spatial", -1.0),
        ("image", 100),
        ("headroom", 0.9),
        ("qps", ()),
        ("codec_qps", ()),
        ("codec_qps", (20, 52)),
        ("density_rate", 0.0),
        ("coarse_share", 0.0),
    ):
        with pytest.raises(HoloreelError, match=f"--{name.replace('_', '-')} is"):
            replace(VideoConfig(), **{name: value})


def test_each_ablation_takes_one_part_away() -> None:
    for part in ABLATIONS:
        changed = [
            name for name, value in vars(without(VideoConfig(), part)).items() if value != getattr(VideoConfig(), name)
        ]
        assert len(changed) == 1 or changed == ["spatial", "smooth"], part  # both are total variations
    assert {"standard", "fast", "paper"} <= set(PRESETS)
