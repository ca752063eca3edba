# SPDX-License-Identifier: GPL-3.0-or-later
"""A training run on disk: coarse fields, groups, shading network, frame after frame, and the reel it ends in.

Every stage leaves files, whole or not at all, in the checkpoint beside the reel; going on means to make those that are
missing. What a frame needs is read when its turn comes, so that memory does not grow with the video.
"""

import hashlib
import json
import math
import platform
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..capture import Capture
from ..errors import HoloreelError
from ..files import atomic_path, read_json, write_json
from ..runs import claim_run, differences, one_torch_thread, preview_camera
from ..status import Preview
from .coarse import Coarse, occupancy_of
from .coarse_frames import CoarseJob, train_coarse_frames
from .codec import check_rung
from .config import VideoConfig
from .deferred import DeferredShading
from .draw import QUALITY, draw_field
from .encode import RungSpec, round_trip, write_reel
from .fine import (
    FrameTrainer,
    GroupField,
    RoundTrip,
    moved_rows,
    new_network,
    psnr_of,
    rows_from_coarse,
    train_frames,
)
from .grouping import Group, group_frames
from .hull import visual_hull
from .mapping import MappingTable, build_table
from .model import FieldVideo, Rows, read_field_video, read_rows, write_rows
from .occupancy import Lattice, Occupancy
from .package import VideoReel
from .shading import read_shading, write_shading
from .tiles import MACROBLOCK, PROFILES, tiling_of
from .views import FrameViews, subject_bounds

SUPERBLOCK = 64  # pixels
STAGES = ("coarse", "shading", "frames", "encode")
FREE_SETTINGS = ("qps", "codecs")  # they say nothing about the model: a run may go on with others


@dataclass(frozen=True)
class RunPaths:
    """The files of a run, all beside the reel and named after it."""

    reel: Path

    @property
    def checkpoint(self) -> Path:
        """Folder of a run that is not finished."""
        return self.reel.with_suffix(".checkpoint")

    @property
    def settings(self) -> Path:
        """What the run that the checkpoint belongs to was told."""
        return self.checkpoint / "settings.json"

    @property
    def coarse(self) -> Path:
        """Coarse fields and occupancies, unless they are shared with other runs."""
        return self.checkpoint / "coarse"

    @property
    def partial(self) -> Path:
        """The model as far as it is trained."""
        return self.checkpoint / "model"

    @property
    def model(self) -> Path:
        """The trained model: what other rungs can be made of."""
        return self.reel.with_suffix(".model")

    @property
    def record(self) -> Path:
        """What was trained how: settings, versions, groups, seconds, and how well each frame fits."""
        return self.reel.with_suffix(".train.json")


@dataclass(frozen=True)
class VideoProgress:
    """Where a run stands: `stage` of `STAGES`, the frame worked on (from 0), and steps done of those planned in all.

    `psnr` is that of training rays over random backgrounds, near the subject: lower than that of whole pictures; None
    while nothing is learned. `preview` draws the frame as far as it is trained, if it is called at once; None while
    there is nothing to draw.
    """

    stage: str
    frame: int
    frames: int
    iteration: int
    iterations: int
    psnr: float | None
    seconds_left: float
    preview: Preview | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True)
class TrainedVideo:
    """What a run made: the reel, the model behind it, and the seconds spent on each stage."""

    reel: VideoReel
    model: FieldVideo
    seconds: dict[str, float]


Listener = Callable[[VideoProgress], None]


def train_video(
    capture: Capture,
    out: Path,
    config: VideoConfig | None = None,
    on_progress: Listener = lambda progress: None,
    resume: bool = False,
    *,
    coarse: Path | None = None,
    workers: int = 1,
    keep_model: bool = True,
) -> TrainedVideo:
    """Train a VideoRF from a capture and write it to `out` (a `.reel` path), its model beside it.

    `coarse` is a folder of coarse fields to take, or to fill, instead of the run's own: runs that differ in later
    stages share it. So many `workers` train them at once. Without `keep_model`, the returned model has lost its rows
    once the run is over. When stopped, the run goes on with `resume` behind the last frame that was finished, and ends
    in the same bits; as long as it has not come to the network, other settings may be given. Raises `HoloreelError`
    where `out` cannot be written, the checkpoint or the shared folder belongs to other settings, the capture has no
    masks, or a frame does not fit into the image.
    """
    config = config or VideoConfig()
    paths = RunPaths(out)
    claim_run(out, paths.checkpoint, resume)
    rungs = [RungSpec(qp, codec) for codec in config.codecs for qp in config.qps]
    for rung in rungs:
        check_rung(rung.qp, rung.codec)
    if not capture.masked:
        raise HoloreelError(
            f"{capture.source}: a VideoRF is of a subject alone, and not all pictures have masks or transparency; give "
            "masks, render over a transparent film, or train Spacetime Gaussians (stg)."
        )
    settings = {"config": asdict(config), "capture": _identity(capture)}
    _claim_settings(paths.settings, settings, renew=not paths.partial.exists())
    run = _Run(capture, config, paths, coarse or paths.coarse, workers, on_progress)
    with one_torch_thread():
        model = run.model()
    reel = run.encode(model, rungs)
    if keep_model:
        shutil.rmtree(paths.model, ignore_errors=True)
        paths.partial.rename(paths.model)
        model = read_field_video(paths.model)
    shutil.rmtree(paths.checkpoint, ignore_errors=True)
    return TrainedVideo(reel, model, run.clock.seconds)


@dataclass
class _Clock:
    """Seconds spent and steps made, stage by stage."""

    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(STAGES, 0.0))
    steps: dict[str, int] = field(default_factory=lambda: dict.fromkeys(STAGES, 0))

    @contextmanager
    def of(self, stage: str) -> Iterator[None]:
        """Count the time inside to a stage."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] += time.perf_counter() - start


class _Run:
    """The stages of one run."""

    def __init__(
        self,
        capture: Capture,
        config: VideoConfig,
        paths: RunPaths,
        coarse_folder: Path,
        workers: int,
        on_progress: Listener,
    ) -> None:
        self.capture, self.config, self.paths, self.workers = capture, config, paths, workers
        self.on_progress, self.clock = on_progress, _Clock()
        self.frames = capture.frame_count
        low, high = subject_bounds(capture)
        self.lattice = Lattice.around(low, high, config.resolution)
        coarse_lattice = Lattice.around(low, high, max(8, round(config.resolution * config.coarse_share)))
        self.job = CoarseJob(capture, coarse_lattice, coarse_folder, config.coarse, config.seed, border=config.border)
        self.groups: tuple[Group, ...] = ()
        self.tables: tuple[MappingTable, ...] = ()
        self.network = new_network(config)
        self.fits: dict[int, float] = {}
        self.began, self.done, self.skipped = time.perf_counter(), 0, 0
        self.planned = self._plan(min(config.shading_groups, self.frames), 0)

    def _plan(self, learning: int, heads: int) -> int:
        config = self.config
        fine = learning * config.first_iterations + heads * config.head_iterations
        rest = (self.frames - learning - heads) * config.iterations
        return self.frames * config.coarse.iterations + fine + rest

    # -- what the listener hears

    def _tell(self, stage: str, frame: int, psnr: float | None, steps: int, preview: Preview | None = None) -> None:
        """Say how far the run is after so many more steps."""
        self.done += steps
        worked = max(self.done - self.skipped, 1)
        left = (time.perf_counter() - self.began) / worked * max(self.planned - self.done, 0)
        self.on_progress(VideoProgress(stage, frame, self.frames, self.done, self.planned, psnr, left, preview))

    def _skip(self, steps: int) -> None:
        self.done, self.skipped = self.done + steps, self.skipped + steps

    # -- stages

    def model(self) -> FieldVideo:
        """Return the trained model; its rows lie in the checkpoint."""
        with self.clock.of("coarse"):
            occupancies = self._coarse_stage()
        size = self._image_size(max(int(occupancy.sum()) for occupancy in occupancies))
        longest = self.config.longest if self.config.grouping else 1
        self.groups = tuple(group_frames(occupancies, size[0] * size[1], longest))
        self.tables = tuple(build_table(group.union, size, self.config.image_layout) for group in self.groups)
        learning = min(self.config.shading_groups, len(self.groups))
        self.planned = self._plan(learning, len(self.groups) - learning)
        with self.clock.of("shading"):
            self._shading_stage(learning)
        with self.clock.of("frames"):
            for index in range(len(self.groups)):
                self._train_group(index)
        model = self._model_so_far()
        model.write_header(self.paths.partial)
        return model

    def _coarse_stage(self) -> list[Occupancy]:
        """Make the coarse fields that are missing, and return the occupancy of every frame."""
        config, job = self.config, self.job
        settings = {
            "capture": _identity(self.capture),
            "lattice": asdict(job.lattice),
            "config": asdict(config.coarse),
            "border": config.border,
            "seed": config.seed,
        }
        _claim_settings(job.folder / "settings.json", settings)
        done = [0] * self.frames

        def tell(frame: int, iteration: int, psnr: float) -> None:
            self._tell("coarse", frame, psnr, iteration - done[frame])
            done[frame] = iteration

        self._skip(config.coarse.iterations * sum(job.path(frame).is_file() for frame in range(self.frames)))
        train_coarse_frames(job, range(self.frames), self.workers, tell)
        return [self._occupancy(frame) for frame in range(self.frames)]

    def _occupancy(self, frame: int) -> Occupancy:
        """Return the occupancy of a frame, from its file where there is one; its name tells what it is made of."""
        config = self.config
        made_of = [asdict(self.lattice), config.gamma, config.weight_share]
        digest = hashlib.sha256(json.dumps(made_of).encode()).hexdigest()[:12]
        path = self.job.folder / f"occupancy_{digest}_{frame:06d}.npy"
        if not path.exists():
            views = FrameViews(self.capture, frame, border=config.border)
            hull = visual_hull(views, self.lattice, config.coarse.misses, config.coarse.reach)
            found = occupancy_of(self.job.read(frame), self.lattice, hull, config.gamma, config.weight_share)
            with atomic_path(path) as temporary:
                np.save(temporary, np.packbits(found), allow_pickle=False)
        return _read_occupancy(path, self.lattice.shape)

    def _image_size(self, fullest: int) -> tuple[int, int]:
        """Return the (height, width) of the feature images: as told, or what the fullest frame and headroom need."""
        config = self.config
        unit = SUPERBLOCK if config.image_layout == "superblocks" else MACROBLOCK
        edge = config.image
        if edge == 0:
            needed = math.ceil(math.sqrt(fullest * config.headroom) / unit) * unit
            edge = min(needed, PROFILES[config.profile].edge)
        tiling_of(config.profile, config.features + 1, edge, edge)
        return edge, edge

    def _shading_stage(self, learning: int) -> None:
        """Train the network with the first frames of groups, unless that is done."""
        heads = [group.first for group in self.groups[:learning]]
        path = self.paths.partial / "model.shading"
        if path.exists():
            self.network = DeferredShading.of(read_shading(path, self.config.shape))
            self._skip(len(heads) * self.config.first_iterations)
            return
        trainers = []
        for index, frame in enumerate(heads):
            field_of = GroupField.of(self.lattice, self.tables[index])
            start = rows_from_coarse(self._coarse(frame), field_of.table, self.config.ranges)
            trainers.append(self._trainer(field_of, frame, start, None, self.config.first_iterations))
        train_frames(trainers, self.network, True, lambda trainer: self._heard("shading", trainer))
        for frame, trainer in zip(heads, trainers, strict=True):
            self._keep(frame, trainer)
        write_shading(path, self.network.numbers())

    def _train_group(self, index: int) -> None:
        """Train the frames of a group that are not trained yet."""
        group, table = self.groups[index], self.tables[index]
        field_of = None
        for frame in range(group.first, group.first + group.count):
            iterations = self.config.head_iterations if frame == group.first else self.config.iterations
            if self._has_rows(frame):
                self._skip(0 if index < self.config.shading_groups and frame == group.first else iterations)
                continue
            field_of = field_of or GroupField.of(self.lattice, table)
            fresh = rows_from_coarse(self._coarse(frame), table, self.config.ranges)
            previous = None if frame == group.first else self._rows(frame - 1)
            start = self._start(frame, index, fresh, previous)
            trainer = self._trainer(field_of, frame, start, previous, iterations)
            train_frames([trainer], self.network, False, lambda trainer: self._heard("frames", trainer))
            self._keep(frame, trainer)

    def _start(self, frame: int, index: int, fresh: Rows, previous: Rows | None) -> Rows:
        """Return the rows that a frame starts from; `fresh` is what its own coarse field suggests."""
        if self.config.start == "coarse":
            return fresh
        if previous is None:
            return moved_rows(self._rows(frame - 1), self.tables[index - 1], self.tables[index], fresh)
        if self.config.start == "warm":
            return previous
        return np.concatenate((fresh[:, :1], previous[:, 1:]), 1)

    def _trainer(
        self, field_of: GroupField, frame: int, start: Rows, previous: Rows | None, iterations: int
    ) -> FrameTrainer:
        views = FrameViews(self.capture, frame, border=self.config.border)
        trip = through_codec(field_of.table, previous, self.config) if self.config.codec_from < 1 else None
        return FrameTrainer(field_of, views, frame, start, previous, self.config, iterations, trip)

    def _heard(self, stage: str, trainer: FrameTrainer) -> None:
        def preview() -> np.ndarray:
            shading, camera = self.network.numbers(), preview_camera(self.capture)
            return draw_field(trainer.group.volume, trainer.table, shading, camera, QUALITY["fast"]).image

        self._tell(stage, trainer.frame, psnr_of(trainer.error), 1, preview)

    def _keep(self, frame: int, trainer: FrameTrainer) -> None:
        self.fits[frame] = psnr_of(trainer.error)
        write_json(self.paths.partial / f"fit_{frame:06d}.json", {"psnr": round(self.fits[frame], 3)})
        write_rows(self.paths.partial, frame, trainer.rows)

    def encode(self, model: FieldVideo, rungs: list[RungSpec]) -> VideoReel:
        """Write the reel and the run's record."""

        def tell(done: int, total: int) -> None:
            self._tell("encode", (done - 1) % self.frames, None, 0)

        with self.clock.of("encode"):
            reel = write_reel(
                model,
                self.paths.reel,
                rungs,
                self.config.profile,
                files={"config": self.paths.record.name},
                on_progress=tell,
            )
        write_json(self.paths.record, self._record(reel))
        return reel

    # -- what lies on disk

    def _coarse(self, frame: int) -> Coarse:
        """Return a frame's coarse field on the fine lattice."""
        return self.job.read(frame).resampled(self.lattice)

    def _has_rows(self, frame: int) -> bool:
        return (self.paths.partial / f"rows_{frame:06d}.npy").exists()

    def _rows(self, frame: int) -> Rows:
        index = next(i for i, group in enumerate(self.groups) if group.first <= frame < group.first + group.count)
        return read_rows(self.paths.partial, frame, (self.tables[index].count, self.config.features + 1))

    def _model_so_far(self) -> FieldVideo:
        name = _name(self.capture)
        return FieldVideo(
            self.lattice,
            self.groups,
            self.tables,
            self.network.numbers(),
            self.config.ranges,
            self._rows,
            fps=self.capture.fps,
            frame_start=self.capture.frame_start,
            step=self.config.step,
            transmittance_min=self.config.transmittance_min,
            provenance={"capture": name, "iterations": self.config.iterations},
        )

    def _record(self, reel: VideoReel) -> dict[str, Any]:
        seconds = {stage: round(value, 2) for stage, value in self.clock.seconds.items()}
        groups = [
            {"first": group.first, "frames": group.count, "vertices": table.count}
            for group, table in zip(self.groups, self.tables, strict=True)
        ]
        return {
            "config": asdict(self.config),
            "capture": _name(self.capture),
            "train_cameras": self.capture.camera_names("train"),
            "lattice": asdict(self.lattice),
            "groups": groups,
            "image": [reel.tiling.height, reel.tiling.width],
            "seconds": seconds | {"total": round(sum(seconds.values()), 2)},
            "seconds_per_frame": round(sum(seconds.values()) / self.frames, 2),
            "memory_mib": _peak_memory(),
            "psnr": [self._fit(frame) for frame in range(self.frames)],
            "versions": {"python": platform.python_version(), "torch": torch.__version__, "numpy": np.__version__},
        }

    def _fit(self, frame: int) -> float | None:
        return read_json(self.paths.partial / f"fit_{frame:06d}.json").get("psnr")


def through_codec(table: MappingTable, previous: Rows | None, config: VideoConfig) -> RoundTrip:
    """Return the way of a frame's rows (N, C) through the codec at a QP, behind the frame before where there is one."""
    ranges = config.ranges
    tiling = tiling_of(config.profile, config.features + 1, *table.size)
    empty = ranges.encode(ranges.empty)
    before = [] if previous is None else [table.to_image(ranges.encode(previous), empty)]

    def trip(rows: Rows, qp: int) -> Rows:
        images, _ = round_trip([*before, table.to_image(ranges.encode(rows), empty)], tiling, qp)
        return ranges.decode(table.to_rows(images[-1]))

    return trip


def _claim_settings(path: Path, settings: dict[str, Any], renew: bool = False) -> None:
    """Write down what a folder's files are made of, or make sure that it is the same. Raises `HoloreelError`.

    `renew` writes it down anew: there are no such files yet.
    """
    if renew or not path.exists():
        write_json(path, settings)
        return
    changed = differences(read_json(path), settings, tuple(f"config.{name}" for name in FREE_SETTINGS))
    if changed:
        raise HoloreelError(
            f"{path.parent}: was made with another {', '.join(changed)}; pass the same settings, or delete the folder "
            "to make it anew."
        )


def _identity(capture: Capture) -> dict[str, Any]:
    """Return what tells one capture from another, without looking at pictures."""
    cameras = {name: capture.cameras[name].to_json() for name in capture.camera_names("train")}
    return {"name": _name(capture), "frames": capture.frame_count, "cameras": cameras}


def _name(capture: Capture) -> str:
    return capture.name


def _read_occupancy(path: Path, shape: tuple[int, int, int]) -> Occupancy:
    count = math.prod(shape)
    try:
        packed = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise HoloreelError(f"{path} cannot be read ({error}): delete it and go on with --resume.") from error
    if not isinstance(packed, np.ndarray) or packed.dtype != np.uint8 or packed.shape != (-(-count // 8),):
        raise HoloreelError(f"{path} is no occupancy of this lattice: delete it and go on with --resume.")
    return np.unpackbits(packed, count=count).astype(bool).reshape(shape)


def _peak_memory() -> int | None:
    """Return the most memory the process has held, in MiB; None where the system does not tell."""
    if sys.platform == "win32":
        return None
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak >> (20 if sys.platform == "darwin" else 10)
