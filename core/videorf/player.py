# SPDX-License-Identifier: GPL-3.0-or-later
"""Play a VideoRF: any frame of a reel, decoded, or of a trained model, as any camera sees it.

Both players draw the same way, from a frame's mapping table and rows; they differ in where the rows come from.
"""

import math
import time
import warnings
from abc import abstractmethod
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ..camera import Camera
from ..draw import Drawing, Player, Quality
from ..errors import HoloreelError
from ..reel import Triple
from ..render import Backend
from .draw import QUALITY, camera_rays, draw_field, draw_field_torch
from .encode import reel_size
from .field import FieldLattice, MarchRules
from .mapping import MappingTable
from .march import Volume
from .model import FieldVideo, read_field_video
from .native import load_kernels
from .package import Rung, VideoReel, read_video_reel
from .shading import Shading

Drawn = Literal["cpu", "cuda", "reference"]

GROUPS_HELD = 2  # tables and lattices in memory: going back and forth over a seam makes nothing twice
CODES_HELD = 256 << 20  # bytes of decoded frames in memory: going back inside a group decodes nothing twice
ROUNDING = 1e-6  # of a frame: a time that stands for a frame is one, though it was rounded
PREFERRED = "h264"  # of rungs with the same QP: every machine decodes it


class Held(NamedTuple):
    """A group made ready for drawing: its table, its lattice, and the lattice as the compiled march has it."""

    table: MappingTable
    field: FieldLattice
    volume: Volume | None


class FramePlayer(Player):
    """Draws frames that are tables of rows. A VideoRF has no sub-frames: what lies between two frames is the earlier.

    `source` has the lattice, the groups and the place on the timeline. `seconds` says how long the last drawing took:
    `decode` of the video, `unpack` into rows, `draw`, and `prepare`, which a group needs once.
    """

    subject_alone = True

    def __init__(
        self, path: Path, source: VideoReel | FieldVideo, shading: Shading, quality: Quality, backend: Backend
    ):
        if quality not in QUALITY:
            raise HoloreelError(f"The quality '{quality}' is unknown: take one of {', '.join(QUALITY)}.")
        self.path, self.source, self.shading = path, source, shading
        self.backend_name = choose_backend(backend)
        self.frame_start, self.frame_count = source.frame_start, source.frame_count
        self.background = source.background
        self.rules = rules_of(source, quality)
        self.report: list[str] = []
        self.seconds: dict[str, float] = {}
        self._held = lru_cache(maxsize=GROUPS_HELD)(self._prepare)

    @abstractmethod
    def table(self, group: int) -> MappingTable:
        """Return the mapping table of a group."""

    @abstractmethod
    def rows(self, index: int) -> NDArray[np.float32]:
        """Return the rows (N, C) of a frame, counted from 0."""

    def index_of(self, frame: float) -> int:
        """Return the frame, counted from 0, that is shown at a frame of the timeline; held at both ends."""
        return min(max(math.floor(frame - self.frame_start + ROUNDING), 0), self.frame_count - 1)

    def draw(self, camera: Camera, frame: float, background: Triple | None = None) -> Drawing:
        """Draw one frame through any lens, over the file's own background unless another is given."""
        self.seconds = {}
        index = self.index_of(frame)
        rows = self.rows(index)
        with self._timed("prepare"):
            held = self._held(self.source.group_of(index))
        with self._timed("draw"):
            table = torch.from_numpy(np.concatenate((rows, self.source.ranges.empty[None])))
            color = self.background if background is None else background
            if held.volume is not None:
                drawn = draw_field(held.volume, table, self.shading, camera, self.rules, color)
            else:
                table = table.to("cuda" if self.backend_name == "cuda" else "cpu")
                drawn = draw_field_torch(held.field, table, self.shading, camera, self.rules, color)
        return Drawing(drawn.image, drawn.alpha, np.where(np.isfinite(drawn.depth), drawn.depth, np.float32(0)))

    def reach(self, camera: Camera) -> NDArray[np.bool_] | None:
        """Return the pixels (H, W) where the lens sees something; None where it does everywhere."""
        if camera.model == "PINHOLE":
            return None
        seen = np.isfinite(camera_rays(camera)[1]).all(-1).reshape(camera.height, camera.width)
        return None if seen.all() else seen

    def facts(self) -> dict[str, Any]:
        """Return how many groups there are."""
        return {"groups": len(self.source.groups)}

    def _prepare(self, group: int) -> Held:
        table = self.table(group)
        field = FieldLattice(self.source.lattice, table.lookup(), table.count + 1)
        return Held(table, field, Volume(field) if self.backend_name == "cpu" else None)

    @contextmanager
    def _timed(self, part: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[part] = self.seconds.get(part, 0.0) + time.perf_counter() - start


class VideoPlayer(FramePlayer):
    """Draws the frames of a `.reel` from one of its rungs, in any order.

    `rung` is its place in the reel, or its name: a QP as "20", with the codec where it matters as "hevc:20"; without
    one, the best. `quality` is "full", what it was trained with, or "fast" or "draft", which take longer steps. Frames
    that a truncated video does not hold are named in `report`; the others can be drawn.
    """

    source: VideoReel

    def __init__(
        self,
        path: str | Path,
        rung: int | str | None = None,
        quality: Quality = "full",
        backend: Backend = "auto",
    ):
        reel = read_video_reel(path)
        super().__init__(reel.path, reel, reel.shade(), quality, backend)
        self.rung = find_rung(reel, rung)
        self.video = reel.video(self.rung)
        if lost := self.missing():
            self.report.append(
                f"{self.video.path} is cut off: {frames_text(lost)} cannot be drawn; fetch the rest of it."
            )
        self._codes: OrderedDict[int, NDArray[np.uint8]] = OrderedDict()
        self._last = -1
        self._tables = lru_cache(maxsize=GROUPS_HELD)(reel.table)

    def missing(self) -> list[int]:
        """Return the frames of the timeline that a truncated video does not hold."""
        return [
            self.frame_start + frame
            for group in self.video.missing()
            for frame in range(group.first, group.first + group.frames)
        ]

    def table(self, group: int) -> MappingTable:
        """Return the mapping table of a group, read from the reel."""
        return self._tables(group)

    def codes(self, index: int) -> NDArray[np.uint8]:
        """Return the codes (N, C) of a frame, counted from 0, as they were decoded: do not change them."""
        if index not in self._codes:
            first = self.source.firsts[self.source.group_of(index)]
            follows = first <= self._last < index
            for frame in range(self._last + 1 if follows else first, index + 1):
                self._decode(frame)
        self._codes.move_to_end(index)
        return self._codes[index]

    def rows(self, index: int) -> NDArray[np.float32]:
        """Return the rows (N, C) of a frame, counted from 0, dequantized."""
        codes = self.codes(index)
        with self._timed("unpack"):
            return self.source.ranges.decode(codes)

    def size(self) -> int:
        """Return the bytes of all that is played: the rung's video, tables, shading network and manifest."""
        return reel_size(self.source, self.rung).total

    def facts(self) -> dict[str, Any]:
        """Return the rung that is played, and what each rung takes, in words."""
        reel = self.source
        rungs = {rung_name(rung): size_text(reel, index) for index, rung in enumerate(reel.rungs)}
        return super().facts() | {"rung": rung_name(reel.rungs[self.rung]), "rungs": rungs}

    def _decode(self, frame: int) -> None:
        self._last = -1  # until the frame is there
        with self._timed("decode"):
            luma = self.video.luma(frame)
        with self._timed("unpack"):
            codes = self.table(self.source.group_of(frame)).to_rows(self.source.tiling.unpack(luma))
        self._last = frame
        self._codes[frame] = codes
        self._codes.move_to_end(frame)
        while len(self._codes) > 1 and sum(held.nbytes for held in self._codes.values()) > CODES_HELD:
            self._codes.popitem(last=False)


class FieldPlayer(FramePlayer):
    """Draws the frames of a trained model as they were before anything was coded."""

    source: FieldVideo

    def __init__(
        self, model: FieldVideo, quality: Quality = "full", backend: Backend = "auto", path: Path = Path("the model")
    ):
        super().__init__(path, model, model.shading, quality, backend)

    @classmethod
    def open(cls, folder: str | Path, quality: Quality = "full", backend: Backend = "auto") -> "FieldPlayer":
        """Open the folder of a trained model."""
        return cls(read_field_video(folder), quality, backend, Path(folder))

    def table(self, group: int) -> MappingTable:
        """Return the mapping table of a group."""
        return self.source.tables[group]

    def rows(self, index: int) -> NDArray[np.float32]:
        """Return the rows (N, C) of a frame, counted from 0."""
        with self._timed("unpack"):
            return self.source.rows(index)

    def size(self) -> int:
        """Return the bytes of all rows, tables and the shading network, as they are in memory."""
        tables = [table.bitmask() for table in self.source.tables]
        rows = sum(
            group.count * table.count for group, table in zip(self.source.groups, self.source.tables, strict=True)
        )
        return 4 * rows * self.source.channels + sum(map(len, tables)) + 4 * self.source.shading.shape.count


def rules_of(source: VideoReel | FieldVideo, quality: Quality) -> MarchRules:
    """Return how rays are marched: at full quality as in training, else with steps as many times longer as `QUALITY`
    says."""
    trained, full, wanted = MarchRules(source.step, source.transmittance_min), QUALITY["full"], QUALITY[quality]
    if wanted == full:
        return trained
    least = max(trained.transmittance_min, wanted.transmittance_min)
    return MarchRules(trained.step * wanted.step / full.step, least)


def choose_backend(name: Backend) -> Drawn:
    """Return what draws: `auto` takes the GPU if torch sees one, else the compiled march, or, where it cannot be
    loaded, plain torch, and warns about it.

    Raises `HoloreelError` where `cpu` or `cuda` is asked for and is not there.
    """
    if name not in ("auto", "cpu", "reference", "cuda"):
        raise ValueError(f"no backend '{name}'; take auto, cpu, reference or cuda")
    if name == "reference":
        return "reference"
    if name in ("auto", "cuda") and torch.cuda.is_available():
        return "cuda"
    if name == "cuda":
        raise HoloreelError("--backend cuda: torch sees no GPU; take --backend cpu, or install a torch that does.")
    try:
        load_kernels()
    except HoloreelError as error:
        if name == "cpu":
            raise
        warnings.warn(f"{error} Until then everything is drawn by plain torch, far slower.", stacklevel=3)
        return "reference"
    return "cpu"


def rung_name(rung: Rung) -> str:
    """Return what a rung is called: its codec and QP, as h264:20."""
    return f"{rung.codec}:{rung.qp}"


def find_rung(reel: VideoReel, wanted: int | str | None = None) -> int:
    """Return the place of a rung in its reel: of a place, a name like "20" or "hevc:20", or the best (None).

    The best is the H.264 rung of lowest QP; a QP alone means the H.264 rung where several codecs have it. Raises
    `HoloreelError` where there is no such rung.
    """
    order = sorted(range(len(reel.rungs)), key=lambda k: (reel.rungs[k].codec != PREFERRED, reel.rungs[k].qp))
    if wanted is None:
        return order[0]
    found = [wanted] if isinstance(wanted, int) and 0 <= wanted < len(reel.rungs) else []
    if isinstance(wanted, str):
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
