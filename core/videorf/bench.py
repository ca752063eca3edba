# SPDX-License-Identifier: GPL-3.0-or-later
"""How fast the ray march, training and drawing are, on a hollow figure seen from around it."""

import time
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch

from ..camera import Camera
from . import reference
from .deferred import DeferredShading, composite
from .draw import QUALITY, draw_field
from .field import FieldLattice, MarchRules, Rays
from .losses import rgb_loss
from .mapping import MappingTable, build_table
from .march import Volume, count_samples, march
from .native import get_threads
from .occupancy import Lattice, dilate
from .optimize import TableOptimizer, noisy_rows
from .shading import ShadingShape


class MarchSpeed(NamedTuple):
    """Samples per second, in millions, on `threads` threads; `twin_ratio` is how many times slower the torch twin is.

    `forward` is the march alone, as in rendering; `training` goes forth and back, and the twin does the same, on as
    many threads and rays that are a part of the same.
    """

    threads: int
    vertices: int
    samples_per_ray: float
    forward: float
    training: float
    twin_ratio: float


class StepSpeed(NamedTuple):
    """Milliseconds of a training step, and of its parts: the noise, the march, the network with the loss, the way back
    through all of it, and the optimizer.
    """

    noise: float
    march: float
    network: float
    backward: float
    optimizer: float

    @property
    def total(self) -> float:
        """The whole step."""
        return sum(self)


def bench_march(
    edge: int = 96, channels: int = 8, rays: int = 8192, twin_rays: int = 512, repeats: int = 5, seed: int = 0
) -> MarchSpeed:
    """Measure on a lattice of `edge` vertices per side; the best of `repeats` runs each."""
    field, _, table, bundle = _scene(edge, channels, rays, seed)
    volume, rules = Volume(field), MarchRules()
    part = Rays(*(values[:twin_rays] for values in bundle if values is not None))
    samples, twin_samples = count_samples(volume, table, bundle), count_samples(volume, table, part)

    def train(run: Callable[[torch.Tensor], torch.Tensor]) -> None:
        leaf = table.clone().requires_grad_()
        run(leaf).square().sum().backward()

    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)  # as in training: torch's threads would spin on the march's cores
        forward = _best(lambda: march(volume, table, bundle, rules), repeats)
        training = _best(lambda: train(lambda leaf: march(volume, leaf, bundle, rules).features), repeats)
        torch.set_num_threads(get_threads())
        twin = _best(
            lambda: train(lambda leaf: reference.march(field, leaf, part, rules).features), max(1, repeats // 2)
        )
    finally:
        torch.set_num_threads(before)
    return MarchSpeed(
        get_threads(),
        field.rows - 1,
        samples / rays,
        samples / forward / 1e6,
        samples / training / 1e6,
        (twin / twin_samples) / (training / samples),
    )


def bench_step(edge: int = 128, channels: int = 8, rays: int = 4096, repeats: int = 9, seed: int = 0) -> StepSpeed:
    """Measure one training step's parts on a lattice of `edge` vertices per side; the best of `repeats` each."""
    field, mapping, table, bundle = _scene(edge, channels, rays, seed)
    volume, network = Volume(field), DeferredShading(ShadingShape(channels - 1), torch.Generator().manual_seed(seed))
    quantum, wide = torch.full((channels,), 0.05), torch.full((channels,), 50.0)
    optimizer = TableOptimizer(mapping, table, quantum, -wide, wide, table[:-1] + 0.01)
    rates, truth, seen = torch.full((channels,), 0.01), torch.rand(rays, 3), torch.empty_like(table)
    times: list[list[float]] = []
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        for repeat in range(repeats):
            marks = [time.perf_counter()]
            leaf = noisy_rows(table, quantum, repeat, seen).detach().requires_grad_()
            marks.append(time.perf_counter())
            marched = march(volume, leaf, bundle)
            marks.append(time.perf_counter())
            colors = composite(network(marched.features, bundle.directions), marched.transmittance, 1.0)
            loss = rgb_loss(colors, truth)
            marks.append(time.perf_counter())
            loss.backward()
            marks.append(time.perf_counter())
            assert leaf.grad is not None
            optimizer.step(leaf.grad, rates, 1e-5, 1e-5)
            marks.append(time.perf_counter())
            times.append([1e3 * (after - mark) for mark, after in pairwise(marks)])
    finally:
        torch.set_num_threads(before)
    return StepSpeed(*(min(part) for part in zip(*times, strict=True)))


def bench_drawing(edge: int = 128, width: int = 320, height: int = 180, repeats: int = 5) -> dict[str, float]:
    """Return the milliseconds of a picture that the figure fills, per quality; the best of `repeats` each."""
    field, _, table, _ = _scene(edge, 8, 1, 0)
    volume = Volume(field)
    shading = DeferredShading(ShadingShape(7), torch.Generator().manual_seed(0)).numbers()
    camera = Camera.look_at((3.0, 0.3, 0.4), (0.0, 0.0, 0.0), width=width, height=height, fx=2.2 * width)
    return {
        name: 1e3 * _best(partial(draw_field, volume, table, shading, camera, rules), repeats)
        for name, rules in QUALITY.items()
    }


def _scene(edge: int, channels: int, count: int, seed: int) -> tuple[FieldLattice, MappingTable, torch.Tensor, Rays]:
    random = np.random.default_rng(seed)
    axis = np.linspace(-1, 1, edge)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    radius = np.linalg.norm(grid / np.array([0.45, 0.5, 0.95]), axis=-1) + 0.1 * np.sin(9 * grid).sum(-1)
    occupancy = dilate(abs(radius - 0.8) < 0.06)
    image_edge = int(np.ceil(np.sqrt(occupancy.sum()) / 8)) * 8
    mapping = build_table(occupancy, (image_edge, image_edge))
    field = FieldLattice(Lattice((edge,) * 3, (-1.0, -1.0, -1.0), 2 / (edge - 1)), mapping.lookup(), mapping.count + 1)
    table = random.normal(0, 1, (field.rows, channels)).astype(np.float32)
    table[:, 0] = random.uniform(-4, 0, field.rows)
    table[-1] = 0
    table[-1, 0] = -8
    angle = random.uniform(0, 2 * np.pi, count)
    origins = np.stack((3 * np.cos(angle), 3 * np.sin(angle), random.uniform(0, 1, count)), -1)
    directions = random.uniform(-1, 1, (count, 3)) * [0.45, 0.5, 0.9] - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    arrays = (origins.astype(np.float32), directions.astype(np.float32), random.random(count, dtype=np.float32))
    return field, mapping, torch.from_numpy(table), Rays(*map(torch.from_numpy, arrays))


def _best(run: Callable[[], object], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return min(times)
