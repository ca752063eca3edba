# SPDX-License-Identifier: GPL-3.0-or-later
"""Coarse fields: their file, their change of lattice, and their training on a ball whose place and colors are known."""

import io
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch
from holoreel.core.errors import HoloreelError
from holoreel.core.videorf import coarse as coarse_module
from holoreel.core.videorf import native, reference
from holoreel.core.videorf.coarse import (
    Coarse,
    CoarseConfig,
    entropy,
    occupancy_of,
    ray_weights,
    read_coarse,
    resample,
    rescaled,
    train_coarse,
    wider,
)
from holoreel.core.videorf.coarse_frames import CoarseJob, train_coarse_frames
from holoreel.core.videorf.field import FieldLattice, MarchRules, Rays
from holoreel.core.videorf.hull import visual_hull
from holoreel.core.videorf.march import Volume, march
from holoreel.core.videorf.occupancy import Lattice, occupied, opacity
from holoreel.core.videorf.views import FrameViews
from hypothesis import given
from hypothesis import strategies as st

from .videorf_ball import CENTER, RADIUS, around, ball_capture, distances, dome, hits_of

QUICK = CoarseConfig(iterations=120, rays=1024)


@given(st.floats(-12, 16), st.floats(0.2, 5))
def test_rescaled_densities_absorb_in_proportion(density, ratio):
    again = float(rescaled(np.array(density), ratio))
    assert np.logaddexp(0, again) == pytest.approx(ratio * np.logaddexp(0, density), rel=3e-6)
    assert opacity(np.array(again)) == pytest.approx(opacity(np.array(density), ratio), rel=3e-6)


def test_resample_is_exact_for_linear_values():
    source = Lattice((9, 7, 8), (-1.0, 0.5, 2.0), 0.25)
    target = Lattice((20, 12, 17), (-1.2, 0.52, 2.1), 0.11)

    def plane(lattice):
        vertices = np.stack(np.meshgrid(*map(np.arange, lattice.shape), indexing="ij"), -1)
        places = lattice.positions(vertices)
        return np.stack((places @ [3.0, -2.0, 1.0] + 5, places @ [0.1, 1.0, 10.0]), -1), places

    values, expected = plane(source)[0], plane(target)[0]
    places = plane(target)[1]
    beyond = ((places < source.lowest) | (places > source.highest)).any(-1)
    assert 0.1 < beyond.mean() < 0.9
    mean = resample(values, source, target, -7.0)
    assert mean[~beyond] == pytest.approx(expected[~beyond], abs=1e-4)
    assert (mean[beyond] == -7).all()
    assert (resample(values[..., 0], source, source, 0.0) == values[..., 0].astype(np.float32)).all()


def test_resampled_fields_look_the_same():
    """Rays lose as much in a field as in the same on a finer, shifted lattice."""
    lattice = around(40)
    density = np.minimum(40 * (RADIUS - distances(lattice)), 3).astype(np.float32)
    random = np.random.default_rng(0)
    coarse = Coarse(lattice, density, random.random((*lattice.shape, 3), np.float32), np.ones_like(density))
    finer = coarse.resampled(Lattice.around(CENTER - RADIUS, CENTER + RADIUS, 67, margin=6))
    camera = dome(3)["cam01"]
    origins, directions = (torch.from_numpy(part.astype(np.float32)) for part in camera.rays())
    alphas = [march(*volume_of(field), Rays(origins, directions), MarchRules(0.25)).alpha for field in (coarse, finer)]
    assert 0.2 < float(alphas[0].mean()) < 0.6
    assert float((alphas[0] - alphas[1]).abs().max()) < 0.02


def volume_of(coarse):
    """All vertices of a coarse field, ready for the march."""
    count = coarse.density.size
    lookup = np.arange(count, dtype=np.int32).reshape(coarse.lattice.shape)
    rows = np.concatenate((coarse.density[..., None], coarse.color), -1).reshape(-1, 4)
    table = np.concatenate((rows, [[-8.0, 0, 0, 0]])).astype(np.float32)
    return Volume(FieldLattice(coarse.lattice, lookup, count + 1)), torch.from_numpy(table)


def telling_coarse():
    """A field whose values encode their place."""
    shape = (4, 5, 6)
    place = np.arange(120, dtype=np.float32).reshape(shape)
    color = (place[..., None] * 3 + np.arange(3, dtype=np.float32)) / 360
    return Coarse(Lattice(shape, (0.125, -3.5, 2.25), 0.3), place - 8, color, 1000 + place)


def test_file_round_trip(tmp_path):
    coarse, path = telling_coarse(), tmp_path / "new" / "field.npz"
    coarse.write(path)
    again = read_coarse(path)
    assert again.lattice == coarse.lattice
    for name in ("density", "color", "weights"):
        assert (getattr(again, name) == getattr(coarse, name)).all()
        assert getattr(again, name).dtype == np.float32
    assert [entry.name for entry in path.parent.iterdir()] == ["field.npz"]


def spoiled(path, name, value):
    """Write another array into a file; bytes are taken as they are."""
    with zipfile.ZipFile(path) as archive:
        parts = {entry: archive.read(entry) for entry in archive.namelist()}
    if isinstance(value, bytes):
        parts[f"{name}.npy"] = value
    else:
        buffer = io.BytesIO()
        np.save(buffer, value, allow_pickle=True)
        parts[f"{name}.npy"] = buffer.getvalue()
    with zipfile.ZipFile(path, "w") as archive:
        for entry, data in parts.items():
            archive.writestr(entry, data)


def huge_header():
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(buffer, {"descr": "<f4", "fortran_order": False, "shape": (200_000,) * 3})
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("density", np.zeros((4, 5, 7), np.float32)),
        ("density", np.zeros((4, 5, 6), np.float64)),
        ("density", np.zeros(4, np.float32)),
        ("density", np.full((4, 5, 6), np.nan, np.float32)),
        ("density", huge_header()),
        ("weights", np.array([{"a": 1}], object)),
        ("color", np.zeros((4, 5, 6, 4), np.float32)),
        ("place", np.array([0, 0, 0, -1.0])),
        ("place", np.array([0, np.inf, 0, 1.0])),
        ("place", b"not an array"),
    ],
)
def test_damaged_files_are_refused(tmp_path, name, value):
    path = tmp_path / "field.npz"
    telling_coarse().write(path)
    spoiled(path, name, value)
    with pytest.raises(HoloreelError, match=r"field\.npz .*train it again"):
        read_coarse(path)


@pytest.mark.parametrize("size", [0, 10, 700])
def test_cut_files_are_refused(tmp_path, size):
    path = tmp_path / "field.npz"
    telling_coarse().write(path)
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(HoloreelError, match=r"field\.npz .*train it again"):
        read_coarse(path)
    with pytest.raises(HoloreelError, match=r"none\.npz"):
        read_coarse(tmp_path / "none.npz")


def test_entropy_is_that_of_a_coin():
    left = torch.tensor([0.0, 1.0, 0.5, 0.25])
    assert entropy(left).tolist() == pytest.approx([0, 0, np.log(2), 0.25 * np.log(4) + 0.75 * np.log(4 / 3)], abs=3e-5)


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    """A painted ball: its capture, its training views, its lattice, its coarse field."""
    capture = ball_capture(tmp_path_factory.mktemp("ball"), 1, painted=True, splits={"cam05": "test"})
    views, lattice = FrameViews(capture, 0), around(24, margin=3)
    return capture, views, lattice, train_coarse(views, lattice, QUICK, seed=4)


def drawn(coarse, camera):
    """A coarse field over white, and its alpha."""
    origins, directions = (torch.from_numpy(part.astype(np.float32)) for part in camera.rays())
    marched = march(*volume_of(coarse), Rays(origins, directions))
    image = marched.features + marched.transmittance[:, None]
    return image.reshape(camera.height, camera.width, 3).numpy(), marched.alpha.reshape(camera.height, -1).numpy()


def test_trained_ball_is_seen_by_a_camera_it_never_saw(ball):
    capture, _, _, coarse = ball
    camera = capture.cameras["cam05"]
    image, alpha = drawn(coarse, camera)
    hit, normals = hits_of(camera)
    truth = np.where(hit[..., None], 0.5 + 0.4 * normals, 1.0)
    assert -10 * np.log10(np.square(image - truth).mean()) > 24
    rim = hit ^ (hits_of(camera, radius=RADIUS * 0.8)[0])
    assert alpha[hit & ~rim].min() > 0.9
    assert alpha[~hits_of(camera, radius=RADIUS * 1.15)[0]].max() < 0.1


def test_coarse_fields_are_whole(ball):
    _, views, lattice, coarse = ball
    outside = ~visual_hull(views, lattice)
    assert (coarse.density[outside] == -8).all()
    assert (coarse.weights[outside] == 0).all()
    assert 0 <= coarse.color.min() < coarse.color.max() <= 1
    assert coarse.weights.min() >= 0
    assert coarse.weights[distances(lattice) < RADIUS / 2].sum() < 0.02 * coarse.weights.sum()


def test_occupancy_covers_the_surface(ball):
    _, views, _, coarse = ball
    fine = around(32, margin=3)
    hull = visual_hull(views, fine)
    found = occupancy_of(coarse, fine, hull)
    away = distances(fine)
    shell = abs(away - RADIUS) < 0.5 * fine.spacing
    assert (found & shell).sum() > 0.98 * shell.sum()
    assert not (found & ~hull).any()
    field = coarse.resampled(fine)
    assert (found == occupied(field.density, 0.05, field.weights, 0.97, hull)).all()
    assert occupancy_of(coarse, fine, hull, share=0.7).sum() < found.sum()
    assert occupancy_of(coarse, fine, None).sum() >= found.sum()
    with pytest.raises(HoloreelError, match="lower gamma"):
        occupancy_of(replace(coarse, density=np.full_like(coarse.density, -8)), fine, hull)


def test_weights_are_those_of_the_samples(ball, tmp_path):
    """The kernels' gradient against weights that the twin sums, ray by ray, one vertex lit at a time."""
    lattice = ball[2]
    views = FrameViews(ball_capture(tmp_path, cameras=dome(3)), 0)
    lookup = np.full(lattice.shape, -1, np.int32)
    lookup[9:12, 9:12, 9:12] = np.random.default_rng(1).permutation(27).reshape(3, 3, 3)
    field = FieldLattice(lattice, lookup, 28)
    rows = torch.from_numpy(np.random.default_rng(0).uniform(-1, 1, (28, 4)).astype(np.float32))
    rows[-1, 0] = -8
    weights = ray_weights(Volume(field), rows, views, CoarseConfig(weight_rays=10**6), torch.Generator())
    batch = views.rays(slice(None))
    rays = Rays(batch.origins.double(), batch.directions.double())
    lit = torch.cat((rows[:, :1], torch.eye(28)), 1).double()
    parts = [torch.cat((lit[:, :1], lit[:, 1 + at : 15 + at]), 1) for at in (0, 14)]
    summed = torch.cat([reference.march(field, part, rays).features.sum(0) for part in parts])
    assert weights.numpy() == pytest.approx(summed[:27].numpy(), rel=1e-3)
    few = ray_weights(Volume(field), rows, views, CoarseConfig(weight_rays=len(views) // 2), torch.Generator())
    assert float(few.sum() / weights.sum()) == pytest.approx(0.5, rel=0.2)


def test_training_hangs_on_the_seed_alone(ball):
    _, views, lattice, _ = ball
    short = replace(QUICK, iterations=6)
    before = native.get_threads()
    try:
        native.set_threads(1)
        one = train_coarse(views, lattice, short, seed=1)
        native.set_threads(3)
        three = train_coarse(views, lattice, short, seed=1)
    finally:
        native.set_threads(before)
    assert (one.density == three.density).all()
    assert (one.color == three.color).all()
    assert (one.weights == three.weights).all()
    assert (one.density != train_coarse(views, lattice, short, seed=2).density).any()


def test_progress(ball):
    _, views, lattice, _ = ball
    heard = []
    threads = torch.get_num_threads()
    train_coarse(views, lattice, replace(QUICK, iterations=50), on_progress=lambda *report: heard.append(report))
    assert [iteration for iteration, _ in heard] == [20, 40, 50]
    assert 5 < heard[0][1] < heard[-1][1] < 40
    assert torch.get_num_threads() == threads


def test_total_variation_smooths(ball):
    _, views, lattice, _ = ball
    fields = [train_coarse(views, lattice, replace(QUICK, iterations=30, smooth=weight)) for weight in (0, 1e-2)]
    rough = [np.abs(np.diff(field.density[distances(lattice) < RADIUS])).mean() for field in fields]
    assert rough[1] < 0.8 * rough[0]


def test_many_frames_in_many_processes(tmp_path):
    capture = ball_capture(tmp_path / "ball", 3, dome(6), [CENTER, CENTER + 0.1, CENTER - 0.1])
    short = CoarseConfig(iterations=5, rays=256)
    jobs = [CoarseJob(capture, around(16), tmp_path / name, short, seed=7) for name in ("one", "two")]
    heard = []
    train_coarse_frames(jobs[0], range(3), on_progress=lambda *report: heard.append(report[:2]))
    assert heard == [(0, 5), (1, 5), (2, 5)]
    jobs[1].folder.mkdir()
    jobs[1].path(1).write_bytes(b"kept")
    heard.clear()
    train_coarse_frames(jobs[1], range(3), workers=2, on_progress=lambda *report: heard.append(report[:2]))
    assert sorted(heard) == [(0, 5), (2, 5)]
    assert jobs[1].path(1).read_bytes() == b"kept"
    for frame in (0, 2):
        assert (jobs[0].read(frame).density == jobs[1].read(frame).density).all()
    assert (jobs[0].read(0).density != jobs[0].read(2).density).any()


@pytest.mark.parametrize(
    "wrong", [{"iterations": 0}, {"misses": -1}, {"smooth": float("nan")}, {"step": 0.0}, {"color_rate": float("inf")}]
)
def test_settings_out_of_range(wrong):
    with pytest.raises(HoloreelError, match=f"--coarse.{next(iter(wrong)).replace('_', '-')} is"):
        CoarseConfig(**wrong)


@given(st.tuples(*[st.integers(2, 256)] * 3))
def test_wider_lattices_cover_the_same_box(shape):
    lattice = Lattice(shape, (0.5, -1.0, 2.0), 0.25)
    wide = wider(lattice)
    assert wide.spacing == 0.5
    assert wide.lowest == lattice.lowest
    assert all(high >= mine for high, mine in zip(wide.highest, lattice.highest, strict=True))
    assert all(2 * edge <= mine + 3 for edge, mine in zip(wide.shape, shape, strict=True))


def test_large_lattices_start_from_wider_ones(ball):
    """As many steps on the large lattice alone leave haze."""
    capture, views, _, _ = ball
    large, camera = around(60, margin=4), capture.cameras["cam05"]
    hit, normals = hits_of(camera)
    truth = np.where(hit[..., None], 0.5 + 0.4 * normals, 1.0)
    errors, heard = [], []
    config = CoarseConfig(iterations=60, rays=512)
    for widest in (256, 32):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(coarse_module, "WIDEST", widest)
            field = train_coarse(views, large, config, 0, lambda iteration, _: heard.append(iteration))
        assert field.lattice == large
        errors.append(np.square(drawn(field, camera)[0] - truth).mean())
    assert errors[1] < 0.7 * errors[0]
    assert heard == [20, 40, 60] * 2
