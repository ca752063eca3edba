# SPDX-License-Identifier: GPL-3.0-or-later
"""Measure the rasterizers: the whole chain from raw parameters to pictures and back, and its parts."""

import itertools
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from types import ModuleType

import torch

from ..camera import Camera
from ..render import cpu, native, reference
from ..render.contract import Rendering, SpacetimeTensors
from ..render.scenes import random_scene

SIZES = ((640, 360), (1352, 1014))
COUNTS = (50_000, 200_000)
CHANNELS = (3, 9)
THREADS = (1, 2)
RASTER_PARTS = ("sort", "bin", "blend", "backward_blend")
TIME = 0.5


@dataclass(frozen=True)
class Setup:
    """What one row of the table measures."""

    width: int
    height: int
    gaussians: int
    channels: int
    threads: int

    def scene(self) -> tuple[SpacetimeTensors, Camera]:
        """Return the scene, the same for any number of threads."""
        return random_scene(self.gaussians, self.width, self.height, self.channels)


@dataclass
class Row:
    """Milliseconds: medians over the rounds. `raster` is sorting, binning and blending, forward and backward."""

    setup: Setup
    backend: str
    intersections: int = 0
    forward: float = 0.0
    backward: float = 0.0
    total: float = 0.0
    best_total: float = 0.0
    raster: float = 0.0
    parts: dict[str, float] = field(default_factory=dict)

    def as_dict(self) -> dict[str, object]:
        """Return the row for JSON."""
        return asdict(self)


def setups() -> Iterator[Setup]:
    """Yield every row of the table."""
    for (width, height), count, channels, threads in itertools.product(SIZES, COUNTS, CHANNELS, THREADS):
        yield Setup(width, height, count, channels, threads)


def measure(setup: Setup, rounds: int, progress: Callable[[], None] = lambda: None) -> Row:
    """Measure the compiled kernels."""
    threads = native.get_threads()
    native.set_threads(setup.threads)
    try:
        once = _Runner(cpu, setup)
        once.run()
        samples = []
        for _ in range(rounds):
            samples.append(once.run())
            progress()
    finally:
        native.set_threads(threads)
    return _row(setup, "cpu", once.intersections, samples)


def measure_reference(setup: Setup, time_limit_s: float = 60.0) -> Row:
    """Measure plain torch, three times or until the time limit has passed; `setup.threads` are torch's."""
    threads = torch.get_num_threads()
    torch.set_num_threads(setup.threads)
    try:
        once = _Runner(reference, setup)
        start, samples = time.perf_counter(), [once.run()]
        while len(samples) < 3 and time.perf_counter() - start < time_limit_s / 2:
            samples.append(once.run())
    finally:
        torch.set_num_threads(threads)
    return _row(setup, "reference", 0, samples)


class _Runner:
    """One scene, rendered forward and backward as often as asked."""

    def __init__(self, backend: ModuleType, setup: Setup) -> None:
        gaussians, self.camera = setup.scene()
        self.backend = backend
        self.arrays = SpacetimeTensors(*(array.requires_grad_() for array in gaussians))
        generator = torch.Generator().manual_seed(0)
        self.gradient = torch.randn(setup.height, setup.width, setup.channels, generator=generator)
        self.intersections = 0

    def run(self) -> dict[str, float]:
        """Return milliseconds: forward, backward, and the parts where the backend tells them."""
        for array in self.arrays:
            array.grad = None
        start = time.perf_counter()
        pictures: Rendering = self.backend.rasterize_spacetime(self.arrays, TIME, self.camera)
        middle = time.perf_counter()
        torch.autograd.backward(pictures.features, self.gradient)
        end = time.perf_counter()
        sample = {"forward": 1e3 * (middle - start), "backward": 1e3 * (end - middle)}
        frame = getattr(pictures.features.grad_fn, "frame", None)
        if frame is not None:
            self.intersections = frame.intersections
            sample |= {name: 1e3 * seconds for name, seconds in frame.timings().items()}
        return sample


def _row(setup: Setup, backend: str, intersections: int, samples: list[dict[str, float]]) -> Row:
    middle = {name: statistics.median(sample[name] for sample in samples) for name in samples[0]}
    totals = [sample["forward"] + sample["backward"] for sample in samples]
    raster = [sum(sample.get(name, 0.0) for name in RASTER_PARTS) for sample in samples]
    parts = {name: value for name, value in middle.items() if name not in ("forward", "backward")}
    return Row(
        setup,
        backend,
        intersections,
        forward=middle["forward"],
        backward=middle["backward"],
        total=statistics.median(totals),
        best_total=min(totals),
        raster=statistics.median(raster),
        parts=parts,
    )
