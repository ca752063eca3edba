# SPDX-License-Identifier: GPL-3.0-or-later
"""The measures against their definitions, written out."""

import numpy as np
import pytest
from holoreel.core.errors import HoloreelError
from holoreel.core.metrics import psnr, score, ssim


def ssim_by_definition(a: np.ndarray, b: np.ndarray, data_range: float) -> float:
    """Wang et al. 2004 with a uniform 7 x 7 window, unbiased variances, windows that lie inside the picture."""
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    values = []
    for channel in range(a.shape[2]):
        for y in range(a.shape[0] - 6):
            for x in range(a.shape[1] - 6):
                p, q = a[y : y + 7, x : x + 7, channel].ravel(), b[y : y + 7, x : x + 7, channel].ravel()
                covariance = np.cov(p, q)
                numerator = (2 * p.mean() * q.mean() + c1) * (2 * covariance[0, 1] + c2)
                denominator = (p.mean() ** 2 + q.mean() ** 2 + c1) * (covariance[0, 0] + covariance[1, 1] + c2)
                values.append(numerator / denominator)
    return float(np.mean(values))


@pytest.fixture
def pair() -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(1)
    truth = random.random((17, 21, 3))
    return np.clip(truth + random.normal(0, 0.1, truth.shape), 0, 1), truth


@pytest.mark.parametrize("data_range", [1.0, 2.0])
def test_ssim_is_the_definitions(pair, data_range):
    assert ssim(*pair, data_range) == pytest.approx(ssim_by_definition(*pair, data_range), abs=1e-9)


def test_scores_are_the_papers(pair):
    scores = score(*pair)
    assert scores.psnr == pytest.approx(20 * np.log10(1 / np.sqrt(np.mean((pair[0] - pair[1]) ** 2))))
    assert scores.dssim1 == pytest.approx((1 - ssim_by_definition(*pair, 1.0)) / 2)
    assert scores.dssim2 == pytest.approx((1 - ssim_by_definition(*pair, 2.0)) / 2)
    assert scores.ssim == pytest.approx(1 - 2 * scores.dssim1)
    assert scores.dssim2 < scores.dssim1


def test_identical_pictures(pair):
    assert score(pair[1], pair[1]) == pytest.approx((100.0, 1.0, 0.0, 0.0))


def test_renderings_are_clipped_before_they_are_measured(pair):
    wild = pair[1].copy()
    wild[0, 0], wild[1, 1] = 7.0, -7.0
    tame = np.clip(wild, 0, 1)
    assert score(wild, pair[1]) == score(tame, pair[1])


def test_a_mask_limits_what_is_measured(pair):
    image, truth = pair
    mask = np.zeros(truth.shape[:2], bool)
    mask[3:9, 4:12] = True
    inside, outside = truth.copy(), truth.copy()
    inside[mask] = image[mask]
    outside[~mask] = image[~mask]
    assert psnr(inside, truth, mask) == pytest.approx(psnr(image[mask][None], truth[mask][None]))
    assert psnr(outside, truth, mask) == 100.0
    far = np.zeros_like(mask)
    far[-4:, -4:] = True  # windows of 7 around these do not reach the damage
    assert ssim(inside, truth, mask=far) == pytest.approx(1.0)
    with pytest.raises(HoloreelError, match="mask"):
        psnr(image, truth, np.zeros_like(mask))


def test_small_pictures_and_wrong_shapes_are_refused(pair):
    with pytest.raises(HoloreelError, match="7 pixels"):
        ssim(pair[0][:6], pair[1][:6])
    with pytest.raises(ValueError, match="H, W, C"):
        psnr(pair[0][:, :, 0], pair[1][:, :, 0])
