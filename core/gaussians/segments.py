# SPDX-License-Identifier: GPL-3.0-or-later
"""Long videos as runs of frames, each a model of its own that is trained and played as a unit.

Neighbors share their static part, so that nothing jumps where one hands over to the next: a segment starts from what
stood still in the one before it. It may also learn from a few frames beyond its own on either side (`overlap`); its
times are then changed so that its own frames span [0, 1) all the same, and no reader need know.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..capture import Points
from .config import TrainConfig
from .model import SpacetimeGaussians, concatenate
from .seeds import as_trained, gaussians_from_points

STATIC_WIDTH = 0.5  # segments: one that lives shorter has to do with something that happens
STATIC_DRIFT = 1.5  # footprints that a still Gaussian may move over its segment


@dataclass(frozen=True)
class SegmentPlan:
    """Frames of a capture, counted from 0: those a segment plays, and those it learns from (the same and more)."""

    index: int
    start: int
    count: int
    train_start: int
    train_count: int


def plan_segments(frame_count: int, length: int, overlap: int = 0) -> list[SegmentPlan]:
    """Cut `frame_count` frames into the fewest segments of at most `length` frames (0: one segment), equally long.

    Each learns from `overlap` more frames on either side where there are such.
    """
    pieces = -(-frame_count // length) if length else 1
    edges = [round(frame_count * piece / pieces) for piece in range(pieces + 1)]
    plans = []
    for index, (start, end) in enumerate(pairwise(edges)):
        first, last = max(start - overlap, 0), min(end + overlap, frame_count)
        plans.append(SegmentPlan(index, start, end - start, first, last - first))
    return plans


def retime(gaussians: SpacetimeGaussians, shift: float, stretch: float) -> SpacetimeGaussians:
    """Return the same Gaussians on another clock: what happened at time u happens at `stretch` · u + `shift`."""
    slower = 1.0 / stretch
    features = gaussians.features.copy()
    features[:, 6:] *= slower  # the time part of a full model; a lite one has none
    orders = np.array([slower, slower**2, slower**3], np.float32)
    return SpacetimeGaussians(
        means=gaussians.means,
        motions=gaussians.motions * orders[None, :, None],
        quats=gaussians.quats,
        omegas=gaussians.omegas * slower,
        log_scales=gaussians.log_scales,
        opacity_logits=gaussians.opacity_logits,
        features=features,
        trbf_centers=gaussians.trbf_centers * stretch + shift,
        trbf_log_scales=gaussians.trbf_log_scales + np.log(stretch),
    )


def to_played(gaussians: SpacetimeGaussians, plan: SegmentPlan) -> SpacetimeGaussians:
    """Change the clock of the frames that were learned from to that of the frames that are played."""
    if plan.count == plan.train_count:
        return gaussians
    return retime(gaussians, (plan.train_start - plan.start) / plan.count, plan.train_count / plan.count)


def static_rows(gaussians: SpacetimeGaussians, footprint: float) -> NDArray[np.bool_]:
    """Return which Gaussians stand still and stay at least as long as their segment, (N,).

    `footprint` is what one pixel covers, in world units.
    """
    ways = np.linalg.norm(gaussians.motions.astype(np.float64), axis=2) * (0.5, 0.25, 0.125)
    return (gaussians.trbf_log_scales >= np.log(STATIC_WIDTH)) & (ways.sum(axis=1) <= STATIC_DRIFT * footprint)


def inherited(gaussians: SpacetimeGaussians, footprint: float, config: TrainConfig) -> SpacetimeGaussians:
    """Return the static part of a segment as the next one takes it over: centered in time, and there to stay."""
    kept = gaussians.take(static_rows(gaussians, footprint))
    half = 0.5 - kept.trbf_centers[:, None]
    features = kept.features.copy()
    features[:, 6:] = 0.0  # how a full model's color changed in a time that is over
    middle = kept.quats + half * kept.omegas
    zero = np.zeros_like
    return SpacetimeGaussians(
        means=kept.means,
        motions=zero(kept.motions),
        quats=middle,
        omegas=zero(kept.omegas),
        log_scales=kept.log_scales,
        opacity_logits=kept.opacity_logits,
        features=features,
        trbf_centers=np.full(len(kept), 0.5, np.float32),
        trbf_log_scales=np.maximum(kept.trbf_log_scales, np.float32(np.log(config.static_width))),
    )


def warm_seeds(
    points: Sequence[Points], static: SpacetimeGaussians, config: TrainConfig, rng: np.random.Generator
) -> SpacetimeGaussians:
    """Return the first Gaussians of a segment: the `static` part of the one before, and seeds for what is not in it.

    A long-lived seed is left out where an inherited Gaussian lies closer than the seed's own neighbors.
    """
    from scipy.spatial import cKDTree

    fresh = as_trained(gaussians_from_points(points, config, rng), config)
    if not len(static):
        return fresh
    distance = cKDTree(static.means).query(fresh.means, workers=-1)[0]
    long_lived = fresh.trbf_log_scales >= np.log(STATIC_WIDTH)
    known = long_lived & (distance < np.exp(fresh.log_scales.max(axis=1)))
    return concatenate([static, fresh.take(~known)])
