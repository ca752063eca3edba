# SPDX-License-Identifier: GPL-3.0-or-later
"""Which Gaussians matter most, so that the first few of a sorted model stand for all of it. Needs numpy only."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .model import ALWAYS_LOG_SCALE, SpacetimeGaussians, sigmoid


def importance(gaussians: SpacetimeGaussians) -> NDArray[np.float64]:
    """Return (N,) opacity times radius, times the part of the segment [0, 1) that a Gaussian lives.

    The radius is the geometric mean of the two largest standard deviations. On real models the first half by this rule
    draws nearer to the whole than by area or volume, which keep too little of what is small and sharp.
    """
    sizes = np.sort(gaussians.log_scales.astype(np.float64), axis=1)
    radius = np.exp(0.5 * (sizes[:, 1] + sizes[:, 2]))
    return sigmoid(gaussians.opacity_logits.astype(np.float64)) * radius * _time_alive(gaussians)


def most_important_first(segments: Sequence[SpacetimeGaussians]) -> NDArray[np.int64]:
    """Return the order of the rows of all segments, one after the other, that puts the most important first.

    Within a segment that is by `importance`; the segments take turns by their sizes, so that the first part of the
    whole is the same part of each.
    """
    orders = [np.argsort(-importance(gaussians), kind="stable") for gaussians in segments]
    if len(orders) == 1:
        return orders[0]
    places = []
    for order in orders:
        place = np.empty(len(order))
        place[order] = np.arange(len(order)) / max(1, len(order))
        places.append(place)
    return np.argsort(np.concatenate(places), kind="stable")


def _time_alive(gaussians: SpacetimeGaussians) -> NDArray[np.float64]:
    """Return (N,) the integral of exp(-((t - c) / w)²) over [0, 1]."""
    width = np.exp(np.minimum(gaussians.trbf_log_scales.astype(np.float64), ALWAYS_LOG_SCALE))
    center = gaussians.trbf_centers.astype(np.float64)
    return 0.5 * np.sqrt(np.pi) * width * (_erf((1.0 - center) / width) + _erf(center / width))


def _erf(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the error function to within 0.001, and exactly its slope at 0."""
    x = np.clip(x, -6.0, 6.0)
    return np.tanh(2.0 / np.sqrt(np.pi) * (x + 0.0894 * x * x * x))
