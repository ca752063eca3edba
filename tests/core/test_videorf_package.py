# SPDX-License-Identifier: GPL-3.0-or-later
"""The reel of a VideoRF: written, read back, judged as a foreign file, and played."""

import copy
import json
import subprocess
import sys

import numpy as np
import pytest
from holoreel.core.errors import HoloreelError
from holoreel.core.videorf.codec import encode_video
from holoreel.core.videorf.grouping import group_frames
from holoreel.core.videorf.mapping import build_table
from holoreel.core.videorf.occupancy import Lattice
from holoreel.core.videorf.package import (
    Rung,
    VideoReel,
    parse_video_reel,
    read_video_reel,
    write_tables,
    write_video_reel,
)
from holoreel.core.videorf.quantize import fit_ranges
from holoreel.core.videorf.shading import Shading, ShadingShape, write_shading
from holoreel.core.videorf.tiles import tiling_of

CHANNELS = 8
SHAPE = (14, 12, 13)


@pytest.fixture(scope="module")
def packed(tmp_path_factory):
    """A reel of five frames in groups, and the rows (N, C) of each frame, smooth in space as trained ones are."""
    folder = tmp_path_factory.mktemp("package")
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, edge) for edge in SHAPE], indexing="ij"), -1)
    frames = [np.linalg.norm(grid - [0.5 * t / 4, 0, 0], axis=-1) < 0.62 for t in range(5)]
    groups = list(group_frames(frames, int(1.35 * frames[0].sum())))
    assert len(groups) > 1
    tables = [build_table(group.union, (32, 32)) for group in groups]
    rows = []
    for group, table in zip(groups, tables, strict=True):
        place = grid[tuple(table.vertices.T)]
        for t in range(group.first, group.first + group.count):
            channels = [np.sin((1 + c / 3) * place[:, c % 3] + t / 4) * (1 + c) for c in range(CHANNELS)]
            rows.append(np.stack(channels, 1))
    ranges = fit_ranges(rows)
    tiling = tiling_of("universal", CHANNELS, 32, 32)
    counts = [group.count for group in groups]
    owner = [table for table, count in zip(tables, counts, strict=True) for _ in range(count)]
    empty = ranges.encode(ranges.empty)
    lumas = [tiling.pack(table.to_image(ranges.encode(part), empty)) for table, part in zip(owner, rows, strict=True)]
    rungs = []
    for qp in (8, 30):
        video = encode_video(folder / f"a.qp{qp}.mp4", lumas, counts, fps=24, qp=qp)
        rungs.append(Rung(qp, "h264", f"a.qp{qp}.mp4", video))
    shape = ShadingShape(CHANNELS - 1, 1, 4)
    random = np.random.default_rng(0)
    layers = [(random.normal(size=(o, i)), random.normal(size=o)) for o, i in shape.layers]
    layers = tuple((matrix.astype(np.float32), bias.astype(np.float32)) for matrix, bias in layers)
    write_shading(folder / "a.shading", Shading(shape, layers))
    reel = VideoReel(
        folder / "a.reel",
        fps=24.0,
        frame_start=101,
        lattice=Lattice(SHAPE, (-1.0, -1.0, -1.0), 2 / 13),
        ranges=ranges,
        tiling=tiling,
        profile="universal",
        layout="blocks",
        shading=shape,
        shading_file="a.shading",
        tables_file="a.tables",
        groups=write_tables(folder / "a.tables", tables, counts),
        rungs=tuple(rungs),
        up="Z",
        files={"metrics": "metrics.json"},
        provenance={"made": "by a test"},
    )
    write_video_reel(reel)
    return reel, tables, rows


def test_reels_come_back_as_they_were(packed):
    reel, tables, _ = packed
    again = read_video_reel(reel.path)
    assert again == reel
    for index, table in enumerate(tables):
        read = again.table(index)
        assert (read.vertices == table.vertices).all()
        assert (read.pixels == table.pixels).all()
    assert again.shade()(np.zeros((1, 7)), np.array([[0, 0, 1.0]])).shape == (1, 3)


def test_frames_play_from_the_reel_alone(packed):
    reel, _, rows = packed
    again = read_video_reel(reel.path)
    for rung, steps in ((0, 3), (1, 40)):
        video = again.video(rung)
        for frame in (4, 0, 3, 1, 2):
            table = again.table(again.group_of(frame))
            codes = table.to_rows(again.tiling.unpack(video.luma(frame)))
            error = abs(again.ranges.decode(codes) - rows[frame]) / again.ranges.step
            assert error.max() < steps
    with pytest.raises(HoloreelError, match="no frame 5: take 0 to 4"):
        again.group_of(5)
    with pytest.raises(HoloreelError, match="no rung 2"):
        again.video(2)


def test_payloads_that_disagree_are_refused(packed, tmp_path):
    reel, _, _ = packed
    manifest = json.loads(reel.path.read_text())
    path = tmp_path / "b.reel"

    def opened(change):
        changed = copy.deepcopy(manifest)
        change(changed)
        path.write_text(json.dumps(changed))
        return read_video_reel(path)

    with pytest.raises(HoloreelError, match="put it beside"):
        opened(lambda m: None).table(0)
    data = (reel.path.parent / "a.tables").read_bytes()
    (tmp_path / "a.tables").write_bytes(data[:-1])
    with pytest.raises(HoloreelError, match="cut off or damaged at group 1"):
        opened(lambda m: None).table(len(reel.groups) - 1)
    (tmp_path / "a.tables").write_bytes(data)
    assert opened(lambda m: None).table(0).count == reel.groups[0].vertices
    with pytest.raises(HoloreelError, match="the reel says"):
        opened(lambda m: m["tables"]["groups"][0].update(vertices=3)).table(0)
    with pytest.raises(HoloreelError, match="not one of"):
        opened(lambda m: m["lattice"].update(shape=[20, 12, 13])).table(0)
    (tmp_path / "a.shading").write_bytes((reel.path.parent / "a.shading").read_bytes())
    with pytest.raises(HoloreelError, match="weights its reel asks for"):
        opened(lambda m: m["shading"].update(hidden=5)).shade()


CHANGES = [
    ("kind", "spacetime_gaussians"),
    ("version", 0),
    ("version", 2),
    ("fps", 0),
    ("fps", float("1e400")),
    ("frame_start", 2**31),
    ("frame_count", 6),
    ("up", "W"),
    ("color_space", "linear"),
    ("background", [1, 1]),
    ("lattice", None),
    ("lattice.shape", [14, 12, 257]),
    ("lattice.shape", [14.5, 12, 13]),
    ("lattice.lowest", [0, 0, None]),
    ("lattice.spacing", 0),
    ("march.step", 0),
    ("march.transmittance_min", 1),
    ("ranges.low", [0] * 7),
    ("ranges.high", [-99] * 8),
    ("image.width", 40),
    ("image.width", 10**9),
    ("image.columns", 5),
    ("image.profile", "huge"),
    ("image.layout", "spiral"),
    ("shading.features", 8),
    ("shading.hidden", 10**9),
    ("shading.frequencies", 9),
    ("shading.file", "../a.shading"),
    ("shading.file", "C:a.shading"),
    ("tables.file", "/etc/passwd"),
    ("tables.groups", []),
    ("tables.groups.0.frames", 0),
    ("tables.groups.0.vertices", 10**6),
    ("tables.groups.1.offset", 0),
    ("tables.groups.0.size", 2**40),
    ("tables.groups.0.sha256", "zz"),
    ("rungs", {}),
    ("rungs.0", 7),
    ("rungs.0.qp", -1),
    ("rungs.0.codec", "mjpeg"),
    ("rungs.0.file", "a\\b.mp4"),
    ("rungs.0.size", 1),
    ("rungs.0.head", 10**12),
    ("rungs.0.groups", [{}]),
    ("rungs.0.groups.0.offset", 5),
    ("rungs.0.groups.0.size", 10**12),
    ("rungs.0.groups.1.luma_crc32", 2**32),
    ("files", []),
    ("files.metrics", "../../metrics.json"),
    ("provenance", "mine"),
]


@pytest.mark.parametrize(("place", "value"), CHANGES, ids=[f"{place}={value!r}"[:40] for place, value in CHANGES])
def test_wrong_fields_are_named(packed, place, value):
    reel, _, _ = packed
    manifest = json.loads(reel.path.read_text())
    *way, last = place.split(".")
    target = manifest
    for key in way:
        target = target[int(key) if isinstance(target, list) else key]
    if isinstance(target, list):
        target[int(last)] = value
    else:
        target[last] = value
    with pytest.raises(HoloreelError) as caught:
        parse_video_reel(reel.path, manifest)
    text = str(caught.value)
    assert "\n" not in text
    if place.split(".")[0] in ("tables", "rungs", "files"):
        assert place.split(".")[0] in text
        assert str(reel.path) in text


def test_every_field_missing_is_refused(packed):
    reel, _, _ = packed
    manifest = json.loads(reel.path.read_text())
    optional = {"up", "shading.frequencies"}  # null says the same

    def remove(value, at):
        for key in list(value) if isinstance(value, dict) else range(len(value)):
            inner, name = value[key], f"{at}.{key}".lstrip(".")
            if isinstance(inner, dict | list) and name not in ("provenance", "files"):
                remove(inner, name)
            if isinstance(value, dict) and name not in optional and not name.startswith(("provenance.", "files.")):
                held = value.pop(key)
                with pytest.raises(HoloreelError):
                    parse_video_reel(reel.path, manifest)
                value[key] = held

    remove(manifest, "")
    assert parse_video_reel(reel.path, manifest) == reel


def test_a_player_needs_numpy_alone():
    player = ("occupancy", "grouping", "morton", "mapping", "quantize", "tiles", "mp4", "codec", "shading", "fields")
    names = (*player, "package", "model", "encode")
    modules = ", ".join(f"holoreel.core.videorf.{name}" for name in names)
    code = f"import sys; sys.modules.update(torch=None, av=None, scipy=None); import {modules}"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
