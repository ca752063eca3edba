# SPDX-License-Identifier: GPL-3.0-or-later
"""Measure whole training iterations, and where their time goes: the trainer's own steps on a random scene."""

import statistics
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch

from ..camera import Camera
from ..capture import Capture, View
from ..capture.media import Media
from ..gaussians.config import PRESETS
from ..gaussians.model import SpacetimeGaussians
from ..gaussians.train import Trainer
from ..images import write_png
from ..render import get_backend
from ..render.contract import SpacetimeTensors
from ..render.scenes import random_scene
from ..runs import one_torch_thread
from .raster import RASTER_PARTS

VIEWS, FRAMES = 4, 5
WARM_UP = VIEWS * FRAMES + 5  # iterations not counted: every picture has been read once
STAGES = (
    "data",
    "evaluate+project",
    "sort",
    "bin",
    "blend",
    "loss",
    "backward blend",
    "gather",
    "Adam",
    "density",
    "rest",
)


@dataclass(frozen=True)
class Setup:
    """What one row of the table measures."""

    width: int
    height: int
    gaussians: int


SETUPS = (Setup(640, 360, 100_000), Setup(269, 479, 11_000))


@dataclass
class Row:
    """Milliseconds per iteration, medians. `raster` is sorting, binning and blending, forward and backward.

    Where the backend does not tell its parts (`raster` is 0), rasterizing counts as `blend`, and `rest` holds the
    backward pass.
    """

    setup: Setup
    preset: str
    total: float
    raster: float
    parts: dict[str, float]

    @property
    def ratio(self) -> float:
        """The whole iteration over the raster kernels' own time."""
        return self.total / self.raster if self.raster else float("nan")

    def as_dict(self) -> dict[str, object]:
        """Return the row for JSON."""
        return asdict(self) | {"ratio": self.ratio}


def measure(setup: Setup, preset: str, rounds: int, backend: str = "auto") -> Row:
    """Train a random scene towards pictures of a slightly different one, and time `rounds` iterations."""
    module = get_backend(backend)  # type: ignore[arg-type]
    config = replace(PRESETS[preset], iterations=100_000, max_seeds=setup.gaussians)
    columns = 9 if config.model == "full" else 3
    with tempfile.TemporaryDirectory() as folder, one_torch_thread():
        capture, seeds = synthetic_capture(setup, columns, Path(folder), get_backend("auto"))
        watched = _Watched(module)
        trainer = Trainer(capture, config, watched, seeds)  # type: ignore[arg-type]
        watched.watch(trainer.pictures, "next", "data")
        watched.watch(trainer, "_control_number", "density")
        watched.watch(trainer.control, "before_step", "density")
        samples = [watched.sample(trainer.step) for _ in range(WARM_UP + rounds)][WARM_UP:]
    parts = {stage: statistics.median(sample[stage] for sample in samples) for stage in STAGES}
    raster = statistics.median(sample["raster"] for sample in samples)
    return Row(setup, preset, statistics.median(sample["total"] for sample in samples), raster, parts)


def synthetic_capture(
    setup: Setup, columns: int, folder: Path, backend: ModuleType
) -> tuple[Capture, SpacetimeGaussians]:
    """Draw a random scene from a few cameras at a few times; return the capture and Gaussians near the true ones."""
    truth, camera = random_scene(setup.gaussians, setup.width, setup.height, 3)
    cameras: dict[str, Camera] = {}
    images: dict[View, Media] = {}
    for view in range(VIEWS):
        pose = np.eye(4)
        pose[0, 3] = 0.1 * (view - (VIEWS - 1) / 2)
        name = f"camera{view}"
        cameras[name] = Camera(
            camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, pose, name=name
        )  # fmt: skip
        for frame in range(FRAMES):
            with torch.no_grad():
                picture = backend.rasterize_spacetime(truth, frame / FRAMES, cameras[name]).features
            path = folder / f"{name}_{frame}.png"
            write_png(path, picture.cpu().numpy())
            images[name, frame] = path
    random = np.random.default_rng(1)
    arrays = {name: value.numpy() for name, value in zip(SpacetimeTensors._fields, truth, strict=True)}
    arrays["features"] = random.uniform(0, 1, (setup.gaussians, columns)).astype(np.float32)
    return Capture(cameras, images, FRAMES, source=folder), SpacetimeGaussians(**arrays)


class _Watched:
    """A backend whose calls are timed."""

    STAGE_OF = {  # noqa: RUF012
        "rasterize_spacetime": "rasterize",
        "decode": "blend",
        "picture_loss": "loss",
        "l1_dssim": "loss",
        "adam": "Adam",
    }

    def __init__(self, backend: ModuleType) -> None:
        self.backend = backend
        self.seconds: dict[str, float] = defaultdict(float)
        self.frame: Any = None
        for name, stage in self.STAGE_OF.items():
            setattr(self, name, self._timed(getattr(backend, name), stage))

    def __getattr__(self, name: str) -> Any:
        return getattr(self.backend, name)

    def _timed(self, function: Callable[..., Any], stage: str) -> Callable[..., Any]:
        def timed(*arguments: Any, **named: Any) -> Any:
            start = self._now()
            result = function(*arguments, **named)
            self.seconds[stage] += self._now() - start
            if stage == "rasterize":
                self.frame = getattr(result.features.grad_fn, "frame", None)
            return result

        return timed

    def watch(self, owner: object, name: str, stage: str) -> None:
        """Time a method of an object too."""
        setattr(owner, name, self._timed(getattr(owner, name), stage))

    def _now(self) -> float:
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        return time.perf_counter()

    def sample(self, step: Callable[[], object]) -> dict[str, float]:
        """Return milliseconds per stage of one call of `step`."""
        self.seconds.clear()
        start = self._now()
        step()
        total = self._now() - start
        sample = dict.fromkeys(STAGES, 0.0) | {stage: s for stage, s in self.seconds.items() if stage != "rasterize"}
        sample["raster"] = 0.0
        if self.frame is None:
            sample["blend"] += self.seconds["rasterize"]
        else:
            timings = self.frame.timings()
            sample["raster"] = sum(timings[name] for name in RASTER_PARTS)
            names = ("project", "sort", "bin", "blend", "backward_blend", "backward_gather")
            stages = ("evaluate+project", "sort", "bin", "blend", "backward blend", "gather")
            for name, stage in zip(names, stages, strict=True):
                sample[stage] += timings[name]
            self.frame = None
        sample["rest"] = total - sum(sample[stage] for stage in STAGES if stage != "rest")
        return {stage: 1e3 * seconds for stage, seconds in (sample | {"total": total}).items()}


def report(rows: list[Row]) -> str:
    """Return the table that is printed."""
    lines = []
    for row in rows:
        s = row.setup
        ratio = f"{row.ratio:.2f} times the raster kernels' {row.raster:.1f} ms" if row.raster else "on this backend"
        lines.append(f"{row.preset}, {s.gaussians} Gaussians, {s.width}x{s.height}: {row.total:.1f} ms, {ratio}")
        lines.append("   " + ", ".join(f"{stage} {row.parts[stage]:.1f}" for stage in STAGES))
    return "\n".join(lines)
