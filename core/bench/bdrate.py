# SPDX-License-Identifier: GPL-3.0-or-later
"""How many bytes one codec takes against another at equal quality (Bjøntegaard, VCEG-M33).

Both curves, the logarithm of the rate over the quality, are piecewise cubics through their points that do not
overshoot (PCHIP, as in the common test conditions of HEVC and VVC). The mean of their difference over the qualities
that both reach is the mean logarithm of the ratio of their rates.
"""

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from scipy.interpolate import PchipInterpolator


class Point(NamedTuple):
    """A rung: its rate, bytes or any other unit above 0, and its quality, higher is better."""

    rate: float
    quality: float


class RateChange(NamedTuple):
    """`change` is the rate of one curve over that of the other, less 1, on the mean over qualities `low` to `high`."""

    change: float
    low: float
    high: float


def useful(points: Iterable[Point]) -> list[Point]:
    """Return the points in order of rate, without those that are no better than a cheaper one.

    Raises ValueError where a rate is not above 0 or a number is not finite.
    """
    kept: list[Point] = []
    for point in sorted(points, key=lambda point: (point.rate, -point.quality)):
        if not (0 < point.rate < math.inf and math.isfinite(point.quality)):
            raise ValueError(f"a rung of rate {point.rate} and quality {point.quality} lies on no curve")
        if not kept or point.quality > kept[-1].quality:
            kept.append(point)
    return kept


def bd_rate(reference: Iterable[Point], other: Iterable[Point]) -> RateChange | None:
    """Return how much more rate the other curve takes than the reference: 0.25 is a quarter more.

    None where no quality is reached by both, or one of them has fewer than two useful points.
    """
    curves = useful(reference), useful(other)
    if min(map(len, curves)) < 2:
        return None
    low = max(curve[0].quality for curve in curves)
    high = min(curve[-1].quality for curve in curves)
    if high <= low:
        return None
    means = [float(_log_rate(curve).integrate(low, high)) / (high - low) for curve in curves]
    return RateChange(math.expm1(means[1] - means[0]), low, high)


def rate_at(points: Iterable[Point], quality: float) -> float | None:
    """Return the rate at which a curve reaches a quality, None where it does not."""
    curve = useful(points)
    if len(curve) < 2 or not curve[0].quality <= quality <= curve[-1].quality:
        return None
    return float(np.exp(_log_rate(curve)(quality)))


def _log_rate(curve: list[Point]) -> PchipInterpolator:
    return PchipInterpolator([point.quality for point in curve], [math.log(point.rate) for point in curve])
