# SPDX-License-Identifier: GPL-3.0-or-later
"""The trained tensors: Adam against torch's own, and surgery that keeps values and moments together."""

import numpy as np
import pytest
import torch
from holoreel.core.gaussians.config import DensityConfig
from holoreel.core.gaussians.density import SceneScale, densify, empty_stats, prune, reset_opacities
from holoreel.core.gaussians.model import SpacetimeGaussians
from holoreel.core.gaussians.parameters import BETAS, EPSILON, Parameters
from holoreel.core.render import reference
from holoreel.core.render.reference import rotation_matrices

SCENE = SceneScale(footprint=0.01, nearest=1.0, centers=torch.zeros(1, 3))


def make_gaussians(count: int, seed: int = 0) -> SpacetimeGaussians:
    rng = np.random.default_rng(seed)
    return SpacetimeGaussians(
        means=rng.uniform(1, 2, (count, 3)),
        motions=rng.normal(0, 0.1, (count, 3, 3)),
        quats=rng.normal(size=(count, 4)),
        omegas=rng.normal(size=(count, 4)),
        log_scales=rng.uniform(-6, -3, (count, 3)),
        opacity_logits=rng.normal(size=count),
        features=rng.uniform(0, 1, (count, 3)),
        trbf_centers=rng.uniform(0, 1, count),
        trbf_log_scales=rng.uniform(-1, 1, count),
    )


def test_adam_is_torchs_adam() -> None:
    parameters = Parameters(make_gaussians(7))
    rates = {name: 10.0 ** -(index % 4) for index, name in enumerate(parameters.tensors)}
    twins = {name: value.detach().double().clone().requires_grad_() for name, value in parameters.tensors.items()}
    groups = [{"params": [twins[name]], "lr": rate} for name, rate in rates.items()]
    adam = torch.optim.Adam(groups, betas=BETAS, eps=EPSILON)
    rng = torch.Generator().manual_seed(0)
    for _ in range(5):
        for name, value in parameters.tensors.items():
            value.grad = torch.randn(value.shape, generator=rng)
            twins[name].grad = value.grad.double()
        parameters.step(rates, reference)
        adam.step()
    for name, value in parameters.tensors.items():
        torch.testing.assert_close(value.detach().double(), twins[name].detach(), rtol=2e-5, atol=2e-5)
        assert value.grad is None


def test_keep_and_append_move_moments_with_their_rows() -> None:
    parameters = Parameters(make_gaussians(6))
    for name in parameters.tensors:
        parameters.first[name][:] = torch.arange(6.0).reshape(-1, *[1] * (parameters.first[name].dim() - 1))
    means = parameters.tensors["means"].detach().clone()
    parameters.keep(torch.tensor([4, 1]))
    parameters.append(parameters.rows(torch.tensor([0])))
    assert torch.equal(parameters.tensors["means"].detach(), means[[4, 1, 4]])
    for name in parameters.tensors:
        assert parameters.first[name].flatten(1).select(1, 0).tolist() == [4, 1, 0] if name == "means" else True
        assert len(parameters.first[name]) == len(parameters.second[name]) == 3
        assert parameters.tensors[name].is_leaf
        assert parameters.tensors[name].requires_grad


def test_densify_clones_small_splits_large_and_leaves_the_rest() -> None:
    parameters = Parameters(make_gaussians(3))
    with torch.no_grad():
        parameters.tensors["log_scales"][:] = torch.log(torch.tensor([[0.001], [0.5], [0.5]]))
    before = parameters.rows(torch.arange(3))
    stats = empty_stats(3)
    stats.gradient[:] = torch.tensor([1.0, 1.0, 0.0])
    stats.views[:] = 1
    added = densify(parameters, stats, DensityConfig(), SCENE, 100, torch.Generator().manual_seed(0))
    assert added == 2
    assert len(parameters) == 5  # 0 and its clone, 1's two children, 2
    after = parameters.tensors
    assert torch.equal(after["means"][:2], before["means"][[0, 2]])
    assert torch.equal(after["means"][2], before["means"][0])
    torch.testing.assert_close(after["log_scales"][3:].exp(), torch.full((2, 3), 0.5 / 1.6))
    assert not torch.equal(after["means"][3], after["means"][4])


def test_densify_respects_the_limit() -> None:
    parameters = Parameters(make_gaussians(50))
    stats = empty_stats(50)
    stats.gradient[:] = torch.linspace(1, 2, 50)
    stats.views[:] = 1
    densify(parameters, stats, DensityConfig(max_gaussians=60), SCENE, 100, torch.Generator().manual_seed(0))
    assert len(parameters) == 60
    full = Parameters(make_gaussians(50))
    assert densify(full, stats, DensityConfig(max_gaussians=50), SCENE, 100, torch.Generator()) == 0


def test_prune_takes_the_invisible_the_broken_and_the_near() -> None:
    parameters = Parameters(make_gaussians(5))
    with torch.no_grad():
        parameters.tensors["opacity_logits"][:] = 2.0
        parameters.tensors["trbf_centers"][:] = 0.5
        parameters.tensors["opacity_logits"][0] = -8.0  # too faint
        parameters.tensors["trbf_centers"][1], parameters.tensors["trbf_log_scales"][1] = 3.0, -3.0  # never there
        parameters.tensors["omegas"][2, 3] = float("nan")  # broken
        parameters.tensors["means"][3] = torch.tensor([0.0, 0.0, 0.1])  # in front of a camera
    keep = prune(parameters, torch.tensor([0.0, 0.5]), DensityConfig(prune_depth=0.2), SCENE)
    assert keep.tolist() == [False, False, False, False, True]
    assert len(parameters) == 1


def test_reset_caps_opacities_and_forgets_their_momentum() -> None:
    parameters = Parameters(make_gaussians(4))
    parameters.first["opacity_logits"][:] = 1.0
    reset_opacities(parameters, 0.01)
    assert float(parameters.tensors["opacity_logits"].detach().sigmoid().max()) == pytest.approx(0.01, rel=1e-5)
    assert not parameters.first["opacity_logits"].any()


def test_rotations_are_rotations_and_zero_is_none() -> None:
    matrices = rotation_matrices(
        torch.cat([torch.randn(20, 4, generator=torch.Generator().manual_seed(0)), torch.zeros(1, 4)])
    )
    torch.testing.assert_close(matrices @ matrices.mT, torch.eye(3).expand(21, 3, 3), rtol=0, atol=1e-5)
    assert torch.equal(matrices[-1], torch.eye(3))
    quarter = rotation_matrices(torch.tensor([[1.0, 0.0, 0.0, 1.0]]))[0]  # 90° about z takes x to y
    torch.testing.assert_close(quarter[:, 0], torch.tensor([0.0, 1.0, 0.0]))
