# SPDX-License-Identifier: GPL-3.0-or-later
"""A small model of a VideoRF, as training would make it."""

import numpy as np
from holoreel.core.videorf.grouping import group_frames
from holoreel.core.videorf.mapping import build_table
from holoreel.core.videorf.model import FieldVideo, in_memory
from holoreel.core.videorf.occupancy import Lattice
from holoreel.core.videorf.quantize import fit_ranges
from holoreel.core.videorf.shading import Shading, ShadingShape

CHANNELS = 8
SHAPE = (14, 12, 13)
SIZE = (48, 32)


def ball_model(layout="blocks", size=SIZE, frames=5):
    """A ball that wanders through a lattice, in several groups, with channels smooth in space as trained ones are."""
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, edge) for edge in SHAPE], indexing="ij"), -1)
    found = [np.linalg.norm(grid - [0.5 * t / 4, 0, 0], axis=-1) < 0.62 for t in range(frames)]
    groups = tuple(group_frames(found, int(1.35 * found[0].sum())))
    tables = tuple(build_table(group.union, size, layout) for group in groups)
    rows = []
    for group, table in zip(groups, tables, strict=True):
        place = grid[tuple(table.vertices.T)]
        for t in range(group.first, group.first + group.count):
            channels = [np.sin((1 + c / 3) * place[:, c % 3] + t / 4) * (1 + c) for c in range(CHANNELS)]
            rows.append(np.stack(channels, 1).astype(np.float32))
    shape = ShadingShape(CHANNELS - 1, 1, 4)
    random = np.random.default_rng(0)
    layers = tuple(
        (random.normal(size=(o, i)).astype(np.float32), random.normal(size=o).astype(np.float32))
        for o, i in shape.layers
    )
    lattice = Lattice(SHAPE, (-1.0, -1.0, -1.0), 2 / 13)
    ranges = fit_ranges(rows)
    shading = Shading(shape, layers)
    provenance = {"made": "by a test"}
    return FieldVideo(lattice, groups, tables, shading, ranges, in_memory(rows), provenance=provenance, frame_start=101)
