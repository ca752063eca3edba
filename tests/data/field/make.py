# SPDX-License-Identifier: GPL-3.0-or-later
"""Make the VideoRF in this folder anew: `python tests/data/field/make.py`. Blender's Python cannot, for want of PyAV.

Nine frames of a ball that wanders and shrinks, in several groups, at two rates; `codes.npz` holds what a player has of
it: `t0`, `t1` ..., the codes (N, C) of each frame of the first rung after decoding, in the order of the frame's table,
and `last`, those of the last frame of the other rung.
"""

from pathlib import Path

import numpy as np
from holoreel.core.videorf.decode import DecodedVideo
from holoreel.core.videorf.encode import RungSpec, write_reel
from holoreel.core.videorf.grouping import group_frames
from holoreel.core.videorf.mapping import build_table
from holoreel.core.videorf.model import FieldVideo, in_memory
from holoreel.core.videorf.occupancy import Lattice
from holoreel.core.videorf.quantize import fit_ranges
from holoreel.core.videorf.shading import Shading, ShadingShape

FOLDER = Path(__file__).parent
SHAPE, SIZE, FRAMES, FEATURES = (12, 10, 11), (32, 32), 9, 7


def ball() -> FieldVideo:
    """Return the model: densities fall from the ball's middle to far below what can be seen."""
    random = np.random.default_rng(5)
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, edge) for edge in SHAPE], indexing="ij"), -1)
    away = [np.linalg.norm(grid - [0.6 * np.sin(t / 2), 0, t / 30], axis=-1) for t in range(FRAMES)]
    groups = tuple(group_frames([distance < 0.7 - t / 50 for t, distance in enumerate(away)], 225))
    tables = tuple(build_table(group.union, SIZE) for group in groups)
    rows = []
    for group, table in zip(groups, tables, strict=True):
        place = grid[tuple(table.vertices.T)]
        for t in range(group.first, group.first + group.count):
            density = 20 * (0.4 - away[t][tuple(table.vertices.T)])
            features = [np.sin((1 + c / 3) * place[:, c % 3] * 2 + t / 4) * (1 + c / 4) for c in range(FEATURES)]
            rows.append(np.stack((density, *features), 1).astype(np.float32))
    shape = ShadingShape(FEATURES, 1, 16)
    layers = tuple(
        (random.normal(size=(o, i)).astype(np.float32) * 0.4, random.normal(size=o).astype(np.float32) * 0.3)
        for o, i in shape.layers
    )
    lattice = Lattice(SHAPE, (-0.31, 0.72, 1.13), 0.087)
    return FieldVideo(lattice, groups, tables, Shading(shape, layers), fit_ranges(rows), in_memory(rows), frame_start=1)


def main() -> None:
    """Write the reel and its codes into this folder."""
    reel = write_reel(ball(), FOLDER / "ball.reel", [RungSpec(18), RungSpec(34)])
    first, second = DecodedVideo(reel, 0), DecodedVideo(reel, 1)
    codes = {f"t{t}": first.codes(t) for t in range(reel.frame_count)}
    np.savez_compressed(FOLDER / "codes.npz", **codes, last=second.codes(reel.frame_count - 1))


if __name__ == "__main__":
    main()
