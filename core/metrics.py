# SPDX-License-Identifier: GPL-3.0-or-later
"""How alike two pictures are: PSNR, SSIM, DSSIM1 and DSSIM2 as the Spacetime Gaussians paper defines them (Sec. 5).

SSIM is scikit-image's `structural_similarity` with its defaults (a uniform 7 x 7 window, channels averaged). The
paper's DSSIM is (1 - SSIM) / 2, once with a data range of 1 (DSSIM1) and once of 2 (DSSIM2); both are published, so
both are reported. The SSIM reported is that of data range 1.

Where a subject was cut out of its surroundings, the background flatters every picture; two protocols say what to do.
ReRF and its successors measure the whole picture over white, SSIM with a Gaussian window of 11 x 11 pixels (sigma 1.5).
HumanRF takes PSNR over the pixels of the mask, SSIM over the mask's bounding box.

Pictures are (H, W, C) in [0, 1]; renderings are measured as floats, clipped, not rounded to 8 bits.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import HoloreelError

PSNR_MAX = 100.0  # reported for identical pictures, so that means and files stay finite
_WINDOW = 7
_GAUSS_WINDOW = 11


class Scores(NamedTuple):
    """What one rendering scores against its truth."""

    psnr: float
    ssim: float
    dssim1: float
    dssim2: float


def psnr(image: ArrayLike, truth: ArrayLike, mask: ArrayLike | None = None) -> float:
    """Return the peak signal-to-noise ratio in dB, over the pixels where `mask` (H, W) is true; at most 100."""
    errors = np.square(_prepare(image) - _prepare(truth))
    if mask is not None:
        errors = errors[_check_mask(mask)]
    mean = float(errors.mean())
    return min(-10.0 * math.log10(mean), PSNR_MAX) if mean > 0.0 else PSNR_MAX


def ssim(image: ArrayLike, truth: ArrayLike, data_range: float = 1.0, mask: ArrayLike | None = None) -> float:
    """Return the mean structural similarity, over the pixels where `mask` (H, W) is true."""
    from skimage.metrics import structural_similarity

    image, truth = _prepare(image), _prepare(truth)
    if min(image.shape[:2]) < _WINDOW:
        raise HoloreelError(f"SSIM needs pictures of at least {_WINDOW} pixels a side, not {image.shape[1::-1]}.")
    options = {"data_range": data_range, "channel_axis": 2, "win_size": _WINDOW}
    if mask is None:
        return float(structural_similarity(truth, image, **options))
    _, similarity = structural_similarity(truth, image, full=True, **options)
    return float(similarity[_check_mask(mask)].mean())


def score(image: ArrayLike, truth: ArrayLike, mask: ArrayLike | None = None) -> Scores:
    """Return all measures of a rendering against its truth."""
    similarity = ssim(image, truth, 1.0, mask)
    return Scores(
        psnr(image, truth, mask), similarity, (1.0 - similarity) / 2.0, (1.0 - ssim(image, truth, 2.0, mask)) / 2.0
    )


def subject_scores(image: ArrayLike, truth: ArrayLike, mask: ArrayLike) -> dict[str, float]:
    """Return the measures of a picture whose subject is where `mask` (H, W) is true.

    `psnr_mask` and `ssim_crop` are HumanRF's; `ssim_gauss`, over the whole picture, is ReRF's. What cannot be measured
    is left out: a subject that is out of sight, a box of fewer pixels than SSIM's window.
    """
    image, truth, inside = _prepare(image), _prepare(truth), np.asarray(mask, bool)
    scores: dict[str, float] = {}
    if inside.any():
        scores["psnr_mask"] = psnr(image, truth, inside)
        box = bounding_box(inside)
        if min(image[box].shape[:2]) >= _WINDOW:
            scores["ssim_crop"] = ssim(image[box], truth[box])
    if min(image.shape[:2]) >= _GAUSS_WINDOW:
        scores["ssim_gauss"] = ssim_gauss(image, truth)
    return scores


def ssim_gauss(image: ArrayLike, truth: ArrayLike) -> float:
    """Return the structural similarity as its inventors define it: a Gaussian window of 11 x 11 pixels, sigma 1.5."""
    from skimage.metrics import structural_similarity

    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "win_size": _GAUSS_WINDOW}
    return float(structural_similarity(_prepare(truth), _prepare(image), data_range=1.0, channel_axis=2, **options))


def bounding_box(mask: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Return the rows and columns that hold all that is true in a mask (H, W), which is not empty."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def _prepare(image: ArrayLike) -> NDArray[np.float64]:
    values = np.asarray(image, dtype=np.float64)
    if values.ndim != 3:
        raise ValueError(f"pictures are (H, W, C), not {values.shape}")
    return np.clip(values, 0.0, 1.0)


def _check_mask(mask: ArrayLike) -> NDArray[np.bool_]:
    inside = np.asarray(mask, dtype=bool)
    if not inside.any():
        raise HoloreelError("the mask leaves no pixel to measure: give a mask with something in it.")
    return inside
