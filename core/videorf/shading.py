# SPDX-License-Identifier: GPL-3.0-or-later
"""The deferred shading network Φ as plain numbers: its formula, its file. Needs numpy only.

A ray's summed features f and its direction d give its color sigmoid(Φ(f, PE(d))) (Eqs. 2-3). Φ has two hidden layers of
ReLU units, and PE(d) = [d, sin d, cos d, sin 2d, cos 2d, ...] with `frequencies` pairs, or nothing at all where
`frequencies` is None. The file is the weights alone, little-endian float32: matrix (out, in) and bias (out) of each of
the three layers.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import HoloreelError
from ..files import atomic_path

MAX_FREQUENCIES = 8
MAX_HIDDEN = 256
MAX_FEATURES = 15


@dataclass(frozen=True)
class ShadingShape:
    """What decides the sizes of Φ's layers: the features, the frequencies of the direction, the units of a hidden
    layer.
    """

    features: int
    frequencies: int | None = 1
    hidden: int = 16

    def __post_init__(self) -> None:
        sound = self.frequencies is None or 0 <= self.frequencies <= MAX_FREQUENCIES
        if not (sound and 1 <= self.features <= MAX_FEATURES and 1 <= self.hidden <= MAX_HIDDEN):
            raise HoloreelError(
                f"A shading network of {self.features} features, {self.frequencies} frequencies and {self.hidden} "
                f"units is out "
                f"of range: take 1 to {MAX_FEATURES}, null or 0 to {MAX_FREQUENCIES}, and 1 to {MAX_HIDDEN}."
            )

    @property
    def direction_inputs(self) -> int:
        """How many numbers PE(d) has."""
        return 0 if self.frequencies is None else 3 + 6 * self.frequencies

    @property
    def layers(self) -> tuple[tuple[int, int], ...]:
        """The (outputs, inputs) of each layer."""
        return (
            (self.hidden, self.features + self.direction_inputs),
            (self.hidden, self.hidden),
            (3, self.hidden),
        )

    @property
    def count(self) -> int:
        """How many weights there are."""
        return sum(outputs * (inputs + 1) for outputs, inputs in self.layers)


@dataclass(frozen=True)
class Shading:
    """Φ: the matrix (out, in) and the bias (out) of each layer, float32."""

    shape: ShadingShape
    layers: tuple[tuple[NDArray[np.float32], NDArray[np.float32]], ...]

    def __call__(self, features: NDArray, directions: NDArray) -> NDArray[np.float64]:
        """Return the colors (..., 3) of features (..., h) and unit directions (..., 3), in float64."""
        values = np.concatenate((np.asarray(features, np.float64), encode_direction(directions, self.shape)), -1)
        for matrix, bias in self.layers[:-1]:
            values = np.maximum(values @ matrix.T.astype(np.float64) + bias, 0.0)
        matrix, bias = self.layers[-1]
        return 1.0 / (1.0 + np.exp(-(values @ matrix.T.astype(np.float64) + bias)))


def encode_direction(directions: NDArray, shape: ShadingShape) -> NDArray[np.float64]:
    """Return PE(d) (..., 3 + 6 · frequencies), or (..., 0) where Φ does not look at the direction."""
    directions = np.asarray(directions, np.float64)
    if shape.frequencies is None:
        return np.zeros((*directions.shape[:-1], 0))
    waves = [wave(directions * 2.0**k) for k in range(shape.frequencies) for wave in (np.sin, np.cos)]
    return np.concatenate((directions, *waves), -1)


def shading_bytes(shading: Shading) -> bytes:
    """Return what the file of Φ's weights holds."""
    return b"".join(part.astype("<f4").tobytes() for layer in shading.layers for part in layer)


def write_shading(path: str | Path, shading: Shading) -> int:
    """Write Φ's weights, atomically; returns the file's size in bytes."""
    data = shading_bytes(shading)
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)
    return len(data)


def read_shading(path: str | Path, shape: ShadingShape) -> Shading:
    """Read Φ's weights. Raises `HoloreelError` where the file is missing, of another size, or not finite."""
    path, expected = Path(path), 4 * shape.count
    try:
        with path.open("rb") as file:
            data = file.read(expected + 1)
    except OSError as error:
        raise HoloreelError(f"{path} cannot be read ({error.strerror}): put it beside its reel.") from error
    if len(data) != expected:
        raise HoloreelError(f"{path} does not hold the {shape.count} weights its reel asks for: fetch it again.")
    values = np.frombuffer(data, "<f4").astype(np.float32)
    if not np.isfinite(values).all():
        raise HoloreelError(f"{path} holds weights that are not finite: train again or fetch it again.")
    layers, at = [], 0
    for outputs, inputs in shape.layers:
        matrix = values[at : at + outputs * inputs].reshape(outputs, inputs)
        at += outputs * inputs
        layers.append((matrix, values[at : at + outputs]))
        at += outputs
    return Shading(shape, tuple(layers))


def composite(colors: NDArray, transmittance: NDArray, background: NDArray | float) -> NDArray:
    """Return (1 - T) colors + T background for colors (..., 3) and transmittance (...)."""
    left = np.asarray(transmittance)[..., None]
    return (1.0 - left) * colors + left * np.asarray(background)
