# SPDX-License-Identifier: GPL-3.0-or-later
"""The shading network Φ of a VideoRF as nodes: its products are three numbers wide, as Blender's transforms are."""

import hashlib

import bpy
import numpy as np
from numpy.typing import NDArray

from ...core.videorf.shading import Shading, ShadingShape, shading_bytes
from .builder import Float, Matrix, Tree, Vector
from .library import ensure_group

NAME, VERSION = "Holoreel Field Colors", 1
WIDTH = 3  # numbers that a vector carries
PRODUCTS_MAX = 250  # of a group: Blender takes 2 s to build as many, and a minute for a thousand


def fits(shape: ShadingShape) -> bool:
    """Return whether a network is small enough for nodes; the default of training needs 72 products."""
    blocks = -(-shape.features // WIDTH) + shape.direction_inputs // WIDTH
    units = -(-shape.hidden // WIDTH)
    return units * (blocks + units + 1) <= PRODUCTS_MAX


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
        blocks = [unit.at_least((0.0, 0.0, 0.0)) for unit in _product(tree, blocks, matrix, bias)]
    (outputs,) = _product(tree, blocks, last, last_bias)
    tree.output("Color", tree.vector(*(sigmoid(value) for value in outputs.axes())), "Red, green and blue, 0 to 1")


def _product(tree: Tree, blocks: list[Vector], matrix: NDArray[np.float32], bias: NDArray[np.float32]) -> list[Vector]:
    """Return matrix · [blocks] + bias, three rows to a vector; rows and columns to spare are 0."""
    rows, columns = -(-len(matrix) // WIDTH) * WIDTH, len(blocks) * WIDTH
    padded = np.zeros((rows, columns + 1), np.float32)
    padded[: len(matrix), : matrix.shape[1]] = matrix
    padded[: len(matrix), columns] = bias
    sums = []
    for three in np.split(padded, rows // WIDTH):
        weights = np.split(three[:, :columns], len(blocks), axis=1)
        total = _constant(tree, weights[0], three[:, columns]).transform(blocks[0])
        for part, block in zip(weights[1:], blocks[1:], strict=True):
            total = total + _constant(tree, part).turn(block)
        sums.append(total)
    return sums


def _constant(tree: Tree, weights: NDArray[np.float32], shift: NDArray[np.float32] | None = None) -> Matrix:
    """Return the transform v → weights (3, 3) · v + shift (3)."""
    node = tree.node("FunctionNodeCombineMatrix")
    columns = [*weights.T, np.zeros(WIDTH) if shift is None else shift]
    for column, values in enumerate(columns, start=1):
        for row, value in enumerate(values.tolist(), start=1):
            if value != (column == row):  # what the node has by itself; setting a socket updates the whole tree
                node.inputs[f"Column {column} Row {row}"].default_value = value
    return Matrix(tree, node.outputs[0])
