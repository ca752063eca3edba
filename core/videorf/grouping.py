# SPDX-License-Identifier: GPL-3.0-or-later
"""Adaptive grouping: frames that share one mapping table (Eq. 4). Needs numpy only."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from ..errors import HoloreelError
from .occupancy import Occupancy

LONGEST = 60  # frames: a player that seeks decodes half a group on average


@dataclass(frozen=True)
class Group:
    """Frames `first` ... `first + count - 1` (0-based) and the vertices that any of them occupies, (X, Y, Z) bool."""

    first: int
    count: int
    union: Occupancy


def group_frames(occupancies: Iterable[Occupancy], limit: int, longest: int = LONGEST) -> Iterator[Group]:
    """Cut frames into groups, each the longest run whose union has at most `limit` vertices (θ in Eq. 4).

    The frames are taken one by one and given up once their group is out, so any iterable will do. `longest` bounds the
    frames in a group; 1 turns grouping off. Raises `HoloreelError` for a frame that exceeds `limit` alone.
    """
    if limit < 1 or longest < 1:
        raise ValueError("limit and longest must be 1 or more")
    first, count = 0, 0
    union: Occupancy | None = None
    for frame, occupancy in enumerate(occupancies):
        if union is not None and occupancy.shape != union.shape:
            raise ValueError(f"frame {frame} has another lattice than the frames before")
        if union is not None:
            grown = union | occupancy
            if count < longest and int(grown.sum()) <= limit:
                union, count = grown, count + 1
                continue
            yield Group(first, count, union)
        vertices = int(occupancy.sum())
        if vertices > limit:
            raise HoloreelError(
                f"Frame {frame} occupies {vertices:,} vertices and its image has {limit:,} pixels: raise gamma, take a "
                "coarser lattice, or take a larger image."
            )
        first, count, union = frame, 1, occupancy.copy()
    if union is not None:
        yield Group(first, count, union)
