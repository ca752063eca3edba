# SPDX-License-Identifier: GPL-3.0-or-later
"""The optimizer of tables against the losses by autograd and torch's own Adam, in float64."""

import numpy as np
import pytest
import torch
from holoreel.core.errors import HoloreelError
from holoreel.core.videorf import native, reference
from holoreel.core.videorf.losses import smooth_abs, spatial_loss, temporal_loss
from holoreel.core.videorf.mapping import LAYOUTS, build_table
from holoreel.core.videorf.optimize import (
    BETAS,
    EPSILON,
    INSIDE,
    SEAM,
    TableOptimizer,
    image_neighbors,
    joined,
    lattice_neighbors,
    noisy_rows,
)


@pytest.fixture(autouse=True)
def as_before():
    threads = native.get_threads()
    yield
    native.set_threads(threads)
    native.set_lanes(0)


STEP = torch.tensor([0.1, 0.02, 0.03, 0.04])
RATES = torch.tensor([0.2, 0.05, 0.01, 0.03])


def table_of(layout="blocks", shape=(20, 17, 19), share=0.4, seed=0):
    occupancy = np.random.default_rng(seed).random(shape) < share
    return build_table(occupancy, (64, 64), layout)


def rows_of(mapping, seed=1):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(mapping.count + 1, 4, generator=generator) * STEP * 2


def lanes_or_skip(lanes):
    try:
        native.set_lanes(lanes)
    except HoloreelError:
        pytest.skip(f"no {lanes} lanes here")


@pytest.mark.parametrize(("seam", "smooth"), [(1.0, 0.0), (0.25, 0.0), (0.25, 0.05)])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_steps_are_those_of_adam_on_the_losses(layout, seam, smooth):
    mapping = table_of(layout)
    rows, previous = rows_of(mapping), rows_of(mapping, 2)[:-1]
    low, high = torch.full((4,), -0.15), torch.full((4,), 0.2)
    rows[:-1].clamp_(low, high)
    valid = torch.from_numpy(mapping.valid())
    columns = [rows[:-1, c : c + 1].double().requires_grad_() for c in range(4)]
    adam = torch.optim.Adam(
        [{"params": [column], "lr": float(rate)} for column, rate in zip(columns, RATES, strict=True)],
        betas=BETAS,
        eps=EPSILON,
    )
    around = lattice_neighbors(mapping.lookup())
    neighbors = joined(image_neighbors(mapping), around) if smooth else mapping
    mine = TableOptimizer(neighbors, rows, STEP, low, high, previous)
    last, pixels = rows[-1].clone(), torch.from_numpy(mapping.pixels).long()
    generator = torch.Generator().manual_seed(3)
    for _ in range(5):
        gradient = torch.randn(rows.shape, generator=generator) * 1e-4
        mine.step(gradient, RATES, 0.02, 0.03, seam, smooth)
        exact = torch.cat(columns, 1)
        image = exact.new_zeros(64 * 64, 4).index_put((pixels,), exact).reshape(64, 64, 4)
        loss = 0.02 * spatial_loss(image, valid, STEP.double(), seam)
        loss = loss + 0.03 * temporal_loss(exact, previous.double(), STEP.double())
        for near in torch.from_numpy(around.rows[:, ::2]).long().T:  # every pair from one of its sides
            there = near >= 0
            apart = (exact[there] - exact[near[there]]) / STEP.double()
            loss = loss + smooth * smooth_abs(apart).sum() / mapping.count
        loss = loss + (exact * gradient[:-1].double()).sum()
        adam.zero_grad()
        loss.backward()
        adam.step()
        with torch.no_grad():
            for c, column in enumerate(columns):
                column.clamp_(low[c].double(), high[c].double())
    truth = torch.cat(columns, 1).detach()
    assert ((truth == high) | (truth == low)).any()
    assert torch.allclose(rows[:-1].double(), truth, rtol=0, atol=2e-5)
    assert (rows[-1] == last).all()


@pytest.mark.parametrize("lanes", [4, 8])
@pytest.mark.parametrize("channels", [2, 4, 7, 8, 13, 16])
@pytest.mark.parametrize("space", [False, True, None])
def test_kernels_are_the_twin(channels, lanes, space):
    lanes_or_skip(lanes)
    mapping = table_of()
    around, beside = lattice_neighbors(mapping.lookup()), image_neighbors(mapping)
    neighbors = joined(beside, around) if space is None else around if space else beside
    generator = torch.Generator().manual_seed(channels)
    step, rates = torch.rand(channels, generator=generator) + 0.1, torch.rand(channels, generator=generator) * 0.1
    rows = torch.randn(mapping.count + 1, channels, generator=generator)
    previous = rows[:-1] + torch.randn(mapping.count, channels, generator=generator) * step
    start, exact, wide = rows.double(), rows.double(), torch.full((channels,), 1.5)
    mine = TableOptimizer(neighbors, rows, step, -wide, wide, previous)
    twin = reference.TableOptimizer(neighbors, exact, step, -wide, wide, previous)
    for _ in range(4):
        gradient = torch.randn(rows.shape, generator=generator) * 1e-3
        for optimizer in (mine, twin):
            optimizer.step(gradient, rates, 0.5, 0.3, 0.4, 0.7)
    # Adam makes full steps of gradients that are nearly 0: single values may differ by more than rounding.
    assert (rows - exact).norm() < 1e-5 * (exact - start).norm()
    assert torch.allclose(
        noisy_rows(rows, step, 2**40 + 5).double(), reference.noisy_rows(rows.double(), step, 2**40 + 5), atol=1e-6
    )


def test_bits_do_not_hang_on_the_number_of_threads():
    mapping, results = table_of(shape=(33, 40, 40), share=0.05), []
    mapping = build_table(mapping.occupancy() | np.roll(mapping.occupancy(), 1, 0), (128, 128))
    for threads in (1, 2, 5):
        native.set_threads(threads)
        rows, previous, wide = rows_of(mapping), rows_of(mapping, 2)[:-1], torch.full((4,), 9.0)
        optimizer = TableOptimizer(mapping, rows, STEP, -wide, wide, previous)
        for _ in range(3):
            optimizer.step(rows_of(mapping, 3), RATES, 0.1, 0.1, 0.5)
        results.append(rows.numpy().tobytes() + noisy_rows(rows, STEP, 3).numpy().tobytes())
    assert mapping.count > 4096  # more than one thread has something to do
    assert len(set(results)) == 1


def test_first_frames_have_no_rows_before():
    mapping = table_of()
    rows = rows_of(mapping)
    before = rows.clone()
    wide = torch.full((4,), 9.0)
    TableOptimizer(mapping, rows, STEP, -wide, wide).step(torch.zeros_like(rows), RATES, 0.0, 1.0)
    assert (rows == before).all()


def test_neighbors_are_mutual_and_next_to_each_other():
    mapping = table_of("superblocks")
    neighbors = image_neighbors(mapping)
    row, column = np.divmod(mapping.pixels, 64)
    offsets = [(-1, 0), (1, 0), (0, -1), (0, 1)]
    for side, (down, right) in enumerate(offsets):
        has = neighbors.rows[:, side] >= 0
        other = neighbors.rows[has, side]
        assert (row[other] - row[has] == down).all()
        assert (column[other] - column[has] == right).all()
        assert (neighbors.rows[other, side ^ 1] == np.flatnonzero(has)).all()
        apart = (row[other] // 8 != row[has] // 8) | (column[other] // 8 != column[has] // 8)
        assert (neighbors.kinds[has, side] == np.where(apart, SEAM, INSIDE)).all()
    assert (neighbors.rows >= 0).sum() > 3 * mapping.count


def test_neighbors_in_space():
    mapping = table_of(share=0.6)
    found = lattice_neighbors(mapping.lookup()).rows
    place = mapping.vertices.astype(int)
    lookup = mapping.lookup()
    for side in range(6):
        offset = np.zeros(3, int)
        offset[side // 2] = (-1, 1)[side % 2]
        there = place + offset
        inside = ((there >= 0) & (there < lookup.shape)).all(1)
        assert (found[~inside, side] == -1).all()
        assert (found[inside, side] == lookup[tuple(there[inside].T)]).all()


def test_noise_is_uniform_and_hangs_on_the_seed_alone():
    rows, step = torch.zeros(50_001, 4), STEP
    first, again, other = noisy_rows(rows, step, 7), noisy_rows(rows, step, 7), noisy_rows(rows, step, 8)
    assert (first == again).all()
    assert (first != other)[:-1].float().mean() > 0.99
    assert (first[-1] == 0).all()
    share = first[:-1] / step
    assert share.abs().max() <= 0.5
    assert torch.allclose(share.mean(0), torch.zeros(4), atol=0.01)
    assert torch.allclose(share.var(0), torch.full((4,), 1 / 12), atol=0.002)
    assert abs(np.corrcoef(share.numpy().T) - np.eye(4)).max() < 0.02  # channels know nothing of each other
    assert abs(np.corrcoef(share[1:, 0].numpy(), share[:-1, 0].numpy())[0, 1]) < 0.02  # nor do rows
    out = torch.empty_like(rows)
    assert noisy_rows(rows + 1, step, 7, out) is out
    assert torch.allclose(out - 1, first, atol=1e-6)


def test_what_does_not_fit_is_refused():
    mapping = table_of()
    rows, wide = rows_of(mapping), torch.full((4,), 9.0)
    with pytest.raises(ValueError, match="the rows are"):
        TableOptimizer(mapping, rows[:-1], STEP, -wide, wide)
    with pytest.raises(ValueError, match="the rows before"):
        TableOptimizer(mapping, rows, STEP, -wide, wide, rows)
    with pytest.raises(ValueError, match="they change in place"):
        TableOptimizer(mapping, rows.double(), STEP, -wide, wide)
    neighbors = image_neighbors(mapping)
    neighbors.rows[3, 1] = mapping.count
    with pytest.raises(ValueError, match="rows of the table"):
        TableOptimizer(neighbors, rows, STEP, -wide, wide)
    with pytest.raises(ValueError, match="the gradient is"):
        TableOptimizer(mapping, rows, STEP, -wide, wide).step(rows[:-1], RATES)
    with pytest.raises(ValueError, match="the noisy rows need"):
        noisy_rows(rows, STEP, 1, rows[:-1])
