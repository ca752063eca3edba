# SPDX-License-Identifier: GPL-3.0-or-later
"""How fast the ray march is, compiled and in torch: samples per second on a hollow figure seen from around it."""

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch

from . import reference
from .field import FieldLattice, MarchRules, Rays
from .mapping import build_table
from .march import Volume, count_samples, march
from .native import get_threads
from .occupancy import Lattice, dilate


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


def bench_march(
    edge: int = 96, channels: int = 8, rays: int = 8192, twin_rays: int = 512, repeats: int = 5, seed: int = 0
) -> MarchSpeed:
    """Measure on a lattice of `edge` vertices per side; the best of `repeats` runs each."""
    field, table, bundle = _scene(edge, channels, rays, seed)
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


def _scene(edge: int, channels: int, count: int, seed: int) -> tuple[FieldLattice, torch.Tensor, Rays]:
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
    return field, torch.from_numpy(table), Rays(*map(torch.from_numpy, arrays))


def _best(run: Callable[[], object], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return min(times)
