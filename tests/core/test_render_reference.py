# SPDX-License-Identifier: GPL-3.0-or-later
"""The oracle is not judged by itself: against a plain loop over Gaussians, and against finite differences."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from holoreel.core.camera import Camera
from holoreel.core.render import reference
from holoreel.core.render.contract import DensityStats, Rules, SpacetimeTensors
from holoreel.core.render.scenes import random_scene

torch.set_num_threads(2)


def loop_render(g, time, camera, background, rules):
    """Every Gaussian and every pixel, one after another, in numpy and float64."""
    g = SpacetimeTensors(*(array.detach().double().numpy() for array in g))
    pose = camera.world_to_camera
    ys, xs = np.mgrid[: camera.height, : camera.width] + 0.5
    drawable = []
    for i in range(len(g.means)):
        dt = time - g.trbf_centers[i]
        opacity = 1 / (1 + math.exp(-g.opacity_logits[i])) * math.exp(-((dt / math.exp(g.trbf_log_scales[i])) ** 2))
        mean = g.means[i] + dt * g.motions[i, 0] + dt**2 * g.motions[i, 1] + dt**3 * g.motions[i, 2]
        x, y, z = pose[:3, :3] @ mean + pose[:3, 3]
        if z >= rules.near and opacity >= rules.alpha_min:
            drawable.append((np.float32(z), i, opacity, np.array([x, y, z])))
    picture = np.zeros((camera.height, camera.width, g.features.shape[1]))
    transmittance = np.ones((camera.height, camera.width))
    full = np.zeros_like(transmittance, dtype=bool)
    weighted_z = np.zeros_like(transmittance)
    for _, i, opacity, (x, y, z) in sorted(drawable, key=lambda item: item[:2]):
        quat = g.quats[i] + (time - g.trbf_centers[i]) * g.omegas[i]
        length = np.linalg.norm(quat)
        w, a, b, c = quat / length if length > 0 else (1.0, 0.0, 0.0, 0.0)
        cross = np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]])
        rotation = np.eye(3) + 2 * w * cross + 2 * cross @ cross
        covariance = rotation @ np.diag(np.exp(2 * g.log_scales[i])) @ rotation.T
        tangent_x = np.clip(x / z, *tangent_limits(rules, camera.width, camera.fx, camera.cx))
        tangent_y = np.clip(y / z, *tangent_limits(rules, camera.height, camera.fy, camera.cy))
        jacobian = np.array([[camera.fx, 0, -camera.fx * tangent_x], [0, camera.fy, -camera.fy * tangent_y]]) / z
        jacobian = jacobian @ pose[:3, :3]
        conic = np.linalg.inv(jacobian @ covariance @ jacobian.T + rules.low_pass * np.eye(2))
        dx, dy = xs - (camera.fx * x / z + camera.cx), ys - (camera.fy * y / z + camera.cy)
        squared = conic[0, 0] * dx**2 + 2 * conic[0, 1] * dx * dy + conic[1, 1] * dy**2
        alpha = np.minimum(opacity * np.exp(-0.5 * squared), rules.alpha_max)
        seen = (alpha >= rules.alpha_min) & ~full
        full |= seen & (transmittance * (1 - alpha) < rules.transmittance_min)
        weight = np.where(seen & ~full, alpha * transmittance, 0)
        picture += weight[..., None] * g.features[i]
        weighted_z += weight * z
        transmittance -= weight
    alpha = 1 - transmittance
    depth = np.divide(weighted_z, alpha, out=np.zeros_like(alpha), where=alpha > 0)
    return picture + transmittance[..., None] * background, alpha, depth


def tangent_limits(rules, pixels, focal, principal):
    """Return the tangents at the picture's two borders, moved out by what the clamp adds to half the field of view."""
    more = (rules.jacobian_clamp - 1) * 0.5 * pixels / focal
    return -principal / focal - more, (pixels - principal) / focal + more


def turned_camera(camera: Camera) -> Camera:
    """The same picture size from another place, with an uncentered principal point and oblong pixels."""
    angle = 0.3
    pose = np.eye(4)
    pose[:3, :3] = [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
    pose[:3, 3] = [0.4, -0.3, 0.9]
    return Camera(camera.width, camera.height, camera.fx, 1.1 * camera.fy, camera.cx + 3.3, camera.cy - 2.7, pose)


@pytest.mark.parametrize(("channels", "shift"), [(1, 0.0), (3, 0.0), (3, 0.45), (2, -0.7)])
def test_reference_matches_a_plain_loop(channels, shift):
    gaussians, camera = random_scene(400, 53, 37, channels, median_radius_px=9, seed=3)
    gaussians.opacity_logits[:80] = 7.0  # saturated
    gaussians.log_scales[80:90] += 3.0
    gaussians.quats[90:110] = 0
    gaussians.omegas[90:100] = 0
    gaussians.trbf_log_scales[110:130] = -4.0
    gaussians.means[130:150, 2] *= -1
    camera = turned_camera(camera)
    camera = replace(camera, cx=camera.cx + shift * camera.width, cy=camera.cy - 0.5 * shift * camera.height)
    background = np.linspace(0.2, 0.9, channels)
    rules = Rules(near=1.5)
    doubles = SpacetimeTensors(*(array.double() for array in gaussians))
    got = reference.rasterize_spacetime(doubles, 0.37, camera, torch.tensor(background), rules)
    wanted = loop_render(gaussians, 0.37, camera, background, rules)
    assert wanted[1].max() > 0.999
    assert wanted[1].min() < 0.98
    for ours, theirs in zip(got, wanted, strict=True):
        np.testing.assert_allclose(ours.numpy(), theirs, rtol=0, atol=1e-11)


def test_gradients_match_finite_differences():
    gaussians, camera = random_scene(6, 20, 14, 2, median_radius_px=14, seed=5)
    gaussians.quats[2] = 0
    camera = turned_camera(camera)
    generator = torch.Generator().manual_seed(1)
    weights = [
        torch.randn(shape, generator=generator, dtype=torch.float64) for shape in ((14, 20, 2), (14, 20), (14, 20))
    ]
    # Without thresholds the picture is smooth everywhere, as finite differences need.
    rules = Rules(alpha_max=0.9999, alpha_min=1e-300, transmittance_min=0.0, jacobian_clamp=5.0)

    def loss(*arrays):
        *parameters, background = arrays
        pictures = reference.rasterize_spacetime(SpacetimeTensors(*parameters), 0.4, camera, background, rules)
        return sum((picture * weight).sum() for picture, weight in zip(pictures, weights, strict=True))

    inputs = [array.double() for array in gaussians] + [torch.tensor([0.3, 0.7], dtype=torch.float64)]
    inputs[2][2] = 1e-2  # a zero quaternion is a kink; near it is not
    assert torch.autograd.gradcheck(loss, [array.requires_grad_() for array in inputs], eps=1e-6, atol=1e-6, rtol=1e-5)


def test_recomputing_groups_changes_nothing(monkeypatch):
    gaussians, camera = random_scene(300, 64, 48, 3, seed=2)
    gradients = []
    for limit in (1 << 40, 0):
        monkeypatch.setattr(reference, "GRAPH_ELEMENTS", limit)
        means = gaussians.means.clone().requires_grad_()
        picture = reference.rasterize_spacetime(gaussians._replace(means=means), 0.5, camera).features
        picture.square().sum().backward()
        gradients.append(means.grad)
    assert torch.equal(*gradients)


def test_detach_motion_time_leaves_the_opacity_path_alone():
    gaussians, camera = random_scene(50, 32, 32, 3, seed=4)
    gradients = {}
    for still in (False, True):
        for detach in (False, True):
            centers = gaussians.trbf_centers.clone().requires_grad_()
            motions, omegas = (array * (0 if still else 1) for array in (gaussians.motions, gaussians.omegas))
            scene = gaussians._replace(trbf_centers=centers, motions=motions, omegas=omegas)
            picture = reference.rasterize_spacetime(scene, 0.5, camera, rules=Rules(detach_motion_time=detach)).features
            picture.square().sum().backward()
            gradients[still, detach] = centers.grad
    torch.testing.assert_close(gradients[True, True], gradients[True, False])
    assert not torch.allclose(gradients[False, True], gradients[False, False])


def test_density_statistics():
    gaussians, camera = random_scene(200, 64, 48, 3, seed=6)
    gaussians.means[:20, 2] = -1
    gaussians.means.requires_grad_()
    density = DensityStats(torch.zeros(200), torch.zeros(200, dtype=torch.int32), torch.zeros(200))
    for _ in range(2):
        reference.rasterize_spacetime(gaussians, 0.5, camera, density=density).features.square().sum().backward()
    assert set(density.views.tolist()) == {0, 2}
    assert (density.views[:20] == 0).all()
    assert ((density.gradient > 0) <= (density.views > 0)).all()
    assert ((density.radius_px > 0) == (density.views > 0)).all()
