# SPDX-License-Identifier: GPL-3.0-or-later
"""The decoder of full models against its formula in float64 numpy, values and gradients."""

import math

import numpy as np
import pytest
import torch
from holoreel.core.camera import Camera
from holoreel.core.errors import HoloreelError
from holoreel.core.render import cpu, reference

TOLERANCE = 1e-5  # relative, L2


def camera_at(width, height):
    """An oblong, turned camera far from the origin whose principal point is off the middle."""
    a, b = 0.4, -0.3
    turn = np.array([[math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)]])
    turn = turn @ np.array([[1, 0, 0], [0, math.cos(b), -math.sin(b)], [0, math.sin(b), math.cos(b)]])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, (1.5, -0.7, 2.9)
    return Camera(width, height, 0.8 * width, 0.9 * width, 0.2 * width, 0.8 * height, pose)


def rays(camera):
    """Return (H, W, 6) origins and unit directions, from the camera's numbers alone."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    local = np.stack((*np.meshgrid(x, y), np.ones((camera.height, camera.width))), 2)
    turn, shift = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    directions = local @ turn / np.linalg.norm(local, axis=2, keepdims=True)
    return np.concatenate((np.broadcast_to(-turn.T @ shift, directions.shape), directions), 2)


def formula(features, camera, hidden, output, activation, incoming):
    """Return (colors, and the gradients of features, hidden and output), all float64."""
    inputs = np.concatenate((features[..., 3:], rays(camera)), 2)
    units = np.maximum(inputs @ hidden.T, 0)
    raw = features[..., :3] + units @ output.T
    if activation == "sigmoid":
        colors = 1 / (1 + np.exp(-raw))
        d_raw = incoming * colors * (1 - colors)
    elif activation == "clamp":
        colors, d_raw = np.clip(raw, 0, 1), incoming * ((raw >= 0) & (raw <= 1))
    else:
        colors, d_raw = raw, incoming
    d_units = d_raw @ output * (units > 0)
    d_features = np.concatenate((d_raw, d_units @ hidden[:, :6]), 2)
    d_hidden = np.einsum("hwj,hwk->jk", d_units, inputs)
    return colors, d_features, d_hidden, np.einsum("hwc,hwj->cj", d_raw, units)


def case(width, height, seed=0):
    """Return (features, camera, hidden, output, incoming gradient); colors reach beyond [0, 1]."""
    random = np.random.default_rng(seed)
    camera = camera_at(width, height)
    features = random.normal(0.5, 0.6, (height, width, 9))
    arrays = (
        features,
        random.normal(0, 0.5, (6, 12)),
        random.normal(0, 0.5, (3, 6)),
        random.normal(size=(height, width, 3)),
    )
    features, hidden, output, incoming = (array.astype(np.float32).astype(np.float64) for array in arrays)
    return features, camera, hidden, output, incoming


def run(backend, dtype, features, camera, hidden, output, activation, incoming):
    """Return (colors, gradients) of a backend, as float64."""
    tensors = [torch.tensor(array, dtype=dtype, requires_grad=True) for array in (features, hidden, output)]
    colors = backend.decode(tensors[0], camera, *tensors[1:], activation)
    colors.backward(torch.tensor(incoming, dtype=dtype))
    return [colors.detach().double().numpy(), *(tensor.grad.double().numpy() for tensor in tensors)]


def relative(ours, oracle):
    """The relative L2 distance."""
    return np.linalg.norm(ours - oracle) / np.linalg.norm(oracle)


@pytest.fixture(params=["8-lanes", "4-lanes", "reference-float32", "reference-float64"])
def backend(request):
    """Yield (backend, dtype, tolerance): the kernels of both widths, and plain torch."""
    if request.param.startswith("reference"):
        double = request.param.endswith("64")
        yield reference, torch.float64 if double else torch.float32, 1e-12 if double else TOLERANCE
        return
    try:
        cpu.set_lanes(int(request.param[0]))
    except HoloreelError:
        pytest.skip(f"no kernels of {request.param} on this machine")
    yield cpu, torch.float32, TOLERANCE
    cpu.set_lanes(0)


@pytest.mark.parametrize("activation", ["sigmoid", "clamp", "none"])
@pytest.mark.parametrize("size", [(67, 45), (8, 1), (1, 5), (130, 3)])
def test_decode_matches_the_formula(backend, size, activation):
    backend, dtype, tolerance = backend
    features, camera, hidden, output, incoming = case(*size)
    inputs = np.concatenate((features[..., 3:], rays(camera)), 2) @ hidden.T
    raw = features[..., :3] + np.maximum(inputs, 0) @ output.T
    kinks = (np.abs(inputs).min(2) < 1e-5) | (np.minimum(np.abs(raw), np.abs(raw - 1)).min(2) < 1e-5)
    incoming[kinks] = 0  # single precision may fall on the other side
    wanted = formula(features, camera, hidden, output, activation, incoming)
    got = run(backend, dtype, features, camera, hidden, output, activation, incoming)
    assert np.abs(got[0] - wanted[0]).max() <= 20 * tolerance * np.abs(wanted[0]).max()
    for ours, oracle in zip(got, wanted, strict=True):
        assert relative(ours, oracle) <= tolerance


def test_extreme_colors_stay_finite():
    features, camera, hidden, output, incoming = case(16, 16)
    features[..., :3] = np.linspace(-1e4, 1e4, 16 * 16 * 3).reshape(16, 16, 3)
    got = run(cpu, torch.float32, features, camera, 0 * hidden, output, "sigmoid", incoming)
    assert all(np.isfinite(array).all() for array in got)
    assert got[0].min() >= 0
    assert got[0].max() == 1


def test_same_bits_for_any_number_of_threads():
    arguments = case(70, 90)
    results = []
    for threads in (1, 2, 5):
        cpu.set_threads(threads)
        results.append(run(cpu, torch.float32, *arguments[:4], "sigmoid", arguments[4]))
    cpu.set_threads(2)
    assert all(np.array_equal(a, b) for result in results for a, b in zip(result, results[0], strict=True))


@pytest.mark.parametrize("backend", [cpu, reference], ids=["cpu", "reference"])
def test_wrong_arguments_are_named(backend):
    features, camera, hidden, output, _ = (torch.tensor(a) if isinstance(a, np.ndarray) else a for a in case(8, 6))
    with pytest.raises(ValueError, match="features has shape"):
        backend.decode(features[:, :7], camera, hidden, output, "none")
    with pytest.raises(ValueError, match="hidden has shape"):
        backend.decode(features, camera, hidden.T, output, "none")
    with pytest.raises(ValueError, match="output has shape"):
        backend.decode(features, camera, hidden, output[:2], "none")
    with pytest.raises(ValueError, match="activation is 'tanh'"):
        backend.decode(features, camera, hidden, output, "tanh")
