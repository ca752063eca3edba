# SPDX-License-Identifier: GPL-3.0-or-later
"""The fused loss and optimizer step against torch and scikit-image."""

import numpy as np
import pytest
import torch
from holoreel.core.render import cpu, reference
from holoreel.core.render.contract import AdamGroup
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


@pytest.mark.parametrize("backend", [cpu, reference], ids=["cpu", "reference"])
def test_picture_loss_takes_bytes_and_tells_the_squared_error(backend):
    image, target = images(70, 52, 3, seed=4)
    target = (255 * target).round().to(torch.uint8)
    results = []
    for second in (target, target.float() / 255):
        picture = image.clone().requires_grad_()
        loss, squared_error = backend.picture_loss(picture, second, 0.2)
        loss.backward()
        results.append((float(loss.detach()), squared_error, picture.grad))
    assert results[0][0] == pytest.approx(results[1][0], rel=1e-6)
    assert results[0][1] == pytest.approx(float((image - target.double() / 255).square().mean()), rel=1e-6)
    assert results[0][1] == pytest.approx(results[1][1], rel=1e-6)
    torch.testing.assert_close(results[0][2], results[1][2], rtol=1e-4, atol=1e-9)
    with pytest.raises(ValueError, match=r"target is of torch\.int64"):
        backend.picture_loss(image, target.long(), 0.2)


def test_the_loss_can_be_differentiated_twice_over():
    image, target = images(20, 24, 3)
    image.requires_grad_()
    loss = cpu.l1_dssim(image, target, 0.2)
    first, second = (torch.autograd.grad(factor * loss, image, retain_graph=True)[0] for factor in (1.0, 2.0))
    assert torch.equal(2 * first, second)


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
def test_adam_matches_torch(backend):
    generator = torch.Generator().manual_seed(0)
    start = torch.randn(70_000, generator=generator)
    ours, theirs = start.clone(), torch.nn.Parameter(start.clone())
    optimizer = torch.optim.Adam([theirs], lr=3e-3, betas=(0.9, 0.999), eps=1e-15, foreach=False)
    mean, mean_square = torch.zeros_like(start), torch.zeros_like(start)
    for step in range(1, 6):
        gradient = torch.randn(70_000, generator=generator)
        gradient[:100] = 0
        backend.adam([AdamGroup(ours, gradient, mean, mean_square, 3e-3)], 0.9, 0.999, 1e-15, step)
        theirs.grad = gradient
        optimizer.step()
    torch.testing.assert_close(ours, theirs.detach(), rtol=1e-6, atol=1e-7)
    assert torch.equal(ours[:100], start[:100])


@pytest.mark.parametrize("backend", [cpu, reference], ids=["cpu", "reference"])
def test_adam_steps_all_groups_with_their_rates_and_bounds(backend):
    generator = torch.Generator().manual_seed(1)
    shapes = [(5000, 3, 3), (5000,), (5000, 9), (6, 12), (0, 3)]
    rates = [
        (0.1, torch.rand(5000, generator=generator), torch.rand(9, generator=generator)),
        (0.2, torch.rand(5000, generator=generator), None),
        (0.3, None, torch.rand(9, generator=generator)),
        (0.4, None, None),
        (0.5, None, None),
    ]
    values = [torch.randn(shape, generator=generator) for shape in shapes]
    start = [value.clone() for value in values]
    moments = [(torch.zeros_like(value), torch.zeros_like(value)) for value in values]
    wanted = [value.double() for value in values]
    wanted_moments = [(torch.zeros_like(value), torch.zeros_like(value)) for value in wanted]
    low, high = -0.5, 1.0
    for step in (1, 2, 3):
        gradients = [torch.randn(shape, generator=generator) for shape in shapes]
        groups = [
            AdamGroup(value, gradient, *pair, *rate, low, high)
            for value, gradient, pair, rate in zip(values, gradients, moments, rates, strict=True)
        ]
        backend.adam(groups, 0.9, 0.99, 1e-8, step)
        for k, gradient in enumerate(gradients):
            rate, rows, columns = rates[k]
            rows = torch.ones(shapes[k][:1]) if rows is None else rows
            columns = torch.ones(shapes[k][1:]) if columns is None else columns.reshape(shapes[k][1:])
            mean, square = wanted_moments[k]
            mean.mul_(0.9).add_(0.1 * gradient)
            square.mul_(0.99).add_(0.01 * gradient.double() ** 2)
            move = (mean / (1 - 0.9**step)) / ((square / (1 - 0.99**step)).sqrt() + 1e-8)
            move *= rate * columns * rows.reshape(-1, *[1] * (gradient.ndim - 1))
            wanted[k] = (wanted[k] - move).clamp(low, high)
    for ours, theirs, before in zip(values, wanted, start, strict=True):
        torch.testing.assert_close(ours, theirs.float(), rtol=1e-5, atol=1e-5)
        assert not len(ours) or not torch.equal(ours, before)


@pytest.mark.parametrize("backend", [cpu, reference], ids=["cpu", "reference"])
def test_adam_names_what_is_wrong(backend):
    good = [torch.zeros(4, 3) for _ in range(4)]
    with pytest.raises(ValueError, match="gradient must be"):
        backend.adam([AdamGroup(good[0], torch.zeros(4, 2), *good[2:], 1.0)], 0.9, 0.99, 1e-8, 1)
    with pytest.raises(ValueError, match="row_rates has shape"):
        backend.adam([AdamGroup(*good, 1.0, torch.ones(3))], 0.9, 0.99, 1e-8, 1)
    with pytest.raises(ValueError, match="column_rates has shape"):
        backend.adam([AdamGroup(*good, 1.0, None, torch.ones(4))], 0.9, 0.99, 1e-8, 1)
    with pytest.raises(ValueError, match="from 1"):
        backend.adam([AdamGroup(*good, 1.0)], 0.9, 0.99, 1e-8, 0)
