# SPDX-License-Identifier: GPL-3.0-or-later
"""Relocation: copies look like what they were copied from, the dead go where the living are, limits hold."""

import numpy as np
import pytest
import torch
from holoreel.core.gaussians.config import McmcConfig, TrainConfig
from holoreel.core.gaussians.mcmc import McmcControl, grow, multiply, relocate, share, wander
from holoreel.core.gaussians.model import SpacetimeGaussians
from holoreel.core.gaussians.parameters import Parameters
from holoreel.core.gaussians.scale import SceneScale

SCENE = SceneScale(
    footprint=0.01,
    nearest=1.0,
    centers=torch.zeros(1, 3),
    extent=2.0,
    box=torch.tensor([[0.0] * 3, [3.0] * 3]),
    axes=torch.tensor([[0.0, 0.0, 1.0]]),
    cosines=torch.tensor([0.5]),
    focals=torch.tensor([100.0]),
)


def make(count: int, opacities: np.ndarray | None = None) -> Parameters:
    rng = np.random.default_rng(0)
    opacities = rng.uniform(0.1, 0.9, count) if opacities is None else opacities
    gaussians = SpacetimeGaussians(
        means=rng.uniform(1, 2, (count, 3)),
        motions=rng.normal(0, 0.1, (count, 3, 3)),
        quats=rng.normal(size=(count, 4)),
        omegas=rng.normal(size=(count, 4)),
        log_scales=rng.uniform(-6, -3, (count, 3)),
        opacity_logits=np.log(opacities / (1 - opacities)),
        features=rng.uniform(0, 1, (count, 3)),
        trbf_centers=rng.uniform(0, 1, count),
        trbf_log_scales=np.full(count, 1.0),
    )
    parameters = Parameters(gaussians, measure=SCENE.footprints)
    for name in parameters.first:
        parameters.first[name] += 1.0
    return parameters


@pytest.mark.parametrize("copies", [1, 2, 5, 20])
def test_copies_together_look_like_one(copies: int) -> None:
    """Composited along a line: the same opacity in the middle, and about the same area under the profile."""
    opacity = torch.tensor([0.3, 0.9])
    new, factor = share(opacity, torch.tensor([copies, copies]))
    torch.testing.assert_close(1 - (1 - new) ** copies, opacity, rtol=1e-4, atol=1e-6)
    x = np.linspace(-12, 12, 4001)
    for o, o_new, s in zip(opacity.tolist(), new.tolist(), factor.tolist(), strict=True):
        one = o * np.exp(-0.5 * x**2)
        many = 1 - (1 - o_new * np.exp(-0.5 * (x / s) ** 2)) ** copies
        assert np.trapezoid(many, x) == pytest.approx(np.trapezoid(one, x), rel=1e-4)


def test_multiply_puts_copies_where_it_is_told() -> None:
    parameters = make(6)
    before = parameters.rows(torch.arange(6))
    multiply(parameters, torch.tensor([4, 4]), torch.tensor([0, 2]))
    after = parameters.tensors
    assert len(parameters) == 6
    for row in (0, 2, 4):
        assert torch.equal(after["means"][row], before["means"][4])
        assert torch.equal(after["motions"][row], before["motions"][4])
    opacity, factor = share(before["opacity_logits"][4:5].sigmoid(), torch.tensor([3]))
    torch.testing.assert_close(after["opacity_logits"][[0, 2, 4]].sigmoid(), opacity.expand(3), rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(after["log_scales"][2], before["log_scales"][4] + factor.log())
    assert torch.equal(after["means"][[1, 3, 5]], before["means"][[1, 3, 5]])
    assert torch.equal(after["opacity_logits"][[1, 3, 5]], before["opacity_logits"][[1, 3, 5]])
    for moments in parameters.first.values():
        assert not moments[[0, 2, 4]].any()
        assert (moments[[1, 3, 5]] == 1).all()
    assert torch.equal(parameters.units[[0, 2]], parameters.units[[4, 4]])


def test_the_dead_go_to_the_living_in_proportion_to_opacity() -> None:
    opacities = np.concatenate([np.full(2000, 0.001), [0.8], [0.2], [0.4]])
    parameters = make(2003, opacities)
    places = parameters.tensors["means"][-3:].clone()
    dead = torch.arange(2003) < 2000
    assert relocate(parameters, dead, torch.Generator().manual_seed(0)) == 2000
    went = [(parameters.tensors["means"][:2000] == place).all(dim=1).sum().item() for place in places]
    assert sum(went) == 2000
    np.testing.assert_allclose(np.array(went) / 2000, np.array([0.8, 0.2, 0.4]) / 1.4, atol=0.05)
    assert relocate(parameters, torch.ones(2003, dtype=torch.bool), torch.Generator()) == 0


def test_growing_adds_rows() -> None:
    parameters = make(10)
    grow(parameters, 5, torch.Generator().manual_seed(0))
    assert len(parameters) == len(parameters.units) == len(parameters.stats.views) == 15
    known = parameters.tensors["means"][:10].tolist()
    assert all(mean in known for mean in parameters.tensors["means"][10:].tolist())


def test_wandering_has_the_shape_of_the_covariance_and_spares_the_opaque() -> None:
    count = 4000
    parameters = make(count, np.where(np.arange(count) < 2000, 0.001, 0.5))
    with torch.no_grad():
        parameters.tensors["log_scales"][:] = torch.log(torch.tensor([0.01, 0.002, 0.0005]))
        parameters.tensors["quats"][:] = torch.tensor([1.0, 0, 0, 0])
    before = parameters.tensors["means"].clone()
    strength, unit = 0.1, parameters.units[:2000].mean()
    wander(parameters, strength, torch.Generator().manual_seed(0))
    moved = (parameters.tensors["means"] - before).detach()
    assert moved[2000:].abs().max() < 1e-9
    spread = moved[:2000].std(dim=0) / (strength / unit * torch.sigmoid(torch.tensor(0.4)))
    torch.testing.assert_close(spread, torch.tensor([1e-4, 4e-6, 2.5e-7]), rtol=0.2, atol=0)


def test_weights_pull_opacity_and_size_down_as_autograd_says() -> None:
    parameters = make(7)
    config = TrainConfig(strategy="mcmc", mcmc=McmcConfig(opacity_weight=0.3, scale_weight=0.2))
    logits, scales = parameters.tensors["opacity_logits"], parameters.tensors["log_scales"]
    loss = 0.3 * logits.sigmoid().mean() + 0.2 * (scales.exp() / parameters.units[:, None]).mean()
    wanted = torch.autograd.grad(loss, (logits, scales))
    logits.grad, scales.grad = torch.ones_like(logits), torch.ones_like(scales)
    McmcControl(config, SCENE, torch.tensor([0.0])).before_step(parameters)
    torch.testing.assert_close(logits.grad - 1, wanted[0], rtol=1e-3, atol=1e-6)
    torch.testing.assert_close(scales.grad - 1, wanted[1], rtol=1e-3, atol=1e-6)


def test_the_number_grows_to_its_limit_and_no_further() -> None:
    density = TrainConfig().density
    config = TrainConfig(
        iterations=1000,
        strategy="mcmc",
        mcmc=McmcConfig(every=10, growth=0.2, start=0.1, stop=0.5),
        density=type(density)(max_gaussians=40, prune_depth=0.0),
    )
    control, parameters = McmcControl(config, SCENE, torch.tensor([0.0, 0.5])), make(20)
    counts = []
    for iteration in range(1, 1000):
        with torch.no_grad():
            control.after_step(parameters, iteration, 50.0, 1.0, torch.Generator().manual_seed(iteration))
        counts.append(len(parameters))
    assert counts[98] == 20
    assert counts[-1] == max(counts) == 40
