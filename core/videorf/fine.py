# SPDX-License-Identifier: GPL-3.0-or-later
"""The sequential training of feature images (Sec. 4.2): one frame's rows at a time, and the network once.

Frames are independent of each other but for three things that are handed on: the network, the rows of the frame before,
and where those lay. All random numbers of a frame follow from the run's seed and the frame's number, so a run that was
stopped between two frames ends as if it had not been.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .coarse import Coarse
from .config import VideoConfig
from .deferred import DeferredShading, composite
from .field import FieldLattice, MarchRules, Rays
from .losses import rgb_loss
from .mapping import MappingTable
from .march import Volume, march
from .model import Rows
from .occupancy import Lattice
from .optimize import TableOptimizer, image_neighbors, joined, lattice_neighbors, noisy_rows
from .quantize import Ranges
from .views import FrameViews

SMOOTHING = 0.05  # of the error that is reported: the share of the newest step
BETAS = (0.9, 0.99)  # of the network's Adam

RoundTrip = Callable[[Rows, int], Rows]  # rows (N, C) as a decoder returns them at a QP


@dataclass(frozen=True, eq=False)
class GroupField:
    """A group's table, and its lattice made ready for the march."""

    lattice: Lattice
    table: MappingTable
    volume: Volume

    @classmethod
    def of(cls, lattice: Lattice, table: MappingTable) -> "GroupField":
        """Make a table's lattice ready."""
        return cls(lattice, table, Volume(FieldLattice(lattice, table.lookup(), table.count + 1)))


def rows_from_coarse(coarse: Coarse, table: MappingTable, ranges: Ranges) -> Rows:
    """Return the rows (N, C) that a coarse field on the table's lattice suggests: its densities, colors as features.

    A color goes to the first three features, from -1 to 1; others are 0.
    """
    vertices = tuple(table.vertices.T)
    rows = np.zeros((table.count, len(ranges.low)), np.float32)
    rows[:, 0] = coarse.density[vertices]
    colors = min(3, len(ranges.low) - 1)
    rows[:, 1 : 1 + colors] = 2 * coarse.color[vertices][:, :colors] - 1
    return clamped(rows, ranges)


def moved_rows(rows: Rows, old: MappingTable, new: MappingTable, fresh: Rows) -> Rows:
    """Return rows of the old table in ranks of the new one (Sec. 4.2: the start across groups).

    A vertex that only the new table has takes its density from `fresh` (N, C) and the features of the nearest vertex of
    the old table.
    """
    from scipy.ndimage import distance_transform_edt

    ranks = old.lookup()
    nearest = distance_transform_edt(ranks < 0, return_distances=False, return_indices=True)
    vertices = tuple(new.vertices.T)
    found = rows[ranks[tuple(axis[vertices] for axis in nearest)]]
    added = ranks[vertices] < 0
    found[added, 0] = fresh[added, 0]
    return found


def clamped(rows: NDArray, ranges: Ranges) -> Rows:
    """Return rows held to ranges."""
    return np.clip(rows, np.array(ranges.low), np.array(ranges.high)).astype(np.float32)


class FrameTrainer:
    """One frame's rows in training: `step` after `step`, until `iterations` are done."""

    def __init__(
        self,
        group: GroupField,
        views: FrameViews,
        frame: int,
        start: Rows,
        previous: Rows | None,
        config: VideoConfig,
        iterations: int,
        round_trip: RoundTrip | None = None,
    ) -> None:
        """Begin a frame, counted from 0, with the rows `start` (N, C).

        `previous` are those of the frame before in the same group, or None. `round_trip` takes rows through the codec
        that `config.codec_from` speaks of.
        """
        ranges = config.ranges
        self.group, self.views, self.frame, self.config = group, views, frame, config
        self.iteration, self.iterations, self.error, self.round_trip = 0, iterations, math.nan, round_trip
        self.generator = torch.Generator().manual_seed(_seed(config.seed, frame))
        self.table = torch.from_numpy(np.concatenate((clamped(start, ranges), ranges.empty[None])))
        self.quantum = torch.from_numpy(ranges.step)
        low, high = torch.tensor(ranges.low), torch.tensor(ranges.high)
        before = None if previous is None else torch.from_numpy(np.ascontiguousarray(previous))
        near = image_neighbors(group.table)
        if config.smooth:
            near = joined(near, lattice_neighbors(group.table.lookup()))
        self.optimizer = TableOptimizer(near, self.table, self.quantum, low, high, before)
        self.rates = torch.tensor([config.density_rate, *[config.feature_rate] * config.features])
        self.seen = torch.empty_like(self.table)
        self.offset: Tensor | None = None  # what the codec last made of the rows, less the rows
        self.trips = 0  # through the codec

    @property
    def rows(self) -> Rows:
        """The rows (N, C) as they are now."""
        return self.table[:-1].numpy().copy()

    @property
    def progress(self) -> float:
        """How much of the frame's training is done, 0 to 1."""
        return self.iteration / self.iterations

    def step(self, network: DeferredShading) -> None:
        """Look at one batch of rays; gradients are added to the network's where it wants them."""
        config, count = self.config, self.config.rays
        batch = self.views.sample(count, self.generator)
        rays = Rays(batch.origins, batch.directions, torch.rand(count, generator=self.generator))
        background = self._background(count)
        table = self._table().requires_grad_()
        marched = march(self.group.volume, table, rays, MarchRules(config.step, config.transmittance_min))
        colors = composite(network(marched.features, batch.directions), marched.transmittance, background)
        truth = composite(batch.rgba[:, :3], 1 - batch.rgba[:, 3], background)
        loss = rgb_loss(colors, truth)
        loss.backward()
        assert table.grad is not None
        rates = self.rates * decay(self.progress, config)
        self.optimizer.step(table.grad, rates, config.spatial, config.temporal, config.seam, config.smooth)
        self.iteration += 1
        error = loss.item() / 3
        self.error = error if math.isnan(self.error) else self.error + SMOOTHING * (error - self.error)

    def _background(self, count: int) -> Tensor:
        if self.config.random_background:
            return torch.rand(count, 3, generator=self.generator)
        return torch.ones(count, 3)

    def _table(self) -> Tensor:
        """Return the table as the codec would leave it: through the codec itself, with noise in its place, or as is."""
        config = self.config
        if self.round_trip is not None and self.progress >= config.codec_from:
            if self.offset is None or self.iteration % config.codec_every == 0:
                rows, qp = self.rows, config.codec_qps[self.trips % len(config.codec_qps)]
                self.offset = torch.from_numpy(self.round_trip(rows, qp) - rows)
                self.trips += 1
            torch.add(self.table[:-1], self.offset, out=self.seen[:-1])
            self.seen[-1] = self.table[-1]
            return self.seen.detach()
        if self.progress >= config.noise_from:
            seed = int(torch.randint(2**31, (1,), generator=self.generator))
            return noisy_rows(self.table, self.quantum, seed, self.seen).detach()
        return self.table.detach()


def decay(progress: float, config: VideoConfig) -> float:
    """Return by how much rates have fallen at a part of the training, 0 to 1."""
    return config.final_rate**progress


def train_frames(
    trainers: Sequence[FrameTrainer],
    network: DeferredShading,
    learn: bool,
    on_step: Callable[[FrameTrainer], None] = lambda trainer: None,
) -> None:
    """Train frames side by side, and the network with them where it is to `learn`: its step is that of all frames."""
    config = trainers[0].config
    network.requires_grad_(learn)
    adam = torch.optim.Adam(network.parameters(), lr=config.shading_rate, betas=BETAS) if learn else None
    while trainers[0].iteration < trainers[0].iterations:
        if adam is not None:
            adam.param_groups[0]["lr"] = config.shading_rate * decay(trainers[0].progress, config)
            adam.zero_grad()
        for trainer in trainers:
            trainer.step(network)
            on_step(trainer)
        if adam is not None:
            adam.step()
    network.requires_grad_(False)


def psnr_of(error: float) -> float:
    """Return the PSNR of a mean squared error in colors from 0 to 1."""
    return -10 * math.log10(max(error, 1e-12))


def new_network(config: VideoConfig) -> DeferredShading:
    """Return the network a run begins with."""
    return DeferredShading(config.shape, torch.Generator().manual_seed(_seed(config.seed, -1)))


def _seed(seed: int, frame: int) -> int:
    return int(np.random.SeedSequence([seed, frame + 1]).generate_state(1)[0])
