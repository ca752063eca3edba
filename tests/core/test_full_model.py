# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures of full models against a renderer of its own: dense, float64, numpy, written from the paper's formulas."""

from dataclasses import replace

import numpy as np
import pytest
from holoreel.core.camera import Camera
from holoreel.core.errors import HoloreelError
from holoreel.core.gaussians.decoder import Decoder, write_pt
from holoreel.core.gaussians.player import GaussianPlayer, draw, to_tensors
from holoreel.core.gaussians.ply import write_ply
from holoreel.core.reel import SegmentPayload, load_gaussians, save_gaussians, write_segments
from holoreel.core.render import get_backend
from holoreel.core.render.view import decoder_tensors
from holoreel.core.render.warp import lens_warp

ACTIVATIONS = {
    "sigmoid": lambda x: 1.0 / (1.0 + np.exp(-x)),
    "clamp": lambda x: np.clip(x, 0.0, 1.0),
    "none": lambda x: x,
}


def camera() -> Camera:
    """A turned camera whose principal point is off the middle."""
    a, b = 0.15, -0.1
    turn = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    turn = turn @ np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, (0.3, -0.2, 0.4)
    return Camera(96, 64, 88.0, 80.0, 40.0, 37.5, pose)


def rotations(q):
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    return np.stack([
        np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], 1),
        np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], 1),
        np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1),
    ], 1)  # fmt: skip


def dense_picture(model, hidden, output, activation, time, camera, places=None):
    """Every Gaussian at every place, front to back; returns color (H, W, 3), alpha and depth (H, W).

    Places (H, W, 2) in pixels are the pixels' centers unless given.
    """
    W, H, FX, FY, CX, CY = (getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy"))
    pose = camera.world_to_camera
    v, u = np.mgrid[:H, :W] + 0.5 if places is None else (places[..., 1], places[..., 0])
    p = {name: np.asarray(values, np.float64) for name, values in vars(model).items()}
    dt = time - p["trbf_centers"]
    d = dt[:, None]
    means = p["means"] + d * p["motions"][:, 0] + d**2 * p["motions"][:, 1] + d**3 * p["motions"][:, 2]  # Eq. 8
    turns = rotations(p["quats"] + d * p["omegas"])  # Eq. 9
    opacity = np.exp(-((dt / np.exp(p["trbf_log_scales"])) ** 2)) / (1 + np.exp(-p["opacity_logits"]))  # Eq. 7
    features = np.concatenate([p["features"][:, :6], d * p["features"][:, 6:]], 1)  # Eq. 10
    axes = turns * np.exp(p["log_scales"])[:, None, :]
    view, shift = pose[:3, :3], pose[:3, 3]
    local = means @ view.T + shift
    total, alpha_sum, depth_sum, passed = (
        np.zeros((*u.shape, 9)),
        np.zeros(u.shape),
        np.zeros(u.shape),
        np.ones(u.shape),
    )
    done = np.zeros(u.shape, bool)
    for i in np.argsort(local[:, 2], kind="stable"):
        x, y, z = local[i]
        if z < 0.2:
            continue
        tx = np.clip(x / z, (-0.15 * W - CX) / FX, (1.15 * W - CX) / FX) * z
        ty = np.clip(y / z, (-0.15 * H - CY) / FY, (1.15 * H - CY) / FY) * z
        jacobian = np.array([[FX / z, 0, -FX * tx / z**2], [0, FY / z, -FY * ty / z**2]]) @ view
        spread = jacobian @ axes[i]
        inverse = np.linalg.inv(spread @ spread.T + 0.3 * np.eye(2))
        du, dv = u - (FX * x / z + CX), v - (FY * y / z + CY)
        power = inverse[0, 0] * du * du + 2 * inverse[0, 1] * du * dv + inverse[1, 1] * dv * dv
        alpha = np.minimum(0.99, opacity[i] * np.exp(-0.5 * power))
        drawn = (alpha >= 1 / 255) & ~done
        done |= drawn & (passed * (1 - alpha) < 1e-4)
        weight = np.where(drawn & ~done, alpha * passed, 0.0)
        total += weight[..., None] * features[i]
        alpha_sum += weight
        depth_sum += weight * z
        passed -= weight
    directions = np.stack([(u - CX) / FX, (v - CY) / FY, np.ones(u.shape)], 2) @ view
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    origins = np.broadcast_to(-view.T @ shift, directions.shape)
    inputs = np.concatenate([total[..., 3:], origins, directions], 2)
    color = ACTIVATIONS[activation](total[..., :3] + np.maximum(inputs @ hidden.T, 0) @ output.T)  # Eq. 11
    return color, alpha_sum, np.divide(depth_sum, alpha_sum, out=np.zeros(u.shape), where=alpha_sum > 0)


def psnr(a, b):
    return -10 * np.log10(np.mean((a - b) ** 2))


@pytest.fixture
def full(random_model):
    """A full model of 200 Gaussians, some large and out of the picture, and weights that make every part matter."""
    random = np.random.default_rng(8)
    model = random_model(200, seed=3, features=9)
    model.means[:30] = random.uniform([-4, -3, 0.0], [4, 3, 5], (30, 3))
    model.log_scales[:10] = random.uniform(-1.5, -0.5, (10, 3))
    model.features[:] = random.normal(0.3, 0.8, (200, 9))
    return model, random.normal(0, 0.4, (6, 12)).astype(np.float32), random.normal(0, 0.4, (3, 6)).astype(np.float32)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_pictures_are_what_the_formulas_say(tmp_path, full, activation, backend):
    model, hidden, output = full
    decoder = Decoder(hidden, output, activation)
    save_gaussians(tmp_path / "a.reel", model, decoder=decoder, fps=24, frame_start=1, frame_count=8)
    try:
        get_backend(backend)
    except HoloreelError as error:
        pytest.skip(str(error))
    player, pose = GaussianPlayer(tmp_path / "a.reel", backend), camera()
    pictures = []
    for frame in (1, 3.5, 8):
        drawn = player.draw(pose, frame)
        color, alpha, depth = dense_picture(model, hidden, output, activation, (frame - 1) / 8, pose)
        assert alpha.max() > 0.9
        assert psnr(drawn.image, color) >= 80.0, frame
        assert psnr(drawn.alpha, alpha) >= 80.0
        np.testing.assert_allclose(drawn.depth * drawn.alpha, depth * alpha, atol=2e-2)
        pictures.append(drawn.image)
    assert np.abs(pictures[0] - pictures[2]).mean() > 0.01


def test_a_full_model_ignores_the_background(tmp_path, full):
    model, hidden, output = full
    save_gaussians(tmp_path / "a.reel", model, decoder=Decoder(hidden, output), fps=24, frame_start=1, frame_count=8)
    player = GaussianPlayer(tmp_path / "a.reel", "reference")
    plain, over = player.draw(camera(), 3), player.draw(camera(), 3, (1.0, 0.0, 0.5))
    np.testing.assert_array_equal(plain.image, over.image)


def test_the_authors_files_are_drawn_alike(tmp_path, full):
    """A bare PLY with a .pt beside it is the same full model; the activation is assumed, or said."""
    model, hidden, output = full
    write_ply(tmp_path / "point_cloud.ply", model)
    alone = load_gaussians(tmp_path / "point_cloud.ply")
    assert alone.decoder is None
    assert "without its decoder (point_cloud.pt)" in alone.report[-1]
    write_pt(tmp_path / "point_cloud.pt", Decoder(hidden, output))
    for said in (None, "clamp", "none"):
        save_gaussians(
            tmp_path / "a.reel", model, decoder=Decoder(hidden, output, said or "sigmoid"),
            fps=30, frame_start=0, frame_count=50,
        )  # fmt: skip
        bare = GaussianPlayer(tmp_path / "point_cloud.ply", "reference", said)
        assert any("a sigmoid is assumed" in sentence for sentence in bare.report) == (said is None)
        truth = GaussianPlayer(tmp_path / "a.reel", "reference").draw(camera(), 20)
        np.testing.assert_array_equal(bare.draw(camera(), 20).image, truth.image)
    (tmp_path / "point_cloud.pt").write_bytes(b"no state dict")
    with pytest.raises(HoloreelError, match=r"point_cloud\.pt is not the state dict of a decoder"):
        load_gaussians(tmp_path / "point_cloud.ply")


def test_each_segment_has_its_own_network(tmp_path, full):
    model, hidden, output = full
    decoders = [Decoder(hidden, output), Decoder(-hidden, output)]
    parts = [SegmentPayload(model, decoder, 1 + 4 * index, 4) for index, decoder in enumerate(decoders)]
    write_segments(tmp_path / "a.reel", parts, fps=24, frame_start=1)
    player = GaussianPlayer(tmp_path / "a.reel", "reference")
    for frame in (2, 6, 3, 7):
        decoder = decoders[frame > 4]
        time = (frame - 1) % 4 / 4
        color, _, _ = dense_picture(model, decoder.hidden, output, "sigmoid", time, camera())
        assert psnr(player.draw(camera(), frame).image, color) >= 80.0


LENSES = {
    "OPENCV": (-0.2, 0.05, 0.002, -0.003),
    "FULL_OPENCV": (0.4, -0.02, 0.001, 0.002, 0.0, 0.05, 0.0, 0.0),
    "OPENCV_FISHEYE": (0.05, -0.01, 0.0, 0.0),
}


@pytest.mark.parametrize("full_model", [False, True])
@pytest.mark.parametrize("lens", LENSES)
def test_lenses_bend_what_a_pinhole_sees(full, lens, full_model):
    """Each pixel shows what the pinhole's formulas say where its own ray goes; color, alpha and depth alike."""
    model, hidden, output = full
    model.log_scales[:] = model.log_scales.clip(-2.5)  # nothing finer than what interpolation can follow
    model.opacity_logits[:] = model.opacity_logits.clip(-3, 0)
    if not full_model:
        model = replace(model, features=model.features[:, :3])
    straight = camera()
    bent = replace(straight, model=lens, distortion=LENSES[lens])
    decoder = Decoder(hidden, output, "sigmoid") if full_model else None
    background = (0.2, 0.9, 0.4)
    drawn = draw(
        to_tensors(model, full_model), 0.4, bent, get_backend("reference"), background,
        decoder_tensors(decoder) if decoder else None,
    )  # fmt: skip
    local = bent.rays()[1] @ bent.world_to_camera[:3, :3].T
    virtual = lens_warp(bent).pinhole
    plane = local[:, :2] / local[:, 2:]
    places = (plane * (virtual.fx, virtual.fy) + (virtual.cx, virtual.cy)).reshape(bent.height, bent.width, 2)
    nine = model if full_model else replace(model, features=np.pad(model.features, ((0, 0), (0, 6))))
    zeros = np.zeros_like(output)
    color, alpha, depth = dense_picture(
        nine, hidden, output if full_model else zeros, "sigmoid" if full_model else "none", 0.4, virtual, places
    )
    if not full_model:
        color = color + (1 - alpha)[..., None] * background
    assert alpha.std() > 0.1
    assert psnr(drawn.image, color) > 40.0
    assert psnr(drawn.alpha, alpha) > 40.0
    solid = alpha > 0.3
    assert np.abs(drawn.depth - depth)[solid].mean() < 0.02
    assert psnr(drawn.alpha, draw(to_tensors(model), 0.4, straight, get_backend("reference")).alpha) < 35.0


def test_what_a_lens_cannot_see_is_background(random_model):
    """A fisheye that bends more than a pinhole reaches: the corners show the background, nothing else."""
    wide = Camera(80, 60, 18.0, 18.0, 40.0, 30.0, model="OPENCV_FISHEYE", distortion=(0.0, 0.0, 0.0, 0.0))
    drawn = draw(to_tensors(random_model(50)), 0.5, wide, get_backend("reference"), (0.25, 0.5, 0.75))
    np.testing.assert_allclose(drawn.image[:2, :2], np.broadcast_to((0.25, 0.5, 0.75), (2, 2, 3)), atol=1e-6)
    assert not drawn.alpha[:2, :2].any()
    assert not drawn.depth[:2, :2].any()
    assert drawn.alpha[25:35, 35:45].max() > 0.3
