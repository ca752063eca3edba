# SPDX-License-Identifier: GPL-3.0-or-later
"""The trained tensors: Adam against torch's own, and surgery that keeps values and moments together."""

import numpy as np
import pytest
import torch
from holoreel.core.gaussians.config import DensityConfig
from holoreel.core.gaussians.density import (
    broken_rows,
    densify,
    near_rows,
    outside_rows,
    peak_opacity,
    prune,
    reset_opacities,
)
from holoreel.core.gaussians.model import SpacetimeGaussians
from holoreel.core.gaussians.parameters import BETAS, EPSILON, Parameters, Rate
from holoreel.core.gaussians.scale import SceneScale
from holoreel.core.render import reference
from holoreel.core.render.reference import rotation_matrices

SCENE = SceneScale(
    footprint=0.01,
    nearest=1.0,
    centers=torch.zeros(1, 3),
    extent=2.0,
    box=torch.tensor([[-9.0] * 3, [1.9] * 3]),
    axes=torch.tensor([[0.0, 0.0, 1.0]]),
    cosines=torch.tensor([0.5]),
    focals=torch.tensor([100.0]),
)


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
        parameters.step({name: Rate(rate) for name, rate in rates.items()}, reference)
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


def measured(count: int, **values: object) -> Parameters:
    """Parameters whose unit of length is one pixel of the camera of `SCENE`."""
    return Parameters(make_gaussians(count, **values), measure=SCENE.footprints)


def test_densify_clones_small_splits_large_and_leaves_the_rest() -> None:
    parameters = measured(3)
    with torch.no_grad():
        parameters.tensors["log_scales"][:] = torch.log(torch.tensor([[0.001], [0.5], [0.5]]))
    before = parameters.rows(torch.arange(3))
    parameters.stats.gradient[:] = torch.tensor([1.0, 1.0, 0.0])
    parameters.stats.views[:] = 1
    added = densify(parameters, DensityConfig(), 50.0, torch.Generator().manual_seed(0))
    assert added == 2
    assert len(parameters) == 5  # 0 and its clone, 1's two children, 2
    after = parameters.tensors
    assert torch.equal(after["means"][:2], before["means"][[0, 2]])
    assert torch.equal(after["means"][2], before["means"][0])
    torch.testing.assert_close(after["log_scales"][3:].exp(), torch.full((2, 3), 0.5 / 1.6))
    assert not torch.equal(after["means"][3], after["means"][4])
    torch.testing.assert_close(parameters.units, SCENE.footprints(after["means"].detach()))
    assert not parameters.stats.gradient.any()
    assert len(parameters.stats.views) == 5
    assert torch.equal(after["trbf_centers"][3], before["trbf_centers"][1])


def test_children_have_random_times_where_asked() -> None:
    parameters = measured(40)
    parameters.stats.gradient[:], parameters.stats.views[:] = 1.0, 1
    before = set(parameters.tensors["trbf_centers"].tolist())
    densify(parameters, DensityConfig(random_centers=True), 50.0, torch.Generator().manual_seed(0))
    fresh = [center for center in parameters.tensors["trbf_centers"].tolist() if center not in before]
    assert len(fresh) >= 40
    assert min(fresh) >= 0
    assert max(fresh) < 1


def test_a_batch_asks_for_the_same_pull() -> None:
    """The loss of a step is the mean of its pictures, and so are the gradients of each of them."""
    one, two = measured(30), measured(30)
    one.stats.gradient[:], two.stats.gradient[:] = torch.linspace(0, 4e-5, 30), torch.linspace(0, 2e-5, 30)
    one.stats.views[:], two.stats.views[:] = 1, 1
    config = DensityConfig()
    added = densify(one, config, 50.0, torch.Generator().manual_seed(0))
    assert 0 < added < 30
    assert densify(two, config, 100.0, torch.Generator().manual_seed(0)) == added


def test_densify_respects_the_limit() -> None:
    parameters = measured(50)
    parameters.stats.gradient[:] = torch.linspace(1, 2, 50)
    parameters.stats.views[:] = 1
    densify(parameters, DensityConfig(max_gaussians=60), 50.0, torch.Generator().manual_seed(0))
    assert len(parameters) == 60
    full = measured(50)
    full.stats.gradient[:], full.stats.views[:] = 1.0, 1
    assert densify(full, DensityConfig(max_gaussians=50), 50.0, torch.Generator()) == 0


def test_prune_takes_the_invisible_the_broken_the_near_and_the_far_and_counts_them() -> None:
    parameters = measured(6)
    times = torch.tensor([0.0, 0.5])
    with torch.no_grad():
        parameters.tensors["means"].clamp_(max=1.8)
        parameters.tensors["opacity_logits"][:] = 2.0
        parameters.tensors["trbf_centers"][:] = 0.5
        parameters.tensors["opacity_logits"][0] = -8.0  # too faint
        parameters.tensors["trbf_centers"][1], parameters.tensors["trbf_log_scales"][1] = 3.0, -3.0  # never there
        parameters.tensors["omegas"][2, 3] = float("nan")  # broken
        parameters.tensors["means"][3] = torch.tensor([0.0, 0.0, 0.1])  # in front of a camera
        parameters.tensors["means"][5] = 5.0  # outside the seeds' box
    kept = parameters.tensors["means"][4].clone()
    causes = {
        "broken": broken_rows(parameters),
        "faint": peak_opacity(parameters, times) < 0.02,
        "near": near_rows(parameters, SCENE, 0.2),
        "outside": outside_rows(parameters, SCENE),
    }
    assert [rows.tolist() for rows in causes.values()] == [
        [row == 2 for row in range(6)],
        [row in (0, 1) for row in range(6)],
        [row == 3 for row in range(6)],
        [row == 5 for row in range(6)],
    ]
    causes["again"] = causes["near"]
    assert prune(parameters, causes) == {"broken": 1, "faint": 2, "near": 1, "outside": 1, "again": 0}
    assert len(parameters) == 1
    assert torch.equal(parameters.tensors["means"][0], kept)


@pytest.mark.parametrize("frames", [1, 2, 7])
def test_peak_opacity_is_the_largest_over_the_frames(frames: int) -> None:
    model = make_gaussians(60)
    model.trbf_centers = np.random.default_rng(1).uniform(-0.5, 1.5, 60).astype(np.float32)
    times = np.arange(frames) / frames
    wanted = np.max([model.evaluate(time).opacities for time in times], axis=0)
    found = peak_opacity(Parameters(model), torch.tensor(times, dtype=torch.float32))
    np.testing.assert_allclose(found.numpy(), wanted, rtol=1e-4, atol=1e-7)


def test_rates_may_differ_by_row_and_zero_means_frozen() -> None:
    """Adam does not care how large gradients are, so a rate of ten is ten steps' worth of moving."""
    parameters = Parameters(make_gaussians(4), {"hidden": torch.ones(6, 12), "output": torch.ones(3, 6)})
    before = {name: value.detach().clone() for name, value in (parameters.tensors | parameters.network).items()}
    for value in (*parameters.tensors.values(), *parameters.network.values()):
        value.grad = torch.full_like(value, 1e-6)
    rates = dict.fromkeys(before, Rate(0.0)) | {
        "means": Rate(2.0, torch.tensor([0.5, 5.0, 0.0, 1.0])),
        "motions": Rate(1.0, None, torch.tensor([1.0] * 3 + [0.0] * 6)),
        "hidden": Rate(0.5),
        "features": Rate(0.1, None, None, 0.5, 0.6),
    }
    parameters.step(rates, reference)
    moved = {name: before[name] - value.detach() for name, value in (parameters.tensors | parameters.network).items()}
    torch.testing.assert_close(moved["means"], torch.tensor([[1.0], [10.0], [0.0], [2.0]]).expand(4, 3))
    torch.testing.assert_close(moved["hidden"], torch.full((6, 12), 0.5))
    torch.testing.assert_close(moved["motions"], torch.tensor([1.0, 0.0, 0.0])[:, None].expand(4, 3, 3))
    assert parameters.tensors["features"].min() >= 0.5
    assert parameters.tensors["features"].max() <= 0.6
    assert not any(value.any() for name, value in moved.items() if rates[name].rate == 0.0)


def test_state_keeps_everything() -> None:
    parameters = Parameters(make_gaussians(5), {"hidden": torch.ones(6, 12), "output": torch.ones(3, 6)})
    parameters.stats.gradient[:] = torch.arange(5.0)
    parameters.units *= 3
    again = Parameters.from_state(parameters.state())
    assert again.state().keys() == parameters.state().keys()
    assert torch.equal(again.units, parameters.units)
    assert torch.equal(again.stats.gradient, parameters.stats.gradient)
    again.units += 1
    assert not torch.equal(again.units, parameters.units)  # a copy


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
