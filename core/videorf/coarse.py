# SPDX-License-Identifier: GPL-3.0-or-later
"""The coarse field of one frame: a dense grid of raw density and color (Sec. 4.1)."""

import math
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.lib import format as npy
from numpy.typing import NDArray
from torch import Tensor

from ..errors import HoloreelError
from ..files import atomic_path
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

    iterations: int = 300
    """steps"""
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


Listener = Callable[[int, float], None]


def train_coarse(
    views: FrameViews,
    lattice: Lattice,
    config: CoarseConfig | None = None,
    seed: int = 0,
    on_progress: Listener | None = None,
) -> Coarse:
    """Return the density and color of one frame, optimized in the vertices of its visual hull.

    The loss is that of the rays' colors over a random background each, so that what is empty must let it through, plus
    the entropy of what a ray lets through (DVGO). `on_progress` hears of the steps done and the batch's PSNR. The
    result hangs on the seed, not on the number of threads. Raises `HoloreelError` where the hull is empty.
    """
    config = config or CoarseConfig()
    hull = visual_hull(views, lattice, config.misses, config.reach)
    vertices = np.argwhere(hull)
    vertices = vertices[np.argsort(morton.encode(*vertices.T))]
    lookup = np.full(lattice.shape, -1, np.int32)
    lookup[tuple(vertices.T)] = np.arange(len(vertices))
    volume = Volume(FieldLattice(lattice, lookup, len(vertices) + 1))
    with one_torch_thread():
        rows = _optimized(volume, views, config, seed, on_progress)
        weights = ray_weights(volume, rows, views, config, seed)
    return Coarse(
        lattice,
        _scattered(rows[:-1, 0], vertices, lattice, EMPTY_DENSITY),
        _scattered(rows[:-1, 1:], vertices, lattice, UNKNOWN_COLOR),
        _scattered(weights, vertices, lattice, 0.0),
    )


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Keep torch to one thread: its idle ones would spin on the cores of the march."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _optimized(
    volume: Volume, views: FrameViews, config: CoarseConfig, seed: int, on_progress: Listener | None
) -> Tensor:
    """Return the rows (N + 1, 4) [raw density, color]: color is what the march sums, without any activation."""
    rows = torch.tensor([START_DENSITY, *[UNKNOWN_COLOR] * 3]).repeat(volume.field.rows, 1)
    rows[-1] = torch.tensor([EMPTY_DENSITY, 0.0, 0.0, 0.0])
    low, high = torch.tensor([EMPTY_DENSITY, 0.0, 0.0, 0.0]), torch.tensor([HIGHEST, 1.0, 1.0, 1.0])
    neighbors = lattice_neighbors(volume.field.lookup)
    optimizer = TableOptimizer(neighbors, rows, torch.tensor(SMOOTH_STEPS), low, high)
    rates = torch.tensor([config.density_rate, *[config.color_rate] * 3])
    generator = torch.Generator().manual_seed(seed)
    for iteration in range(config.iterations):
        leaf = rows.detach().requires_grad_()
        photometric, unsure = _losses(volume, leaf, views, config, generator)
        (gradient,) = torch.autograd.grad(photometric + config.entropy * unsure, leaf)
        optimizer.step(gradient, rates * config.final_rate ** (iteration / config.iterations), spatial=config.smooth)
        if on_progress and ((iteration + 1) % REPORT_EVERY == 0 or iteration + 1 == config.iterations):
            on_progress(iteration + 1, -10 * math.log10(max(photometric.item() / 3, 1e-10)))
    return rows


def _losses(
    volume: Volume, rows: Tensor, views: FrameViews, config: CoarseConfig, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Return L_rgb of a batch and the mean entropy of its background."""
    batch = views.sample(config.rays, generator)
    jitter = torch.rand(config.rays, generator=generator)
    background = torch.rand(config.rays, 3, generator=generator)
    marched = march(volume, rows, Rays(batch.origins, batch.directions, jitter), MarchRules(config.step))
    alpha = batch.rgba[:, 3:]
    truth = batch.rgba[:, :3] * alpha + background * (1 - alpha)
    left = marched.transmittance
    return rgb_loss(marched.features + left[:, None] * background, truth), entropy(left).mean()


def entropy(transmittance: Tensor) -> Tensor:
    """Return the entropy of whether a ray reaches the background, in nats: 0 where it surely does or does not."""
    left = transmittance.clamp(1e-6, 1 - 1e-6)
    return -(left * left.log() + (1 - left) * (1 - left).log())


def ray_weights(volume: Volume, rows: Tensor, views: FrameViews, config: CoarseConfig, seed: int) -> Tensor:
    """Return what rays of the pool see of each row (N): the sum of their samples' weights, shared out to corners.

    That is the gradient of the sum of a summed feature. A large pool is thinned at random.
    """
    generator = torch.Generator().manual_seed(seed)
    chosen = torch.arange(len(views))
    if len(views) > config.weight_rays:
        chosen = torch.randperm(len(views), generator=generator)[: config.weight_rays]
    batch = views.rays(chosen)
    leaf = torch.cat((rows[:, :1], torch.zeros_like(rows[:, :1])), 1).requires_grad_()
    marched = march(volume, leaf, Rays(batch.origins, batch.directions), MarchRules(config.step))
    (gradient,) = torch.autograd.grad(marched.features.sum(), leaf)
    return gradient[:-1, 1]


def _scattered(values: Tensor, vertices: NDArray[np.int64], lattice: Lattice, fill: float) -> Grid:
    grid = np.full((*lattice.shape, *values.shape[1:]), fill, np.float32)
    grid[tuple(vertices.T)] = values.numpy()
    return grid
