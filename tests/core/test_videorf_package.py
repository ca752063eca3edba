# SPDX-License-Identifier: GPL-3.0-or-later
"""The reel of a VideoRF: written, read back, judged as a foreign file, and played."""

import copy
import json
import shutil
import subprocess
import sys

import numpy as np
import pytest
from holoreel.core.errors import HoloreelError
from holoreel.core.videorf.encode import RungSpec, write_reel
from holoreel.core.videorf.package import parse_video_reel, read_video_reel

from .videorf_model import ball_model


@pytest.fixture(scope="module")
def packed(tmp_path_factory):
    """A reel of five frames in groups, its tables and the rows (N, C) of each frame."""
    model = ball_model()
    path = tmp_path_factory.mktemp("package") / "a.reel"
    reel = write_reel(model, path, [RungSpec(8), RungSpec(30)], files={"metrics": "metrics.json"})
    return reel, model.tables, [model.rows(frame) for frame in range(5)]


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


def copied(reel, folder):
    for path in reel.path.parent.iterdir():
        shutil.copy(path, folder / path.name)
    return folder / "a.reel"


@pytest.mark.parametrize(
    "change",
    [
        lambda m: m["ranges"]["high"].__setitem__(3, m["ranges"]["high"][3] + 1e-3),
        lambda m: m["ranges"]["low"].__setitem__(0, -8.5),
        lambda m: m["lattice"].update(spacing=0.1),
        lambda m: m["lattice"].update(lowest=[0, 0, 0]),
        lambda m: m["image"].update(layout="macroblocks"),
        lambda m: m["shading"].update(sha256="0" * 64),
    ],
    ids=["range", "empty", "spacing", "place", "layout", "network"],
)
def test_videos_of_another_training_are_refused(packed, tmp_path, change):
    """A stream carries what it means: a manifest that says something else is not believed."""
    path = copied(packed[0], tmp_path)
    manifest = json.loads(path.read_text())
    change(manifest)
    path.write_text(json.dumps(manifest))
    reel = read_video_reel(path)
    with pytest.raises(HoloreelError, match=r"a\.qp8\.mp4 was not encoded for the lattice, ranges"):
        reel.video().luma(0)


def test_networks_of_another_training_are_refused(packed, tmp_path):
    path = copied(packed[0], tmp_path)
    data = bytearray((tmp_path / "a.shading").read_bytes())
    data[6] ^= 1
    (tmp_path / "a.shading").write_bytes(data)
    with pytest.raises(HoloreelError, match="damaged or of another training"):
        read_video_reel(path).shade()


def test_what_is_whole_of_a_damaged_reel_plays(packed, tmp_path):
    reel = read_video_reel(copied(packed[0], tmp_path))
    last = reel.rungs[0].video.groups[-1]
    video = tmp_path / "a.qp8.mp4"
    data = video.read_bytes()
    video.write_bytes(data[: last.offset + last.size // 2])
    (tmp_path / "a.qp30.mp4").unlink()
    tables = bytearray((tmp_path / "a.tables").read_bytes())
    tables[1] ^= 255
    (tmp_path / "a.tables").write_bytes(tables)
    assert reel.video(0).luma(0).shape == reel.tiling.picture
    assert reel.table(1).count == reel.groups[1].vertices
    player = reel.video(0)
    player.check(player.video.groups[0])
    with pytest.raises(HoloreelError, match=f"cut off: frames {last.first} to 4 are not whole"):
        player.check(last)
    with pytest.raises(HoloreelError, match="damaged at group 0"):
        reel.table(0)
    with pytest.raises(HoloreelError, match=r"a\.qp30\.mp4 cannot be read"):
        reel.video(1)
    # One wrong byte in the middle of a group is found without decoding.
    video.write_bytes(data[: last.offset + 200] + bytes([data[last.offset + 200] ^ 1]) + data[last.offset + 201 :])
    player = reel.video(0)
    player.check(player.video.groups[0])
    with pytest.raises(HoloreelError, match="not the file that was encoded: it was damaged, cut, or encoded again"):
        player.check(last)


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
    ("image.width", 24),
    ("image.width", 10**9),
    ("image.columns", 5),
    ("image.profile", "huge"),
    ("image.layout", "spiral"),
    ("shading.features", 8),
    ("shading.hidden", 10**9),
    ("shading.frequencies", 9),
    ("shading.file", "../a.shading"),
    ("shading.sha256", "f" * 63),
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
