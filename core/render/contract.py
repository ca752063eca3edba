# SPDX-License-Identifier: GPL-3.0-or-later
"""What every rasterizer backend promises.

Backends: `cpu` (our C++ kernels), `reference` (plain torch, the oracle) and `cuda` (gsplat, on an NVIDIA GPU).

Each backend module has the functions `rasterize`, `rasterize_spacetime` and `decode` with the signatures below; they
are differentiable with respect to every tensor argument.

    rasterize(means, quats, scales, opacities, features, camera, background=None, rules=None, density=None)
        -> Rendering
        3D Gaussians: means (N,3), quats (N,4) wxyz unnormalized, scales (N,3) linear, opacities (N,) in [0,1],
        features (N,C).
    rasterize_spacetime(gaussians: SpacetimeTensors, time, camera, background=None, rules=None, density=None, rows=None)
        -> Rendering
        Spacetime Gaussians at `time` (Eqs. 6-9), evaluated and projected in one pass. `rows`, an ascending int32 (M,),
        draws those alone (`lifetimes` lists those alive), for a cost that the others have no
        part in; `density` cannot be had with it.
    decode(features, camera, hidden, output, activation) -> Tensor
        The colors (H,W,3) of a full model's rendering (Eqs. 10-11): features (H,W,9) are [base, direction, time],
        hidden (6,12) and output (3,6) the weights of the network, activation one of `ACTIVATIONS`. A pixel's color is
        activation(base + output · relu(hidden · [direction, time, ray origin, ray direction])), with the ray through
        the pixel's center in the world and its direction of unit length. `clamp` passes no gradient outside [0, 1].

    native_lens(camera) -> bool
        Whether `rasterize`, `rasterize_spacetime` and `decode` take this camera as it is: PINHOLE always.
    warp(rendering, lens: core.render.warp.Warp, background=None) -> Rendering
        What a lens with distortion sees of the rendering that its virtual pinhole makes over black, with `background`
        behind it then.

What training needs beside them:

    picture_loss(image, target, weight_dssim) -> PictureLoss
        (1 - w) mean|image - target| + w (1 - mean SSIM) of two (H,W,C) images, and their mean squared error. The target
        holds values, or bytes (uint8) that stand for 255ths. SSIM has an 11 x 11 Gaussian window of sigma 1.5, zeros
        beyond the border, C1 = 0.01² and C2 = 0.03². At equal values the gradient of the first term is 0.
    l1_dssim(image, target, weight_dssim) -> Tensor
        The loss alone.
    adam(groups: Sequence[AdamGroup], beta1, beta2, eps, step) -> None
        One step of Adam for every tensor of a model in one pass, in place, as `torch.optim.Adam` does; `step` counts
        from 1.

`camera` is a `holoreel.core.camera.Camera` for which `native_lens` holds; `background` a (C,) tensor or None for black;
`rules` None for `Rules()`. C is 1 to 16.

Gaussians are drawn in the order of their camera-space z, rounded to single precision; equal ones in the order of their
rows. A row is skipped, and gets zero gradient, where a parameter is not finite (but an infinite `trbf_log_scale` means
always on), where the opacity at `time` is under `alpha_min`, or where its 2D covariance cannot be inverted. A zero
quaternion means no rotation. Renderings are float32, or for `reference` of the dtype of the means.

A backend's `DEVICE` says where its pictures lie and where tensors are best kept; they are brought there if they lie
elsewhere. `cuda` has a few rules of its own, which its module names, and so is held to wider tolerances.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor

ACTIVATIONS = ("none", "clamp", "sigmoid")  # of a decoder's output, in the order the kernels number them


@dataclass(frozen=True)
class Rules:
    """The splatting rules, with the authors' defaults, so that a model renders as it was trained.

    A pixel skips a Gaussian whose alpha is under `alpha_min`, caps alpha at `alpha_max`, and stops before the Gaussian
    that would take its transmittance under `transmittance_min`. `low_pass` (px²) is added to the diagonal of the 2D
    covariance. Gaussians nearer than `near` are skipped. Where the Jacobian is taken, and there alone, `x/z` and `y/z`
    are held within the picture and a margin on each of its four sides, wherever the principal point lies: the margin is
    (jacobian_clamp - 1) / 2 of the width or height. `detach_motion_time` makes `trbf_centers` learn from the opacity
    alone, as the authors train: by default it also gets the gradient through motion and rotation. Without `cull_faded`
    the kernels project and tile what the time has faded out too, as the authors do: the same picture, later. With
    `warp_lenses`, `view` warps lenses with distortion even where the backend could draw them as they are.
    """

    alpha_max: float = 0.99
    alpha_min: float = 1.0 / 255.0
    transmittance_min: float = 1e-4
    low_pass: float = 0.3
    near: float = 0.2
    jacobian_clamp: float = 1.3
    detach_motion_time: bool = False
    cull_faded: bool = True
    warp_lenses: bool = False


class SpacetimeTensors(NamedTuple):
    """The fields of `SpacetimeGaussians`, as torch tensors of the same shapes and meanings."""

    means: Tensor
    motions: Tensor
    quats: Tensor
    omegas: Tensor
    log_scales: Tensor
    opacity_logits: Tensor
    features: Tensor
    trbf_centers: Tensor
    trbf_log_scales: Tensor


def listed(g: SpacetimeTensors, rows: Tensor | None) -> SpacetimeTensors:
    """Return the Gaussians of the listed rows alone, all if there is no list."""
    return g if rows is None else SpacetimeTensors(*(array[rows.to(array.device)] for array in g))


class Rendering(NamedTuple):
    """One picture: `features` (H,W,C) with the background composited, `alpha` (H,W), `depth` (H,W).

    `depth` is the alpha-weighted mean of camera-space z (0 where alpha is 0); it carries gradient like the rest.
    """

    features: Tensor
    alpha: Tensor
    depth: Tensor


@dataclass
class DensityStats:
    """What density control needs; backward adds to these tensors in place, once per rendered picture.

    `gradient`: (N,) sum of |dL/d(mean in pixels)|; `views`: (N,) int32 how many pictures saw each Gaussian;
    `radius_px`: (N,) largest projected radius (3 sigma of the longer axis) seen so far.
    """

    gradient: Tensor
    views: Tensor
    radius_px: Tensor


class PictureLoss(NamedTuple):
    """What one picture costs: `loss`, a scalar to be differentiated, and the mean `squared_error`."""

    loss: Tensor
    squared_error: float


class AdamGroup(NamedTuple):
    """One tensor of any shape for `adam`, with its gradient and its two moments, all alike.

    The step size is `rate`, times a factor for each row of the first dimension (`row_rates`, (N,)) and one for each
    value within a row (`column_rates`, as many as a row has values, in their order). Afterwards values are held in
    [`low`, `high`]. What a picture did not see is stepped too, as in `torch.optim.Adam`.
    """

    value: Tensor
    gradient: Tensor
    mean: Tensor
    mean_square: Tensor
    rate: float
    row_rates: Tensor | None = None
    column_rates: Tensor | None = None
    low: float = -math.inf
    high: float = math.inf
