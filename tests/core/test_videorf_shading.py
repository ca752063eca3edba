# SPDX-License-Identifier: GPL-3.0-or-later
"""Deferred shading and the losses of the sequential training, against their formulas."""

import math

import numpy as np
import pytest
import torch
from holoreel.core.errors import HoloreelError
from holoreel.core.videorf import deferred, shading
from holoreel.core.videorf.deferred import DeferredShading
from holoreel.core.videorf.losses import noisy, rgb_loss, smooth_abs, spatial_loss, temporal_loss
from holoreel.core.videorf.shading import ShadingShape, read_shading, write_shading


def network(shape, seed=0):
    """A network whose every weight and bias is its own."""
    generator = torch.Generator().manual_seed(seed)
    made = DeferredShading(shape, generator)
    with torch.no_grad():
        for layer in made.layers:
            layer.bias.copy_(torch.randn(layer.bias.shape, generator=generator) * 0.3)
    return made


def inputs(features, count=20, seed=1):
    random = np.random.default_rng(seed)
    directions = random.normal(size=(count, 3))
    return random.normal(size=(count, features)), directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize("frequencies", [None, 0, 1, 4])
def test_network_is_its_formula(frequencies, tmp_path):
    shape = ShadingShape(7, frequencies, hidden=5)
    made = network(shape)
    f, d = inputs(7)
    colors = made(torch.from_numpy(f).float(), torch.from_numpy(d).float()).detach().numpy()
    numbers = made.numbers()
    assert numbers(f, d) == pytest.approx(colors, abs=1e-6)
    # One ray by hand, number by number.
    values = [*f[0]]
    if frequencies is not None:
        values += [*d[0]]
        for k in range(frequencies):
            values += [math.sin(2**k * x) for x in d[0]] + [math.cos(2**k * x) for x in d[0]]
    for index, (matrix, bias) in enumerate(numbers.layers):
        raw = [sum(w * x for w, x in zip(row, values, strict=True)) + b for row, b in zip(matrix, bias, strict=True)]
        values = [max(x, 0.0) for x in raw] if index < 2 else [1 / (1 + math.exp(-x)) for x in raw]
    assert values == pytest.approx(colors[0], abs=1e-6)
    # The file and the way back lose no bit.
    assert write_shading(tmp_path / "a.shading", numbers) == 4 * shape.count
    again = DeferredShading.of(read_shading(tmp_path / "a.shading", shape)).numbers()
    for mine, theirs in zip(again.layers, numbers.layers, strict=True):
        assert all((a == b).all() for a, b in zip(mine, theirs, strict=True))


def test_network_without_direction_does_not_see_it():
    f, d = inputs(4)
    blind, seeing = network(ShadingShape(4, None)).numbers(), network(ShadingShape(4, 2)).numbers()
    assert (blind(f, d) == blind(f, -d)).all()
    assert not (seeing(f, d) == seeing(f, -d)).any()


def test_fresh_networks_are_gray_and_learn():
    made = DeferredShading(ShadingShape(7, 1), torch.Generator().manual_seed(2))
    f, d = (torch.from_numpy(part).float() for part in inputs(7))
    f.requires_grad_()
    colors = made(f, d)
    assert (colors - 0.5).abs().max() < 0.25
    colors[:, 0].sum().backward()
    assert (f.grad.abs().sum(1) > 0).all()


def test_shading_files_are_judged(tmp_path):
    shape = ShadingShape(7, 1)
    path = tmp_path / "a.shading"
    write_shading(path, network(shape).numbers())
    data = path.read_bytes()
    for damaged, message in (
        (data[:-1], "does not hold the"),
        (data + b"\0", "does not hold the"),
        (data[:-4] + np.float32(np.nan).tobytes(), "not finite"),
    ):
        path.write_bytes(damaged)
        with pytest.raises(HoloreelError, match=message):
            read_shading(path, shape)
    with pytest.raises(HoloreelError, match="put it beside its reel"):
        read_shading(tmp_path / "none", shape)
    for wrong in ((0, 1, 16), (16, 1, 16), (7, -1, 16), (7, 9, 16), (7, 1, 0), (7, 1, 257)):
        with pytest.raises(HoloreelError, match="out of range"):
            ShadingShape(*wrong)


def test_composite_puts_the_background_behind():
    colors, left = np.array([[0.2, 0.4, 0.6]]), np.array([0.25])
    expected = [[0.75 * 0.2 + 0.25, 0.75 * 0.4 + 0.25, 0.75 * 0.6 + 0.25]]
    assert shading.composite(colors, left, 1.0) == pytest.approx(np.array(expected))
    mine = deferred.composite(torch.from_numpy(colors), torch.from_numpy(left), 1.0)
    assert mine.numpy() == pytest.approx(np.array(expected))


def plain_abs(x):
    return x * x / 2 if abs(x) < 1 else abs(x) - 0.5


@pytest.mark.parametrize("seam", [1.0, 0.25])
def test_spatial_loss_is_its_sum(seam):
    random = np.random.default_rng(0)
    image = random.normal(0, 2, (17, 19, 3))
    valid = random.random((17, 19)) < 0.8
    step = np.array([0.5, 1.0, 3.0])
    total = 0.0
    for v in range(17):
        for u in range(19):
            for dv, du in ((1, 0), (0, 1)):
                if v + dv < 17 and u + du < 19 and valid[v, u] and valid[v + dv, u + du]:
                    weight = seam if (v + dv) % 8 * dv + (u + du) % 8 * du == 0 else 1.0
                    difference = (image[v + dv, u + du] - image[v, u]) / step
                    total += weight * sum(map(plain_abs, difference))
    loss = spatial_loss(torch.from_numpy(image), torch.from_numpy(valid), torch.from_numpy(step), seam)
    assert float(loss) == pytest.approx(total / valid.sum())


def test_pixels_without_a_vertex_have_no_say():
    image = torch.rand(16, 16, 4, requires_grad=True)
    valid = torch.zeros(16, 16, dtype=torch.bool)
    valid[:8, :5] = True
    loss = spatial_loss(image, valid, torch.full((4,), 0.1))
    loss.backward()
    assert (image.grad[~valid] == 0).all()
    assert (image.grad[valid] != 0).any()
    assert float(spatial_loss(image.detach(), torch.zeros_like(valid), torch.ones(4))) == 0


def test_temporal_loss_pulls_to_the_frame_before_alone():
    random = np.random.default_rng(0)
    rows, previous, step = random.normal(0, 3, (30, 4)), random.normal(0, 3, (30, 4)), np.array([0.5, 1, 2, 4.0])
    mine = torch.from_numpy(rows).requires_grad_()
    before = torch.from_numpy(previous).requires_grad_()
    loss = temporal_loss(mine, before, torch.from_numpy(step))
    expected = sum(plain_abs(x) for x in ((rows - previous) / step).ravel()) / 30
    assert float(loss.detach()) == pytest.approx(expected)
    loss.backward()
    assert before.grad is None
    slope = np.clip((rows - previous) / step, -1, 1) / step / 30
    assert mine.grad.numpy() == pytest.approx(slope)


def test_color_loss_and_noise():
    assert float(rgb_loss(torch.tensor([[0.5, 0, 0], [0, 0, 1.0]]), torch.zeros(2, 3))) == pytest.approx(0.625)
    assert smooth_abs(torch.tensor([-3.0, 0.5])).tolist() == pytest.approx([2.5, 0.125])
    step = torch.tensor([0.1, 4.0])
    shift = noisy(torch.zeros(4000, 2), step, torch.Generator().manual_seed(0)) / step
    assert shift.abs().max() <= 0.5
    assert shift.std(0).tolist() == pytest.approx([1 / math.sqrt(12)] * 2, rel=0.05)
    assert shift.mean(0).abs().max() < 0.02
