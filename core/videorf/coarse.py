# SPDX-License-Identifier: GPL-3.0-or-later
"""The coarse field of one frame: a dense grid of raw density and color (Sec. 4.1)."""

import math
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.lib import format as npy
from numpy.typing import NDArray
from torch import Tensor

from ..errors import HoloreelError
from ..files import atomic_path
from ..runs import one_torch_thread
from . import morton
from .field import FieldLattice, MarchRules, Rays
from .hull import REACH, visual_hull
from .losses import rgb_loss
from .march import Volume, march
from .occupancy import GAMMA, WEIGHT_SHARE, Lattice, Occupancy, occupied
from .optimize import TableOptimizer, lattice_neighbors
from .quantize import EMPTY_DENSITY
from .views import FrameViews

UNKNOWN_COLOR = 0.5  # of vertices that were not trained
START_DENSITY = 0.0  # the hull is half-solid at first
WIDEST = 48  # vertices along the longest side of the lattice that training begins with
REPORT_EVERY = 20  # steps
HIGHEST = 16.0  # raw densities lie between EMPTY_DENSITY and this
SMOOTH_STEPS = (1.0, 0.1, 0.1, 0.1)  # differences of density and color that total variation takes for large

Grid = NDArray[np.float32]


@dataclass(frozen=True)
class Coarse:
    """What the coarse stage knows of a frame, per vertex of `lattice`.

    `density` (X, Y, Z) is raw: softplus(density) is what one spacing of this lattice absorbs. `color` (X, Y, Z, 3) lies
    in 0..1. `weights` (X, Y, Z) is what the training rays see of each vertex: the sum of their samples' weights.
    Vertices outside of the hull hold `EMPTY_DENSITY`, gray and 0.
    """

    lattice: Lattice
    density: Grid
    color: Grid
    weights: Grid

    def resampled(self, lattice: Lattice) -> "Coarse":
        """Return the same field on another lattice, with densities that absorb as much over the same length.

        Values are trilinear means, vertices beyond this lattice are empty.
        """
        raw = resample(self.density, self.lattice, lattice, EMPTY_DENSITY)
        density = rescaled(raw, lattice.spacing / self.lattice.spacing)
        color = resample(self.color, self.lattice, lattice, UNKNOWN_COLOR)
        return Coarse(lattice, density, color, resample(self.weights, self.lattice, lattice, 0.0))

    def write(self, path: str | Path) -> None:
        """Write the field as a compressed NPZ, atomically."""
        place = np.array([*self.lattice.lowest, self.lattice.spacing])
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, place=place, density=self.density, color=self.color, weights=self.weights)


def rescaled(density: NDArray, ratio: float) -> Grid:
    """Return raw densities of spacings `ratio` times as long: softplus of them is `ratio` times what it was."""
    absorbed = ratio * np.logaddexp(0.0, np.asarray(density, np.float64))
    return (absorbed + np.log(-np.expm1(-absorbed))).astype(np.float32)  # the inverse of softplus, for small and large


def resample(values: NDArray, source: Lattice, target: Lattice, fill: float) -> Grid:
    """Return the trilinear means of `values` (X, Y, Z, ...) of one lattice at the vertices of another, `fill` beyond.

    Both lattices have the world's axes, so that the mean is one of means along each axis.
    """
    result = np.asarray(values, np.float32)
    inside = np.ones(target.shape, bool)
    for axis in range(3):
        count = source.shape[axis]
        place = target.lowest[axis] + target.spacing * np.arange(target.shape[axis]) - source.lowest[axis]
        place /= source.spacing
        cell = np.clip(np.floor(place), 0, count - 2).astype(int)
        part = (place - cell).astype(np.float32).reshape(-1, *[1] * (result.ndim - 1 - axis))
        result = np.take(result, cell, axis) * (1 - part) + np.take(result, cell + 1, axis) * part
        within = (place >= -1e-6) & (place <= count - 1 + 1e-6)
        inside &= within.reshape(-1, *[1] * (2 - axis))
    result[~inside] = fill
    return result


def occupancy_of(
    coarse: Coarse, fine: Lattice, hull: Occupancy | None, gamma: float = GAMMA, share: float = WEIGHT_SHARE
) -> Occupancy:
    """Return the occupancy O of a frame on the fine lattice: what `occupied` says of its coarse field.

    `hull` is that of the fine lattice, or None. Raises `HoloreelError` where nothing is occupied.
    """
    field = coarse.resampled(fine)
    found = occupied(field.density, gamma, field.weights, share, hull)
    if not found.any():
        raise HoloreelError(
            f"The coarse field has no vertex of an opacity above {gamma:g}: lower gamma, or train the coarse stage "
            "for more iterations."
        )
    return found


def read_coarse(path: str | Path) -> Coarse:
    """Read what `Coarse.write` wrote. Raises `HoloreelError` where the file is missing, damaged or no such field."""
    path = Path(path)
    try:
        with zipfile.ZipFile(path) as archive:
            return _read(archive)
    except (OSError, EOFError, NotImplementedError, zipfile.BadZipFile, zlib.error) as error:
        raise HoloreelError(f"{path} cannot be read ({error}): delete it and train it again.") from error
    except (HoloreelError, ValueError, KeyError) as error:
        reason = str(error).rstrip(".")
        raise HoloreelError(f"{path} is no coarse field ({reason}): delete it and train it again.") from error


def _read(archive: zipfile.ZipFile) -> Coarse:
    """Read the arrays, none before its header is known to be sound; a ValueError says what is wrong."""
    shapes = {name: _header(archive, name) for name in ("place", "density", "color", "weights")}
    grid = shapes["density"][0]
    wanted = {"place": (4,), "density": grid, "color": (*grid, 3), "weights": grid}
    for name, shape in wanted.items():
        if shapes[name] != (shape, np.float64 if name == "place" else np.float32):
            raise ValueError(f"its {name} is {shapes[name][0]} of {shapes[name][1]}")
    if len(grid) != 3:
        raise ValueError(f"its density is {grid}")
    *lowest, spacing = _array(archive, "place").tolist()
    lattice = Lattice((grid[0], grid[1], grid[2]), (lowest[0], lowest[1], lowest[2]), spacing)
    arrays = [_array(archive, name) for name in ("density", "color", "weights")]
    if not all(np.isfinite(array).all() for array in arrays):
        raise ValueError("it holds values that are not finite")
    return Coarse(lattice, *arrays)


def _header(archive: zipfile.ZipFile, name: str) -> tuple[tuple[int, ...], np.dtype]:
    with archive.open(f"{name}.npy") as file:
        if npy.read_magic(file) != (1, 0):
            raise ValueError(f"its {name} is of another version")
        shape, _, kind = npy.read_array_header_1_0(file)
    return shape, kind


def _array(archive: zipfile.ZipFile, name: str) -> NDArray:
    with archive.open(f"{name}.npy") as file:
        return np.asarray(npy.read_array(file, allow_pickle=False))


@dataclass(frozen=True)
class CoarseConfig:
    """How a coarse field is trained."""

    iterations: int = 400
    """steps, in equal parts on the lattice and on each of the wider ones it starts from"""
    rays: int = 4096
    """pixels that a step looks at"""
    density_rate: float = 0.7
    """Adam's step for raw densities"""
    color_rate: float = 0.03
    """Adam's step for colors"""
    final_rate: float = 0.1
    """both rates decay to this part of themselves"""
    entropy: float = 0.01
    """weight of the background's entropy: rays shall be either stopped or free"""
    smooth: float = 3e-4
    """weight of the total variation in space"""
    misses: int = 0
    """masks that may leave out a vertex of the visual hull"""
    reach: float = REACH
    """spacings from a mask at which a vertex is still in the hull"""
    step: float = 0.5
    """of the ray march, in spacings"""
    weight_rays: int = 65536
    """rays, at most, by which vertices are weighed"""

    def __post_init__(self) -> None:
        bounds = {"iterations": 1, "rays": 1, "weight_rays": 1, "entropy": 0, "smooth": 0, "misses": 0, "reach": 0}
        wrong = [name for name, least in bounds.items() if not getattr(self, name) >= least]
        positive = ("density_rate", "color_rate", "final_rate", "step")
        wrong += [name for name in positive if not 0 < getattr(self, name) < math.inf]
        if wrong:
            name = wrong[0]
            least = f"{bounds[name]} or more" if name in bounds else "more than 0"
            raise HoloreelError(f"--coarse.{name.replace('_', '-')} is {getattr(self, name)}: take {least}.")


Listener = Callable[[int, float], None]


def train_coarse(
    views: FrameViews,
    lattice: Lattice,
    config: CoarseConfig | None = None,
    seed: int = 0,
    on_progress: Listener | None = None,
) -> Coarse:
    """Return the density and color of one frame, optimized in the vertices of its visual hull.

    A large lattice starts from what one of twice the spacing has learned, which starts from a wider one in turn: far
    fewer steps then lead as far. The loss is that of the rays' colors over a random background each, so that what is
    empty must let it through, plus the entropy of what a ray lets through (DVGO) and the total variation in space.

    `on_progress` hears of the steps done and the batch's PSNR. The result hangs on the seed, not on the number of
    threads. Raises `HoloreelError` where the hull is empty.
    """
    config = config or CoarseConfig()
    lattices = [lattice]
    while max(lattices[0].shape) > WIDEST:
        lattices.insert(0, wider(lattices[0]))
    generator = torch.Generator().manual_seed(seed)
    coarse: Coarse | None = None
    ends = [config.iterations * (level + 1) // len(lattices) for level in range(len(lattices))]
    with one_torch_thread():
        for level, done, end in zip(lattices, (0, *ends), ends, strict=False):
            hull = visual_hull(views, level, config.misses, config.reach)
            training = _Training(views, level, hull, config, generator, coarse)
            training.run(done, end, on_progress)
            coarse = training.coarse()
    assert coarse is not None
    return coarse


def wider(lattice: Lattice) -> Lattice:
    """Return a lattice of twice the spacing that covers the same box."""
    x, y, z = (max(2, edge // 2 + 1) for edge in lattice.shape)
    return Lattice((x, y, z), lattice.lowest, 2 * lattice.spacing)


class _Training:
    """The training of one lattice's rows (N + 1, 4) [raw density, color]: the march sums color as it is."""

    def __init__(
        self,
        views: FrameViews,
        lattice: Lattice,
        hull: Occupancy,
        config: CoarseConfig,
        generator: torch.Generator,
        start: Coarse | None,
    ) -> None:
        self.views, self.lattice, self.config, self.generator = views, lattice, config, generator
        vertices = np.argwhere(hull)
        self.vertices = vertices[np.argsort(morton.encode(*vertices.T))]
        lookup = np.full(lattice.shape, -1, np.int32)
        lookup[tuple(self.vertices.T)] = np.arange(len(vertices))
        self.volume = Volume(FieldLattice(lattice, lookup, len(vertices) + 1))
        self.rows = self._first_rows(start)
        low, high = torch.tensor([EMPTY_DENSITY, 0.0, 0.0, 0.0]), torch.tensor([HIGHEST, 1.0, 1.0, 1.0])
        self.optimizer = TableOptimizer(lattice_neighbors(lookup), self.rows, torch.tensor(SMOOTH_STEPS), low, high)

    def _first_rows(self, start: Coarse | None) -> Tensor:
        rows = torch.tensor([START_DENSITY, *[UNKNOWN_COLOR] * 3]).repeat(len(self.vertices) + 1, 1)
        rows[-1] = torch.tensor([EMPTY_DENSITY, 0.0, 0.0, 0.0])
        if start is not None:
            there, place = start.resampled(self.lattice), tuple(self.vertices.T)
            rows[:-1, 0] = torch.from_numpy(there.density[place]).clamp(EMPTY_DENSITY, HIGHEST)
            rows[:-1, 1:] = torch.from_numpy(there.color[place])
        return rows

    def run(self, done: int, end: int, on_progress: Listener | None) -> None:
        """Go the steps `done` to `end` of all."""
        config = self.config
        rates = torch.tensor([config.density_rate, *[config.color_rate] * 3])
        for iteration in range(done, end):
            leaf = self.rows.detach().requires_grad_()
            photometric, unsure = self._losses(leaf)
            (gradient,) = torch.autograd.grad(photometric + config.entropy * unsure, leaf)
            decay = config.final_rate ** ((iteration - done) / (end - done))
            self.optimizer.step(gradient, rates * decay, smooth=config.smooth)
            if on_progress and ((iteration + 1) % REPORT_EVERY == 0 or iteration + 1 == config.iterations):
                on_progress(iteration + 1, -10 * math.log10(max(photometric.item() / 3, 1e-10)))

    def _losses(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Return L_rgb of a batch and the mean entropy of its background."""
        count = self.config.rays
        batch = self.views.sample(count, self.generator)
        rays = Rays(batch.origins, batch.directions, torch.rand(count, generator=self.generator))
        background = torch.rand(count, 3, generator=self.generator)
        marched = march(self.volume, rows, rays, MarchRules(self.config.step))
        alpha = batch.rgba[:, 3:]
        truth = batch.rgba[:, :3] * alpha + background * (1 - alpha)
        left = marched.transmittance
        return rgb_loss(marched.features + left[:, None] * background, truth), entropy(left).mean()

    def coarse(self) -> Coarse:
        """Return what has been learned."""
        weights = ray_weights(self.volume, self.rows, self.views, self.config, self.generator)
        return Coarse(
            self.lattice,
            self._grid(self.rows[:-1, 0], EMPTY_DENSITY),
            self._grid(self.rows[:-1, 1:], UNKNOWN_COLOR),
            self._grid(weights, 0.0),
        )

    def _grid(self, values: Tensor, fill: float) -> Grid:
        grid = np.full((*self.lattice.shape, *values.shape[1:]), fill, np.float32)
        grid[tuple(self.vertices.T)] = values.numpy()
        return grid


def entropy(transmittance: Tensor) -> Tensor:
    """Return the entropy of whether a ray reaches the background, in nats: 0 where it surely does or does not."""
    left = transmittance.clamp(1e-6, 1 - 1e-6)
    return -(left * left.log() + (1 - left) * (1 - left).log())


def ray_weights(
    volume: Volume, rows: Tensor, views: FrameViews, config: CoarseConfig, generator: torch.Generator
) -> Tensor:
    """Return what rays of the pool see of each row (N): the sum of their samples' weights, shared out to corners.

    That is the gradient of the sum of a summed feature. A large pool is thinned at random.
    """
    chosen = torch.arange(len(views))
    if len(views) > config.weight_rays:
        chosen = torch.randint(len(views), (config.weight_rays,), generator=generator)
    batch = views.rays(chosen)
    leaf = torch.cat((rows[:, :1], torch.zeros_like(rows[:, :1])), 1).requires_grad_()
    marched = march(volume, leaf, Rays(batch.origins, batch.directions), MarchRules(config.step))
    (gradient,) = torch.autograd.grad(marched.features.sum(), leaf)
    return gradient[:-1, 1]
