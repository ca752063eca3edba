# SPDX-License-Identifier: GPL-3.0-or-later
"""Feature tables as bytes: one range per channel for the whole video (Sec. 4.3). Needs numpy only.

Code c stands for low + c (high - low) / 255. The ranges never change within a video, since a change would break the
prediction of one frame from the last. Channel 0 is the raw density, and its code 0 is what empty vertices hold: the
player fills vertices without a pixel with the density `low[0]` and features 0.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import HoloreelError

LEVELS = 255
EMPTY_DENSITY = -8.0  # softplus gives 3e-4: as good as nothing
MAX_CHANNELS = 16


@dataclass(frozen=True)
class Ranges:
    """The lowest and highest value of each channel [density, features]."""

    low: tuple[float, ...]
    high: tuple[float, ...]

    def __post_init__(self) -> None:
        pairs = list(zip(self.low, self.high, strict=True))
        finite = np.isfinite(np.array(pairs, np.float32)).all()
        if not 2 <= len(pairs) <= MAX_CHANNELS or not finite or not all(low < high for low, high in pairs):
            raise HoloreelError(
                f"The ranges {pairs} are not 2 to {MAX_CHANNELS} pairs of finite numbers, the lower first: write the "
                "video again."
            )

    @property
    def step(self) -> NDArray[np.float32]:
        """The difference between neighboring codes, per channel (C)."""
        return ((np.array(self.high) - np.array(self.low)) / LEVELS).astype(np.float32)

    @property
    def empty(self) -> NDArray[np.float32]:
        """The row of an empty vertex (C): the lowest density, features 0."""
        return np.array([self.low[0], *[0.0] * (len(self.low) - 1)], np.float32)

    def encode(self, values: NDArray) -> NDArray[np.uint8]:
        """Return the codes of rows (..., C); what lies out of range takes the nearest code. NaN is a ValueError."""
        if np.isnan(values).any():
            raise ValueError("a feature table holds NaN")
        codes = (np.asarray(values, np.float64) - np.array(self.low)) / self.step.astype(np.float64)
        return np.clip(np.rint(codes), 0, LEVELS).astype(np.uint8)

    def decode(self, codes: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the rows (..., C) that codes stand for. Every player computes in float32: low + code * step."""
        rows = codes.astype(np.float32)
        rows *= self.step
        rows += np.array(self.low, np.float32)
        return rows


def fit_ranges(
    tables: Iterable[NDArray], empty_density: float = EMPTY_DENSITY, percentile: float = 0.0, least: float = 1e-3
) -> Ranges:
    """Return the ranges of a video from the occupied rows (N, C) of its frames.

    Each channel spans what its frames span when `percentile` of a frame's values is left out at either end: few
    outliers then cost no precision. The density starts at `empty_density` in any case. A channel narrower than `least`
    is widened.
    """
    if not 0 <= percentile < 50:
        raise HoloreelError(f"The percentile {percentile:g} is out of range: take 0 up to, not with, 50.")
    spans = [np.percentile(table, (percentile, 100 - percentile), axis=0) for table in tables if len(table)]
    if not spans:
        raise HoloreelError("No frame has an occupied vertex: there is nothing to encode.")
    low, high = np.min(spans, axis=0)[0], np.max(spans, axis=0)[1]
    low[0] = empty_density
    high = np.maximum(high, low + least)
    return Ranges(tuple(low.tolist()), tuple(high.tolist()))
