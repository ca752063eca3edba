# SPDX-License-Identifier: GPL-3.0-or-later
"""Spacetime Gaussians as arrays, and their evaluation at a time (Spacetime Gaussians, Sec. 4.1). Needs numpy only."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]


@dataclass
class SpacetimeGaussians:
    """The parameters of N Spacetime Gaussians, raw as they are trained and stored.

    `features` has 3 columns for a lite model (linear display-referred RGB, no offset, no harmonics) and 9 for a full one
    (base, direction, time: Eq. 10). Time is normalized: a segment spans [0, 1).
    """

    means: Array  # (N, 3) position at the temporal center, b_0 of Eq. 8
    motions: Array  # (N, 3, 3) b_1, b_2, b_3 of Eq. 8: [order, axis]
    quats: Array  # (N, 4) w x y z, not normalized, c_0 of Eq. 9; all zero means no rotation
    omegas: Array  # (N, 4) c_1 of Eq. 9
    log_scales: Array  # (N, 3)
    opacity_logits: Array  # (N,)
    features: Array  # (N, 3) or (N, 9)
    trbf_centers: Array  # (N,) μ^τ of Eq. 7
    trbf_log_scales: Array  # (N,) log of the width w; s^τ = w⁻²

    def __len__(self) -> int:
        return len(self.means)
