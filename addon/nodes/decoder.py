# SPDX-License-Identifier: GPL-3.0-or-later
"""The shading network Φ of a VideoRF as nodes, which calculate with three numbers at once.

A unit takes one Multiply Add for each three of its inputs and a sum over the axes; transforms of vectors by matrices
would do with fewer nodes, but take Blender three times as long.
"""

import hashlib

import bpy
import numpy as np
from numpy.typing import NDArray

from ...core.videorf.shading import Shading, ShadingShape, shading_bytes
from .builder import Float, Tree, Vector
from .library import ensure_group

NAME, VERSION = "Holoreel Field Colors", 2
WIDTH = 3  # numbers that a vector carries
PRODUCTS_MAX = 600  # of a group: building takes time with their square, some seconds for as many


def fits(shape: ShadingShape) -> bool:
    """Return whether a network is small enough for nodes; the default of training needs 210 products."""
    inputs = -(-shape.features // WIDTH) + shape.direction_inputs // WIDTH
    units = -(-shape.hidden // WIDTH)
    return shape.hidden * (inputs + units) + 3 * units <= PRODUCTS_MAX


def feature_sockets(features: int) -> list[str]:
    """Return the names of the inputs that take the features, three each; what is left over in the last is ignored."""
    return [f"Features {first + 1}" for first in range(0, features, WIDTH)]


def decoder(shading: Shading) -> bpy.types.NodeTree:
    """Return the group that computes `shading`: features and a unit direction in, a display-referred color out.

    It is built once for each network per .blend file, with the weights as its constants.
    """
    digest = hashlib.sha256(repr(shading.shape).encode() + shading_bytes(shading)).hexdigest()[:16]
    tooltip = "Compute the color of a VideoRF's features as seen along a direction"
    return ensure_group(NAME, f"{VERSION}-{digest}", tooltip, lambda tree: _fill(tree, shading))


def sigmoid(value: Float) -> Float:
    """Return 1 / (1 + exp(-value)); what exp cannot hold becomes 0, since Blender divides 1 by infinity to 0."""
    return 1.0 / ((-value).exp() + 1.0)


def _fill(tree: Tree, shading: Shading) -> None:
    shape = shading.shape
    blocks = [
        tree.vector_input(name, "Three of the summed features", is_field=True)
        for name in feature_sockets(shape.features)
    ]
    direction = tree.vector_input("Direction", "From the eye to the point, of length 1", (0, 1, 0), is_field=True)
    if shape.frequencies is not None:
        turns = [direction * 2.0**k for k in range(shape.frequencies)]
        blocks += [direction, *(wave for turn in turns for wave in (turn.sin(), turn.cos()))]

    (first, first_bias), (second, second_bias), (last, last_bias) = shading.layers
    spare = -shape.features % WIDTH
    first = np.insert(first, [shape.features] * spare, 0.0, axis=1)  # where the last block of features is not full
    for matrix, bias in ((first, first_bias), (second, second_bias)):
        blocks = [unit.at_least((0.0, 0.0, 0.0)) for unit in _layer(tree, blocks, matrix, bias)]
    (outputs,) = _layer(tree, blocks, last, last_bias)
    tree.output("Color", tree.vector(*(sigmoid(value) for value in outputs.axes())), "Red, green and blue, 0 to 1")


def _layer(tree: Tree, blocks: list[Vector], matrix: NDArray[np.float32], bias: NDArray[np.float32]) -> list[Vector]:
    """Return matrix · [blocks] + bias, three outputs to a vector; outputs and inputs to spare are 0."""
    columns = len(blocks) * WIDTH
    weights = np.pad(matrix, ((0, 0), (0, columns - matrix.shape[1]))).reshape(len(matrix), len(blocks), WIDTH)
    outputs: list[Float | float] = []
    for row, shift in zip(weights.tolist(), bias.tolist(), strict=True):
        total: Vector | tuple[float, float, float] = (shift, 0.0, 0.0)
        for block, factors in zip(blocks, row, strict=True):
            total = block.times_plus(tuple(factors), total)
        outputs.append(total.dot((1.0, 1.0, 1.0)))
    outputs += [0.0] * (-len(outputs) % WIDTH)
    return [tree.vector(*outputs[start : start + WIDTH]) for start in range(0, len(outputs), WIDTH)]
