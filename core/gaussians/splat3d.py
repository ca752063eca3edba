# SPDX-License-Identifier: GPL-3.0-or-later
"""A moment of a model as an ordinary 3D Gaussian Splatting PLY, for any viewer of such files. Needs numpy only.

All properties `float`: x y z, nx ny nz (zeros), f_dc_0..2 (constant harmonic: (color - 0.5) / C0), opacity (logit),
scale_0..2 (log), rot_0..3 (w x y z, unit length). Degree 0: there is no f_rest.
"""

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ..plyfile import write_vertices
from .decoder import Decoder
from .flat import flat_colors
from .model import SpacetimeGaussians, logit
from .ply import SH_C0

_OPAQUE = 1.0 - 2.0**-20  # what stands for an opacity of 1, whose logit is infinite
_SMALLEST = 1e-30  # of scales, so that their logarithm is finite


def write_moment(
    path: str | Path,
    gaussians: SpacetimeGaussians,
    time: float,
    decoder: Decoder | None = None,
    viewpoint: ArrayLike | None = None,
) -> int:
    """Write what is visible at a normalized time, atomically; return how many Gaussians that is.

    Opacities are those at that time; Gaussians under 1/255 are left out, because no pixel would show them. Colors of a
    full model are `flat.flat_colors`, as seen from `viewpoint`.
    """
    gaussians = gaussians.without_bad_rows()
    evaluated = gaussians.evaluate(time)
    colors = flat_colors(gaussians, decoder, viewpoint, time)[evaluated.alive]
    shown = evaluated.take(evaluated.alive)
    columns = {
        ("x", "y", "z"): shown.means,
        ("nx", "ny", "nz"): np.zeros_like(shown.means),
        ("f_dc_0", "f_dc_1", "f_dc_2"): (colors - 0.5) / SH_C0,
        ("opacity",): logit(shown.opacities.astype(np.float64).clip(max=_OPAQUE))[:, None],
        ("scale_0", "scale_1", "scale_2"): np.log(shown.scales.astype(np.float64).clip(_SMALLEST)),
        ("rot_0", "rot_1", "rot_2", "rot_3"): shown.quats,
    }
    table = np.zeros(len(shown), dtype=[(name, "f4") for names in columns for name in names])
    for names, values in columns.items():
        for name, column in zip(names, values.T, strict=True):
            table[name] = column
    write_vertices(path, table)
    return len(shown)
