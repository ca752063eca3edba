# SPDX-License-Identifier: GPL-3.0-or-later
"""The network that turns a full model's features into colors (Spacetime Gaussians, Eqs. 10 and 11). Needs numpy only.

It has two layers without biases: color = activation(base + output · max(0, hidden · x)), with the 12 inputs
x = [direction feature (3), time feature (3), ray origin (3), unit ray direction (3)], the ray in world space.

Files: `NAME.decoder.safetensors` is our own (float32 tensors `hidden` (6, 12) and `output` (3, 6), `activation` in the
metadata); `point_cloud.pt` is the authors' (torch.save of a state dict with `mlp1.weight` (6, 12, 1, 1) and
`mlp2.weight` (3, 6, 1, 1)), which does not say the activation. Only the latter needs torch.
"""

import io
import json
import pickle
import struct
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import HoloreelError
from ..files import atomic_path
from .model import sigmoid

Activation = Literal["sigmoid", "clamp", "none"]
ACTIVATIONS: tuple[Activation, ...] = get_args(Activation)
SHAPES = {"hidden": (6, 12), "output": (3, 6)}

_SUFFIX = ".decoder.safetensors"
_MAX_BYTES = 1 << 20  # a decoder is about 1.5 KB
_STATE_DICT = {"mlp1.weight": "hidden", "mlp2.weight": "output"}


@dataclass(frozen=True, eq=False)
class Decoder:
    """The weights of one network.

    `activation` is what the authors' variants end in: `sigmoid` (Neural 3D Video), `clamp` to [0, 1] (Technicolor) or
    `none` (Immersive; pictures are clipped only where they are shown). Wrong shapes, values that are not finite and
    unknown activations are a ValueError.
    """

    hidden: NDArray[np.float32]  # (6, 12)
    output: NDArray[np.float32]  # (3, 6)
    activation: Activation = "sigmoid"

    def __post_init__(self) -> None:
        for name, shape in SHAPES.items():
            array = np.ascontiguousarray(getattr(self, name), dtype=np.float32)
            if array.shape != shape:
                raise ValueError(f"{name} has shape {array.shape}, not {shape}")
            if not np.isfinite(array).all():
                raise ValueError(f"{name} holds values that are not finite")
            object.__setattr__(self, name, array)
        if self.activation not in ACTIVATIONS:
            raise ValueError(f"activation is {self.activation!r}, not one of {', '.join(ACTIVATIONS)}")

    def decode(self, features: ArrayLike, origins: ArrayLike, directions: ArrayLike) -> NDArray[np.float64]:
        """Return colors (..., 3) in float64: the oracle of the kernels.

        `features` (..., 9) are [base, direction, time × (t - μ^τ)]; `origins` and `directions` (..., 3) the rays in the
        world, directions of unit length.
        """
        features = np.asarray(features, np.float64)
        rays = [
            np.broadcast_to(np.asarray(part, np.float64), (*features.shape[:-1], 3)) for part in (origins, directions)
        ]
        inputs = np.concatenate([features[..., 3:], *rays], axis=-1)
        raw = features[..., :3] + np.maximum(inputs @ self.hidden.T.astype(np.float64), 0.0) @ self.output.T
        if self.activation == "sigmoid":
            return sigmoid(raw)
        return np.clip(raw, 0.0, 1.0) if self.activation == "clamp" else raw


def decoder_path(payload: Path) -> Path:
    """Return where the decoder of a payload `NAME.ply` lies: `NAME.decoder.safetensors` beside it."""
    return payload.with_name(payload.stem + _SUFFIX)


def write_decoder(path: str | Path, decoder: Decoder) -> None:
    """Write a `.safetensors` file (github.com/huggingface/safetensors), atomically."""
    header: dict[str, Any] = {"__metadata__": {"activation": decoder.activation}}
    payload = b""
    for name, shape in SHAPES.items():
        data = getattr(decoder, name).astype("<f4").tobytes()
        header[name] = {"dtype": "F32", "shape": shape, "data_offsets": [len(payload), len(payload) + len(data)]}
        payload += data
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)  # so that the numbers are aligned
    with atomic_path(path) as temporary:
        temporary.write_bytes(struct.pack("<Q", len(text)) + text + payload)


def read_decoder(path: str | Path) -> Decoder:
    """Read a `.decoder.safetensors`; raises `HoloreelError` where it is missing, damaged or of another network."""
    path = Path(path)
    data = _read(path)
    try:
        (length,) = struct.unpack_from("<Q", data)
        header = json.loads(data[8 : 8 + length].decode())
        payload = data[8 + length :]
        arrays = {name: _tensor(header[name], payload, shape) for name, shape in SHAPES.items()}
        return Decoder(**arrays, activation=header["__metadata__"]["activation"])
    except (ValueError, KeyError, TypeError, RecursionError, struct.error) as error:
        raise HoloreelError(
            f"{path} is not a decoder ({_reason(error)}): it needs float32 tensors 'hidden' (6, 12) and 'output' "
            f"(3, 6) and the metadata 'activation'; write the reel again or fetch a whole copy."
        ) from error


def _tensor(entry: dict[str, Any], payload: bytes, shape: tuple[int, ...]) -> NDArray[np.float32]:
    start, end = entry["data_offsets"]
    if entry["dtype"] != "F32" or tuple(entry["shape"]) != shape:
        raise ValueError(f"a tensor of {entry['dtype']} {entry['shape']} stands where F32 {list(shape)} belongs")
    if not 0 <= start <= end <= len(payload) or end - start != 4 * shape[0] * shape[1]:
        raise ValueError("a tensor lies outside the file")
    return np.frombuffer(payload[start:end], "<f4").reshape(shape).astype(np.float32)


def read_pt(path: str | Path, activation: Activation = "sigmoid") -> Decoder:
    """Read the authors' `point_cloud.pt`; the file does not say its activation.

    Nothing in it is executed (`weights_only`), and it may have been saved from a GPU. Raises `HoloreelError` where it
    is not a state dict of the network, ImportError where torch is not installed.
    """
    import torch

    path = Path(path)
    data = _read(path)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:  # what torch.save has written since 1.6
            if sum(entry.file_size for entry in archive.infolist()) > _MAX_BYTES:
                raise ValueError("it unpacks to more than a decoder can hold")
        state = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
        return Decoder(**_weights(state), activation=activation)
    except (
        *(ValueError, KeyError, TypeError, AttributeError, IndexError, RuntimeError, EOFError, NotImplementedError),
        *(AssertionError, OverflowError, OSError, MemoryError),
        *(zipfile.BadZipFile, zlib.error, pickle.UnpicklingError, struct.error),
    ) as error:
        raise HoloreelError(
            f"{path} is not the state dict of a decoder ({_reason(error)}): give the point_cloud.pt that was saved "
            "with the point_cloud.ply beside it."
        ) from error


def _weights(state: Any) -> dict[str, NDArray[np.float32]]:
    import torch

    if not isinstance(state, dict) or set(state) != set(_STATE_DICT):
        found = ", ".join(map(str, list(state)[:4])) if isinstance(state, dict) else type(state).__name__
        raise ValueError(f"it holds {found or 'nothing'} instead of {' and '.join(_STATE_DICT)}")
    arrays = {}
    for key, name in _STATE_DICT.items():
        tensor, shape = state[key], (*SHAPES[name], 1, 1)
        if not isinstance(tensor, torch.Tensor) or tensor.dtype != torch.float32 or tuple(tensor.shape) != shape:
            raise ValueError(f"{key} is not a float32 tensor of shape {shape}")
        arrays[name] = tensor.detach().numpy().reshape(SHAPES[name]).copy()
    return arrays


def write_pt(path: str | Path, decoder: Decoder) -> None:
    """Write the authors' `point_cloud.pt`, atomically; the activation has no place in it."""
    import torch

    state = {
        key: torch.from_numpy(getattr(decoder, name).reshape(*SHAPES[name], 1, 1)) for key, name in _STATE_DICT.items()
    }
    with atomic_path(path) as temporary:
        torch.save(state, temporary)


def _read(path: Path) -> bytes:
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise HoloreelError(
                f"{path} is larger than a decoder can be ({_MAX_BYTES >> 20} MiB): give the right file."
            )
        return path.read_bytes()
    except OSError as error:
        raise HoloreelError(f"{path} cannot be read ({error.strerror or error}): check the path.") from error


def _reason(error: BaseException) -> str:
    """The first line of what went wrong, short enough for a sentence."""
    if isinstance(error, pickle.UnpicklingError):
        return "it holds more than tensors"
    if isinstance(error, KeyError):
        return f"{error} is missing"
    text = str(error).strip().partition("\n")[0].rstrip(".") or type(error).__name__
    return text if len(text) <= 120 else f"{text[:117]}..."
