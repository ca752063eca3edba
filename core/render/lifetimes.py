# SPDX-License-Identifier: GPL-3.0-or-later
"""Which Gaussians of a segment are alive when: lists of rows, so that a frame of playback costs what is seen in it."""

import math
from collections import OrderedDict

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .contract import SpacetimeTensors

SLACK = (
    1e-3  # how far beyond its life, in its own temporal widths, a Gaussian is still listed: more than rounding moves
)


class Lifetimes:
    """The rows that may be seen in each of a segment's frames; a list holds for the whole time to the next frame.

    A Gaussian lives while its opacity (Eq. 7) is `alpha_min` or more. Lists are made when first asked for, and those of
    `frames` frames are kept: 4 bytes per row and frame that it lives in.
    """

    def __init__(self, gaussians: SpacetimeTensors, frames: int, alpha_min: float) -> None:
        self.frames = frames
        self.alpha_min = alpha_min
        self._begin, self._end = _lives(gaussians, alpha_min)
        self._lists: OrderedDict[int, Tensor] = OrderedDict()

    def rows(self, time: float) -> Tensor:
        """Return the ascending rows, (M,) int32, among which are all that are seen at a normalized time, also outside
        [0, 1]."""
        frame = math.floor(time * self.frames)
        if frame in self._lists:
            self._lists.move_to_end(frame)
            return self._lists[frame]
        # Rounding must not lose the frame's ends, as at 7 / 25 * 25 > 7.
        first, last = (frame - SLACK) / self.frames, (frame + 1 + SLACK) / self.frames
        living = (self._begin <= last) & (self._end >= first)
        self._lists[frame] = torch.from_numpy(np.flatnonzero(living).astype(np.int32))
        if len(self._lists) > self.frames:
            self._lists.popitem(last=False)
        return self._lists[frame]


def _lives(g: SpacetimeTensors, alpha_min: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """When each row is first and last seen; NaN where never: a parameter of its life is not finite, or it is too faint.

    occupancy · exp(-u²) >= alpha_min where |u| <= sqrt(ln(occupancy / alpha_min)), and u = (t - center) / width.
    """
    logits, centers, log_widths = (
        array.detach().cpu().double().numpy() for array in (g.opacity_logits, g.trbf_centers, g.trbf_log_scales)
    )
    with np.errstate(all="ignore"):
        reach = -np.logaddexp(0.0, -logits) - math.log(alpha_min)
        # A hair more than exact, and infinite where the width is: such a Gaussian is always on.
        half = (np.sqrt(np.maximum(reach, 0.0)) + SLACK) * np.exp(log_widths)
        half[~(reach >= -SLACK)] = np.nan
        return centers - half, centers + half
