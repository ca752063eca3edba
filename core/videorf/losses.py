# SPDX-License-Identifier: GPL-3.0-or-later
"""The losses of the sequential training (Eqs. 5-8).

L_spatial and L_temporal measure differences in steps of the quantizer, channel by channel, so that one weight serves
all channels, and are means over the pixels in use, so that one weight serves all sizes. Below one step the absolute
value is rounded off to a parabola: the codec cannot tell smaller differences, and Adam would make full steps of the
sign of noise.
"""

import torch
from torch import Tensor

from .mapping import BLOCK


def smooth_abs(difference: Tensor) -> Tensor:
    """Return |x| - 1/2, and x² / 2 where |x| < 1: its slope is x held to -1 ... 1."""
    return torch.nn.functional.huber_loss(difference, torch.zeros_like(difference), reduction="none", delta=1.0)


def spatial_loss(image: Tensor, valid: Tensor, step: Tensor, seam: float = 1.0) -> Tensor:
    """Return L_spatial of a feature image (H, W, C) (Eq. 5): its total variation, a scalar.

    `valid` (H, W; bool) says which pixels hold a vertex: a difference counts where both sides do, and the sum is
    divided by their number. `step` (C) is the quantizer's; `seam` weighs differences across the borders of 8 x 8
    blocks.
    """
    steps = image / step
    total = image.new_zeros(())
    for axis in (0, 1):
        edge = image.shape[axis]
        here, there = steps.narrow(axis, 0, edge - 1), steps.narrow(axis, 1, edge - 1)
        counts = (valid.narrow(axis, 0, edge - 1) & valid.narrow(axis, 1, edge - 1)).to(image.dtype)
        if seam != 1.0:
            at_border = torch.arange(1, edge, device=image.device) % BLOCK == 0
            weights = torch.where(at_border, seam, 1.0).to(image.dtype)
            counts = counts * (weights[:, None] if axis == 0 else weights)
        total = total + (smooth_abs(there - here).sum(-1) * counts).sum()
    return total / valid.sum().clamp(min=1)


def temporal_loss(rows: Tensor, previous: Tensor, step: Tensor) -> Tensor:
    """Return L_temporal of the occupied rows (N, C) against those of the frame before, a constant (Eq. 6): a scalar.

    Not for the first frame of a group.
    """
    return smooth_abs((rows - previous.detach()) / step).sum() / max(len(rows), 1)


def rgb_loss(colors: Tensor, truth: Tensor) -> Tensor:
    """Return L_rgb of rays (N, 3) (Eq. 8), as a mean over rays of the channels' sum: its weight does not hang on the
    batch.
    """
    return (colors - truth).square().sum(-1).mean()


def noisy(rows: Tensor, step: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Return the rows with uniform noise of one step of the quantizer: what training sees of the rounding to come."""
    noise = torch.rand(rows.shape, generator=generator, dtype=rows.dtype, device=rows.device)
    return rows + (noise - 0.5) * step
