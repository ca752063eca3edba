# SPDX-License-Identifier: GPL-3.0-or-later
"""Drawing a field: against the march and the shading in float64, one pixel at a time where it matters."""

import math

import numpy as np
import pytest
import torch
from holoreel.core.camera import Camera
from holoreel.core.errors import HoloreelError
from holoreel.core.videorf import native, reference
from holoreel.core.videorf.deferred import DeferredShading
from holoreel.core.videorf.draw import QUALITY, camera_rays, draw_field, draw_field_torch
from holoreel.core.videorf.field import FieldLattice, MarchRules, Rays
from holoreel.core.videorf.march import Volume
from holoreel.core.videorf.occupancy import Lattice, dilate
from holoreel.core.videorf.shading import ShadingShape, composite


@pytest.fixture(autouse=True)
def as_before():
    threads = native.get_threads()
    yield
    native.set_threads(threads)
    native.set_lanes(0)


def scene(channels=8, frequencies=1, hidden=16, seed=0):
    """A hollow ball of random rows, a network that is not gray, and a camera that sees it off its middle."""
    random = np.random.default_rng(seed)
    shape = (29, 24, 33)
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, edge) for edge in shape], indexing="ij"), -1)
    occupancy = dilate(abs(np.linalg.norm(grid, axis=-1) - 0.75) < 0.06)
    lookup = np.full(shape, -1, np.int32)
    count = int(occupancy.sum())
    lookup[occupancy] = random.permutation(count)
    field = FieldLattice(Lattice(shape, (-1.2, -0.9, -1.4), 0.09), lookup, count + 1)
    table = random.normal(0, 1, (field.rows, channels)).astype(np.float32)
    table[:, 0] = random.uniform(-4, 1, field.rows)
    table[-1] = 0
    table[-1, 0] = -8
    generator = torch.Generator().manual_seed(seed)
    network = DeferredShading(ShadingShape(channels - 1, frequencies, hidden), generator)
    with torch.no_grad():
        for layer in network.layers:
            layer.bias.copy_(torch.randn(layer.bias.shape, generator=generator) * 0.5)
            layer.weight.mul_(1.5)
    return field, torch.from_numpy(table), network.numbers()


def camera(width=37, height=23, **changes):
    return Camera.look_at((2.5, -3.0, 1.2), (0.1, 0.0, -0.2), width=width, height=height, fx=28.0, **changes)


@pytest.mark.parametrize("rules", [MarchRules(0.5, 0.0), MarchRules(1.0, 0.05)])
@pytest.mark.parametrize(("channels", "frequencies", "hidden"), [(8, 1, 16), (4, None, 5), (12, 4, 16), (13, 0, 33)])
def test_a_picture_is_march_and_shading(channels, frequencies, hidden, rules):
    field, table, shading = scene(channels, frequencies, hidden)
    view, background = camera(), (0.2, 0.5, 0.9)
    origins, directions = camera_rays(view)
    rays = Rays(torch.from_numpy(origins), torch.from_numpy(directions))
    marched = reference.march(field, table.double(), rays, rules)
    left = marched.transmittance.numpy()
    truth = composite(shading(marched.features.numpy(), directions), left, np.array(background))
    local = directions @ view.world_to_camera[:3, :3].T
    with np.errstate(invalid="ignore"):
        z = np.where(left < 1, local[:, 2] * marched.depth.numpy() / (1 - left), np.inf)
    for drawn in (
        draw_field(Volume(field), table, shading, view, rules, background),
        draw_field_torch(field, table.double(), shading, view, rules, background, chunk=100),
    ):
        assert drawn.image.shape == (23, 37, 3)
        assert drawn.image.dtype == drawn.alpha.dtype == drawn.depth.dtype == np.float32
        assert abs(drawn.image.reshape(-1, 3) - truth).max() < 1e-5
        assert abs(drawn.alpha.ravel() - (1 - left)).max() < 1e-5
        solid = left < 0.99
        assert (np.isinf(drawn.depth) == (drawn.alpha == 0)).all()
        assert abs(drawn.depth.ravel()[solid] / z[solid] - 1).max() < 1e-4
    assert 50 < solid.sum() < 37 * 23 - 50


def test_bits_do_not_hang_on_the_number_of_threads():
    field, table, shading = scene()
    pictures = []
    for threads in (1, 2, 5):
        native.set_threads(threads)
        drawn = draw_field(Volume(field), table, shading, camera())
        pictures.append(b"".join(part.tobytes() for part in drawn))
    assert len(set(pictures)) == 1


@pytest.mark.parametrize("lanes", [4, 8])
def test_narrow_and_wide_kernels_draw_alike(lanes):
    field, table, shading = scene(frequencies=8)
    best = draw_field(Volume(field), table, shading, camera())
    try:
        native.set_lanes(lanes)
    except HoloreelError:
        pytest.skip(f"no {lanes} lanes here")
    drawn = draw_field(Volume(field), table, shading, camera())
    assert abs(drawn.image - best.image).max() < 1e-5
    assert abs(drawn.alpha - best.alpha).max() < 1e-5


def test_networks_of_other_tables_are_refused():
    field, table, shading = scene(8)
    with pytest.raises(HoloreelError, match="other features than the table"):
        draw_field(Volume(field), table[:, :3].contiguous(), shading, camera())
    with pytest.raises(HoloreelError, match="must lie in"):
        draw_field(Volume(field), table, shading, camera(), MarchRules(0.0))


def test_depth_is_planar():
    """A wall across the view has one depth in all pixels, however far its edges are from the eye."""
    lookup = np.full((40, 40, 6), -1, np.int32)
    lookup[:, :, 2:4] = np.arange(40 * 40 * 2).reshape(40, 40, 2)
    field = FieldLattice(Lattice((40, 40, 6), (-2.0, -2.0, 3.0), 0.1), lookup, 3201)
    table = torch.zeros(3201, 4)
    table[:, 0], table[-1, 0] = 60.0, -8.0
    view = Camera(32, 24, 32.0, 32.0, 16.0, 12.0)
    *_, shading = scene(4)
    drawn = draw_field(Volume(field), table, shading, view)
    assert drawn.alpha.min() > 0.999
    assert abs(drawn.depth - 3.2).max() < 0.1
    assert drawn.depth.std() < 0.03


def test_what_a_lens_does_not_see_is_background():
    field, table, shading = scene()
    wide = Camera.look_at((2.5, -3.0, 1.2), (0.1, 0, 0), width=32, height=32, fx=4.0)
    fisheye = Camera(32, 32, 4.0, 4.0, 16.0, 16.0, wide.world_to_camera, "OPENCV_FISHEYE", "", (0.0, 0.0, 0.0, 0.0))
    unseen = ~np.isfinite(camera_rays(fisheye)[1]).all(1).reshape(32, 32)
    assert 0 < unseen.sum() < unseen.size
    for drawn in (
        draw_field(Volume(field), table, shading, fisheye, background=(0.1, 0.2, 0.3)),
        draw_field_torch(field, table, shading, fisheye, background=(0.1, 0.2, 0.3)),
    ):
        assert (drawn.alpha[unseen] == 0).all()
        assert (drawn.image[unseen] == np.array((0.1, 0.2, 0.3), np.float32)).all()
        assert (drawn.depth[unseen] == math.inf).all()
        assert np.isfinite(drawn.image).all()
        assert drawn.alpha.max() > 0.1


def test_lower_qualities_look_alike():
    field, table, shading = scene()
    view = camera()
    full = draw_field(Volume(field), table, shading, view, QUALITY["full"]).image
    errors = [
        abs(draw_field(Volume(field), table, shading, view, rules).image - full).mean() for rules in QUALITY.values()
    ]
    assert errors[0] == 0
    assert errors == sorted(errors)
    assert errors[-1] < 0.05
