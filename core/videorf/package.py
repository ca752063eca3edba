# SPDX-License-Identifier: GPL-3.0-or-later
"""The `.reel` of a VideoRF: one manifest, and beside it everything a player needs. Needs numpy only.

    {"kind": "videorf", "version": 1, "fps": 24.0, "frame_start": 1, "frame_count": 24, "up": "Z",
     "color_space": "display", "background": [1, 1, 1],
     "lattice": {"shape": [x, y, z], "lowest": [x, y, z], "spacing": 0.02},
     "march": {"step": 0.5, "transmittance_min": 0.0001},
     "ranges": {"low": [-8, ...], "high": [16, ...]},
     "image": {"profile": "universal", "width": 512, "height": 512, "columns": 4, "rows": 2, "layout": "blocks"},
     "shading": {"file": "NAME.shading", "features": 7, "frequencies": 1, "hidden": 16, "sha256": "..."},
     "tables": {"file": "NAME.tables", "groups": [{"frames": 12, "vertices": 35463, "offset": 0, "size": 2100,
                "sha256": "..."}]},
     "rungs": [{"qp": 20, "codec": "h264", "file": "NAME.qp20.mp4", "size": 440000, "head": 761,
                "groups": [{"offset": 761, "size": 439239, "sha256": "...", "luma_crc32": 123456789}]}],
     "files": {"metrics": "metrics.json"}, "provenance": {...}}

Groups follow each other without gap; `tables` holds their occupancy bitmasks one after the other. All rungs are cut at
the same frames and share tables and shading, so a player may change rungs at the head of any group. Every part is a run
of bytes in a file, so a static HTTP server with ranges is all that a stream needs.
"""

import hashlib
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import HoloreelError
from ..files import atomic_path, read_json, write_json
from .codec import CODECS, CodedGroup, CodedVideo, FeatureVideo
from .fields import Fields
from .mapping import LAYOUTS, Layout, MappingTable, check_size, table_from_bitmask
from .mp4 import Span
from .occupancy import Lattice
from .quantize import Ranges
from .shading import Shading, ShadingShape, read_shading, shading_bytes
from .tiles import Tiling, tiling_of

KIND = "videorf"
VERSION = 1
UP_AXES = ("X", "-X", "Y", "-Y", "Z", "-Z")
MAX_FRAMES = 10_000_000
MAX_GROUPS = 1_000_000
MAX_RUNGS = 100
MAX_TABLE_BYTES = 4 << 20  # a bitmask of 256³ vertices without any packing is 2 MiB


class TableEntry(NamedTuple):
    """A group: how many frames and vertices it has, and where its bitmask lies."""

    frames: int
    vertices: int
    offset: int
    size: int
    sha256: str


class Rung(NamedTuple):
    """One rate: the constant QP, the codec, the video file and where its groups lie."""

    qp: int
    codec: str
    file: str
    video: CodedVideo


@dataclass(frozen=True)
class VideoReel:
    """A VideoRF at `path`; frames `frame_start` ... on Blender's timeline. What the fields mean is said above."""

    path: Path
    fps: float
    frame_start: int
    lattice: Lattice
    ranges: Ranges
    tiling: Tiling
    profile: str
    layout: Layout
    shading: ShadingShape
    shading_file: str
    shading_sha256: str
    tables_file: str
    groups: tuple[TableEntry, ...]
    rungs: tuple[Rung, ...]
    up: str | None = None
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    step: float = 0.5
    transmittance_min: float = 1e-4
    files: dict[str, str] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)

    @property
    def frame_count(self) -> int:
        """How many frames all groups have."""
        return sum(group.frames for group in self.groups)

    @property
    def firsts(self) -> list[int]:
        """The first frame of each group, counted from 0."""
        return [0, *accumulate(group.frames for group in self.groups)][:-1]

    def group_of(self, frame: int) -> int:
        """Return the group of a frame, counted from 0."""
        if not 0 <= frame < self.frame_count:
            raise HoloreelError(f"{self.path} has no frame {frame}: take 0 to {self.frame_count - 1}.")
        return bisect_right(self.firsts, frame) - 1

    @property
    def meaning(self) -> str:
        """The SHA-256 of all that turns codes into a field: every video of a training carries it in its head.

        It is that of these, little-endian, one after the other: lattice (3 uint32; 4 float64), ranges (C float64
        lowest, C float64 highest), tiles (5 uint32: channels, height, width, columns, rows), the layout's name, the
        shading network's shape (3 int32; -1 where it does not look at the direction) and the SHA-256 of its weights.
        """
        lattice, tiling, shape = self.lattice, self.tiling, self.shading
        frequencies = -1 if shape.frequencies is None else shape.frequencies
        parts = (
            np.array(lattice.shape, "<u4"),
            np.array((*lattice.lowest, lattice.spacing), "<f8"),
            np.array((*self.ranges.low, *self.ranges.high), "<f8"),
            np.array((tiling.channels, tiling.height, tiling.width, tiling.columns, tiling.rows), "<u4"),
            self.layout.encode(),
            np.array((shape.features, frequencies, shape.hidden), "<i4"),
            bytes.fromhex(self.shading_sha256),
        )
        return hashlib.sha256(b"".join(bytes(part) for part in parts)).hexdigest()

    def video(self, rung: int = 0) -> FeatureVideo:
        """Open the video of a rung."""
        if not 0 <= rung < len(self.rungs):
            raise HoloreelError(f"{self.path} has no rung {rung}: take 0 to {len(self.rungs) - 1}.")
        part = self.rungs[rung]
        return FeatureVideo(self.path.parent / part.file, part.video, self.tiling.picture, self.meaning)

    def table(self, group: int) -> MappingTable:
        """Read a group's table. Raises `HoloreelError` where it is missing, damaged, or not of the size it should
        be.
        """
        entry, path = self.groups[group], self.path.parent / self.tables_file
        try:
            with path.open("rb") as file:
                file.seek(entry.offset)
                data = file.read(entry.size)
        except OSError as error:
            raise HoloreelError(f"{path} cannot be read ({error.strerror}): put it beside the reel.") from error
        if hashlib.sha256(data).hexdigest() != entry.sha256:
            raise HoloreelError(f"{path} is cut off or damaged at group {group}: fetch it again.")
        size = self.tiling.height, self.tiling.width
        table = table_from_bitmask(data, self.lattice.shape, size, self.layout)
        if table.count != entry.vertices:
            raise HoloreelError(
                f"{path} holds {table.count} vertices in group {group}, the reel says {entry.vertices}: fetch both "
                f"again."
            )
        return table

    def shade(self) -> Shading:
        """Read the shading network. Raises `HoloreelError` where it is missing or another one than the reel's."""
        path = self.path.parent / self.shading_file
        shading = read_shading(path, self.shading)
        if hashlib.sha256(shading_bytes(shading)).hexdigest() != self.shading_sha256:
            raise HoloreelError(f"{path} is damaged or of another training: fetch it again.")
        return shading


def write_tables(path: str | Path, tables: Sequence[MappingTable], frames: Sequence[int]) -> tuple[TableEntry, ...]:
    """Write the bitmasks of groups of so many frames to one file, atomically; returns where they lie."""
    masks = [table.bitmask() for table in tables]
    with atomic_path(path) as temporary:
        temporary.write_bytes(b"".join(masks))
    offsets = [0, *accumulate(map(len, masks))]
    return tuple(
        TableEntry(count, table.count, offset, len(mask), hashlib.sha256(mask).hexdigest())
        for count, table, offset, mask in zip(frames, tables, offsets, masks, strict=False)
    )


def write_video_reel(reel: VideoReel) -> None:
    """Write the manifest at `reel.path`, atomically; what it names should be there already."""
    tiling = reel.tiling
    manifest = {
        "kind": KIND,
        "version": VERSION,
        "fps": reel.fps,
        "frame_start": reel.frame_start,
        "frame_count": reel.frame_count,
        "up": reel.up,
        "color_space": "display",
        "background": reel.background,
        "lattice": {"shape": reel.lattice.shape, "lowest": reel.lattice.lowest, "spacing": reel.lattice.spacing},
        "march": {"step": reel.step, "transmittance_min": reel.transmittance_min},
        "ranges": {"low": reel.ranges.low, "high": reel.ranges.high},
        "image": {
            "profile": reel.profile,
            "width": tiling.width,
            "height": tiling.height,
            "columns": tiling.columns,
            "rows": tiling.rows,
            "layout": reel.layout,
        },
        "shading": {"file": reel.shading_file, **vars(reel.shading), "sha256": reel.shading_sha256},
        "tables": {"file": reel.tables_file, "groups": [group._asdict() for group in reel.groups]},
        "rungs": [_rung_object(rung) for rung in reel.rungs],
        "files": reel.files,
        "provenance": reel.provenance,
    }
    parse_video_reel(reel.path, manifest)  # what cannot be read is not written
    write_json(reel.path, manifest)


def _rung_object(rung: Rung) -> dict[str, Any]:
    keys = ("offset", "size", "sha256", "luma_crc32")
    return {
        "qp": rung.qp,
        "codec": rung.codec,
        "file": rung.file,
        "size": rung.video.size,
        "head": rung.video.head.size,
        "groups": [{key: getattr(group, key) for key in keys} for group in rung.video.groups],
    }


def read_video_reel(path: str | Path) -> VideoReel:
    """Read and check a manifest, not its payloads. Raises `HoloreelError` naming the field that is wrong."""
    return parse_video_reel(Path(path), read_json(path))


def parse_video_reel(path: Path, manifest: dict[str, Any]) -> VideoReel:
    """Check a manifest, whoever wrote it. Raises `HoloreelError` naming the field that is wrong."""
    top = Fields(path, "", manifest)
    top.demand(path.suffix.lower() == ".reel", "name", path.name, "a name that ends in .reel")
    top.demand(manifest.get("kind") == KIND, "kind", manifest.get("kind"), f"'{KIND}'")
    version = top.whole("version", 1, 1_000_000)
    if version > VERSION:
        raise HoloreelError(f"{path} is of version {version}, this Holoreel reads up to {VERSION}: update Holoreel.")
    top.choice("color_space", ("display",))
    up = manifest.get("up")
    top.demand(up is None or up in UP_AXES, "up", up, f"null or one of {', '.join(UP_AXES)}")
    lattice, march, ranges, image = (top.part(name) for name in ("lattice", "march", "ranges", "image"))
    shading, tables = top.part("shading"), top.part("tables")
    features = shading.whole("features", 1, 15)
    hidden, frequencies = shading.whole("hidden", 1, 256), shading.value.get("frequencies")
    frequencies = None if frequencies is None else shading.whole("frequencies", 0, 8)
    layout = image.choice("layout", LAYOUTS)
    height, width = (image.whole(name, 1, 2048) for name in ("height", "width"))
    check_size((height, width), layout)
    profile = image.choice("profile", ("universal", "quality"))
    tiling = tiling_of(profile, features + 1, height, width)
    for name, value in (("columns", tiling.columns), ("rows", tiling.rows)):
        image.demand(image.value.get(name) == value, name, image.value.get(name), f"{value}, as '{profile}' has")
    shape = lattice.triple("shape")
    lattice.demand(all(edge == int(edge) for edge in shape), "shape", shape, "three whole numbers")
    x, y, z = map(int, shape)
    low, high = (ranges.numbers(name, features + 1) for name in ("low", "high"))
    groups = _parse_tables(tables, (x, y, z), height * width)
    top.whole("frame_count", *[sum(group.frames for group in groups)] * 2)
    red, green, blue = top.numbers("background", 3)
    return VideoReel(
        path=path,
        fps=top.number("fps", 1e-3, 1000),
        frame_start=top.whole("frame_start", -(2**31), 2**31 - 1),
        lattice=Lattice((x, y, z), lattice.triple("lowest"), lattice.number("spacing", 1e-12, 1e12)),
        ranges=Ranges(low, high),
        tiling=tiling,
        profile=profile,
        layout=layout,
        shading=ShadingShape(features, frequencies, hidden),
        shading_file=shading.file("file"),
        shading_sha256=shading.digest("sha256"),
        tables_file=tables.file("file"),
        groups=groups,
        rungs=_parse_rungs(top, groups),
        up=up,
        background=(red, green, blue),
        step=march.number("step", 1 / 64, 64),
        transmittance_min=march.number("transmittance_min", 0, 0.999),
        files={name: top.part("files").file(name) for name in top.part("files").value},
        provenance=top.part("provenance").value,
    )


def _parse_tables(tables: Fields, shape: tuple[int, int, int], pixels: int) -> tuple[TableEntry, ...]:
    most = min(pixels, shape[0] * shape[1] * shape[2])
    groups, end, frames = [], 0, 0
    for entry in tables.parts("groups", MAX_GROUPS):
        group = TableEntry(
            entry.whole("frames", 1, MAX_FRAMES - frames),
            entry.whole("vertices", 0, most),
            entry.whole("offset", end, end),
            entry.whole("size", 1, MAX_TABLE_BYTES),
            entry.digest("sha256"),
        )
        end, frames = group.offset + group.size, frames + group.frames
        groups.append(group)
    return tuple(groups)


def _parse_rungs(top: Fields, tables: tuple[TableEntry, ...]) -> tuple[Rung, ...]:
    rungs = []
    firsts = list(accumulate((table.frames for table in tables), initial=0))
    for rung in top.parts("rungs", MAX_RUNGS):
        size = rung.whole("size", 1, 2**53)
        head = rung.whole("head", 1, size)
        entries = rung.parts("groups", MAX_GROUPS)
        rung.demand(len(entries) == len(tables), "groups", len(entries), f"as many as tables, {len(tables)}")
        groups, end = [], head
        for entry, first, table in zip(entries, firsts, tables, strict=False):
            length = entry.whole("size", 1, min(size - end, 2**31 - 1))
            crc = entry.whole("luma_crc32", 0, 2**32 - 1)
            offset = entry.whole("offset", end, end)
            groups.append(CodedGroup(first, table.frames, offset, length, entry.digest("sha256"), crc))
            end += length
        rung.demand(end == size, "size", size, f"{end}, where its last group ends")
        video = CodedVideo(size, Span(0, head), tuple(groups))
        rungs.append(Rung(rung.whole("qp", 0, 255), rung.choice("codec", tuple(CODECS)), rung.file("file"), video))
    return tuple(rungs)
