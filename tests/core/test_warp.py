# SPDX-License-Identifier: GPL-3.0-or-later
"""Warping a virtual pinhole's picture to a real lens: where points land, gradients, what no distortion means."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from holoreel.core.camera import Camera
from holoreel.core.errors import HoloreelError
from holoreel.core.render import cpu, reference
from holoreel.core.render.contract import Rendering, Rules
from holoreel.core.render.reference import rasterize
from holoreel.core.render.warp import MAX_AREA, MAX_FIELD_DEGREES, Warp, lens_warp, make_warp

LENSES = {
    "OPENCV": (-0.28, 0.07, 0.002, -0.003),
    "FULL_OPENCV": (0.5, 0.1, 0.001, -0.002, 0.02, 0.7, 0.2, 0.03),
    "OPENCV_FISHEYE": (0.05, -0.01, 0.002, -0.001),
}


def camera(model: str, width: int = 96, height: int = 72, focal: float = 70.0) -> Camera:
    """Off center, turned and moved."""
    view = Camera.look_at((1, -3, 0.5), (0, 0.2, 0), width=width, height=height, fx=focal)
    return replace(
        view, fy=focal * 1.05, cx=width * 0.46, cy=height * 0.55, model=model, distortion=LENSES.get(model, (0.0,) * 4)
    )


@pytest.mark.parametrize("model", LENSES)
def test_points_land_where_the_lens_projects_them(model: str) -> None:
    """Small Gaussians, one at a time: the middle of what is seen of each is the pixel that the camera names."""
    view = camera(model)
    warp = lens_warp(view)
    pixels = np.array([[48.3, 36.2], [12.5, 10.7], [85.1, 60.4], [70.6, 9.3], [9.4, 64.0]])
    points = view.unproject(pixels, [2.0, 3.0, 2.5, 4.0, 3.5])
    v, u = np.mgrid[: view.height, : view.width] + 0.5
    for point, expected in zip(points, pixels, strict=True):
        rendering = rasterize(
            torch.tensor(point[None]), torch.tensor([[1.0, 0, 0, 0]]).double(), torch.full((1, 3), 0.04).double(),
            torch.tensor([0.9]).double(), torch.ones(1, 1).double(), warp.pinhole, rules=Rules(alpha_min=1e-6),
        )  # fmt: skip
        seen = warp.apply(rendering.features)[..., 0].numpy()
        assert seen.max() > 0.5
        # A peak is where it is, whatever the lens does to the shape around it: fit the logarithm around the maximum.
        row, column = np.unravel_index(seen.argmax(), seen.shape)
        near = np.s_[row - 1 : row + 2, column - 1 : column + 2]
        x, y = u[near].ravel() - expected[0], v[near].ravel() - expected[1]
        terms = np.stack([np.ones(9), x, y, x * x, x * y, y * y], axis=1)
        _, a, b, c, d, e = np.linalg.lstsq(terms, np.log(seen[near].ravel()), rcond=None)[0]
        offset = np.linalg.solve([[2 * c, d], [d, 2 * e]], [-a, -b])
        assert np.abs(offset).max() < 0.05


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV", "FULL_OPENCV"])
def test_no_distortion_changes_nothing(model: str) -> None:
    view = replace(
        camera("OPENCV"), model=model, distortion=(0.0,) * {"PINHOLE": 0, "OPENCV": 4, "FULL_OPENCV": 8}[model]
    )
    warp = lens_warp(view)
    picture = torch.rand(warp.pinhole.height, warp.pinhole.width, 2, generator=torch.Generator().manual_seed(0))
    left, top = round(warp.pinhole.cx - view.cx), round(warp.pinhole.cy - view.cy)
    assert torch.allclose(warp.apply(picture), picture[top : top + view.height, left : left + view.width], atol=1e-5)
    assert warp.valid.all()


@pytest.mark.parametrize("samples", [1, 2])
def test_gradient(samples: int) -> None:
    view = camera("OPENCV_FISHEYE", 7, 5, 3.5)
    warp = replace(make_warp(view), samples=samples)
    picture = torch.rand(warp.pinhole.height, warp.pinhole.width, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(warp.apply, (picture,), fast_mode=True)


@pytest.mark.parametrize("model", LENSES)
@pytest.mark.parametrize("samples", [1, 2])
def test_a_smooth_pattern_is_seen_as_it_is(model: str, samples: int) -> None:
    """A pattern on the sphere of directions, integrated over pixels of both lenses: the warp takes one to the other."""
    view = camera(model)

    def picture(lens: Camera) -> np.ndarray:
        _, rays = lens.scaled(lens.width * 3, lens.height * 3).rays()
        waves = np.random.default_rng(0).normal(size=(6, 3))
        waves *= 55 / np.linalg.norm(waves, axis=1, keepdims=True)  # 8 pixels to a wave
        value = 0.5 + np.sin(rays @ waves.T).mean(axis=1) / 2
        return value.reshape(lens.height, 3, lens.width, 3).mean(axis=(1, 3))

    warp = replace(lens_warp(view), samples=samples)
    seen = warp.apply(torch.tensor(picture(warp.pinhole))[..., None])[..., 0].numpy()
    mse = np.mean((seen - picture(view))[warp.valid.numpy()] ** 2)
    assert -10 * np.log10(mse) > (42, 50)[samples - 1]


def test_wide_fisheye_is_masked_and_bounded() -> None:
    view = camera("OPENCV_FISHEYE", 96, 96, 24.0)
    warp = lens_warp(view)
    assert warp.pinhole.width * warp.pinhole.height < MAX_AREA * 96 * 96 * 1.1
    assert warp.samples == 2
    _, rays = view.rays()
    x, _, z = (view.world_to_camera[:3, :3] @ rays.T).reshape(3, 96, 96)
    valid = warp.valid.numpy()
    limit = np.radians(MAX_FIELD_DEGREES / 2)
    assert (np.arctan2(np.abs(x), z)[valid] <= limit).all()
    assert valid[48, 48]
    assert 0.3 < valid.mean() < 0.9
    ones = warp.apply(torch.ones(warp.pinhole.height, warp.pinhole.width, 1))[..., 0]
    assert torch.allclose(ones, warp.valid.float(), atol=1e-5)


def test_one_map_per_lens_and_a_pose_per_camera() -> None:
    view = camera("OPENCV")
    moved = replace(view, world_to_camera=np.eye(4), name="moved")
    first, second = lens_warp(view), lens_warp(moved)
    assert first.valid is second.valid
    assert np.array_equal(first.pinhole.world_to_camera, view.world_to_camera)
    assert np.array_equal(second.pinhole.world_to_camera, np.eye(4))
    assert second.pinhole.name == "moved"
    with pytest.raises(ValueError, match="not"):
        first.apply(torch.ones(3, 3, 1))


def test_a_lens_that_sees_nothing_is_refused() -> None:
    far_off = Camera(8, 8, 5.0, 5.0, 5000.0, 4.0, model="OPENCV", distortion=(-0.5, 0.0, 0.0, 0.0))
    with pytest.raises(HoloreelError, match="sees nothing"):
        lens_warp(far_off)


@pytest.fixture(params=[4, 8])
def lanes(request: pytest.FixtureRequest) -> Iterator[int]:
    """Run with kernels of a width, if this machine has it."""
    try:
        cpu.set_lanes(request.param)
    except HoloreelError as error:
        pytest.skip(str(error))
    yield request.param
    cpu.set_lanes(0)


def incoming_gradient(warp: Warp, channels: int) -> torch.Tensor:
    """A random one."""
    return torch.randn(*warp.valid.shape, channels, generator=torch.Generator().manual_seed(1))


def by_torch(picture: torch.Tensor, warp: Warp) -> list[torch.Tensor]:
    """What comes out of it, and the gradient of a random sum of that, in float64."""
    picture = picture.double().requires_grad_()
    seen = warp.apply(picture)
    seen.backward(incoming_gradient(warp, picture.shape[2]).double())
    assert picture.grad is not None
    return [seen.detach(), picture.grad]


def by_kernels(picture: torch.Tensor, warp: Warp) -> list[torch.Tensor]:
    """The same."""
    return [cpu.warp_layers(picture, warp), cpu.spread_layers(incoming_gradient(warp, picture.shape[2]), warp)]


@pytest.mark.parametrize("model", LENSES)
@pytest.mark.parametrize("samples", [1, 2])
@pytest.mark.parametrize("channels", [1, 3, 5, 8, 16])
def test_kernels_do_as_torch(model: str, samples: int, channels: int, lanes: int) -> None:
    """A fisheye so wide that part of it is not covered; widths that are no multiple of a block."""
    view = camera(model, 203, 91, 60.0 if model == "OPENCV_FISHEYE" else 150.0)
    warp = replace(make_warp(view), samples=samples)
    size = (warp.pinhole.height, warp.pinhole.width, channels)
    picture = torch.rand(size, generator=torch.Generator().manual_seed(0))
    for ours, wanted in zip(by_kernels(picture, warp), by_torch(picture, warp), strict=True):
        assert (ours - wanted).abs().max() <= 1e-5
    assert warp.valid.all() == (model != "OPENCV_FISHEYE")


@pytest.mark.parametrize("samples", [1, 2])
def test_kernels_know_the_border_of_the_picture(samples: int, lanes: int) -> None:
    """Places beyond every border, at corners, and in the picture's last pixels."""
    generator = torch.Generator().manual_seed(2)
    pinhole = Camera(9, 7, 10.0, 10.0, 4.5, 3.5)
    places = torch.rand(40, 131, 2, generator=generator) * torch.tensor([19.0, 17.0]) - 5.0
    warp = Warp(pinhole, torch.rand(38, 129, generator=generator) < 0.8, samples, places)
    for channels in (1, 5, 11):
        picture = torch.rand(7, 9, channels, generator=generator)
        for ours, wanted in zip(by_kernels(picture, warp), by_torch(picture, warp), strict=True):
            assert (ours - wanted).abs().max() <= 1e-5 * wanted.abs().max()


def test_kernels_give_the_same_for_any_number_of_threads() -> None:
    warp = lens_warp(camera("OPENCV_FISHEYE", 203, 150, 60.0))
    picture = torch.rand(warp.pinhole.height, warp.pinhole.width, 5, generator=torch.Generator().manual_seed(3))
    before, results = cpu.get_threads(), []
    for threads in (1, 2, 5):
        cpu.set_threads(threads)
        results.append(by_kernels(picture, warp))
    cpu.set_threads(before)
    for result in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(result, results[0], strict=True))


@pytest.mark.parametrize("background", [None, (0.0, 0.0, 0.0), (0.2, 0.5, 0.9)])
@pytest.mark.parametrize("asked", ["color", "alpha", "depth", "all"])
def test_renderings_are_seen_as_by_torch(background: tuple[float, ...] | None, asked: str) -> None:
    """Whichever of the three has a gradient; parts are empty, and bicubic samples overshoot beside the full ones."""
    warp = replace(lens_warp(camera("OPENCV_FISHEYE", 60, 40, 20.0)), samples=2)
    generator = torch.Generator().manual_seed(4)
    size = (warp.pinhole.height, warp.pinhole.width)
    alpha = (3 * torch.rand(size, generator=generator) - 1).clamp(0, 1)
    alpha[: size[0] // 2, : size[1] // 2] = 0
    parts = (torch.rand(*size, 3, generator=generator), alpha, 1 + torch.rand(size, generator=generator))
    weights = [torch.randn(40, 60, *rest, generator=generator) for rest in ((3,), (), ())]
    results = []
    for backend, dtype in ((cpu, torch.float32), (reference, torch.float64)):
        tensors = [part.to(dtype, copy=True).requires_grad_() for part in parts]
        behind = None if background is None else torch.tensor(background, dtype=dtype, requires_grad=any(background))
        seen = backend.warp(Rendering(*tensors), warp, behind)
        chosen = range(3) if asked == "all" else [("color", "alpha", "depth").index(asked)]
        # Where hardly anything is, depth is a fraction of rounding errors.
        solid = seen.alpha.detach() > 0.05
        sum((seen[k] * weights[k].to(dtype) * (solid if k == 2 else 1)).sum() for k in chosen).backward()
        leaves = tensors if behind is None or not behind.requires_grad else [*tensors, behind]
        gradients = [torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for leaf in leaves]
        results.append([seen.features, seen.alpha, seen.depth * solid, *gradients])
    assert len(results[0]) == len(results[1])
    for ours, wanted in zip(*results, strict=True):
        assert (ours - wanted).abs().max() <= 2e-5 * max(1.0, float(wanted.detach().abs().max()))


def test_kernels_refuse_what_they_cannot_warp() -> None:
    warp = lens_warp(camera("OPENCV"))
    with pytest.raises(ValueError, match="not"):
        cpu.warp(Rendering(torch.ones(3, 3, 1), torch.ones(3, 3), torch.ones(3, 3)), warp)
    with pytest.raises(HoloreelError, match="1 to 16 channels"):
        cpu.warp_layers(torch.ones(warp.pinhole.height, warp.pinhole.width, 17), warp)
