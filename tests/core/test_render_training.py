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
    assert float(loss.detach()) == pytest.approx(float(wanted.detach()), abs=1e-6)
    (3.0 * loss).backward()
    (3.0 * wanted).backward()
    assert (ours.grad.double() - oracle.grad).norm() <= 2e-4 * oracle.grad.norm() + 1e-9


def test_reference_ssim_matches_scikit_image_away_from_the_border():
    image, target = (picture.double() for picture in images(60, 70, 3, seed=2))
    _, theirs = structural_similarity(
        image.numpy(),
        target.numpy(),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=2,
        full=True,
    )
    ours = reference.ssim_map(image, target)[:, 0].permute(1, 2, 0).numpy()
    np.testing.assert_allclose(ours[5:-5, 5:-5], theirs[5:-5, 5:-5], atol=1e-9)


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
