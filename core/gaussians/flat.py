# SPDX-License-Identifier: GPL-3.0-or-later
"""One color for each Gaussian of a full model, for whatever cannot run its decoder. Needs numpy only.

The decoder belongs to pixels: it sees features that were blended, and each pixel's own ray. Here it is run once for
each Gaussian, on that Gaussian's own features and the ray that meets it from one viewpoint. Where an opaque Gaussian
fills a pixel seen from there, this is the pixel's color; elsewhere it is near it. Without a viewpoint, the activation
of the base color is nearer than any made-up ray.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .decoder import Decoder
from .model import SpacetimeGaussians


def flat_colors(
    gaussians: SpacetimeGaussians,
    decoder: Decoder | None,
    viewpoint: ArrayLike | None = None,
    time: float | None = None,
) -> NDArray[np.float32]:
    """Return display-referred colors (N, 3): a lite model's own, a full one's decoded, or its base without a decoder.

    `viewpoint` is where rays come from, in the world; without one the network adds nothing to the base. `time` is the
    normalized time to decode at; without one each Gaussian is decoded at its temporal center.
    """
    if decoder is None or gaussians.variant == "lite":
        return gaussians.features[:, :3]
    if viewpoint is None:
        base = np.pad(gaussians.features[:, :3], ((0, 0), (0, 6)))
        return decoder.decode(base, np.zeros(3), np.zeros(3)).astype(np.float32)
    if time is None:
        means, features = gaussians.means, gaussians.features.copy()
        features[:, 6:] = 0.0
    else:
        evaluated = gaussians.evaluate(time)
        means, features = evaluated.means, evaluated.features
    origins = np.asarray(viewpoint, np.float64)
    away = means - origins
    distance = np.linalg.norm(away, axis=1, keepdims=True)
    directions = away / np.where(distance > 0, distance, 1.0)
    return decoder.decode(features, origins, directions).astype(np.float32)


def flattened(
    gaussians: SpacetimeGaussians, decoder: Decoder | None, viewpoint: ArrayLike | None = None
) -> SpacetimeGaussians:
    """Return a lite model with the `flat_colors` of a full one; a lite model comes back as it is."""
    if gaussians.variant == "lite":
        return gaussians
    return replace(gaussians, features=flat_colors(gaussians, decoder, viewpoint))
