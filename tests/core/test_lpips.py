# SPDX-License-Identifier: GPL-3.0-or-later
"""LPIPS against its definition written out in numpy, on small random networks; real weights are the user's."""

import numpy as np
import pytest
import torch
from holoreel.core.errors import HoloreelError
from holoreel.core.lpips import LAYERS, Convolution, Lpips, _package_folder, _read_heads, distance, features, load_lpips

# Everything that the real networks have, few channels wide: stride, padding, pooling, layers that are not compared.
TINY = (
    Convolution(0, 3, 4, kernel=5, stride=2, padding=2, tapped=True),
    Convolution(3, 4, 3, pool=3),
    Convolution(5, 3, 5, pool=2, tapped=True),
)


def random_weights(layers, seed=0):
    random = np.random.default_rng(seed)
    weights = {}
    for layer in layers:
        shape = (layer.outputs, layer.inputs, layer.kernel, layer.kernel)
        weights[f"features.{layer.number}.weight"] = random.normal(0, 0.3, shape).astype(np.float32)
        weights[f"features.{layer.number}.bias"] = random.normal(0, 0.1, layer.outputs).astype(np.float32)
    return weights


def tensors(weights):
    return {name: torch.from_numpy(value) for name, value in weights.items()}


def pool_by_definition(x, window):
    rows, columns = ((side - window) // 2 + 1 for side in x.shape[1:])
    return np.array([
        [[plane[2 * i : 2 * i + window, 2 * j : 2 * j + window].max() for j in range(columns)] for i in range(rows)]
        for plane in x
    ])  # fmt: skip


def convolve_by_definition(x, weight, bias, stride, padding):
    x = np.pad(x, ((0, 0), (padding, padding), (padding, padding)))
    size = weight.shape[2]
    rows, columns = ((side - size) // stride + 1 for side in x.shape[1:])
    out = np.empty((len(weight), rows, columns))
    for i in range(rows):
        for j in range(columns):
            window = x[:, i * stride : i * stride + size, j * stride : j * stride + size]
            out[:, i, j] = (weight * window).sum(axis=(1, 2, 3)) + bias
    return np.maximum(out, 0)


def features_by_definition(picture, layers, weights):
    x = (picture.transpose(2, 0, 1) - np.array([-0.03, -0.088, -0.188])[:, None, None]) / np.array(
        [0.458, 0.448, 0.45]
    )[:, None, None]
    taps = []
    for layer in layers:
        if layer.pool:
            x = pool_by_definition(x, layer.pool)
        kernel, bias = (weights[f"features.{layer.number}.{part}"] for part in ("weight", "bias"))
        x = convolve_by_definition(x, kernel, bias, layer.stride, layer.padding)
        if layer.tapped:
            taps.append(x)
    return taps


def lpips_by_definition(a, b, layers, weights, heads):
    total = 0.0
    for x, y, head in zip(
        *(features_by_definition(picture, layers, weights) for picture in (a, b)), heads, strict=True
    ):
        x, y = (f / (np.sqrt((f**2).sum(axis=0)) + 1e-10) for f in (x, y))
        total += np.einsum("chw,c->hw", (x - y) ** 2, head).mean()
    return total


@pytest.fixture
def pair():
    random = np.random.default_rng(3)
    return random.random((19, 24, 3)), random.random((19, 24, 3))


@pytest.mark.parametrize("input_range", ["paper", "standard"])
def test_a_tiny_network_measures_by_the_definition(pair, input_range, monkeypatch):
    monkeypatch.setitem(LAYERS, "vgg", TINY)
    weights = random_weights(TINY)
    heads = [np.random.default_rng(n).random(layer.outputs) for n, layer in enumerate(TINY) if layer.tapped]
    measure = Lpips("vgg", tensors(weights), [torch.from_numpy(head).float() for head in heads], input_range)
    scaled = [2 * picture - 1 if input_range == "standard" else picture for picture in pair]
    assert measure(*pair) == pytest.approx(lpips_by_definition(*scaled, TINY, weights, heads), rel=1e-4)
    assert measure(pair[0], pair[0]) == 0.0


def test_the_two_input_ranges_differ(pair, monkeypatch):
    monkeypatch.setitem(LAYERS, "vgg", TINY)
    made = [
        Lpips("vgg", tensors(random_weights(TINY)), [torch.ones(4), torch.ones(5)], r) for r in ("paper", "standard")
    ]
    assert made[0](*pair) != pytest.approx(made[1](*pair), rel=0.01)


@pytest.mark.parametrize(
    ("network", "shapes"),
    [
        ("alex", [(64, 15, 15), (192, 7, 7), (384, 3, 3), (256, 3, 3), (256, 3, 3)]),
        ("vgg", [(64, 64, 64), (128, 32, 32), (256, 16, 16), (512, 8, 8), (512, 4, 4)]),
    ],
)
def test_the_networks_compare_the_layers_of_the_package(network, shapes):
    """The sizes of torchvision's networks at 64 x 64, at the ReLUs that LPIPS takes."""
    taps = features(torch.rand(1, 3, 64, 64), network, tensors(random_weights(LAYERS[network])))
    assert [tuple(tap.shape[1:]) for tap in taps] == shapes
    assert all(tap.min() >= 0 for tap in taps)


def test_distance_is_blind_to_the_length_of_features():
    a, b = [torch.rand(1, 6, 4, 5)], [torch.rand(1, 6, 4, 5)]
    head = [torch.rand(6)]
    assert distance([a[0] * 7], [b[0] * 0.2], head) == pytest.approx(distance(a, b, head), rel=1e-5)


@pytest.fixture
def folder(tmp_path):
    """Files as torchvision and the package `lpips` name and shape them, of random numbers."""
    torch.save(tensors(random_weights(LAYERS["alex"])), tmp_path / "alexnet-owt-7be5be79.pth")
    heads = {f"lin{i}.model.1.weight": torch.rand(1, n, 1, 1) for i, n in enumerate((64, 192, 384, 256, 256))}
    torch.save(heads, tmp_path / "alex.pth")
    return tmp_path


def test_weights_are_found_and_read(folder, pair):
    from safetensors.torch import save_file

    (measure,) = load_lpips(folder)
    (single,) = load_lpips(folder / "alexnet-owt-7be5be79.pth", input_range="paper")
    a, b = (np.tile(picture, (2, 2, 1)) for picture in pair)
    assert measure.name == "lpips_alex"
    assert measure(a, b) == single(a, b) > 0
    other = folder / "safe"
    other.mkdir()
    save_file(tensors(random_weights(LAYERS["alex"])), other / "alexnet.safetensors")
    (safe,) = load_lpips(other, heads=folder)
    assert safe(a, b) == measure(a, b)
    with pytest.raises(HoloreelError, match="at least 31 pixels"):
        measure(*pair)


def test_the_packages_linear_weights_are_read():
    """The real files, where somebody installed or unpacked the package; it is not imported."""
    places = _package_folder()
    if not places:
        pytest.skip("the package lpips is absent")
    for network, sizes in (("alex", [64, 192, 384, 256, 256]), ("vgg", [64, 128, 256, 512, 512])):
        heads = _read_heads(places[0] / f"{network}.pth", network)
        assert [len(head) for head in heads] == sizes
        assert all(head.min() >= 0 for head in heads)


def test_mistakes_get_a_sentence(folder):
    with pytest.raises(HoloreelError, match="does not exist"):
        load_lpips(folder / "nothing")
    empty = folder / "empty"
    empty.mkdir()
    with pytest.raises(HoloreelError, match="neither alexnet"):
        load_lpips(empty)
    with pytest.raises(HoloreelError, match=r"no alex\.pth"):
        load_lpips(folder, heads=empty)
    (empty / "alexnet.pth").write_bytes(b"not weights at all")
    with pytest.raises(HoloreelError, match="not a state dict"):
        load_lpips(empty, heads=folder)
    torch.save(tensors(random_weights(LAYERS["alex"][:3])), empty / "alexnet.pth")
    with pytest.raises(HoloreelError, match=r"features\.8\.weight is not a tensor of shape \[256, 384, 3, 3\]"):
        load_lpips(empty, heads=folder)
    torch.save([1, 2], empty / "alexnet.pth")
    with pytest.raises(HoloreelError, match="holds a list"):
        load_lpips(empty, heads=folder)
    broken = {f"lin{i}.model.1.weight": torch.rand(1, n, 1, 1) for i, n in enumerate((64, 192, 384, 256, 256))}
    broken["lin2.model.1.weight"][0, 5] = float("nan")
    torch.save(broken, empty / "alex.pth")
    with pytest.raises(HoloreelError, match="not finite"):
        load_lpips(folder, heads=empty)
