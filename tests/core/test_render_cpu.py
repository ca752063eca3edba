# SPDX-License-Identifier: GPL-3.0-or-later
"""The compiled kernels against the float64 oracle: forward, whole-chain gradients, hostile rows, invariants."""

import functools
import math
from dataclasses import replace
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
import torch
from holoreel.core.camera import Camera
from holoreel.core.errors import HoloreelError
from holoreel.core.render import cpu, reference
from holoreel.core.render.contract import DensityStats, Rendering, Rules, SpacetimeTensors
from holoreel.core.render.scenes import random_scene
from hypothesis import given, settings
from hypothesis import strategies as st

torch.set_num_threads(2)
FORWARD = 2e-6
GRADIENT = 1e-5
TIME = 0.4


@pytest.fixture(params=[8, 4], ids=["8-lanes", "4-lanes"])
def lanes(request):
    """Run with the kernels of one vector width."""
    try:
        cpu.set_lanes(request.param)
    except HoloreelError:
        pytest.skip(f"no kernels of {request.param} lanes on this machine")
    yield request.param
    cpu.set_lanes(0)


@pytest.fixture(autouse=True)
def two_threads():
    """Run with two threads, whatever the test leaves behind."""
    cpu.set_threads(2)
    yield
    cpu.set_threads(2)


class Case(NamedTuple):
    """A scene, how it is seen, and what is asked of the pictures."""

    gaussians: SpacetimeTensors
    camera: Camera
    background: torch.Tensor
    rules: Rules


def hard_case(channels, count=1500, width=123, height=85, seed=4):
    """All kinds of Gaussians that are trouble, among ordinary ones. 123 x 85 is no multiple of a tile."""
    g, camera = random_scene(count, width, height, channels, median_radius_px=7, seed=seed)
    kind = iter(range(0, count, 40))

    def some():
        start = next(kind)
        return slice(start, start + 40)

    g.opacity_logits[some()] = 9.0  # saturated
    g.opacity_logits[some()] = 3.0
    g.means[some(), 2] *= -1  # behind the camera
    g.means[some(), 2] = 0.21  # grazing the near plane: huge and mostly off the picture
    g.means[some(), 2] = 0.19
    g.quats[some()] = 0
    rows = some()
    g.quats[rows] = 0
    g.omegas[rows] = 0
    g.means[some(), 0] *= 3  # off the picture, where the Jacobian is clamped
    needles, pancakes, huge, tiny = some(), some(), some(), some()
    g.log_scales[needles, 0] += 3.0
    g.log_scales[needles, 1:] -= 5.0
    g.log_scales[pancakes, 0] -= 9.0
    g.log_scales[huge] += 3.0
    g.opacity_logits[huge] -= 2.0
    g.log_scales[tiny] -= 8.0
    g.trbf_log_scales[some()] = -6.0  # dead at nearly any time
    g.trbf_log_scales[some()] = math.inf  # always on
    rows = some()
    g.trbf_centers[rows] = TIME
    g.trbf_log_scales[rows] = -60.0
    angle = 0.2
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 0] = pose[2, 2] = math.cos(angle)
    pose[0, 2], pose[2, 0] = math.sin(angle), -math.sin(angle)
    pose[:3, 3] = torch.tensor([-0.5, 0.1, 0.3])
    camera = Camera(width, height, camera.fx, 1.05 * camera.fy, camera.cx + 2.3, camera.cy - 1.7, pose.numpy())
    return Case(g, camera, torch.linspace(0.1, 0.9, channels), Rules())


def plain_case(channels, count, width, height):
    """An ordinary scene at an ordinary size."""
    g, camera = random_scene(count, width, height, channels, seed=2)
    return Case(g, camera, torch.linspace(0.1, 0.9, channels), Rules())


def fragile_pixels(case):
    """Return (H, W): where the oracle itself sits on a decision.

    That is an alpha next to alpha_min or to the cap, or a transmittance next to the limit, found in float64 from the
    reference's splats alone, in the boxes they cover.
    """
    doubles = SpacetimeTensors(*(array.double() for array in case.gaussians))
    rules, camera = case.rules, case.camera
    with torch.no_grad():
        g = reference.evaluate(doubles, TIME)
        finite = torch.nonzero(g.opacities >= rules.alpha_min)[:, 0]
        g = reference.Gaussians3D(*(array[finite] for array in g))
        splats = reference.project(g, finite, camera, rules)
    fragile = np.zeros((camera.height, camera.width), dtype=bool)
    full = np.zeros_like(fragile)
    transmittance = np.ones(fragile.shape)
    means, conics, opacities = splats.means.numpy(), splats.conics.numpy(), splats.opacities.numpy()
    reach = np.sqrt(2 * np.log(opacities * 1.01 / rules.alpha_min)[:, None] * splats.covariances[:, [0, 2]].numpy())
    size = (camera.width, camera.height)
    low = np.clip(np.floor(means - reach - 1), 0, size).astype(int)
    high = np.clip(np.ceil(means + reach + 1), 0, size).astype(int)
    for i in np.nonzero((low < high).all(1))[0]:
        box = (slice(low[i, 1], high[i, 1]), slice(low[i, 0], high[i, 0]))
        dx = np.arange(low[i, 0], high[i, 0]) + 0.5 - means[i, 0]
        dy = (np.arange(low[i, 1], high[i, 1]) + 0.5 - means[i, 1])[:, None]
        a, b, c = conics[i]
        uncapped = opacities[i] * np.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
        alpha = np.minimum(uncapped, rules.alpha_max)
        before, live = transmittance[box], ~full[box]
        seen = (alpha >= rules.alpha_min) & live
        after = before * (1 - alpha)
        stops = seen & (after < rules.transmittance_min)
        near = np.abs(alpha / rules.alpha_min - 1) < 1e-5
        near |= np.abs(uncapped / rules.alpha_max - 1) < 1e-5
        near |= seen & (np.abs(after / rules.transmittance_min - 1) < 1e-4)
        fragile[box] |= near & live
        full[box] |= stops
        transmittance[box] = np.where(seen & ~stops, after, before)
    return torch.from_numpy(fragile)


def image_gradients(case, channels, seed=0):
    """Random gradients of the three pictures."""
    generator = torch.Generator().manual_seed(seed)
    size = (case.camera.height, case.camera.width)
    return tuple(torch.randn(*size, *rest, generator=generator) for rest in ((channels,), (), ()))


def render_with_gradients(backend, dtype, case, incoming):
    """Return (pictures, gradients of the nine arrays and the background)."""
    arrays = [array.to(dtype).clone().requires_grad_() for array in (*case.gaussians, case.background)]
    pictures = backend.rasterize_spacetime(SpacetimeTensors(*arrays[:9]), TIME, case.camera, arrays[9], case.rules)
    sum((p * g.to(dtype)).sum() for p, g in zip(pictures, incoming, strict=True)).backward()
    return Rendering(*(picture.detach() for picture in pictures)), [array.grad for array in arrays]


def relative(ours, oracle):
    """The relative L2 distance."""
    return float((ours.double() - oracle).norm() / oracle.norm())


@functools.cache
def judged(make_case, *arguments):
    """Return a case, its solid pixels, the gradients asked of it, and what the oracle makes of it."""
    case = make_case(*arguments)
    fragile = fragile_pixels(case)
    assert fragile.double().mean() <= 0.01
    solid = ~fragile
    incoming = image_gradients(case, case.gaussians.features.shape[1])
    incoming = tuple(g * (solid[..., None] if g.ndim == 3 else solid) for g in incoming)
    return case, solid, incoming, *render_with_gradients(reference, torch.float64, case, incoming)


def assert_agrees(make_case, *arguments, threads_tried=(1, 2)):
    """Forward to 2e-6 and the gradients of every array to 1e-5, outside the few fragile pixels."""
    case, solid, incoming, oracle, oracle_gradients = judged(make_case, *arguments)
    assert oracle.alpha.max() > 0.999
    for threads in threads_tried:
        cpu.set_threads(threads)
        ours, gradients = render_with_gradients(cpu, torch.float32, case, incoming)
        assert (ours.features - oracle.features)[solid].abs().max() <= FORWARD
        assert (ours.alpha - oracle.alpha)[solid].abs().max() <= FORWARD
        # Depths are not of order one: single precision itself is relative.
        assert ((ours.depth - oracle.depth).abs() / oracle.depth.clamp(min=1))[solid].max() <= FORWARD
        names = (*SpacetimeTensors._fields, "background")
        errors = {n: relative(a, b) for n, a, b in zip(names, gradients, oracle_gradients, strict=True)}
        assert max(errors.values()) <= GRADIENT, errors


@pytest.mark.parametrize("channels", [1, 3, 9])
def test_hard_scene_agrees_with_the_oracle(lanes, channels):
    assert_agrees(hard_case, channels)


def test_full_size_scene_agrees_with_the_oracle(lanes):
    assert_agrees(plain_case, 3, 20_000, 640, 360, threads_tried=(2,))


def off_center_case(shift):
    """The hard case with the principal point far from the middle; the Gaussians are moved to fill the picture."""
    case = hard_case(3)
    camera = replace(case.camera, cx=case.camera.cx + shift * 123, cy=case.camera.cy - 0.7 * shift * 85)
    means = case.gaussians.means.clone()
    means[:, 0] -= shift * 123 / camera.fx * means[:, 2]
    means[:, 1] += 0.7 * shift * 85 / camera.fy * means[:, 2]
    return case._replace(camera=camera, gaussians=case.gaussians._replace(means=means))


@pytest.mark.parametrize("shift", [0.45, -0.65])
def test_principal_point_far_from_the_middle(lanes, shift):
    assert_agrees(off_center_case, shift, threads_tried=(2,))


@pytest.mark.parametrize("backend", [cpu, reference], ids=["cpu", "reference"])
@pytest.mark.parametrize(("left", "top"), [(0, 0), (96, 64), (32, 64)])
def test_a_crop_is_a_camera_with_another_principal_point(backend, left, top):
    """Also under the Jacobian's clamp, which lies around the crop's own borders: small Gaussians do not reach it."""
    gaussians, camera = random_scene(1500, 160, 120, 3, median_radius_px=4, seed=8)
    gaussians.log_scales.clamp_(max=math.log(2 / camera.fx))  # and those farther than a pixel or two are small
    gaussians.motions.zero_()
    whole = backend.rasterize_spacetime(gaussians, TIME, camera)
    crop = replace(camera, width=64, height=56, cx=camera.cx - left, cy=camera.cy - top)
    part = backend.rasterize_spacetime(gaussians, TIME, crop)
    assert part.alpha.max() > 0.9
    for ours, theirs in zip(part, whole, strict=True):
        torch.testing.assert_close(ours, theirs[top : top + 56, left : left + 64], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("channels", [2, 5, 12, 16])
def test_padded_channels(lanes, channels):
    assert_agrees(hard_case, channels, 800, 50, 40, threads_tried=(2,))


@pytest.mark.parametrize("asked", ["features", "alpha", "depth"])
def test_one_picture_alone_has_its_gradient(asked):
    case, _, incoming, *_ = judged(hard_case, 3)
    results = []
    for backend, dtype in ((reference, torch.float64), (cpu, torch.float32)):
        arrays = [array.to(dtype).clone().requires_grad_() for array in case.gaussians]
        pictures = backend.rasterize_spacetime(SpacetimeTensors(*arrays), TIME, case.camera)
        (getattr(pictures, asked) * getattr(Rendering(*incoming), asked).to(dtype)).sum().backward()
        results.append([torch.zeros_like(array) if array.grad is None else array.grad for array in arrays])
    for oracle, ours in zip(*results, strict=True):
        assert (ours.double() - oracle).norm() <= GRADIENT * float(oracle.norm())


def test_static_gaussians_agree_with_the_oracle(lanes):
    case = hard_case(3)
    with torch.no_grad():
        still = reference.evaluate(case.gaussians, TIME)
    still = reference.Gaussians3D(*(array[still.opacities > 0.01] for array in still))
    as_spacetime = SpacetimeTensors(
        still.means,
        torch.zeros(len(still.means), 3, 3),
        still.quats,
        torch.zeros(len(still.means), 4),
        still.scales.log(),
        torch.logit(still.opacities.double()).float(),
        still.features,
        torch.full((len(still.means),), TIME),
        torch.zeros(len(still.means)),
    )
    solid = ~fragile_pixels(case._replace(gaussians=as_spacetime))
    incoming = tuple(g * (solid[..., None] if g.ndim == 3 else solid) for g in image_gradients(case, 3))
    results = []
    for backend, dtype in ((reference, torch.float64), (cpu, torch.float32)):
        arrays = [array.to(dtype).clone().requires_grad_() for array in (*still, case.background)]
        pictures = backend.rasterize(*arrays[:5], case.camera, arrays[5])
        sum((p * g.to(dtype)).sum() for p, g in zip(pictures, incoming, strict=True)).backward()
        results.append((pictures.features.detach(), [array.grad for array in arrays]))
    assert (results[1][0] - results[0][0])[solid].abs().max() <= FORWARD
    for ours, oracle in zip(results[1][1], results[0][1], strict=True):
        assert relative(ours, oracle) <= GRADIENT


def test_same_bits_for_any_number_of_threads(lanes):
    case = hard_case(3)
    incoming = image_gradients(case, 3)
    first = None
    for threads in (1, 2, 3, 2, 7, 1):
        cpu.set_threads(threads)
        pictures, gradients = render_with_gradients(cpu, torch.float32, case, incoming)
        result = [*pictures, *gradients]
        first = first or result
        assert all(torch.equal(a, b) for a, b in zip(result, first, strict=True))


@pytest.mark.parametrize("backend", [cpu, reference], ids=["cpu", "reference"])
def test_rows_that_are_not_finite_are_skipped(backend):
    case = plain_case(3, 300, 64, 48)
    kept = torch.ones(300, dtype=torch.bool)
    broken = SpacetimeTensors(*(array.clone() for array in case.gaussians))
    rows = iter(range(0, 300, 7))
    for array in broken:
        for value in (math.nan, math.inf, -math.inf):
            if array is broken.trbf_log_scales and value == math.inf:
                continue
            row = next(rows)
            array.reshape(300, -1)[row, -1] = value
            kept[row] = False
    huge = next(rows)
    broken.log_scales[huge] = 800.0  # finite itself, but its covariance is not
    kept[huge] = False
    incoming = image_gradients(case, 3)
    pictures, gradients = render_with_gradients(backend, torch.float32, case._replace(gaussians=broken), incoming)
    clean = case._replace(gaussians=SpacetimeTensors(*(array[kept] for array in case.gaussians)))
    wanted, wanted_gradients = render_with_gradients(backend, torch.float32, clean, incoming)
    for ours, theirs in zip(pictures, wanted, strict=True):
        torch.testing.assert_close(ours, theirs)
    for ours, theirs in zip(gradients[:9], wanted_gradients[:9], strict=True):
        torch.testing.assert_close(ours[kept], theirs)
        assert (ours[~kept] == 0).all()


@pytest.mark.parametrize("backend", [cpu, reference], ids=["cpu", "reference"])
@pytest.mark.parametrize("size", [(1, 1), (3, 40), (17, 16), (16, 15)])
def test_nothing_to_draw_is_background(backend, size):
    height, width = size
    gaussians, _ = random_scene(5, 8, 8, 3)
    camera = Camera(width, height, 10.0, 10.0, width / 2, height / 2)
    background = torch.tensor([0.1, 0.2, 0.3])
    gaussians.means[:, 2] = -5
    for scene in (gaussians, SpacetimeTensors(*(array[:0] for array in gaussians))):
        arrays = [array.clone().requires_grad_() for array in scene]
        features, alpha, depth = backend.rasterize_spacetime(SpacetimeTensors(*arrays), 0.5, camera, background)
        assert torch.equal(features, background.expand(height, width, 3))
        assert not alpha.any()
        assert not depth.any()
        if features.requires_grad:
            features.sum().backward()
        assert all(array.grad is None or not array.grad.any() for array in arrays)


@settings(max_examples=25, deadline=None)
@given(width=st.integers(1, 70), height=st.integers(1, 70), seed=st.integers(0, 99), lanes=st.sampled_from([0, 4]))
def test_order_of_rows_and_split_of_channels_do_not_matter(width, height, seed, lanes):
    gaussians, camera = random_scene(150, width, height, 5, median_radius_px=8, seed=seed)
    cpu.set_lanes(lanes)
    whole = cpu.rasterize_spacetime(gaussians, TIME, camera)
    shuffle = torch.randperm(150, generator=torch.Generator().manual_seed(seed))
    shuffled = cpu.rasterize_spacetime(SpacetimeTensors(*(array[shuffle] for array in gaussians)), TIME, camera)
    assert all(torch.equal(a, b) for a, b in zip(whole, shuffled, strict=True))
    parts = [
        cpu.rasterize_spacetime(gaussians._replace(features=gaussians.features[:, columns]), TIME, camera).features
        for columns in (slice(0, 1), slice(1, 5))
    ]
    assert torch.equal(torch.cat(parts, 2), whole.features)
    cpu.set_lanes(0)


def test_density_statistics_agree_with_the_reference():
    case, _, (weights, *_), *_ = judged(hard_case, 3)
    results = []
    for backend, dtype in ((reference, torch.float64), (cpu, torch.float32)):
        count = len(case.gaussians.means)
        density = DensityStats(torch.zeros(count), torch.zeros(count, dtype=torch.int32), torch.zeros(count))
        for time in (TIME, 0.6):
            arrays = [array.to(dtype).clone().requires_grad_() for array in case.gaussians]
            pictures = backend.rasterize_spacetime(SpacetimeTensors(*arrays), time, case.camera, density=density)
            (pictures.features * weights.to(dtype)).sum().backward()
        results.append(density)
    oracle, ours = results
    assert relative(ours.gradient, oracle.gradient.double()) < 1e-3  # the mask is that of one of the two times
    differing = ours.views != oracle.views  # seen by a tile's corner, or not
    assert differing.double().mean() < 0.02
    assert relative(ours.radius_px[~differing], oracle.radius_px[~differing].double()) < 1e-5


def test_detach_motion_time_agrees_with_the_reference():
    case, _, incoming, *_ = judged(hard_case, 3)
    case = case._replace(rules=Rules(detach_motion_time=True))
    _, oracle = render_with_gradients(reference, torch.float64, case, incoming)
    _, ours = render_with_gradients(cpu, torch.float32, case, incoming)
    assert relative(ours[7], oracle[7]) <= GRADIENT
    _, attached = render_with_gradients(cpu, torch.float32, case._replace(rules=Rules()), incoming)
    assert relative(attached[7], oracle[7]) > 1e-3


def test_without_temporal_culling_the_picture_is_the_same():
    case = hard_case(3)
    case.gaussians.trbf_log_scales[::3] = -2.0
    case.gaussians.opacity_logits[:40:4] = -200.0
    scene = case.gaussians, TIME, case.camera, case.background
    results, visible = [], []
    for rules in (Rules(), Rules(cull_faded=False)):
        arrays = SpacetimeTensors(*(array.clone().requires_grad_() for array in scene[0]))
        pictures = cpu.rasterize_spacetime(arrays, *scene[1:], rules)
        visible.append(pictures.features.grad_fn.frame.intersections)
        pictures.features.square().sum().backward()
        results.append((*pictures, *(array.grad for array in arrays)))
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))
    assert visible[1] > 1.2 * visible[0]


def test_memory_is_used_again_only_when_nobody_holds_it():
    case = plain_case(3, 300, 96, 64)
    with torch.no_grad():
        held = cpu.rasterize_spacetime(case.gaussians, TIME, case.camera)
        copies = [picture.clone() for picture in held]
        row = held.features[3]  # a view alone keeps the memory too
        places = {held.features.data_ptr()}
        for time in (0.1, 0.2, 0.3):
            other = cpu.rasterize_spacetime(case.gaussians, time, case.camera)
            assert other.features.data_ptr() not in places
        assert all(torch.equal(a, b) for a, b in zip(held, copies, strict=True))
        del held
        cpu.rasterize_spacetime(case.gaussians, 0.9, case.camera)
        assert torch.equal(row, copies[0][3])
        del row, other
        again = [cpu.rasterize_spacetime(case.gaussians, time, case.camera).features.data_ptr() for time in (0.1, 0.2)]
        assert again[0] == again[1]


def test_no_gradient_no_graph():
    case = plain_case(3, 100, 32, 32)
    with torch.no_grad():
        assert not cpu.rasterize_spacetime(case.gaussians, TIME, case.camera).features.requires_grad


def test_wrong_shapes_are_named():
    case = plain_case(3, 100, 32, 32)
    with pytest.raises(ValueError, match="quats has shape"):
        cpu.rasterize_spacetime(case.gaussians._replace(quats=torch.zeros(100, 3)), TIME, case.camera)
    with pytest.raises(ValueError, match="features has shape"):
        cpu.rasterize_spacetime(case.gaussians._replace(features=torch.zeros(100, 17)), TIME, case.camera)
    with pytest.raises(ValueError, match="background has shape"):
        cpu.rasterize_spacetime(case.gaussians, TIME, case.camera, torch.zeros(4))
    for backend in (cpu, reference):
        with pytest.raises(ValueError, match="PINHOLE cameras, not OTHER"):
            backend.rasterize_spacetime(case.gaussians, TIME, SimpleNamespace(model="OTHER"))
    with pytest.raises(HoloreelError, match="alpha_min"):
        cpu.rasterize_spacetime(case.gaussians, TIME, case.camera, rules=Rules(alpha_min=0.0))


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_any_bits_are_survived(seed):
    """Parameters of any bit pattern neither crash nor spoil alpha, nor the gradients of sound rows."""
    generator = torch.Generator().manual_seed(seed)
    gaussians, camera = random_scene(60, 40, 30, 3, seed=seed)
    arrays = []
    for array in gaussians:
        wild = torch.randint(-(2**31), 2**31 - 1, array.shape, generator=generator).int().view(torch.float32)
        chosen = torch.rand(array.shape, generator=generator) < 0.05
        arrays.append(torch.where(chosen, wild, array).requires_grad_())
    pictures = cpu.rasterize_spacetime(SpacetimeTensors(*arrays), TIME, camera)
    assert torch.isfinite(pictures.alpha).all()
    assert ((pictures.alpha >= 0) & (pictures.alpha <= 1)).all()
    pictures.alpha.sum().backward()
    finite = [torch.isfinite(array.grad).reshape(60, -1).all(1) for array in arrays if array.grad is not None]
    # A finite but absurd parameter may have an infinite gradient; a sound row never has.
    sound = torch.stack(
        [torch.isclose(a, b).reshape(60, -1).all(1) for a, b in zip(arrays, gaussians, strict=True)]
    ).all(0)
    assert torch.stack(finite)[:, sound].all()
