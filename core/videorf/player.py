# SPDX-License-Identifier: GPL-3.0-or-later
"""Play a VideoRF: any frame of a reel, decoded, or of a trained model, as any camera sees it."""

import math
import warnings
from abc import abstractmethod
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ..camera import Camera
from ..draw import Drawing, Player
from ..errors import HoloreelError
from ..reel import Triple
from ..render import Backend
from .decode import DecodedVideo, FrameSource, Stopwatch, frames_text, rung_name, size_text
from .draw import QUALITY, camera_rays, draw_field, draw_field_torch
from .encode import reel_size
from .field import FieldLattice, MarchRules
from .mapping import MappingTable
from .march import Volume
from .model import FieldVideo, read_field_video
from .native import load_kernels
from .package import read_video_reel

Drawn = Literal["cpu", "cuda", "reference"]

GROUPS_HELD = 2  # in memory, ready for drawing: going back and forth over a seam makes nothing twice
ROUNDING = 1e-6  # of a frame: a time that stands for a frame is one, though it was rounded


class Held(NamedTuple):
    """A group's lattice, ready for drawing, and as the compiled march has it."""

    field: FieldLattice
    volume: Volume | None


class FramePlayer(Player):
    """Draws frames that are tables of rows. A VideoRF has no sub-frames: what lies between two frames is the earlier.

    `seconds` says how long the last drawing took: `decode` of the video, `unpack` into rows, `draw`, and `prepare`,
    which a group needs once.
    """

    subject_alone = True

    def __init__(self, path: Path, source: FrameSource, quality: str, backend: Backend, watch: Stopwatch):
        if quality not in QUALITY:
            raise HoloreelError(f"The quality '{quality}' is unknown: take one of {', '.join(QUALITY)}.")
        self.path, self.source, self.watch = path, source, watch
        self.backend_name = choose_backend(backend)
        self.frame_start, self.frame_count = source.frame_start, source.frame_count
        self.background = source.background
        self.rules = rules_of(source, quality)
        self.report: list[str] = []
        self._held = lru_cache(maxsize=GROUPS_HELD)(self._prepare)

    @property
    def seconds(self) -> dict[str, float]:
        """What the last drawing took, by part."""
        return self.watch.seconds

    def index_of(self, frame: float) -> int:
        """Return the frame, counted from 0, that is shown at a frame of the timeline; held at both ends."""
        return min(max(math.floor(frame - self.frame_start + ROUNDING), 0), self.frame_count - 1)

    def draw(self, camera: Camera, frame: float, background: Triple | None = None) -> Drawing:
        """Draw one frame through any lens, over the file's own background unless another is given."""
        self.watch.seconds = {}
        index = self.index_of(frame)
        rows = self.source.rows(index)
        with self.watch.part("prepare"):
            field, volume = self._held(self.source.group_of(index))
        with self.watch.part("draw"):
            table = torch.from_numpy(np.concatenate((rows, self.source.ranges.empty[None])))
            color = self.background if background is None else background
            if volume is not None:
                drawn = draw_field(volume, table, self.source.shading, camera, self.rules, color)
            else:
                table = table.to("cuda" if self.backend_name == "cuda" else "cpu")
                drawn = draw_field_torch(field, table, self.source.shading, camera, self.rules, color)
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

    @abstractmethod
    def table(self, group: int) -> MappingTable:
        """Return the mapping table of a group."""

    def _prepare(self, group: int) -> Held:
        table = self.table(group)
        field = FieldLattice(self.source.lattice, table.lookup(), table.count + 1)
        return Held(field, Volume(field) if self.backend_name == "cpu" else None)


class VideoPlayer(FramePlayer):
    """Draws the frames of a `.reel` from one of its rungs, in any order.

    `rung` is its place in the reel, or its name: a QP as "20", with the codec where it matters as "hevc:20"; without
    one, the best. `quality` is "full", what it was trained with, or "fast" or "draft", which take longer steps. Frames
    that a truncated video does not hold are named in `report`; the others can be drawn.
    """

    source: DecodedVideo

    def __init__(
        self,
        path: str | Path,
        rung: int | str | None = None,
        quality: str = "full",
        backend: Backend = "auto",
    ):
        watch = Stopwatch()
        source = DecodedVideo(read_video_reel(path), rung, watch)
        super().__init__(source.reel.path, source, quality, backend, watch)
        self.reel, self.rung = source.reel, source.rung
        if lost := self.missing():
            video = source.video.path
            self.report.append(f"{video} is cut off: {frames_text(lost)} cannot be drawn; fetch the rest of it.")

    def missing(self) -> list[int]:
        """Return the frames of the timeline that a truncated video does not hold."""
        return [self.frame_start + frame for frame in self.source.missing()]

    def table(self, group: int) -> MappingTable:
        """Return the mapping table of a group, read from the reel."""
        return self.source.table(group)

    def size(self) -> int:
        """Return the bytes of all that is played: the rung's video, tables, shading network and manifest."""
        return reel_size(self.reel, self.rung).total

    def facts(self) -> dict[str, Any]:
        """Return the rung that is played, and what each rung takes, in words."""
        rungs = {rung_name(rung): size_text(self.reel, index) for index, rung in enumerate(self.reel.rungs)}
        return super().facts() | {"rung": rung_name(self.reel.rungs[self.rung]), "rungs": rungs}


class FieldPlayer(FramePlayer):
    """Draws the frames of a trained model as they were before anything was coded."""

    source: FieldVideo

    def __init__(
        self, model: FieldVideo, quality: str = "full", backend: Backend = "auto", path: Path = Path("the model")
    ):
        super().__init__(path, model, quality, backend, Stopwatch())

    @classmethod
    def open(cls, folder: str | Path, quality: str = "full", backend: Backend = "auto") -> "FieldPlayer":
        """Open the folder of a trained model."""
        return cls(read_field_video(folder), quality, backend, Path(folder))

    def table(self, group: int) -> MappingTable:
        """Return the mapping table of a group."""
        return self.source.tables[group]

    def size(self) -> int:
        """Return the bytes of all rows as floats, of the tables and of the network."""
        model = self.source
        parts = zip(model.groups, model.tables, strict=True)
        rows = sum(4 * model.channels * group.count * table.count for group, table in parts)
        return rows + sum(len(table.bitmask()) for table in model.tables) + 4 * model.shading.shape.count


def rules_of(source: FrameSource, quality: str) -> MarchRules:
    """Return how rays are marched: at full quality as in training, else with steps as many times longer as `QUALITY`
    says.
    """
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
