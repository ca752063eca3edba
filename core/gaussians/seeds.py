# SPDX-License-Identifier: GPL-3.0-or-later
"""The first Gaussians of a run, from the capture's points of all frames (Spacetime Gaussians, Sec. 5)."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..capture import Points
from .config import TrainConfig
from .model import ALWAYS_LOG_SCALE, SpacetimeGaussians, logit

# A voxel this many point spacings wide almost surely holds a point of every frame in which its surface is there.
STATIC_VOXEL = 2.5
STATIC_SHARE = 0.8
SIZE_LIMITS = (0.1, 10.0)  # of a seed, in point spacings
SIGMOID_COLORS = (0.02, 0.98)  # a sigmoid reaches neither 0 nor 1


def neighbor_distances(points: NDArray[np.float32], count: int = 3) -> NDArray[np.float32]:
    """Return the root mean square distance of each of (N, 3) points to its `count` nearest others, (N,)."""
    from scipy.spatial import cKDTree

    count = min(count, len(points) - 1)
    if count < 1:
        return np.full(len(points), 1e-3, np.float32)
    distances = cKDTree(points).query(points, k=count + 1, workers=-1)[0][:, 1:]
    return np.sqrt(np.mean(distances**2, axis=1)).astype(np.float32)


def voxel_ids(points: NDArray[np.float32], size: float) -> NDArray[np.int64]:
    """Return for each of (N, 3) points a number that it shares with exactly the points of its voxel."""
    cells = np.floor(points.astype(np.float64) / size).astype(np.int64)
    # Three of these fit into one int64; what lies farther out than a million voxels is a stray point.
    cells = np.clip(cells - np.median(cells, axis=0).astype(np.int64), -(2**19), 2**19)
    cells -= cells.min(axis=0)
    return np.unique(np.ravel_multi_index(tuple(cells.T), cells.max(axis=0) + 1), return_inverse=True)[1]


def first_of_each(ids: NDArray[np.int64], order: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the positions of the first element of each id, met in the given `order`."""
    return order[np.unique(ids[order], return_index=True)[1]]


def split_static(
    points: NDArray[np.float32], frames: NDArray[np.int64], frame_count: int, spacing: float
) -> NDArray[np.bool_]:
    """Return which points lie where nearly all frames have points: what stands still, (N,)."""
    voxels = voxel_ids(points, STATIC_VOXEL * spacing)
    occupied = np.unique(voxels * frame_count + frames) // frame_count
    needed = STATIC_SHARE * len(np.unique(frames))  # not every frame need have points
    return np.bincount(occupied, minlength=voxels.max() + 1)[voxels] >= needed


def chosen_points(points: Sequence[Points], config: TrainConfig) -> NDArray[np.bool_]:
    """Return which of the points of all frames may become seeds, (N,) in the order of the frames.

    Every `seed_frames`-th frame takes part; all but the first one with the `sparse_share` of its points that are
    farthest from their neighbors: what the first frame leaves open, and no copies of what it shows.
    """
    chosen = []
    for index, frame in enumerate(points):
        keep = np.full(len(frame), index % config.seed_frames == 0)
        if index and config.sparse_share < 1.0 and keep.any():
            distances = neighbor_distances(frame.xyz, 1)
            keep[np.argsort(-distances, kind="stable")[round(config.sparse_share * len(frame)) :]] = False
        chosen.append(keep)
    return np.concatenate(chosen)


def gaussians_from_points(
    points: Sequence[Points], config: TrainConfig, rng: np.random.Generator
) -> SpacetimeGaussians:
    """Make lite Spacetime Gaussians from the points of each frame of a segment.

    With `split_static`, points that nearly every frame has in the same place become one long-lived Gaussian; the others
    (without, all) become Gaussians of `moving_width` centered at their frame. Sizes follow the distance to the nearest
    neighbors. There must be a point.
    """
    frame_count = len(points)
    xyz = np.concatenate([frame.xyz for frame in points])
    rgb = np.concatenate([frame.rgb for frame in points]).astype(np.float32) / 255.0
    frames = np.repeat(np.arange(frame_count), [len(frame) for frame in points])
    spacing = _surface_spacing(max(points, key=len).xyz, rng)

    static = np.ones(len(xyz), dtype=bool)
    if not config.split_static:
        static[:] = False
    elif frame_count > 1:
        static = split_static(xyz, frames, frame_count, spacing)
    order = rng.permutation(len(xyz))
    order = order[chosen_points(points, config)[order]]
    kept = _thin(xyz, order[static[order]], spacing, config.max_seeds * 2 // 3)
    moving = order[~static[order]]
    kept = np.concatenate([kept, moving[: max(config.max_seeds - len(kept), 0)]])

    xyz, rgb, frames, static = xyz[kept], rgb[kept], frames[kept], static[kept]
    scales = _sizes(xyz, frames, static, config.split_static)
    scales = np.clip(scales, SIZE_LIMITS[0] * spacing, SIZE_LIMITS[1] * spacing)
    count = len(kept)
    return SpacetimeGaussians(
        means=xyz,
        motions=np.zeros((count, 3, 3), np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        omegas=np.zeros((count, 4), np.float32),
        log_scales=np.repeat(np.log(scales)[:, None], 3, axis=1).astype(np.float32),
        opacity_logits=np.full(count, np.log(config.seed_opacity / (1 - config.seed_opacity)), np.float32),
        features=rgb,
        trbf_centers=np.where(static, 0.5, frames / frame_count).astype(np.float32),
        trbf_log_scales=np.log(np.where(static, config.static_width, config.moving_width)).astype(np.float32),
    )


def _sizes(
    xyz: NDArray[np.float32], frames: NDArray[np.int64], static: NDArray[np.bool_], by_frame: bool
) -> NDArray[np.float32]:
    """Return the root mean square distance of each point to its nearest neighbors, (N,)."""
    if not by_frame:
        return neighbor_distances(xyz)
    scales = np.empty(len(xyz), np.float32)
    scales[static] = neighbor_distances(xyz[static]) if static.any() else 0
    # Neighbors of a moving point are those of its own frame: the others are where it was, not how dense it is.
    for frame in np.unique(frames[~static]):
        rows = ~static & (frames == frame)
        scales[rows] = neighbor_distances(xyz[rows])
    return scales


def as_trained(gaussians: SpacetimeGaussians, config: TrainConfig) -> SpacetimeGaussians:
    """Return Gaussians as the run trains them: features of its model, and neutral where it leaves a part out.

    The color of a lite one becomes the base of a full one, before the decoder's output function. The other way round is
    a ValueError.
    """
    if config.model == "lite" and gaussians.variant == "full":
        raise ValueError("a lite model cannot begin with Gaussians of a full one")
    features, motions = gaussians.features, gaussians.motions.copy()
    if config.model == "full" and gaussians.variant == "lite":
        base = features
        if config.decoder_output == "sigmoid":
            base = logit(np.clip(features, *SIGMOID_COLORS))
        features = np.concatenate([base, np.zeros((len(gaussians), 6))], axis=1)
    motions[:, config.motion :] = 0.0
    widths = gaussians.trbf_log_scales
    return replace(
        gaussians,
        features=features,
        motions=motions,
        omegas=gaussians.omegas if config.rotation else np.zeros_like(gaussians.omegas),
        trbf_log_scales=widths if config.temporal_opacity else np.full_like(widths, ALWAYS_LOG_SCALE),
    )


def _surface_spacing(xyz: NDArray[np.float32], rng: np.random.Generator) -> float:
    """Return the typical distance between neighbors among points on surfaces, measured on some of them."""
    sample = xyz[rng.permutation(len(xyz))[:20_000]]
    # Leaving points out of a surface widens the distances as the square root.
    return float(np.median(neighbor_distances(sample))) * float(np.sqrt(len(sample) / len(xyz)))


def _thin(xyz: NDArray[np.float32], rows: NDArray[np.int64], spacing: float, limit: int) -> NDArray[np.int64]:
    """Keep one of `rows` per voxel, with voxels as small as `limit` allows."""
    size = spacing * 0.5
    while True:
        kept = rows[first_of_each(voxel_ids(xyz[rows], size), np.arange(len(rows)))] if len(rows) else rows
        if len(kept) <= limit:
            return kept
        size *= 1.15
