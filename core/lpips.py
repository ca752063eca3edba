# SPDX-License-Identifier: GPL-3.0-or-later
"""LPIPS (Zhang et al. 2018, version 0.1) of AlexNet and VGG16, from weights that the user has.

The distance of two pictures is a weighted mean of squared differences between unit-length features of five layers:
sum over layers l of mean over pixels of w_l · (f_l(a) / |f_l(a)| - f_l(b) / |f_l(b)|)². The features are those of
torchvision's ImageNet networks (alexnet-*.pth, vgg16-*.pth, or .safetensors with the same names), the linear weights
w_l those of the package `lpips` (its files weights/v0.1/alex.pth and vgg.pth, read without importing it).

The networks were made for pictures in [-1, 1] (`standard`). The paper's code, like much that followed, gives them
[0, 1] without scaling (`paper`), which yields other numbers: compare only what was measured alike.
"""

import importlib.util
import pickle
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from .errors import HoloreelError

Network = Literal["alex", "vgg"]
InputRange = Literal["paper", "standard"]
NETWORKS: tuple[Network, ...] = get_args(Network)

_MEAN = (-0.030, -0.088, -0.188)  # of pictures in [-1, 1], subtracted by LPIPS
_DEVIATION = (0.458, 0.448, 0.450)
_EPSILON = 1e-10
_MAX_BYTES = 1 << 30  # VGG16 with its classifier has 528 MB
_MIN_SIDE = {"alex": 31, "vgg": 16}  # pixels that five layers need


@dataclass(frozen=True)
class Convolution:
    """A convolution with ReLU: its number among torchvision's `features`, its shape, and what goes before and after.

    `pool` is the window of a maximum pooling (stride 2) before it; `tapped` says that its output is compared.
    """

    number: int
    inputs: int
    outputs: int
    kernel: int = 3
    stride: int = 1
    padding: int = 1
    pool: int = 0
    tapped: bool = False


LAYERS: dict[Network, tuple[Convolution, ...]] = {
    "alex": (
        Convolution(0, 3, 64, kernel=11, stride=4, padding=2, tapped=True),
        Convolution(3, 64, 192, kernel=5, padding=2, pool=3, tapped=True),
        Convolution(6, 192, 384, pool=3, tapped=True),
        Convolution(8, 384, 256, tapped=True),
        Convolution(10, 256, 256, tapped=True),
    ),
    "vgg": (
        Convolution(0, 3, 64),
        Convolution(2, 64, 64, tapped=True),
        Convolution(5, 64, 128, pool=2),
        Convolution(7, 128, 128, tapped=True),
        Convolution(10, 128, 256, pool=2),
        Convolution(12, 256, 256),
        Convolution(14, 256, 256, tapped=True),
        Convolution(17, 256, 512, pool=2),
        Convolution(19, 512, 512),
        Convolution(21, 512, 512, tapped=True),
        Convolution(24, 512, 512, pool=2),
        Convolution(26, 512, 512),
        Convolution(28, 512, 512, tapped=True),
    ),
}
_PATTERNS: dict[Network, tuple[str, ...]] = {
    "alex": ("alexnet*.pth", "alexnet*.pt", "alexnet*.safetensors"),
    "vgg": ("vgg16*.pth", "vgg16*.pt", "vgg16*.safetensors"),
}


def features(
    picture: Tensor, network: Network, weights: Mapping[str, Tensor], layers: tuple[Convolution, ...] | None = None
) -> list[Tensor]:
    """Return the compared layers' features (1, C, H, W) of a picture (1, 3, H, W), already centered and scaled."""
    taps = []
    for layer in LAYERS[network] if layers is None else layers:
        if layer.pool:
            picture = functional.max_pool2d(picture, layer.pool, 2)
        weight, bias = (weights[f"features.{layer.number}.{part}"] for part in ("weight", "bias"))
        picture = functional.conv2d(picture, weight, bias, layer.stride, layer.padding).relu()
        if layer.tapped:
            taps.append(picture)
    return taps


def distance(first: list[Tensor], second: list[Tensor], heads: list[Tensor]) -> float:
    """Return LPIPS from both pictures' features and the linear weights (C,) of each layer."""
    total = 0.0
    for a, b, head in zip(first, second, heads, strict=True):
        a, b = (x / (x.square().sum(dim=1, keepdim=True).sqrt() + _EPSILON) for x in (a, b))
        total += float(((a - b).square() * head[:, None, None]).sum(dim=1).mean())
    return total


class Lpips:
    """One of the two networks, ready to measure; `name` is the measure's name in tables: lpips_alex, lpips_vgg."""

    def __init__(
        self,
        network: Network,
        weights: Mapping[str, Tensor],
        heads: list[Tensor],
        input_range: InputRange = "paper",
    ):
        self.network, self.weights, self.heads, self.input_range = network, weights, heads, input_range
        self.name = f"lpips_{network}"

    def __call__(self, image: NDArray[np.floating], truth: NDArray[np.floating]) -> float:
        """Return the distance of two pictures (H, W, 3) in [0, 1]; raises `HoloreelError` where they are too small."""
        least = _MIN_SIDE[self.network]
        if min(image.shape[:2]) < least:
            raise HoloreelError(
                f"LPIPS ({self.network}) needs pictures of at least {least} pixels a side, not "
                f"{image.shape[1]}x{image.shape[0]}: render larger ones, or leave --lpips-weights away."
            )
        with torch.no_grad():
            first, second = (features(self._prepare(x), self.network, self.weights) for x in (image, truth))
            return distance(first, second, self.heads)

    def _prepare(self, image: NDArray[np.floating]) -> Tensor:
        pixels = torch.from_numpy(np.clip(image, 0.0, 1.0).astype(np.float32)).permute(2, 0, 1)[None]
        if self.input_range == "standard":
            pixels = 2.0 * pixels - 1.0
        mean, deviation = (torch.tensor(values)[:, None, None] for values in (_MEAN, _DEVIATION))
        return (pixels - mean) / deviation


def load_lpips(path: Path, heads: Path | None = None, input_range: InputRange = "paper") -> list[Lpips]:
    """Return the measures whose weights lie at `path`: a weights file, or a folder with one or two of them.

    The linear weights are taken from `heads` (the folder with alex.pth and vgg.pth, or the file of a single network),
    else from `path` if they lie there, else from the installed package `lpips`. Raises `HoloreelError` where something
    is missing, damaged or of another network.
    """
    found = _backbones(path)
    return [
        Lpips(
            network, _read_backbone(file, network), _read_heads(_heads_file(network, path, heads), network), input_range
        )
        for network, file in found.items()
    ]


def _backbones(path: Path) -> dict[Network, Path]:
    if not path.exists():
        raise HoloreelError(f"{path} does not exist: give a folder with torchvision's alexnet-*.pth or vgg16-*.pth.")
    found: dict[Network, Path] = {}
    for network in NETWORKS:
        if path.is_dir():
            files = sorted(file for pattern in _PATTERNS[network] for file in path.glob(pattern))
        else:
            files = [path] if any(path.match(pattern) for pattern in _PATTERNS[network]) else []
        if files:
            found[network] = files[0]
    if not found:
        raise HoloreelError(
            f"{path} holds neither alexnet*.pth nor vgg16*.pth (or .safetensors): give torchvision's weights by these "
            "names."
        )
    return found


def _heads_file(network: Network, path: Path, heads: Path | None) -> Path:
    places = [heads] if heads else [path if path.is_dir() else path.parent, *_package_folder()]
    for place in places:
        for file in (place, place / f"{network}.pth", place / f"lpips_{network}.pth"):
            if file.is_file():
                return file
    raise HoloreelError(
        f"{places[0]} has no {network}.pth with the linear weights of LPIPS: take weights/v0.1/{network}.pth out of "
        "the package lpips (`pip download --no-deps lpips`) and name its folder with --lpips-heads."
    )


def _package_folder() -> list[Path]:
    """Where an installed package `lpips` keeps its files; it is not imported, because it needs torchvision."""
    specification = importlib.util.find_spec("lpips")
    if specification is None or not specification.origin:
        return []
    return [Path(specification.origin).parent / "weights" / "v0.1"]


def _read_backbone(file: Path, network: Network) -> dict[str, Tensor]:
    state = _read_state(file)
    weights = {}
    for layer in LAYERS[network]:
        for part, shape in (
            ("weight", (layer.outputs, layer.inputs, layer.kernel, layer.kernel)),
            ("bias", (layer.outputs,)),
        ):
            key = f"features.{layer.number}.{part}"
            weights[key] = _tensor(file, state, key, shape)
    return weights


def _read_heads(file: Path, network: Network) -> list[Tensor]:
    state = _read_state(file)
    sizes = [layer.outputs for layer in LAYERS[network] if layer.tapped]
    return [
        _tensor(file, state, f"lin{index}.model.1.weight", (1, size, 1, 1)).reshape(size)
        for index, size in enumerate(sizes)
    ]


def _tensor(file: Path, state: Mapping[str, Tensor], key: str, shape: tuple[int, ...]) -> Tensor:
    value = state.get(key)
    if not isinstance(value, Tensor) or tuple(value.shape) != shape or not value.is_floating_point():
        raise HoloreelError(f"{file}: {key} is not a tensor of shape {list(shape)}; give the weights file itself.")
    if not bool(torch.isfinite(value).all()):
        raise HoloreelError(f"{file}: {key} holds values that are not finite; fetch the file again.")
    return value.to(torch.float32)


def _read_state(file: Path) -> Mapping[str, Tensor]:
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        if file.stat().st_size > _MAX_BYTES:
            raise ValueError(f"it has more than {_MAX_BYTES >> 20} MB")
        if file.suffix == ".safetensors":
            return load_file(file)
        state = torch.load(file, map_location="cpu", weights_only=True)
        if not isinstance(state, Mapping):
            raise ValueError(f"it holds a {type(state).__name__}")
        return state
    except (OSError, ValueError, RuntimeError, EOFError, KeyError, pickle.UnpicklingError, SafetensorError) as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise HoloreelError(f"{file} is not a state dict ({reason}): give the weights file as downloaded.") from error
