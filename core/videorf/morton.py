# SPDX-License-Identifier: GPL-3.0-or-later
"""Morton codes (Z-order): the bits of the coordinates, interleaved. Needs numpy only.

Bit 0 of a code is bit 0 of the first coordinate, bit 1 that of the second, and so on. Coordinates lie in 0 ... 1023.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

BITS = 10


def encode(*coordinates: ArrayLike) -> NDArray[np.uint32]:
    """Return the codes of two or three arrays of coordinates."""
    code = np.zeros(np.broadcast_shapes(*map(np.shape, coordinates)), np.uint32)
    for axis, values in enumerate(coordinates):
        whole = np.asarray(values).astype(np.uint32)
        for bit in range(BITS):
            code |= (whole >> np.uint32(bit) & np.uint32(1)) << np.uint32(bit * len(coordinates) + axis)
    return code


def decode(code: ArrayLike, dimensions: int) -> tuple[NDArray[np.uint32], ...]:
    """Return the coordinates that codes were made of; `dimensions` is 2 or 3."""
    code = np.asarray(code).astype(np.uint32)
    coordinates = tuple(np.zeros(code.shape, np.uint32) for _ in range(dimensions))
    for axis, values in enumerate(coordinates):
        for bit in range(BITS):
            values |= (code >> np.uint32(bit * dimensions + axis) & np.uint32(1)) << np.uint32(bit)
    return coordinates
