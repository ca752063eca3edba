# SPDX-License-Identifier: GPL-3.0-or-later
"""The comparison of rate-distortion curves, against closed forms and published examples."""

import math

import pytest
from holoreel.core.bench.bdrate import Point, bd_rate, rate_at, useful
from hypothesis import given
from hypothesis import strategies as st

# The examples of the package `bjontegaard` and of the script `bjontegaard_metric`, with what the former gives for them
# with PCHIP (which agrees with the sheet of JVET-T2010).
PUBLISHED = [
    (
        [(9487.76, 40.037), (4593.60, 38.615), (2486.44, 36.845), (1358.24, 34.851)],
        [(9787.80, 40.121), (4469.00, 38.651), (2451.52, 36.970), (1356.24, 34.987)],
        -0.04417485350589045,
    ),
    (
        [(82472.76, 43.825), (26875.24, 41.404), (9487.76, 40.037), (4593.6, 38.615)],
        [(99896.96, 44.731), (33952.04, 41.875), (9787.8, 40.121), (4469.0, 38.651)],
        -0.0447218200276197,
    ),
    (
        [(686.76, 40.28), (309.58, 37.18), (157.11, 34.24), (85.95, 31.42)],
        [(893.34, 40.39), (407.8, 37.21), (204.93, 34.17), (112.75, 31.24)],
        0.31379878202397627,
    ),
]


def points(pairs):
    return [Point(*pair) for pair in pairs]


@pytest.mark.parametrize(("reference", "other", "expected"), PUBLISHED)
def test_published_examples(reference, other, expected):
    assert bd_rate(points(reference), points(other)).change == pytest.approx(expected, abs=1e-12)


def test_closed_forms():
    # log2 of the rate is linear in quality, at 6 dB and at 5 dB per doubling: PCHIP follows lines exactly.
    slow = [Point(2 ** ((q - 30) / 5), q) for q in (30, 32, 35, 40)]
    fast = [Point(2 ** ((q - 30) / 6), q) for q in (28, 33, 36)]
    found = bd_rate(slow, fast)
    assert (found.low, found.high) == (30, 36)
    mean = ((1 / 6 - 1 / 5) * 6**2 / 2) / 6  # of log2 of the ratio over 30 to 36
    assert found.change == pytest.approx(2**mean - 1, abs=1e-12)
    assert rate_at(slow, 37.5) == pytest.approx(2**1.5)
    assert rate_at(slow, 40.01) is None


@given(st.lists(st.tuples(st.floats(0.1, 9), st.floats(0.1, 9)), min_size=2, max_size=6), st.floats(0.1, 10))
def test_a_factor_in_rate_is_that_factor(steps, factor):
    rate, quality, curve = 1.0, 20.0, []
    for more, better in steps:
        rate, quality = rate * (1 + more), quality + better
        curve.append(Point(rate, quality))
    scaled = [Point(factor * point.rate, point.quality) for point in reversed(curve)]
    assert bd_rate(curve, scaled).change == pytest.approx(factor - 1, rel=1e-9, abs=1e-9)
    there, back = bd_rate(curve, scaled).change, bd_rate(scaled, curve).change
    assert (1 + there) * (1 + back) == pytest.approx(1)


def test_rungs_that_buy_nothing_are_left_out():
    curve = points([(10, 30), (20, 32), (30, 31.9), (40, 32), (50, 33)])
    assert useful(reversed(curve)) == points([(10, 30), (20, 32), (50, 33)])
    assert bd_rate(curve, useful(curve)).change == pytest.approx(0)


def test_curves_that_do_not_meet_are_not_compared():
    low, high = points([(1, 20), (2, 25)]), points([(1, 26), (2, 28)])
    assert bd_rate(low, high) is None
    assert bd_rate(low, low[:1]) is None
    assert bd_rate(low, [Point(3, 20), Point(4, 20)]) is None
    for bad in (Point(0, 20), Point(math.inf, 20), Point(1, math.nan)):
        with pytest.raises(ValueError, match="no curve"):
            bd_rate(low, [*low, bad])
