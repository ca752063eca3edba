# SPDX-License-Identifier: GPL-3.0-or-later
"""The ray march: the twin against a loop in plain Python, the kernels against the twin in float64."""

import math
import os

import numpy as np
import pytest
import torch
from holoreel.core.errors import HoloreelError
from holoreel.core.videorf import native, reference
from holoreel.core.videorf.field import FieldLattice, MarchRules, Rays
from holoreel.core.videorf.march import Volume, count_samples, march
from holoreel.core.videorf.occupancy import Lattice, dilate

TOLERANCE = 1e-5  # relative, L2


@pytest.fixture(autouse=True)
def two_threads():
    before, torch_before = native.get_threads(), torch.get_num_threads()
    native.set_threads(2)
    torch.set_num_threads(1)
    yield
    native.set_threads(before)
    torch.set_num_threads(torch_before)
    native.set_lanes(0)


def ball_field(shape=(37, 22, 29), seed=0):
    """A hollow ball of random rows with a few stray vertices, some of them on the lattice's faces."""
    random = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, edge) for edge in shape], indexing="ij"), -1)
    radius = np.linalg.norm(grid, axis=-1)
    occupancy = dilate(abs(radius - 0.75) < 0.08) | (random.random(shape) < 0.004)
    lookup = np.full(shape, -1, np.int32)
    count = int(occupancy.sum())
    lookup[occupancy] = random.permutation(count)
    return FieldLattice(Lattice(shape, (-1.8, 0.4, 2.0), 0.07), lookup, count + 1)


def random_table(field, channels, seed=1, density=(-3.0, 2.0)):
    random = np.random.default_rng(seed)
    table = random.normal(0, 1, (field.rows, channels))
    table[:, 0] = random.uniform(*density, field.rows)
    table[-1] = 0
    table[-1, 0] = -8
    return torch.from_numpy(table)


def random_rays(field, count, seed=2):
    """Rays through the lattice from all sides, from inside, past it, and along its axes."""
    random = np.random.default_rng(seed)
    low, high = np.array(field.lattice.lowest), np.array(field.lattice.highest)
    size = high - low
    origins = low + size * random.uniform(-1.5, 2.5, (count, 3))
    origins[: count // 8] = low + size * random.random((count // 8, 3))
    targets = low + size * random.random((count, 3))
    directions = targets - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions[-4:] = [[0, 0, 1], [0, -1, 0], [1, 0, 0], [0, 0, -1]]
    origins[-4:] = targets[-4:] - directions[-4:] * 5
    origins, directions = origins.astype(np.float32), directions.astype(np.float32)
    return Rays(*map(torch.from_numpy, (origins, directions, random.random(count, dtype=np.float32))))


def relative(mine, truth):
    mine, truth = mine.detach().double(), truth.detach().double()
    return float((mine - truth).norm() / truth.norm())


def loop_march(field, table, origin, direction, jitter, step, least):
    """One ray, one sample after the other."""
    lattice, last = field.lattice, [edge - 1 for edge in field.lattice.shape]
    o = [(origin[a] - lattice.lowest[a]) / lattice.spacing for a in range(3)]
    near, far = 0.0, math.inf
    for a in range(3):
        if direction[a] == 0:
            if not 0 <= o[a] <= last[a]:
                return np.zeros(table.shape[1] - 1), 1.0, 0.0
            continue
        ends = sorted(((0 - o[a]) / direction[a], (last[a] - o[a]) / direction[a]))
        near, far = max(near, ends[0]), min(far, ends[1])
    features, left, depth, k = np.zeros(table.shape[1] - 1), 1.0, 0.0, 0
    while (t := near + (k + jitter) * step) < far:
        k += 1
        p = [min(max(o[a] + t * direction[a], 0.0), last[a]) for a in range(3)]
        cell = [min(int(p[a]), last[a] - 1) for a in range(3)]
        row, occupied = np.zeros(table.shape[1]), False
        for corner in range(8):
            offset = (corner >> 2, corner >> 1 & 1, corner & 1)
            index = field.lookup[tuple(c + d for c, d in zip(cell, offset, strict=True))]
            occupied |= index >= 0
            weight = math.prod(p[a] - cell[a] if offset[a] else 1 - p[a] + cell[a] for a in range(3))
            row += weight * table[index]  # -1 is the last row
        if not occupied:
            continue
        passed = (1 + math.exp(row[0])) ** -step
        weight = left * (1 - passed)
        features += weight * row[1:]
        depth += weight * t * lattice.spacing
        left *= passed
        if left <= least:
            break
    return features, left, depth


def test_twin_is_the_loop():
    field = ball_field()
    table, rays = random_table(field, 5, density=(-2, 4)), random_rays(field, 60)
    rules = MarchRules(step=0.7, transmittance_min=0.01)
    marched = reference.march(field, table, rays, rules)
    ended = 0
    for index in range(60):
        ray = (rays.origins[index].tolist(), rays.directions[index].tolist(), float(rays.jitter[index]))
        features, left, depth = loop_march(field, table.numpy(), *ray, *rules)
        assert marched.features[index].numpy() == pytest.approx(features, abs=1e-9)
        assert float(marched.transmittance[index]) == pytest.approx(left, abs=1e-9)
        assert float(marched.depth[index]) == pytest.approx(depth, abs=1e-9)
        ended += left <= 0.01
    assert 5 < ended < 55


@pytest.mark.parametrize("lanes", [4, 8])
@pytest.mark.parametrize("channels", [2, 4, 8, 12, 13, 16])
def test_kernels_are_the_twin(channels, lanes):
    try:
        assert native.set_lanes(lanes) == lanes
    except HoloreelError:
        pytest.skip(f"no {lanes} lanes here")
    field = ball_field()
    table = random_table(field, channels).float().requires_grad_()
    exact = table.detach().double().requires_grad_()
    rays, rules = random_rays(field, 300), MarchRules(0.5, 0.0)
    mine, truth = march(Volume(field), table, rays, rules), reference.march(field, exact, rays, rules)
    random = torch.Generator().manual_seed(3)
    incoming = [torch.randn(part.shape, generator=random, dtype=torch.float64) for part in truth]
    for part, other in zip(mine, truth, strict=True):
        assert part.shape == other.shape
        assert relative(part, other) < TOLERANCE
    sum((part * gradient).sum() for part, gradient in zip(truth, incoming, strict=True)).backward()
    sum((part * gradient).sum() for part, gradient in zip(mine, incoming, strict=True)).backward()
    assert relative(table.grad, exact.grad) < TOLERANCE
    assert relative(table.grad[:, 0], exact.grad[:, 0]) < TOLERANCE
    assert (table.grad[-1] == 0).all()
    assert (exact.grad[-1] == 0).all()


@pytest.mark.parametrize("part", ["features", "transmittance", "depth"])
def test_each_output_carries_its_own_gradient(part):
    field = ball_field()
    table = random_table(field, 8).float().requires_grad_()
    exact = table.detach().double().requires_grad_()
    rays = random_rays(field, 300)._replace(jitter=None)
    rules = MarchRules(1.0, 0.0)
    getattr(march(Volume(field), table, rays, rules), part).sum().backward()
    getattr(reference.march(field, exact, rays, rules), part).sum().backward()
    assert relative(table.grad, exact.grad) < TOLERANCE


def test_rays_end_early_in_the_same_place():
    field = ball_field()
    table = random_table(field, 8, density=(2.0, 6.0)).float().requires_grad_()
    exact = table.detach().double().requires_grad_()
    rays, rules = random_rays(field, 500), MarchRules(0.5, 1e-4)
    volume = Volume(field)
    mine, truth = march(volume, table, rays, rules), reference.march(field, exact, rays, rules)
    assert relative(mine.features, truth.features) < 1e-4
    mine.features.square().sum().backward()
    truth.features.square().sum().backward()
    assert relative(table.grad, exact.grad) < 1e-4
    assert count_samples(volume, table, rays, rules) < 0.7 * count_samples(volume, table, rays, MarchRules(0.5, 0.0))


def test_gradients_are_the_same_bits_for_any_number_of_threads():
    field = ball_field()
    table, rays = random_table(field, 8).float(), random_rays(field, 10_000)
    volume, gradients, pictures = Volume(field), [], []
    for threads in (1, 2, 5):
        native.set_threads(threads)
        leaf = table.clone().requires_grad_()
        marched = march(volume, leaf, rays)
        (marched.features.square().sum() + marched.depth.sum()).backward()
        gradients.append(leaf.grad.numpy().tobytes())
        pictures.append(b"".join(part.detach().numpy().tobytes() for part in marched))
    assert len(set(gradients)) == len(set(pictures)) == 1


def test_skipping_leaves_no_sample_out():
    """A lattice that is full takes every sample; thinned out, it takes exactly those in occupied cells."""
    field = ball_field((70, 40, 50))
    rays, rules = random_rays(field, 400), MarchRules(0.5, 0.0)
    table = random_table(field, 4).float()
    lattice = field.lattice
    local = (rays.origins.double().numpy() - lattice.lowest) / lattice.spacing
    full = np.arange(math.prod(lattice.shape), dtype=np.int32).reshape(lattice.shape)
    everything = torch.zeros(full.size + 1, 4)
    all_samples = count_samples(Volume(FieldLattice(lattice, full, full.size + 1)), everything, rays, rules)
    directions, expected, total = rays.directions.double().numpy(), 0, 0
    for o, d, jitter in zip(local, directions, rays.jitter.numpy().astype(float), strict=True):
        with np.errstate(divide="ignore"):
            ends = np.sort(np.stack(((0 - o) / d, (np.array(lattice.shape) - 1 - o) / d)), 0)
        near, far = max(0.0, ends[0].max()), ends[1].min()
        t = near + (np.arange(max(0, math.ceil((far - near) / 0.5 - jitter))) + jitter) * 0.5
        cell = np.clip((o + t[:, None] * d).astype(int), 0, np.array(lattice.shape) - 2)
        corners = cell[:, None] + np.indices((2, 2, 2)).reshape(3, 8).T
        expected += int((field.lookup[tuple(np.moveaxis(corners, -1, 0))] >= 0).any(1).sum())
        total += len(t)
    assert abs(all_samples - total) <= 2  # a sample on the far face may fall either way
    assert abs(count_samples(Volume(field), table, rays, rules) - expected) <= 2 + expected // 5000


def test_empty_fields_and_rays_without_meaning_are_black():
    lattice = Lattice((5, 6, 7), (0, 0, 0), 1.0)
    nothing = FieldLattice(lattice, np.full((5, 6, 7), -1, np.int32), 1)
    table = torch.zeros(1, 4, requires_grad=True)
    rays = random_rays(nothing, 50)
    marched = march(Volume(nothing), table, rays)
    assert (marched.transmittance == 1).all()
    assert (marched.features == 0).all()
    marched.depth.sum().backward()
    assert (table.grad == 0).all()
    field = ball_field()
    broken = random_rays(field, 6)
    for index, (part, value) in enumerate([(0, math.nan), (1, math.nan), (0, math.inf), (1, math.inf), (1, 0.0)]):
        broken[part][index] = value
    marched = march(Volume(field), random_table(field, 8).float(), broken)
    assert (marched.transmittance[:5] == 1).all()
    none = march(Volume(field), random_table(field, 8).float(), Rays(torch.zeros(0, 3), torch.zeros(0, 3)))
    assert none.features.shape == (0, 7)


def test_wrong_arguments_are_refused():
    field = ball_field()
    bad = field.lookup.copy()
    bad[0, 0, 0] = field.rows - 1  # the row of empty vertices belongs to nobody
    with pytest.raises(HoloreelError, match="a row that the table does not have"):
        Volume(field._replace(lookup=bad))
    volume, rays = Volume(field), random_rays(field, 8)
    with pytest.raises(ValueError, match="the table is"):
        march(volume, torch.zeros(field.rows, 17), rays)
    with pytest.raises(ValueError, match="the table is"):
        march(volume, torch.zeros(field.rows - 1, 8), rays)
    with pytest.raises(ValueError, match="jitter"):
        march(volume, torch.zeros(field.rows, 8), rays._replace(jitter=torch.zeros(9)))
    for rules in (MarchRules(0.0), MarchRules(math.nan), MarchRules(0.5, 1.0), MarchRules(0.5, -0.1)):
        with pytest.raises(HoloreelError, match="must lie in"):
            march(volume, torch.zeros(field.rows, 8), rays, rules)
    with pytest.raises(HoloreelError, match="7 lanes"):
        native.set_lanes(7)


def test_a_gradient_is_taken_once_and_tapes_are_used_again():
    field = ball_field()
    volume, rays = Volume(field), random_rays(field, 200)
    gradients = []
    for _ in range(4):
        table = random_table(field, 8).float().requires_grad_()
        loss = march(volume, table, rays).features.sum()
        other = march(volume, table.detach().flip(0).requires_grad_(), rays).features.sum()  # another tape, in between
        loss.backward(retain_graph=True)
        gradients.append(table.grad.clone())
        other.backward()
        with pytest.raises(RuntimeError, match="once"):
            loss.backward()
    assert all((gradient == gradients[0]).all() for gradient in gradients)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_march_works_in_a_forked_child():
    field = ball_field()
    table, rays, volume = random_table(field, 8).float(), random_rays(field, 500), Volume(field)
    march(volume, table, rays)
    child = os.fork()
    if child == 0:
        os._exit(0 if bool(torch.isfinite(march(volume, table, rays).features).all()) else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def test_a_field_is_learned_from_its_pictures():
    """The gradients lead somewhere: rays that were not trained on look right afterwards."""
    field = ball_field((16, 15, 14))
    truth = random_table(field, 4, density=(-2.0, 2.0)).float()
    volume, seen, unseen = Volume(field), random_rays(field, 2000), random_rays(field, 500, seed=9)
    target, test = march(volume, truth, seen).features, march(volume, truth, unseen).features
    table = torch.zeros_like(truth)
    table[-1] = truth[-1]
    table.requires_grad_()
    optimizer = torch.optim.Adam([table], lr=0.1)

    def error(rays, picture):
        return float((march(volume, table.detach(), rays).features - picture).square().mean())

    before = error(seen, target), error(unseen, test)
    for _ in range(60):
        optimizer.zero_grad()
        (march(volume, table, seen).features - target).square().mean().backward()
        optimizer.step()
    assert error(seen, target) < 0.01 * before[0]
    assert error(unseen, test) < 0.2 * before[1]
    assert (table[-1] == truth[-1]).all()
