# SPDX-License-Identifier: GPL-3.0-or-later
"""Training: it learns a scene it can check, resumes bit for bit, and refuses what cannot work."""

import json
import signal
from dataclasses import replace
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from holoreel.core.camera import Camera
from holoreel.core.capture import Capture, Points, read_capture, write_capture, write_points
from holoreel.core.cli import main
from holoreel.core.errors import HoloreelError
from holoreel.core.gaussians.config import PRESETS, DensityConfig, GuidedConfig, LearningRates, McmcConfig, TrainConfig
from holoreel.core.gaussians.model import SpacetimeGaussians
from holoreel.core.gaussians.parameters import Parameters
from holoreel.core.gaussians.player import GaussianPlayer
from holoreel.core.gaussians.run import RunPaths, train_reel
from holoreel.core.gaussians.train import Trainer, valid_pixels
from holoreel.core.reel import load_gaussians, read_reel
from holoreel.core.render import get_backend
from holoreel.core.render.view import render_view

FRAMES, WIDTH, HEIGHT = 4, 64, 48
QUICK = TrainConfig(iterations=40, checkpoint_every=10, density=DensityConfig(prune_every=7, events=2))
Backend = object


def true_scene() -> SpacetimeGaussians:
    """A still wall of colored dots and a handful of dots that cross in front of it."""
    rng = np.random.default_rng(0)
    still, moving = 250, 30
    count = still + moving
    means = np.concatenate(
        [
            rng.uniform([-1.6, 0.4, -1.2], [1.6, 0.5, 1.2], (still, 3)),
            rng.uniform([-0.6, -0.4, -0.4], [0, -0.2, 0.4], (moving, 3)),
        ]
    )
    motions = np.zeros((count, 3, 3))
    motions[still:, 0, 0] = 0.8
    return SpacetimeGaussians(
        means=means,
        motions=motions,
        quats=np.tile([1.0, 0, 0, 0], (count, 1)),
        omegas=np.zeros((count, 4)),
        log_scales=np.log(np.concatenate([np.full((still, 3), 0.12), np.full((moving, 3), 0.06)])),
        opacity_logits=np.full(count, 3.0),
        features=rng.uniform(0.1, 0.9, (count, 3)),
        trbf_centers=np.full(count, 0.0),
        trbf_log_scales=np.full(count, 3.0),
    )


def recorded(folder: Path, cameras: dict[str, Camera], blind: int | None = None) -> Capture:
    """The true scene as `cameras` see it, cam00 held out; pixels that a lens cannot see have the value `blind`."""
    backend, scene = get_backend(), true_scene()
    images, seeds = {}, {}
    tensors = Parameters(scene).spacetime
    for frame in range(FRAMES):
        for name, camera in cameras.items():
            with torch.no_grad():
                picture = render_view(backend, tensors, frame / FRAMES, camera).features.clamp(0, 1)
            pixels = np.rint(picture.numpy() * 255).astype(np.uint8)
            valid = valid_pixels(camera)
            if valid is not None and blind is not None:
                pixels[~valid.numpy()] = blind
            images[name, frame] = folder / f"{name}-{frame}.png"
            imageio.imwrite(images[name, frame], pixels)
        now = scene.evaluate(frame / FRAMES)
        rgb = np.rint(now.features * 255).astype(np.uint8)
        seeds[frame] = folder / f"seeds-{frame}.ply"
        write_points(seeds[frame], Points(now.means, rgb))
    return Capture(cameras, images, FRAMES, splits={"cam00": "test"}, fps=24.0, frame_start=3, seeds=seeds)


def around(fx: float = 60.0) -> dict[str, Camera]:
    """Five cameras on an arc, the middle one first."""
    return {
        f"cam{index:02d}": Camera.look_at(
            (3 * np.sin(angle), -3 * np.cos(angle), 0.3 * (index % 2)), (0, 0, 0), width=WIDTH, height=HEIGHT, fx=fx
        )
        for index, angle in enumerate(np.radians([0, -24, -12, 12, 24]))
    }


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """The true scene seen by five cameras, the middle one held out."""
    folder = tmp_path_factory.mktemp("capture")
    return read_capture(write_capture(folder, recorded(folder, around())))


def heldout_psnr(trainer: Trainer, capture: Capture) -> float:
    errors = []
    for name, frame in capture.views("test"):
        with torch.no_grad():
            rendered = trainer.render(capture.cameras[name], capture.time(frame)).features.clamp(0, 1)
        errors.append(np.mean((rendered.numpy() - capture.image(name, frame) / 255.0) ** 2))
    return float(-10 * np.log10(np.mean(errors)))


def test_training_learns_a_view_it_never_saw(capture: Capture) -> None:
    config = TrainConfig(iterations=400)
    trainer = Trainer(capture, config, get_backend())
    before = heldout_psnr(trainer, capture)
    trainer.run(lambda progress: None)
    after = heldout_psnr(trainer, capture)
    assert after > before + 3
    assert after > 25
    assert trainer.history[-1][0] == 400


def assert_same(a: Trainer, b: Trainer) -> None:
    """Two runs have come to the same bits."""
    assert a.iteration == b.iteration
    for name, value in {**a.parameters.tensors, **a.parameters.network}.items():
        other = {**b.parameters.tensors, **b.parameters.network}[name]
        assert torch.equal(value, other), name


# Each must do what makes it special within 23 iterations and again after: guided sampling when a window of one
# iteration has ended, relocation every few.
VARIANTS = {
    "lite": QUICK,
    "full": replace(QUICK, model="full", decoder_output="sigmoid", batch=2),
    "mcmc": replace(QUICK, strategy="mcmc", mcmc=McmcConfig(every=4, start=0.0, growth=0.1)),
    "guided": replace(
        QUICK, guided=GuidedConfig(times=3, start=0.5, stop=1.0, stable=0.9, patch=8, contrast=1.0, samples=3)
    ),
    "extent": replace(QUICK, unit="extent", rates=LearningRates(means=1e-4, means_final=1e-5, motions=1e-4)),
}


@pytest.mark.parametrize("name", VARIANTS)
def test_same_seed_same_result_and_resuming_changes_nothing(capture: Capture, tmp_path: Path, name: str) -> None:
    backend, config = get_backend(), VARIANTS[name]
    straight = Trainer(capture, config, backend)
    begun = len(straight.parameters)
    straight.run(lambda progress: None)
    first = Trainer(capture, config, backend)
    first.run(lambda progress: None, until=23)
    path = tmp_path / "state.pt"
    torch.save(first.state(), path)
    second = Trainer(capture, config, backend)
    second.load_state(torch.load(path, weights_only=True))
    second.run(lambda progress: None)
    assert_same(straight, second)
    assert straight.iteration == 40
    if name == "guided":
        assert len(straight.guided_at) == 3
        assert straight.guided_at[0] < 23 < straight.guided_at[-1]
    if name == "mcmc":
        assert len(straight.parameters) > begun


def test_interrupted_run_leaves_a_checkpoint_and_resumes_to_a_reel(capture: Capture, tmp_path: Path) -> None:
    out = tmp_path / "a.reel"

    def interrupt(progress: object) -> None:
        if progress.iteration >= 20:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_reel(capture, out, QUICK, get_backend(), interrupt)
    paths = RunPaths(out)
    assert paths.checkpoint.exists()
    assert not out.exists()
    with pytest.raises(HoloreelError, match="--resume"):
        train_reel(capture, out, QUICK, get_backend(), lambda progress: None)
    other = TrainConfig(iterations=40, dssim_weight=0.5, density=QUICK.density)
    with pytest.raises(HoloreelError, match="dssim_weight"):
        train_reel(capture, out, other, get_backend(), lambda progress: None, resume=True)
    trained = train_reel(capture, out, QUICK, get_backend(), lambda progress: None, resume=True)
    assert not paths.checkpoint.exists()
    loaded = load_gaussians(out)
    assert (loaded.fps, loaded.frame_start, loaded.frame_count) == (24.0, 3, FRAMES)
    assert len(loaded.gaussians) == trained.gaussians
    record = json.loads(paths.record.read_text())
    assert record["gaussians"] == len(loaded.gaussians)
    assert record["config"]["iterations"] == 40


def test_ctrl_c_in_the_middle_of_a_step_leaves_a_whole_state(capture: Capture, tmp_path: Path) -> None:
    backend, out = get_backend(), tmp_path / "d.reel"
    calls = 0

    class Interrupting:
        """The backend, but Ctrl-C comes within an Adam step."""

        def __getattr__(self, name: str) -> object:
            return getattr(backend, name)

        def adam(self, *arguments: object) -> None:
            nonlocal calls
            calls += 1
            if calls == 14:
                signal.raise_signal(signal.SIGINT)
            backend.adam(*arguments)

    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        train_reel(capture, out, QUICK, Interrupting(), lambda progress: None)
    assert signal.getsignal(signal.SIGINT) is before
    assert torch.load(RunPaths(out).state, weights_only=True)["iteration"] == 14
    train_reel(capture, out, QUICK, backend, lambda progress: None, resume=True)
    straight = Trainer(capture, QUICK, backend)
    straight.run(lambda progress: None)
    resumed = load_gaussians(out).gaussians
    for name, value in straight.parameters.tensors.items():
        assert np.array_equal(value.detach().numpy(), getattr(resumed, name)), name


def test_command_trains_and_says_what_it_made(capture: Capture, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = tmp_path / "b.reel"
    command = ["train", "stg", str(capture.source), "--out", str(out), "--preset", "lite", "--iterations", "12"]
    assert main(command) == 0
    assert "Gaussians" in capsys.readouterr().out
    assert load_gaussians(out).gaussians.variant == "lite"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--out", "name.ply"], ".reel"),
        (["--out", "x.reel", "--resume"], "no checkpoint"),
        (["--out", "x.reel", "--preset", "lait"], "lite"),
        (["--out", "/proc/no/x.reel"], "choose another --out"),
    ],
)
def test_command_refuses(capture: Capture, tmp_path: Path, monkeypatch, capsys, arguments, message) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["train", "stg", str(capture.source), "--iterations", "2", *arguments]) == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_captures_that_cannot_be_trained(capture: Capture) -> None:
    everything_held_out = {name: "test" for name in capture.cameras}
    no_training = Capture(capture.cameras, capture.images, FRAMES, everything_held_out, seeds=capture.seeds)
    with pytest.raises(HoloreelError, match="hold fewer cameras out"):
        Trainer(no_training, QUICK, get_backend())
    with pytest.raises(HoloreelError, match="holoreel sfm"):
        Trainer(Capture(capture.cameras, capture.images, FRAMES), QUICK, get_backend())


def test_broken_checkpoint_is_refused(capture: Capture, tmp_path: Path) -> None:
    out = tmp_path / "c.reel"
    RunPaths(out).checkpoint.mkdir()
    RunPaths(out).state.write_bytes(b"not a checkpoint")
    with pytest.raises(HoloreelError, match="not a readable checkpoint"):
        train_reel(capture, out, QUICK, get_backend(), lambda progress: None, resume=True)


@pytest.mark.parametrize("activation", ["sigmoid", "clamp", "none"])
def test_full_model_learns_a_view_it_never_saw(capture: Capture, activation: str) -> None:
    trainer = Trainer(capture, TrainConfig(iterations=300, model="full", decoder_output=activation), get_backend())
    before = heldout_psnr(trainer, capture)
    trainer.run(lambda progress: None)
    assert heldout_psnr(trainer, capture) > before + 3
    assert trainer.gaussians().variant == "full"
    decoder = trainer.decoder()
    assert decoder.activation == activation
    assert np.abs(decoder.output).max() > 0


def test_full_model_begins_with_the_colors_of_the_lite_one(capture: Capture) -> None:
    """The network adds nothing yet, and a sigmoid's base color is what it turns into the seed's."""
    lite = Trainer(capture, QUICK, get_backend())
    pictures = {}
    for activation in ("none", "clamp", "sigmoid"):
        full = Trainer(capture, replace(QUICK, model="full", decoder_output=activation), get_backend())
        with torch.no_grad():
            pictures[activation] = full.render(capture.cameras["cam00"], 0.25)
    with torch.no_grad():
        wanted = lite.render(capture.cameras["cam00"], 0.25)
    for name in ("none", "clamp"):
        torch.testing.assert_close(pictures[name].features, wanted.features, rtol=0, atol=1e-5)
    opaque = wanted.alpha > 0.99
    assert opaque.any()
    off = (pictures["sigmoid"].features - wanted.features)[opaque].abs()
    assert off.mean() < 0.03


def test_what_is_rendered_is_what_the_model_says(capture: Capture) -> None:
    """The trained picture against the model's own evaluation in float64, drawn as plain 3D Gaussians and decoded."""
    trainer = Trainer(capture, replace(QUICK, model="full", decoder_output="clamp"), get_backend())
    trainer.run(lambda progress: None)
    camera = capture.cameras["cam00"]
    with torch.no_grad():
        picture = trainer.render(camera, 0.6).features.numpy()
        now = trainer.gaussians().evaluate(0.6)
        arrays = (now.means, now.quats, now.scales, now.opacities, now.features)
        features = trainer.backend.rasterize(*map(torch.from_numpy, arrays), camera).features.numpy()
    origins, directions = camera.rays()
    wanted = trainer.decoder().decode(features.reshape(-1, 9), origins, directions).reshape(picture.shape)
    assert np.abs(trainer.gaussians().features[:, 6:]).max() > 0.01
    np.testing.assert_allclose(picture, wanted, atol=2e-4)


def test_parts_that_are_turned_off_stay_neutral(capture: Capture) -> None:
    backend = get_backend()

    def trained(**settings: object) -> SpacetimeGaussians:
        trainer = Trainer(capture, replace(VARIANTS["guided"], **settings), backend)
        trainer.run(lambda progress: None)
        return trainer.gaussians()

    everything = trained()
    assert everything.motions[:, 2].any()
    assert everything.omegas.any()
    assert np.abs(everything.motions).max() > 0
    for order in range(3):
        model = trained(motion=order)
        assert not model.motions[:, order:].any()
        assert order == 0 or model.motions[:, order - 1].any()
    assert not trained(rotation=0).omegas.any()
    always = trained(temporal_opacity=False)
    for time in (-1.0, 0.0, 0.7, 2.0):  # what is there is there for good
        np.testing.assert_allclose(always.evaluate(time).opacities, always.evaluate(0.5).opacities, rtol=1e-6)
    assert len(np.unique(always.trbf_centers)) <= FRAMES + 1


def test_centers_learn_from_opacity_alone_where_asked(capture: Capture) -> None:
    """With motion detached and every Gaussian always there, nothing is left to pull at the temporal centers."""
    pulls = {}
    for detach in (False, True):
        seeds = true_scene()
        seeds.trbf_log_scales[:] = 8.0
        trainer = Trainer(capture, replace(QUICK, detach_time=detach, model="full"), get_backend(), seeds)
        with torch.no_grad():
            trainer.parameters.tensors["features"][:, 6:] = 0.5
        rendering = trainer.render(capture.cameras["cam01"], 0.5, training=True)
        rendering.features.square().sum().backward()
        pulls[detach] = float(trainer.parameters.tensors["trbf_centers"].grad.abs().max())
    assert pulls[True] < 1e-3 * pulls[False]


def test_given_gaussians_are_where_a_run_begins(capture: Capture) -> None:
    backend, seeds = get_backend(), true_scene()
    no_points = Capture(capture.cameras, capture.images, FRAMES, capture.splits)
    warm = Trainer(no_points, QUICK, backend, seeds)
    np.testing.assert_array_equal(warm.gaussians().means, seeds.means)
    assert heldout_psnr(warm, capture) > 45
    full = Trainer(capture, replace(QUICK, model="full"), backend)
    full.run(lambda progress: None)
    again = Trainer(capture, replace(QUICK, model="full"), backend, full.gaussians(), full.decoder())
    assert heldout_psnr(again, capture) == pytest.approx(heldout_psnr(full, capture), abs=1e-3)
    with pytest.raises(ValueError, match="full"):
        Trainer(capture, QUICK, backend, full.gaussians())


def moved(capture: Capture, folder: Path, scale: float, angle: float) -> Capture:
    """The same capture in a world that is scaled and turned."""
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    cameras, seeds = {}, {}
    for name, camera in capture.cameras.items():
        pose = camera.world_to_camera.copy()
        pose[:3, :3] = pose[:3, :3] @ turn.T
        pose[:3, 3] *= scale
        cameras[name] = replace(camera, world_to_camera=pose)
    for frame in capture.seeds:
        points = capture.seed_points(frame)
        seeds[frame] = folder / f"{frame}.ply"
        write_points(seeds[frame], Points((scale * points.xyz @ turn.T).astype(np.float32), points.rgb))
    return replace(capture, cameras=cameras, seeds=seeds)


@pytest.mark.parametrize(("scale", "angle"), [(1e-3, 0.0), (1e4, 0.0), (7.0, 1.1)])
@pytest.mark.parametrize("model", ["lite", "full"])
def test_neither_unit_nor_axes_of_the_world_matter(
    capture: Capture, tmp_path: Path, scale: float, angle: float, model: str
) -> None:
    config = replace(QUICK, iterations=150, model=model)
    results = []
    for world in (capture, moved(capture, tmp_path, scale, angle)):
        trainer = Trainer(world, config, get_backend())
        trainer.run(lambda progress: None)
        results.append((heldout_psnr(trainer, world), len(trainer.parameters)))
    assert results[1][0] == pytest.approx(results[0][0], abs=0.5)
    assert results[1][1] == pytest.approx(results[0][1], rel=0.1)
    assert results[0][0] > 22


def test_a_tiny_world_is_played_as_it_was_trained(capture: Capture, tmp_path: Path) -> None:
    """Everything there is nearer than what a rasterizer usually begins to draw at."""
    tiny = moved(capture, tmp_path, 1e-3, 0.4)
    trained = train_reel(tiny, tmp_path / "t.reel", replace(QUICK, iterations=80), get_backend(), lambda progress: None)
    assert read_reel(trained.reel.path).near < 3e-3
    player = GaussianPlayer(trained.reel.path)
    picture = player.draw(tiny.cameras["cam00"], player.frame_start).image
    assert np.mean((picture - capture.image("cam00", 0) / 255.0) ** 2) < 0.01


@pytest.mark.parametrize(
    ("density", "message"),
    [
        (DensityConfig(prune_opacity=0.9999, prune_every=5), "too transparent.*--density.prune-opacity"),
        (DensityConfig(prune_depth=50.0, prune_every=5), "too near to a camera.*--density.prune-depth"),
    ],
)
def test_a_scene_that_prunes_to_nothing_stops_with_the_reason(
    capture: Capture, density: DensityConfig, message: str
) -> None:
    trainer = Trainer(capture, replace(QUICK, density=density), get_backend())
    with pytest.raises(HoloreelError, match=f"Gaussians are left at iteration 5.*{message}"):
        trainer.run(lambda progress: None)


def test_a_loss_that_is_not_finite_stops_with_the_reason(capture: Capture) -> None:
    trainer = Trainer(capture, replace(QUICK, model="full"), get_backend())
    with torch.no_grad():
        trainer.parameters.network["output"][0, 0] = float("nan")
    with pytest.raises(HoloreelError, match=r"not finite at iteration 1 .*--rates\.means"):
        trainer.run(lambda progress: None)


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_trains_and_its_moments_come(capture: Capture, name: str) -> None:
    preset = PRESETS[name]
    assert preset.iterations <= preset.planned
    assert preset.guided.times <= 3
    config = replace(preset, iterations=120, schedule=0)
    trainer = Trainer(capture, config, get_backend())
    before = heldout_psnr(trainer, capture)
    trainer.run(lambda progress: None)
    assert heldout_psnr(trainer, capture) > before


@pytest.mark.parametrize("model", ["lite", "full"])
def test_distorted_lenses_train_and_what_they_cannot_see_does_not_count(tmp_path: Path, model: str) -> None:
    """A fisheye whose corners lie beyond what can be drawn: whatever the pictures have there, the run is the same."""
    cameras = {
        name: replace(camera, model="OPENCV_FISHEYE", distortion=(0.05, -0.01, 0.0, 0.0))
        for name, camera in around(fx=21.0).items()
    }
    share = float(valid_pixels(cameras["cam01"]).to(torch.float32).mean())
    assert 0.5 < share < 0.99
    trainers, before = [], 0.0
    for blind in (0, 255):
        folder = tmp_path / str(blind)
        folder.mkdir()
        seen = recorded(folder, cameras, blind)
        trainers.append(Trainer(seen, replace(QUICK, iterations=60, model=model), get_backend()))
        if not before:
            before = heldout_psnr(trainers[0], seen)
            first = seen
        trainers[-1].run(lambda progress: None)
    assert_same(*trainers)
    assert heldout_psnr(trainers[0], first) > before + 2


def test_guided_sampling_fills_a_hole_that_the_seeds_left(tmp_path: Path) -> None:
    """Half of the wall has no seeds: density control has to creep in from its border, guided sampling has not."""
    whole = recorded(tmp_path, around())
    seeds = {}
    for frame in whole.seeds:
        points = whole.seed_points(frame)
        kept = (points.xyz[:, 1] < 0.2) | (points.xyz[:, 0] < -0.3)
        seeds[frame] = tmp_path / f"half-{frame}.ply"
        write_points(seeds[frame], Points(points.xyz[kept], points.rgb[kept]))
    holey = replace(whole, seeds=seeds)
    psnr = {}
    for times in (0, 3):
        config = TrainConfig(iterations=300, guided=GuidedConfig(times=times, patch=8, far=1.4))
        trainer = Trainer(holey, config, get_backend())
        trainer.run(lambda progress: None)
        assert len(trainer.guided_at) == times
        psnr[times] = heldout_psnr(trainer, holey)
    assert psnr[3] > psnr[0] + 0.7
