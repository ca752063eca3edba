# SPDX-License-Identifier: GPL-3.0-or-later
"""Occupancy, grouping, Morton codes and the mapping table between a lattice and an image."""

import itertools
import zlib

import numpy as np
import pytest
from holoreel.core.errors import HoloreelError
from holoreel.core.videorf import morton
from holoreel.core.videorf.grouping import group_frames
from holoreel.core.videorf.mapping import LAYOUTS, build_table, pixel_order, table_from_bitmask, table_from_image
from holoreel.core.videorf.occupancy import Lattice, cells, coarser, dilate, heaviest, occupied, opacity
from hypothesis import given, settings
from hypothesis import strategies as st

SIZES = {"blocks": (24, 40), "raster": (24, 40), "rows": (23, 37), "macroblocks": (32, 48), "superblocks": (64, 128)}


@st.composite
def occupancies(draw, most=800):
    """Blobs and dust on an oblong lattice; empty and full ones too."""
    shape = tuple(draw(st.integers(2, 13)) for _ in range(3))
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    found = random.random(shape) < draw(st.sampled_from([0.0, 0.02, 0.3, 0.9, 1.0]))
    flat = np.flatnonzero(found)
    found.ravel()[flat[most:]] = False
    return found


def bits_of(code, dimensions):
    """Coordinates of a code, bit by bit, in plain Python."""
    text = f"{code:032b}"[::-1]
    return tuple(int(text[axis::dimensions][::-1], 2) for axis in range(dimensions))


@pytest.mark.parametrize("dimensions", [2, 3])
def test_morton_codes_interleave_bits(dimensions):
    codes = np.arange(5000)
    coordinates = morton.decode(codes, dimensions)
    for code in (0, 1, 2, 4, 7, 8, 63, 64, 1234, 4999):
        assert tuple(int(values[code]) for values in coordinates) == bits_of(code, dimensions)
    assert (morton.encode(*coordinates) == codes).all()
    edge = np.array([0, 1023])
    corner = morton.decode(morton.encode(*[edge] * dimensions), dimensions)
    assert all((values == edge).all() for values in corner)


@settings(deadline=None)
@given(occupancies(), st.sampled_from(LAYOUTS))
def test_every_vertex_has_its_own_pixel_and_finds_it_again(occupancy, layout):
    table = build_table(occupancy, SIZES[layout], layout)
    assert table.count == occupancy.sum() == table.valid().sum()
    assert (table.occupancy() == occupancy).all()
    # Every vertex says where it is; after the way through the image it must say so still.
    place = 1 + np.arange(occupancy.size).reshape(occupancy.shape)
    ranks = table.lookup()
    assert ((ranks >= 0) == occupancy).all()
    rows = np.zeros(table.count, np.int64)
    rows[ranks[occupancy]] = place[occupancy]
    image = table.to_image(rows, fill=-7)
    assert ((image == -7) == ~table.valid()).all()
    assert (table.to_rows(image) == rows).all()
    assert (table.to_volume(image) == np.where(occupancy, place, 0)).all()
    # The image that the paper stores says it from the pixel's side.
    x, y, z = table.vertex_image()[table.valid()].T.astype(int)
    assert (place[x, y, z] == image[table.valid()]).all()


@settings(deadline=None)
@given(occupancies(), st.sampled_from(LAYOUTS))
def test_tables_are_rebuilt_bit_for_bit(occupancy, layout):
    table = build_table(occupancy, SIZES[layout], layout)
    from_mask = table_from_bitmask(table.bitmask(), table.shape, table.size, layout)
    from_image = table_from_image(table.vertex_image(), table.count, table.shape, layout)
    for other in (from_mask, from_image):
        assert other.shape == table.shape
        assert other.layout == layout
        for name in ("vertices", "pixels"):
            mine, theirs = getattr(table, name), getattr(other, name)
            assert mine.dtype == theirs.dtype
            assert mine.tobytes() == theirs.tobytes()


def test_a_cube_of_64_vertices_fills_one_block():
    table = build_table(np.ones((16, 16, 16), bool), (64, 64))
    volume = np.moveaxis(np.indices((16, 16, 16)), 0, -1)
    image = table.to_image(volume[tuple(table.vertices.T)])
    for row, column in itertools.product(range(0, 64, 8), repeat=2):
        block = image[row : row + 8, column : column + 8].reshape(-1, 3)
        assert (np.ptp(block, axis=0) == 3).all()
        assert (block.min(0) % 4 == 0).all()


def test_pixel_orders_are_the_documented_ones():
    def first(layout, size, count=70):
        return [divmod(int(pixel), size[1]) for pixel in pixel_order(count, size, layout)]

    paper = first("blocks", (16, 16))
    assert paper[:5] == [(0, 0), (0, 1), (1, 0), (1, 1), (0, 2)]
    assert paper[63:66] == [(7, 7), (0, 8), (0, 9)]
    assert first("raster", (16, 16))[6:10] == [(0, 6), (0, 7), (1, 0), (1, 1)]
    assert first("rows", (5, 14))[13:15] == [(0, 13), (1, 0)]
    corners = [first("macroblocks", (32, 32), 1024)[k] for k in range(0, 1024, 64)]
    assert corners[:6] == [(0, 0), (0, 8), (8, 0), (8, 8), (0, 16), (0, 24)]
    assert first("superblocks", (64, 128), 8192)[4096] == (0, 64)
    for layout in LAYOUTS:
        size = (128, 192)
        assert sorted(pixel_order(size[0] * size[1], size, layout).tolist()) == list(range(size[0] * size[1]))


def test_tables_refuse_what_does_not_fit():
    full = np.ones((4, 4, 5), bool)
    with pytest.raises(HoloreelError, match=r"80 occupied vertices do not fit into 8 x 8 pixels: take a larger image"):
        build_table(full, (8, 8))
    with pytest.raises(HoloreelError, match="multiples of 16"):
        build_table(full, (24, 16), "macroblocks")
    with pytest.raises(HoloreelError, match="'spiral' is unknown"):
        build_table(full, (16, 16), "spiral")
    with pytest.raises(HoloreelError, match="up to 256"):
        build_table(np.ones((257, 1, 1), bool), (24, 16))


def test_damaged_tables_are_refused():
    table = build_table(np.arange(5 * 6 * 7).reshape(5, 6, 7) % 3 == 0, (16, 16))
    mask = table.bitmask()
    for damaged in (mask[:-3], mask + b"x", b"", b"no zlib", zlib.compress(bytes(65)), zlib.compress(bytes(10**7))):
        with pytest.raises(HoloreelError, match="bitmask"):
            table_from_bitmask(damaged, table.shape, table.size)
    with pytest.raises(HoloreelError, match="outside of its lattice"):
        table_from_bitmask(zlib.compress(b"\xff" * 64), table.shape, table.size)
    twice = table.vertex_image().copy()
    twice[0, 0] = twice[0, 1]
    beyond = table.vertex_image().copy()
    beyond[0, 0] = (5, 0, 0)
    for image in (twice, beyond):
        with pytest.raises(HoloreelError, match="twice or outside"):
            table_from_image(image, table.count, table.shape)
    with pytest.raises(HoloreelError, match="no 257 pixels"):
        table_from_image(twice, 257, table.shape)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(0, 2**12 - 1), max_size=12), st.integers(1, 14), st.integers(1, 5))
def test_groups_are_the_longest_prefixes(masks, limit, longest):
    frames = [np.array([mask >> bit & 1 for bit in range(12)], bool).reshape(2, 2, 3) for mask in masks]
    alone = [int(frame.sum()) for frame in frames]
    if any(count > limit for count in alone):
        frame = next(index for index, count in enumerate(alone) if count > limit)
        with pytest.raises(HoloreelError, match=rf"Frame {frame} occupies {alone[frame]} vertices .* raise gamma"):
            list(group_frames(frames, limit, longest))
        return
    groups = list(group_frames(iter(frames), limit, longest))
    assert [frame for group in groups for frame in range(group.first, group.first + group.count)] == [
        *range(len(masks))
    ]
    for group in groups:
        members = frames[group.first : group.first + group.count]
        assert (group.union == np.any(members, axis=0)).all()
        assert group.union.sum() <= limit
        following = group.first + group.count
        if following < len(frames) and group.count < longest:
            assert (group.union | frames[following]).sum() > limit


def test_dilation_cells_and_blocks():
    one = np.zeros((7, 6, 5), bool)
    one[3, 0, 4] = True
    grown = dilate(one)
    assert grown.sum() == 3 * 2 * 2
    assert grown[2:5, :2, 3:].all()
    assert not one[2:5, :2, 3:].all()  # the argument is left alone
    around = cells(one)
    assert around.shape == (6, 5, 4)
    assert np.argwhere(around).tolist() == [[2, 0, 3], [3, 0, 3]]
    blocks = coarser(around, 4)
    assert blocks.shape == (2, 2, 1)
    assert blocks.sum() == 1
    assert blocks[0, 0, 0]


def test_occupancy_by_threshold_weight_and_hull():
    density = np.full((9, 9, 9), -8.0)
    density[4, 4, 4] = 5.0
    density[1, 1, 1] = np.log(np.expm1(-np.log(1 - 0.04)))  # opacity 0.04
    assert opacity(density)[1, 1, 1] == pytest.approx(0.04)
    assert occupied(density, gamma=0.05).sum() == 27
    assert occupied(density, gamma=0.03).sum() == 54
    weights = np.zeros_like(density)
    weights[4, 4, 4], weights[1, 1, 1] = 0.98, 0.02
    assert occupied(density, 0.03, weights, 0.97).sum() == 27
    assert occupied(density, 0.03, weights, 0.99).sum() == 54
    hull = np.zeros(density.shape, bool)
    hull[4:] = True
    assert occupied(density, 0.05, hull=hull).sum() == 18
    assert heaviest(np.zeros((2, 2, 2)), 1.0).sum() == 0
    assert heaviest(np.array([3.0, 1.0, 0.0, 4.0]), 1.0).tolist() == [True, True, False, True]
    with pytest.raises(HoloreelError, match="gamma"):
        occupied(density, gamma=1.0)


def test_lattices_hold_their_box():
    low, high = np.array([-1.0, 2.0, 0.0]), np.array([1.0, 2.5, 4.0])
    lattice = Lattice.around(low, high, 64)
    assert lattice.shape[2] == 64
    assert lattice.spacing == pytest.approx(4 / 59)
    assert (np.array(lattice.lowest) + 2 * lattice.spacing <= low + 1e-9).all()
    assert (np.array(lattice.highest) - 2 * lattice.spacing >= high - 1e-9).all()
    last = np.array(lattice.shape) - 1
    assert lattice.positions(last) == pytest.approx(lattice.highest)
    assert lattice.positions(np.zeros((2, 3)))[1] == pytest.approx(lattice.lowest)
    for bad in ((low, low, 64), (low, high * np.nan, 64), (low, high, 5), (low, high, 257)):
        with pytest.raises(HoloreelError):
            Lattice.around(*bad)
