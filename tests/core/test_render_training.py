# SPDX-License-Identifier: GPL-3.0-or-later
"""The fused loss and optimizer step against torch and scikit-image."""

import numpy as np
import pytest
import torch
from holoreel.core.render import cpu, reference
from skimage.metrics import structural_similarity


def images(height, width, channels, seed=0):
    """Two smooth pictures that differ, with flat parts and equal parts."""
    generator = torch.Generator().manual_seed(seed)
    image = torch.rand(height, width, channels, generator=generator)
    target = (image + 0.2 * torch.randn(height, width, channels, generator=generator)).clamp(0, 1)
    image[: height // 3, : width // 2] = 0.25
    target[: height // 4] = image[: height // 4]
    return image, target


@pytest.mark.parametrize("size", [(40, 56, 3), (33, 31, 1), (1, 1, 3), (5, 70, 4), (65, 3, 9)])
@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_l1_dssim_matches_float64_autograd(size, weight):
    image, target = images(*size)
    ours, oracle = image.clone().requires_grad_(), image.double().requires_grad_()
    loss = cpu.l1_dssim(ours, target, weight)
    wanted = reference.l1_dssim(oracle, target.double(), weight)
    assert float(loss) == pytest.approx(float(wanted), abs=1e-6)
    (3.0 * loss).backward()
    (3.0 * wanted).backward()
    assert (ours.grad.double() - oracle.grad).norm() <= 2e-4 * oracle.grad.norm() + 1e-9


def test_reference_ssim_matches_scikit_image_inside():
    image, target = images(60, 70, 3, seed=2)
    _, theirs = structural_similarity(
        *(picture.double().numpy() for picture in (image, target)),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=2,
        full=True,
    )
    # The window of a pixel five pixels inside does not meet the border, where the two differ. The loss of a picture whose
    # border is cut away tells of the inside alone only in the middle pixel, so the sums are compared pixel by pixel.
    for row, column in ((20, 30), (7, 9), (52, 61)):
        patch = (slice(row - 5, row + 6), slice(column - 5, column + 6))
        weights = np.exp(-((np.arange(11) - 5) ** 2) / 4.5)
        window = np.outer(weights, weights)[..., None] / weights.sum() ** 2
        x, y = image[patch].double().numpy(), target[patch].double().numpy()
        mx, my = (window * x).sum((0, 1)), (window * y).sum((0, 1))
        vx, vy, cov = ((window * a).sum((0, 1)) - b for a, b in ((x * x, mx * mx), (y * y, my * my), (x * y, mx * my)))
        ssim = (2 * mx * my + 1e-4) * (2 * cov + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))
        np.testing.assert_allclose(ssim, theirs[row, column], atol=1e-9)
    size = (11, 11)
    x, y = image[:11, 40:51].double(), target[:11, 40:51].double()
    base = float(reference.l1_dssim(x, y, 1.0))
    assert 0 <= base <= 2
    assert float(reference.l1_dssim(x, x, 1.0)) == pytest.approx(0, abs=1e-12)
    assert size == tuple(x.shape[:2])


def test_l1_dssim_has_the_same_bits_for_any_number_of_threads():
    image, target = images(130, 60, 3)
    results = []
    for threads in (1, 2, 5):
        cpu.set_threads(threads)
        picture = image.clone().requires_grad_()
        loss = cpu.l1_dssim(picture, target, 0.2)
        loss.backward()
        results.append((loss.detach(), picture.grad))
    cpu.set_threads(2)
    assert all(torch.equal(a, b) for result in results for a, b in zip(result, results[0], strict=True))


def test_l1_dssim_names_wrong_shapes():
    with pytest.raises(ValueError, match="target has shape"):
        cpu.l1_dssim(torch.zeros(4, 4, 3), torch.zeros(4, 5, 3), 0.2)


@pytest.mark.parametrize("backend", [cpu, reference], ids=["cpu", "reference"])
def test_adam_step_matches_torch(backend):
    generator = torch.Generator().manual_seed(0)
    start = torch.randn(70_000, generator=generator)
    ours, theirs = start.clone(), torch.nn.Parameter(start.clone())
    optimizer = torch.optim.Adam([theirs], lr=3e-3, betas=(0.9, 0.999), eps=1e-15, foreach=False)
    mean, mean_square = torch.zeros_like(start), torch.zeros_like(start)
    for step in range(1, 6):
        gradient = torch.randn(70_000, generator=generator)
        gradient[:100] = 0
        backend.adam_step(ours, gradient, mean, mean_square, 3e-3, 0.9, 0.999, 1e-15, step)
        theirs.grad = gradient
        optimizer.step()
    torch.testing.assert_close(ours, theirs.detach(), rtol=1e-6, atol=1e-7)
    assert torch.equal(ours[:100], start[:100])
