# SPDX-License-Identifier: GPL-3.0-or-later
"""What the training of a VideoRF makes, before anything is coded. Needs numpy only.

On disk it is a folder:

    model.json            what the fields of `FieldVideo` say, and the names of the files below
    model.shading         the shading network, as a `.reel` has it
    table_000000.mask     the occupancy bitmask of each group, as a `.reel` has it
    rows_000000.npy       the rows (N, C) of each frame, float32

A frame's rows are written as soon as they are trained and read when they are asked for: a long video is never in memory
at once.
"""

from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import HoloreelError
from ..files import atomic_path, read_json, write_json
from .fields import Fields
from .grouping import Group
from .mapping import LAYOUTS, MappingTable, check_size, table_from_bitmask
from .occupancy import Lattice
from .package import MAX_GROUPS, MAX_TABLE_BYTES, UP_AXES
from .quantize import Ranges
from .shading import Shading, ShadingShape, read_shading, write_shading

KIND = "videorf-model"
VERSION = 1
HEADER = "model.json"
SHADING = "model.shading"
MAX_GROUP_FRAMES = 1_000_000

Rows = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class FieldVideo:
    """A radiance field per frame: rows [raw density, features] of the vertices that a group of frames uses.

    Rank k of `tables[g]` is row k of every frame of `groups[g]`. `load(frame)` returns a frame's rows (N, C), float32;
    `ranges` are those the training kept them in, `ranges.empty` is the row of every vertex without a rank. Densities
    are raw, over one spacing of `lattice`.
    """

    lattice: Lattice
    groups: tuple[Group, ...]
    tables: tuple[MappingTable, ...]
    shading: Shading
    ranges: Ranges
    load: Callable[[int], Rows]
    fps: float = 24.0
    frame_start: int = 1
    up: str | None = "Z"
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    step: float = 0.5
    transmittance_min: float = 1e-4
    provenance: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        firsts = [sum(group.count for group in self.groups[:index]) for index in range(len(self.groups))]
        if not self.groups or [group.first for group in self.groups] != firsts:
            raise ValueError("groups must follow each other without gap, from frame 0 on")
        if len(self.tables) != len(self.groups) or any(table.shape != self.lattice.shape for table in self.tables):
            raise ValueError("there must be one table of the lattice per group")
        if len(self.ranges.low) != self.channels:
            raise ValueError("there must be one range per channel")

    @property
    def channels(self) -> int:
        """How many numbers a row has: the density and the features."""
        return self.shading.shape.features + 1

    @property
    def frame_count(self) -> int:
        """How many frames all groups have."""
        return self.groups[-1].first + self.groups[-1].count

    def group_of(self, frame: int) -> int:
        """Return the group of a frame, both counted from 0."""
        if not 0 <= frame < self.frame_count:
            raise HoloreelError(f"There is no frame {frame} in this model: take 0 to {self.frame_count - 1}.")
        return bisect_right([group.first for group in self.groups], frame) - 1

    def table_of(self, frame: int) -> MappingTable:
        """Return the mapping table of a frame."""
        return self.tables[self.group_of(frame)]

    def rows(self, frame: int) -> Rows:
        """Return a frame's rows (N, C) in ranks of its table; the table that a march takes has `ranges.empty` below
        them.
        """
        wanted = (self.table_of(frame).count, self.channels)
        rows = self.load(frame)
        if rows.shape != wanted or rows.dtype != np.float32:
            raise HoloreelError(f"Frame {frame} has rows of {rows.shape}, its table wants {wanted}: train it again.")
        return rows

    def write(self, folder: str | Path) -> Path:
        """Write the folder, file by file, the header last; returns it."""
        for frame in range(self.frame_count):
            write_rows(folder, frame, self.rows(frame))
        return self.write_header(folder)

    def write_header(self, folder: str | Path) -> Path:
        """Write everything but the rows, which are there already; returns the folder."""
        folder = Path(folder)
        write_shading(folder / SHADING, self.shading)
        for index, table in enumerate(self.tables):
            with atomic_path(folder / _table_name(index)) as temporary:
                temporary.write_bytes(table.bitmask())
        height, width = self.tables[0].size
        groups = [
            {"frames": group.count, "vertices": table.count, "file": _table_name(index)}
            for index, (group, table) in enumerate(zip(self.groups, self.tables, strict=True))
        ]
        write_json(
            folder / HEADER,
            {
                "kind": KIND,
                "version": VERSION,
                "fps": self.fps,
                "frame_start": self.frame_start,
                "up": self.up,
                "background": self.background,
                "lattice": vars(self.lattice),
                "march": {"step": self.step, "transmittance_min": self.transmittance_min},
                "ranges": vars(self.ranges),
                "image": {"width": width, "height": height, "layout": self.tables[0].layout},
                "shading": vars(self.shading.shape),
                "groups": groups,
                "provenance": self.provenance,
            },
        )
        return folder


def in_memory(rows: Sequence[Rows]) -> Callable[[int], Rows]:
    """Return the `load` of rows that are all at hand, frame by frame."""
    return rows.__getitem__


def write_rows(folder: str | Path, frame: int, rows: Rows) -> None:
    """Write a frame's rows (N, C) into a model's folder, atomically."""
    with atomic_path(_rows_path(Path(folder), frame)) as temporary:
        np.save(temporary, np.ascontiguousarray(rows, np.float32), allow_pickle=False)


def read_rows(folder: str | Path, frame: int, shape: tuple[int, int]) -> Rows:
    """Read a frame's rows. Raises `HoloreelError` where they are missing, of another shape or type, or not finite."""
    path = _rows_path(Path(folder), frame)
    try:
        lazy = np.load(path, mmap_mode="r", allow_pickle=False)
        right = isinstance(lazy, np.ndarray) and lazy.shape == shape and lazy.dtype == np.float32
        rows = np.array(lazy, order="C") if right else np.full(1, np.nan, np.float32)
    except (OSError, ValueError, EOFError) as error:
        raise HoloreelError(
            f"{path} cannot be read as rows of a model ({error}): train again with --resume."
        ) from error
    if not right or not np.isfinite(rows).all():
        raise HoloreelError(f"{path} does not hold {shape[0]} x {shape[1]} finite numbers: train the model again.")
    return rows


def is_model(path: str | Path) -> bool:
    """Whether a path is the folder of a trained model."""
    return (Path(path) / HEADER).is_file()


def read_field_video(folder: str | Path) -> FieldVideo:
    """Read a model's folder, without its rows. Raises `HoloreelError` naming the file or the field that is wrong."""
    path = Path(folder) / HEADER
    top = Fields(path, "", read_json(path))
    top.demand(top.value.get("kind") == KIND, "kind", top.value.get("kind"), f"'{KIND}'")
    top.whole("version", 1, VERSION)
    up = top.value.get("up")
    top.demand(up is None or up in UP_AXES, "up", up, f"null or one of {', '.join(UP_AXES)}")
    lattice, march, ranges, image, shading = (
        top.part(name) for name in ("lattice", "march", "ranges", "image", "shading")
    )
    features, frequencies = shading.whole("features", 1, 15), shading.value.get("frequencies")
    frequencies = None if frequencies is None else shading.whole("frequencies", 0, 8)
    shape = ShadingShape(features, frequencies, shading.whole("hidden", 1, 256))
    edges = lattice.triple("shape")
    lattice.demand(all(edge == int(edge) for edge in edges), "shape", edges, "three whole numbers")
    x, y, z = map(int, edges)
    size = image.whole("height", 1, 2048), image.whole("width", 1, 2048)
    layout = image.choice("layout", LAYOUTS)
    check_size(size, layout)
    low, high = (ranges.numbers(name, features + 1) for name in ("low", "high"))
    groups: list[Group] = []
    tables: list[MappingTable] = []
    for entry in top.parts("groups", MAX_GROUPS):
        table = table_from_bitmask(_read_mask(path.parent / entry.file("file")), (x, y, z), size, layout)
        entry.whole("vertices", table.count, table.count)
        first = groups[-1].first + groups[-1].count if groups else 0
        groups.append(Group(first, entry.whole("frames", 1, MAX_GROUP_FRAMES), table.occupancy()))
        tables.append(table)
    red, green, blue = top.numbers("background", 3)
    counts = [table.count for group, table in zip(groups, tables, strict=True) for _ in range(group.count)]
    return FieldVideo(
        Lattice((x, y, z), lattice.triple("lowest"), lattice.number("spacing", 1e-12, 1e12)),
        tuple(groups),
        tuple(tables),
        read_shading(path.parent / SHADING, shape),
        Ranges(low, high),
        lambda frame: read_rows(path.parent, frame, (counts[frame], features + 1)),
        fps=top.number("fps", 1e-3, 1000),
        frame_start=top.whole("frame_start", -(2**31), 2**31 - 1),
        up=up,
        background=(red, green, blue),
        step=march.number("step", 1 / 64, 64),
        transmittance_min=march.number("transmittance_min", 0, 0.999),
        provenance=top.part("provenance").value,
    )


def _read_mask(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(MAX_TABLE_BYTES + 1)
    except OSError as error:
        raise HoloreelError(f"{path} cannot be read ({error.strerror}): train the model again.") from error


def _rows_path(folder: Path, frame: int) -> Path:
    return folder / f"rows_{frame:06d}.npy"


def _table_name(index: int) -> str:
    return f"table_{index:06d}.mask"
