# SPDX-License-Identifier: GPL-3.0-or-later
"""Any frame of a reel as rows, in any order, from one of its rungs. Needs numpy, and PyAV when a frame is decoded."""

import time
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..errors import HoloreelError
from .encode import reel_size
from .mapping import MappingTable
from .model import FieldVideo
from .package import Rung, VideoReel

TABLES_HELD = 2  # in memory: going back and forth over a seam reads nothing twice
CODES_HELD = 256 << 20  # bytes of decoded frames in memory: going back inside a group decodes nothing twice
PREFERRED = "h264"  # of rungs with the same QP: every machine decodes it


class Stopwatch:
    """Adds up the seconds that parts of a work take."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Count what is done inside."""
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


class DecodedVideo:
    """The frames of a reel as a player of one of its rungs has them; frames are counted from 0.

    It can be used as a `FieldVideo` is, whose fields it has: `rows` are (N, C), and vertices without a rank have
    `ranges.empty`. `wanted` is as in `find_rung`. The `watch` counts `decode`, the video, and `unpack`, what makes rows
    of a luma. Raises `HoloreelError` where the reel's files are missing or not as it says.
    """

    def __init__(self, reel: VideoReel, wanted: int | str | None = None, watch: Stopwatch | None = None) -> None:
        self.reel, self.rung = reel, find_rung(reel, wanted)
        self.watch = watch or Stopwatch()
        self.video = reel.video(self.rung)
        self.shading = reel.shade()
        self.lattice, self.ranges, self.groups = reel.lattice, reel.ranges, reel.groups
        self.fps, self.frame_start, self.frame_count = reel.fps, reel.frame_start, reel.frame_count
        self.up, self.background = reel.up, reel.background
        self.step, self.transmittance_min = reel.step, reel.transmittance_min
        self.group_of = reel.group_of
        self.table = lru_cache(maxsize=TABLES_HELD)(reel.table)
        self._codes: OrderedDict[int, NDArray[np.uint8]] = OrderedDict()
        self._last = -1  # what the video decoded last

    def missing(self) -> list[int]:
        """Return the frames that a truncated video does not hold."""
        lost = self.video.missing()
        return [frame for group in lost for frame in range(group.first, group.first + group.frames)]

    def table_of(self, frame: int) -> MappingTable:
        """Return the mapping table of a frame."""
        return self.table(self.group_of(frame))

    def codes(self, frame: int) -> NDArray[np.uint8]:
        """Return the codes (N, C) of a frame as they were decoded: do not change them."""
        if frame not in self._codes:
            first = self.reel.firsts[self.group_of(frame)]
            follows = first <= self._last < frame
            for index in range(self._last + 1 if follows else first, frame + 1):
                self._decode(index)
        self._codes.move_to_end(frame)
        return self._codes[frame]

    def rows(self, frame: int) -> NDArray[np.float32]:
        """Return the rows (N, C) of a frame, dequantized."""
        codes = self.codes(frame)
        with self.watch.part("unpack"):
            return self.ranges.decode(codes)

    def forget(self) -> None:
        """Let go of what was decoded, so that the time of decoding can be measured anew."""
        self._codes.clear()
        self._last = -1

    def _decode(self, frame: int) -> None:
        self._last = -1  # until the frame is there
        with self.watch.part("decode"):
            luma = self.video.luma(frame)
        table = self.table_of(frame)
        with self.watch.part("unpack"):
            self._codes[frame] = table.to_rows(self.reel.tiling.unpack(luma))
        self._codes.move_to_end(frame)
        self._last = frame
        while len(self._codes) > 1 and sum(held.nbytes for held in self._codes.values()) > CODES_HELD:
            self._codes.popitem(last=False)


FrameSource = FieldVideo | DecodedVideo  # what has rows for every frame, and the tables they belong to


def rung_name(rung: Rung) -> str:
    """Return what a rung is called: its codec and QP, as h264:20."""
    return f"{rung.codec}:{rung.qp}"


def rung_order(reel: VideoReel) -> list[int]:
    """Return the places of all rungs: H.264 first, and of each kind the lowest QP first."""
    return sorted(range(len(reel.rungs)), key=lambda k: (reel.rungs[k].codec != PREFERRED, reel.rungs[k].qp))


def find_rung(reel: VideoReel, wanted: int | str | None = None) -> int:
    """Return the place of a rung in its reel: of a place, a name like "20" or "hevc:20", or the best (None).

    The best is the H.264 rung of lowest QP; a QP alone means the H.264 rung where several codecs have it. Raises
    `HoloreelError` where there is no such rung.
    """
    order = rung_order(reel)
    if wanted is None:
        return order[0]
    if isinstance(wanted, int):
        found = [wanted] if 0 <= wanted < len(reel.rungs) else []
    else:
        found = [k for k in order if wanted in (rung_name(reel.rungs[k]), str(reel.rungs[k].qp))]
    if not found:
        known = ", ".join(map(rung_name, reel.rungs))
        raise HoloreelError(f"{reel.path} has no rung {wanted}: take one of {known}.")
    return found[0]


def size_text(reel: VideoReel, rung: int) -> str:
    """Return what a rung takes, in words."""
    size = reel_size(reel, rung)
    return (
        f"{size.total:,} bytes, {size.per_frame / 1000:.1f} kB per frame "
        f"(video {size.video:,}, tables {size.tables:,}, network {size.shading:,}, manifest {size.manifest:,})"
    )


def frames_text(frames: list[int]) -> str:
    """Return frames in words, runs of them as first to last."""
    runs: list[list[int]] = []
    for frame in frames:
        if runs and frame == runs[-1][1] + 1:
            runs[-1][1] = frame
        else:
            runs.append([frame, frame])
    parts = [f"{first} to {last}" if last > first else str(first) for first, last in runs]
    return f"frame{'s' if len(frames) > 1 else ''} {', '.join(parts)}"
