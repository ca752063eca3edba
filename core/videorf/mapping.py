# SPDX-License-Identifier: GPL-3.0-or-later
"""The mapping table M between the vertices of a lattice and the pixels of a feature image (Sec. 4.1). Needs numpy only.

Occupied vertices are sorted in 3D Morton order; each 64 of them fill one 8 x 8 block of the image, in 2D Morton order.
The table follows from the occupancy alone, so a stream carries the occupancy as a compressed bitmask; the image of the
table that the paper stores, one byte per coordinate, is there as well.
"""

import zlib
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ..errors import HoloreelError
from . import morton
from .occupancy import MAX_EDGE, Occupancy

BLOCK = 8  # pixels: the transform of H.264 High
BRICK = 8  # vertices: the bitmask is written brick by brick, which packs twice as well as row by row
MAX_IMAGE_EDGE = 2048

# `blocks` is the paper's. `macroblocks` and `superblocks` put the blocks in Morton order inside squares of 16 and 64
# pixels, the units H.264, and HEVC and AV1 code in. `raster` sorts vertices row by row and fills blocks row by row (no
# Morton order); `rows` keeps the Morton order of vertices and fills whole rows of the image (no blocks).
Layout = Literal["blocks", "macroblocks", "superblocks", "raster", "rows"]
LAYOUTS: tuple[Layout, ...] = get_args(Layout)
_TILE = {"blocks": 8, "macroblocks": 16, "superblocks": 64, "raster": 8, "rows": 1}  # edges are multiples of this


@dataclass(frozen=True)
class MappingTable:
    """Vertex `vertices[k]` (N, 3; uint8) lies at `pixels[k]` (N; int32, row times width plus column) of the image.

    `shape` is the lattice's (X, Y, Z), `size` the image's (height, width).
    """

    shape: tuple[int, int, int]
    size: tuple[int, int]
    layout: Layout
    vertices: NDArray[np.uint8]
    pixels: NDArray[np.int32]

    @property
    def count(self) -> int:
        """How many vertices, and so how many pixels, are in use."""
        return len(self.vertices)

    def occupancy(self) -> Occupancy:
        """Return which vertices have a pixel."""
        found = np.zeros(self.shape, bool)
        found[tuple(self.vertices.T)] = True
        return found

    def lookup(self) -> NDArray[np.int32]:
        """Return the rank k of every vertex, (X, Y, Z), -1 where it is empty: the way from 3D to 2D by `pixels[k]`."""
        ranks = np.full(self.shape, -1, np.int32)
        ranks[tuple(self.vertices.T)] = np.arange(self.count, dtype=np.int32)
        return ranks

    def valid(self) -> NDArray[np.bool_]:
        """Return which pixels (H, W) hold a vertex."""
        found = np.zeros(self.size[0] * self.size[1], bool)
        found[self.pixels] = True
        return found.reshape(self.size)

    def to_image(self, rows: NDArray, fill: NDArray | float = 0) -> NDArray:
        """Return the image (H, W, ...) of a value per vertex (N, ...), `fill` in pixels without one."""
        image = np.empty((self.size[0] * self.size[1], *rows.shape[1:]), rows.dtype)
        image[:] = fill
        image[self.pixels] = rows
        return image.reshape(*self.size, *rows.shape[1:])

    def to_rows(self, image: NDArray) -> NDArray:
        """Return the values per vertex (N, ...) of an image (H, W, ...)."""
        if image.shape[:2] != self.size:
            raise ValueError(f"the image is {image.shape[:2]}, the table's {self.size}")
        return image.reshape(-1, *image.shape[2:])[self.pixels]

    def to_volume(self, image: NDArray, fill: NDArray | float = 0) -> NDArray:
        """Return the volume (X, Y, Z, ...) of an image (H, W, ...), `fill` in vertices without a pixel."""
        volume = np.empty((*self.shape, *image.shape[2:]), image.dtype)
        volume[:] = fill
        volume[tuple(self.vertices.T)] = self.to_rows(image)
        return volume

    def vertex_image(self) -> NDArray[np.uint8]:
        """Return the table as the paper stores it: an RGB image (H, W, 3) of the vertex at each pixel, 0 where none
        is.
        """
        return self.to_image(self.vertices)

    def bitmask(self) -> bytes:
        """Return the occupancy, packed: 8³ bricks in raster order, a bit per vertex in raster order, in zlib."""
        padded = np.pad(self.occupancy(), [(0, -edge % BRICK) for edge in self.shape])
        x, y, z = (edge // BRICK for edge in padded.shape)
        bricks = padded.reshape(x, BRICK, y, BRICK, z, BRICK).transpose(0, 2, 4, 1, 3, 5)
        return zlib.compress(np.packbits(bricks).tobytes(), 9)


def check_size(size: tuple[int, int], layout: Layout) -> None:
    """Raise `HoloreelError` where a layout is unknown or an image of (height, width) cannot have it."""
    if layout not in LAYOUTS:
        raise HoloreelError(f"The layout '{layout}' is unknown: take one of {', '.join(LAYOUTS)}.")
    tile = _TILE[layout]
    if not all(0 < edge <= MAX_IMAGE_EDGE and edge % tile == 0 for edge in size):
        raise HoloreelError(
            f"An image of {size[1]} x {size[0]} pixels cannot have the layout '{layout}': take multiples of {tile} up "
            f"to "
            f"{MAX_IMAGE_EDGE}."
        )


def build_table(occupancy: Occupancy, size: tuple[int, int], layout: Layout = "blocks") -> MappingTable:
    """Return the table of an occupancy (X, Y, Z) for images of `size` (height, width).

    Raises `HoloreelError` where the image has fewer pixels than there are occupied vertices, or cannot have the layout.
    """
    if occupancy.ndim != 3 or not all(1 <= edge <= MAX_EDGE for edge in occupancy.shape):
        raise HoloreelError(f"A lattice of {occupancy.shape} vertices has no table: take up to {MAX_EDGE} per axis.")
    check_size(size, layout)
    vertices = np.argwhere(occupancy)
    if len(vertices) > size[0] * size[1]:
        raise HoloreelError(
            f"{len(vertices):,} occupied vertices do not fit into {size[1]} x {size[0]} pixels: take a larger image, a "
            "coarser lattice, or shorter groups."
        )
    if layout != "raster":
        vertices = vertices[np.argsort(morton.encode(*vertices.T))]
    x, y, z = occupancy.shape
    pixels = pixel_order(len(vertices), size, layout)
    return MappingTable((x, y, z), size, layout, vertices.astype(np.uint8), pixels)


def pixel_order(count: int, size: tuple[int, int], layout: Layout) -> NDArray[np.int32]:
    """Return the pixels (row times width plus column) that the first `count` ranks take."""
    rank = np.arange(count)
    if layout == "rows":
        return rank.astype(np.int32)
    block, inside = rank // BLOCK**2, rank % BLOCK**2
    u, v = divmod(inside, BLOCK)[::-1] if layout == "raster" else morton.decode(inside, 2)
    edge = _TILE[layout] // BLOCK  # of a tile, in blocks
    tile, within = block // edge**2, block % edge**2
    across, down = morton.decode(within, 2)
    per_row = size[1] // (BLOCK * edge)
    column = (tile % per_row * edge + across) * BLOCK + u
    row = (tile // per_row * edge + down) * BLOCK + v
    return (row * size[1] + column).astype(np.int32)


def table_from_image(
    image: NDArray[np.uint8], count: int, shape: tuple[int, int, int], layout: Layout = "blocks"
) -> MappingTable:
    """Return the table that `vertex_image` wrote, of which the first `count` pixels in the layout's order are in use.

    Raises `HoloreelError` where the image names a vertex twice or outside of the lattice.
    """
    check_size((image.shape[0], image.shape[1]), layout)
    if not 0 <= count <= image.shape[0] * image.shape[1]:
        raise HoloreelError(f"The mapping image has no {count} pixels: write it again.")
    pixels = pixel_order(count, (image.shape[0], image.shape[1]), layout)
    vertices = image.reshape(-1, 3)[pixels]
    found = np.zeros(shape, bool)
    if (vertices < np.array(shape)).all():
        found[tuple(vertices.T)] = True
    if int(found.sum()) != count:
        raise HoloreelError("The mapping image names a vertex twice or outside of the lattice: write it again.")
    return MappingTable(shape, (image.shape[0], image.shape[1]), layout, vertices, pixels)


def table_from_bitmask(
    data: bytes, shape: tuple[int, int, int], size: tuple[int, int], layout: Layout = "blocks"
) -> MappingTable:
    """Return the table of a bitmask, bit for bit the one that wrote it. Raises `HoloreelError` for damaged data."""
    if len(shape) != 3 or not all(1 <= edge <= MAX_EDGE for edge in shape):
        raise HoloreelError(f"A lattice of {shape} vertices has no table: take up to {MAX_EDGE} per axis.")
    x, y, z = (-(-edge // BRICK) for edge in shape)
    expected = x * y * z * BRICK**3 // 8
    inflater = zlib.decompressobj()
    try:
        packed = inflater.decompress(data, expected + 1)
    except zlib.error as error:
        raise HoloreelError(f"An occupancy bitmask is damaged ({error}): fetch the reel again.") from error
    if len(packed) != expected or not inflater.eof or inflater.unused_data:
        raise HoloreelError(f"An occupancy bitmask is not one of {shape} vertices: fetch the reel again.")
    bits = np.unpackbits(np.frombuffer(packed, np.uint8)).astype(bool)
    bricks = bits.reshape(x, y, z, BRICK, BRICK, BRICK).transpose(0, 3, 1, 4, 2, 5)
    padded = bricks.reshape(x * BRICK, y * BRICK, z * BRICK)
    occupancy = padded[: shape[0], : shape[1], : shape[2]]
    if int(padded.sum()) != int(occupancy.sum()):
        raise HoloreelError("An occupancy bitmask has vertices outside of its lattice: fetch the reel again.")
    return build_table(occupancy, size, layout)
