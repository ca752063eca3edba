# SPDX-License-Identifier: GPL-3.0-or-later
"""One table of scenes that every backend draws as the float64 oracle does: pictures, gradients, statistics.

The backends that run on a GPU are skipped by name where there is none.
"""

import inspect
import math
import sys
from dataclasses import replace
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
import torch
from holoreel.core.camera import Camera
from holoreel.core.errors import HoloreelError
from holoreel.core.gaussians.decoder import Decoder
from holoreel.core.render import get_backend, reference
from holoreel.core.render.contract import AdamGroup, DensityStats, Rendering, Rules, SpacetimeTensors
from holoreel.core.render.scenes import random_scene
from holoreel.core.render.view import render_view

TIME = 0.4


class Promise(NamedTuple):
    """What a backend is held to."""

    rules: Rules  # the oracle's: those the backend has
    bad_pixels: float  # the part of pixels that may differ by more than `pixel`: a decision may fall the other way
    pixel: float
    gradient: float  # relative, L2


GSPLAT = Promise(Rules(alpha_max=0.999), 0.01, 1e-4, 2e-2)
STAND_IN = "cuda with a stand-in for gsplat"
PROMISES = {"cpu": Promise(Rules(), 0.01, 2e-6, 2e-4), "cuda": GSPLAT, STAND_IN: GSPLAT}


def plain(channels):
    """An ordinary scene."""
    return random_scene(1200, 160, 112, channels, seed=2)


def off_center():
    """The principal point lies outside the picture, whose sides are no multiples of a tile."""
    gaussians, camera = random_scene(900, 131, 83, 3, seed=3)
    shift = 0.7 * camera.width
    gaussians.means[:, 0] -= shift / camera.fx * gaussians.means[:, 2]
    return gaussians, replace(camera, cx=camera.cx + shift, fy=1.1 * camera.fy)


def turned():
    """A camera elsewhere."""
    gaussians, camera = random_scene(900, 96, 64, 3, seed=4)
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 0] = pose[2, 2] = math.cos(0.3)
    pose[0, 2], pose[2, 0] = math.sin(0.3), -math.sin(0.3)
    pose[:3, 3] = torch.tensor([-0.6, 0.2, 0.4])
    return gaussians, replace(camera, world_to_camera=pose.numpy())


def trouble():
    """Rows that are not finite, unrotated, dead, always on, behind the camera, or one before the other."""
    gaussians, camera = random_scene(600, 80, 60, 3, seed=5)
    gaussians.means[:10] = math.nan
    gaussians.log_scales[10:20] = math.inf
    gaussians.quats[20:60], gaussians.omegas[20:60] = 0, 0
    gaussians.trbf_log_scales[60:90] = -6.0
    gaussians.trbf_log_scales[90:120] = math.inf
    gaussians.means[120:150, 2] *= -1
    return gaussians, camera


def nothing():
    """No Gaussian at all."""
    gaussians, camera = random_scene(5, 40, 30, 3)
    return SpacetimeTensors(*(array[:0] for array in gaussians)), camera


CARDS = {
    "1 channel": lambda: plain(1),
    "3 channels": lambda: plain(3),
    "9 channels": lambda: plain(9),
    "16 channels": lambda: plain(16),
    "off center": off_center,
    "turned": turned,
    "trouble": trouble,
    "nothing": nothing,
}


def stand_in(
    *,
    means,
    quats,
    scales,
    opacities,
    colors,
    viewmats,
    Ks,
    width,
    height,
    near_plane,
    eps2d,
    backgrounds,
    render_mode,
    packed,
    with_ut=False,
    with_eval3d=False,
    camera_model="pinhole",
    radial_coeffs=None,
    tangential_coeffs=None,
):
    """What gsplat's `rasterization` returns, made of the oracle's parts; lenses must not distort."""
    assert (render_mode, packed, camera_model) == ("RGB+ED", False, "pinhole")
    assert with_ut == with_eval3d == (radial_coeffs is not None) == (tangential_coeffs is not None)
    if with_ut:
        assert torch.equal(radial_coeffs, torch.zeros(1, 6))
        assert torch.equal(tangential_coeffs, torch.zeros(1, 2))
    (fx, _, cx), (_, fy, cy), _ = Ks[0].tolist()
    camera = Camera(width, height, fx, fy, cx, cy, viewmats[0].double().numpy())
    rules = replace(GSPLAT.rules, near=near_plane, low_pass=eps2d)
    count = len(means)
    gaussians = reference.Gaussians3D(means, quats, scales, opacities, colors)
    splats = reference.project(gaussians, torch.arange(count), camera, rules)
    places = torch.zeros(1, count, 2).index_put((torch.zeros_like(splats.rows), splats.rows), splats.means)
    splats = splats._replace(means=places[0, splats.rows])
    places = places.detach() if with_ut else places  # what the unscented transform finds carries no gradient
    sums = reference.composite(splats, width, height, rules)
    alpha = sums[..., -1:]
    features = sums[..., :-2] + (1 - alpha) * (0 if backgrounds is None else backgrounds[0])
    radii, conics = torch.zeros(1, count, 2, dtype=torch.int32), torch.zeros(1, count, 3)
    _, lists = reference.bin_to_tiles(splats, width, height, rules)
    radii[0, splats.rows[lists]] = 1
    conics[0, splats.rows] = splats.conics.detach()
    depth = sums[..., -2:-1] / alpha.clamp(min=1e-10)
    picture = torch.cat((features, depth), 2)[None]
    return picture, alpha[None], {"means2d": places, "radii": radii, "conics": conics}


@pytest.fixture(params=sorted(PROMISES))
def backend(request, monkeypatch):
    """Yield (backend, its promise)."""
    if request.param == STAND_IN:
        from holoreel.core.render import cuda

        monkeypatch.setattr(cuda, "DEVICE", "cpu")
        monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(rasterization=stand_in))
        return cuda, PROMISES[request.param]
    try:
        return get_backend(request.param), PROMISES[request.param]
    except HoloreelError as error:
        pytest.skip(f"{request.param}: {error}")


def draw(backend, dtype, gaussians, camera, rules, incoming):
    """Return pictures, gradients of all arrays and the background, and the density statistics."""
    device = backend.DEVICE
    arrays = [array.detach().to(device, dtype, copy=True).requires_grad_() for array in gaussians]
    background = torch.linspace(0.1, 0.9, gaussians.features.shape[1]).to(device, dtype).requires_grad_()
    count = len(gaussians.means)
    density = DensityStats(
        torch.zeros(count, device=device),
        torch.zeros(count, dtype=torch.int32, device=device),
        torch.zeros(count, device=device),
    )
    pictures = backend.rasterize_spacetime(SpacetimeTensors(*arrays), TIME, camera, background, rules, density)
    sum((p * g.to(device, dtype)).sum() for p, g in zip(pictures, incoming, strict=True)).backward()
    gradients = [torch.zeros_like(a) if a.grad is None else a.grad for a in (*arrays, background)]
    return *([tensor.detach().double().cpu() for tensor in group] for group in (pictures, gradients)), density


@pytest.mark.parametrize("card", CARDS)
def test_card(backend, card):
    backend, promise = backend
    gaussians, camera = CARDS[card]()
    generator = torch.Generator().manual_seed(0)
    size = (camera.height, camera.width)
    incoming = [torch.randn(*size, *rest, generator=generator) for rest in ((gaussians.features.shape[1],), (), ())]
    rules = promise.rules
    oracle, _, _ = draw(reference, torch.float64, gaussians, camera, rules, incoming)
    ours, _, _ = draw(backend, torch.float32, gaussians, camera, rules, incoming)
    depth_scale = oracle[2].clamp(min=1)
    apart = torch.stack(
        (
            (ours[0] - oracle[0]).abs().amax(2),
            (ours[1] - oracle[1]).abs(),
            (ours[2] - oracle[2]).abs() / depth_scale,
        )
    ).amax(0)
    solid = apart <= promise.pixel
    assert (~solid).double().mean() <= promise.bad_pixels
    # Where a decision fell the other way, the gradient is another one too: it is asked for elsewhere alone.
    incoming = [gradient * (solid[..., None] if gradient.ndim == 3 else solid) for gradient in incoming]
    _, wanted, statistics = draw(reference, torch.float64, gaussians, camera, rules, incoming)
    _, got, ours_statistics = draw(backend, torch.float32, gaussians, camera, rules, incoming)
    for name, a, b in zip((*SpacetimeTensors._fields, "background"), got, wanted, strict=True):
        assert (a - b).norm() <= promise.gradient * b.norm() + 1e-12, name
    pull, wanted_pull = ours_statistics.gradient.cpu().double(), statistics.gradient.double()
    assert (pull - wanted_pull).norm() <= promise.gradient * wanted_pull.norm() + 1e-12
    assert (ours_statistics.views.cpu() != statistics.views).double().sum() <= 0.05 * len(gaussians.means)


@pytest.mark.parametrize("activation", ["none", "clamp", "sigmoid"])
def test_decode_card(backend, activation):
    backend, promise = backend
    generator = torch.Generator().manual_seed(1)
    camera = Camera(37, 23, 30.0, 32.0, 5.0, 30.0)
    shapes = ((23, 37, 9), (6, 12), (3, 6))
    values = [torch.randn(shape, generator=generator) for shape in shapes]
    incoming = torch.randn(23, 37, 3, generator=generator)
    results = []
    for module, dtype in ((reference, torch.float64), (backend, torch.float32)):
        features, hidden, output = (value.to(module.DEVICE, dtype, copy=True).requires_grad_() for value in values)
        colors = module.decode(features, camera, hidden, output, activation)
        colors.backward(incoming.to(module.DEVICE, dtype))
        results.append([tensor.detach().double().cpu() for tensor in (colors, features.grad, hidden.grad, output.grad)])
    for ours, oracle in zip(results[1], results[0], strict=True):
        assert (ours - oracle).norm() <= promise.gradient * oracle.norm()


def test_training_card(backend):
    backend, _ = backend
    generator = torch.Generator().manual_seed(2)
    image = torch.rand(40, 50, 3, generator=generator)
    target = (255 * torch.rand(40, 50, 3, generator=generator)).to(torch.uint8)
    results = []
    for module, dtype in ((reference, torch.float64), (backend, torch.float32)):
        picture = image.to(module.DEVICE, dtype, copy=True).requires_grad_()
        loss, squared_error = module.picture_loss(picture, target, 0.2)
        loss.backward()
        results.append((float(loss.detach()), squared_error, picture.grad.double().cpu()))
    assert results[1][0] == pytest.approx(results[0][0], rel=1e-5)
    assert results[1][1] == pytest.approx(results[0][1], rel=1e-5)
    assert (results[1][2] - results[0][2]).norm() <= 1e-3 * results[0][2].norm()
    value, moments = torch.ones(7, 3, device=backend.DEVICE), torch.zeros(2, 7, 3, device=backend.DEVICE)
    gradient = torch.ones(7, 3, device=backend.DEVICE)
    backend.adam([AdamGroup(value, gradient, moments[0], moments[1], 0.1)], 0.9, 0.99, 1e-15, 1)
    torch.testing.assert_close(value.cpu(), torch.full((7, 3), 0.9))


@pytest.mark.parametrize("card", ["3 channels", "off center", "turned"])
def test_gsplat_is_told_the_same_scene(card):
    """gsplat's own torch projection, which needs no GPU, makes of what it is told what ours makes of the scene."""
    pytest.importorskip("gsplat")
    from gsplat.cuda._torch_impl import _fully_fused_projection
    from gsplat.cuda._torch_impl import _quat_scale_to_covar_preci as covariances
    from holoreel.core.render import cuda

    gaussians, camera = CARDS[card]()
    gaussians = SpacetimeTensors(*(array.double() for array in gaussians))
    rules = Rules()
    rows = reference.alive(gaussians, TIME, rules)
    still = reference.evaluate(SpacetimeTensors(*(array[rows] for array in gaussians)), TIME, rules)
    told = cuda.gaussian_arguments(still)
    matrices, _ = covariances(told["quats"], told["scales"], True, False)
    _, means, depths, conics, _ = _fully_fused_projection(
        told["means"],
        matrices,
        **cuda.camera_arguments(camera, still.means),
        eps2d=rules.low_pass,
        near_plane=rules.near,
    )
    ours = reference.project(still, torch.arange(len(rows)), camera, rules)
    assert len(ours.rows) > 0.5 * len(rows)
    torch.testing.assert_close(means[0, ours.rows], ours.means)
    torch.testing.assert_close(depths[0, ours.rows], ours.depths)
    torch.testing.assert_close(conics[0, ours.rows], ours.conics)


LENSES = {
    "OPENCV": (-0.1, 0.02, 0.001, -0.002),
    "FULL_OPENCV": (0.1, 0.2, 0.001, -0.002, 0.03, 0.12, 0.19, 0.02),
    "OPENCV_FISHEYE": (0.05, -0.01, 0.002, -0.001),
}


def bent(model, *distortion, focal=90.0):
    return Camera(130, 90, focal, 1.05 * focal, 60.0, 50.0, model=model, distortion=distortion)


def test_lenses_that_gsplat_draws():
    """All that the camera sees must be seen by gsplat, which gives up early on strong distortion."""
    from holoreel.core.render import cpu, cuda

    for model, distortion in LENSES.items():
        assert cuda.native_lens(bent(model, *distortion))
        assert not cpu.native_lens(bent(model, *distortion))
        assert not reference.native_lens(bent(model, *distortion))
    assert all(module.native_lens(bent("PINHOLE")) for module in (cpu, cuda, reference))
    assert not cuda.native_lens(bent("OPENCV", -0.3, 0.03, 0, 0, focal=60.0))  # a factor of 0.6 in the corners
    assert not cuda.native_lens(bent("OPENCV", -0.5, 0, 0, 0, focal=60.0))  # the corners see nothing
    assert not cuda.native_lens(bent("OPENCV_FISHEYE", 0, 0, 0, 0, focal=45.0))  # corners at more than 90 degrees
    assert not cuda.native_lens(bent("OPENCV_FISHEYE", -0.2, 0, 0, 0))  # corners beyond what gsplat takes for the field


def test_gsplat_is_told_the_lens():
    from holoreel.core.render import cuda

    like = torch.zeros(1)
    told = cuda.camera_arguments(bent("FULL_OPENCV", 1, 2, 3, 4, 5, 6, 7, 8), like)
    assert told["radial_coeffs"].tolist() == [[1, 2, 5, 6, 7, 8]]
    assert told["tangential_coeffs"].tolist() == [[3, 4]]
    assert (told["camera_model"], told["with_ut"], told["with_eval3d"]) == ("pinhole", True, True)
    told = cuda.camera_arguments(bent("OPENCV", 1, 2, 3, 4), like)
    assert told["radial_coeffs"].tolist() == [[1, 2, 0, 0, 0, 0]]
    assert told["tangential_coeffs"].tolist() == [[3, 4]]
    told = cuda.camera_arguments(bent("OPENCV_FISHEYE", 1, 2, 3, 4), like)
    assert told["radial_coeffs"].tolist() == [[1, 2, 3, 4]]
    assert (told["camera_model"], "tangential_coeffs" in told) == ("fisheye", False)
    assert "with_ut" not in cuda.camera_arguments(bent("PINHOLE"), like)
    with pytest.raises(ValueError, match="PINHOLE"):
        cuda.rasterize_spacetime(random_scene(5, 40, 30, 3)[0], TIME, bent("OPENCV", -0.5, 0, 0, 0, focal=60.0))


@pytest.mark.parametrize("backend", [STAND_IN], indirect=True)
def test_a_lens_drawn_as_it_is(backend):
    """Without distortion it is a pinhole: the same picture; statistics of density come from the means in space."""
    backend, promise = backend
    gaussians, pinhole = plain(3)
    lens = replace(pinhole, model="OPENCV", distortion=(0.0,) * 4)
    size = (pinhole.height, pinhole.width)
    incoming = [torch.randn(*size, 3), torch.zeros(size), torch.zeros(size)]
    oracle, _, wanted = draw(reference, torch.float64, gaussians, pinhole, promise.rules, incoming)
    ours, _, got = draw(backend, torch.float32, gaussians, lens, promise.rules, incoming)
    apart = (ours[0] - oracle[0]).abs().amax(2)
    assert (apart > promise.pixel).double().mean() <= promise.bad_pixels
    both = (got.views > 0) & (wanted.views > 0)
    assert both.sum() > 0.9 * (wanted.views > 0).sum()
    ratio = got.gradient[both] / wanted.gradient[both]
    assert 0.7 < ratio.median() < 1.4


@pytest.mark.parametrize("backend", [STAND_IN], indirect=True)
def test_view_warps_only_what_the_backend_cannot_draw(backend, monkeypatch):
    backend, _ = backend
    drawn = []
    monkeypatch.setattr(
        backend, "rasterize_spacetime", lambda g, time, camera, *_: drawn.append(camera) or reference_picture(camera)
    )

    def reference_picture(camera):
        return Rendering(*(torch.zeros(camera.height, camera.width, *rest) for rest in ((3,), (), ())))

    gaussians, _ = plain(3)
    lens = bent("OPENCV", *LENSES["OPENCV"])
    too_strong = bent("OPENCV", -0.3, 0.03, 0, 0, focal=60.0)
    for camera, rules, native in (
        (lens, None, True),
        (lens, Rules(), True),
        (lens, Rules(warp_lenses=True), False),
        (too_strong, None, False),
        (bent("PINHOLE"), Rules(warp_lenses=True), True),
    ):
        picture = render_view(backend, gaussians, TIME, camera, rules=rules)
        assert picture.alpha.shape == (camera.height, camera.width)
        assert (drawn.pop() is camera) == native


@pytest.mark.parametrize("model", LENSES)
@pytest.mark.parametrize("activation", ["none", "clamp", "sigmoid"])
def test_decode_along_the_rays_of_a_lens(model, activation):
    """Against the float64 decoder; black where the lens sees nothing."""
    camera = replace(bent(model, *LENSES[model]), world_to_camera=turned()[1].world_to_camera)
    if model == "OPENCV":
        camera = replace(camera, distortion=(-0.5, 0.0, 0.0, 0.0), fx=60.0)
    generator = np.random.default_rng(3)
    features, hidden, output = (
        generator.normal(size=size).astype(np.float32) for size in ((90, 130, 9), (6, 12), (3, 6))
    )
    origins, rays = (values.reshape(90, 130, 3) for values in camera.rays())
    wanted = Decoder(hidden, output, activation).decode(features, origins, np.nan_to_num(rays))
    wanted[np.isnan(rays).any(axis=2)] = 0
    assert np.isnan(rays).any() == (model == "OPENCV")
    tensors = (torch.from_numpy(array).double() for array in (features, hidden, output))
    ours = reference.decode(next(tensors), camera, *tensors, activation).numpy()
    np.testing.assert_allclose(ours, wanted, atol=1e-9)


@pytest.mark.parametrize("model", ["PINHOLE", *LENSES])
def test_gsplat_has_these_arguments(model, monkeypatch):
    gsplat = pytest.importorskip("gsplat")
    from holoreel.core.render import cuda

    told = {}
    signature = inspect.signature(gsplat.rasterization)

    def rasterization(**arguments):
        told.update(signature.bind(**arguments).arguments)
        camera = arguments["width"], arguments["height"]
        return torch.zeros(1, *camera[::-1], 4), torch.zeros(1, *camera[::-1], 1), {}

    monkeypatch.setattr(cuda, "DEVICE", "cpu")
    monkeypatch.setattr(gsplat, "rasterization", rasterization)
    cuda.rasterize_spacetime(plain(3)[0], TIME, bent(model, *LENSES.get(model, ())))
    assert told["render_mode"] == "RGB+ED"
