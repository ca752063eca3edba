# SPDX-License-Identifier: GPL-3.0-or-later
"""Training: it learns a scene it can check, resumes bit for bit, and refuses what cannot work."""

import json
import signal
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from holoreel.core.camera import Camera
from holoreel.core.capture import Capture, Points, read_capture, write_capture, write_points
from holoreel.core.cli import main
from holoreel.core.errors import HoloreelError
from holoreel.core.gaussians.config import DensityConfig, TrainConfig
from holoreel.core.gaussians.model import SpacetimeGaussians
from holoreel.core.gaussians.parameters import Parameters
from holoreel.core.gaussians.run import RunPaths, train_reel
from holoreel.core.gaussians.train import Trainer
from holoreel.core.reel import load_gaussians
from holoreel.core.render import get_backend

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


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """The true scene seen by five cameras, the middle one held out."""
    folder = tmp_path_factory.mktemp("capture")
    backend, scene = get_backend(), true_scene()
    cameras = {
        f"cam{index:02d}": Camera.look_at(
            (3 * np.sin(angle), -3 * np.cos(angle), 0.3 * (index % 2)), (0, 0, 0), width=WIDTH, height=HEIGHT, fx=60.0
        )
        for index, angle in enumerate(np.radians([0, -24, -12, 12, 24]))
    }
    images, seeds = {}, {}
    tensors = Parameters(scene).spacetime
    for frame in range(FRAMES):
        for name, camera in cameras.items():
            with torch.no_grad():
                picture = backend.rasterize_spacetime(tensors, frame / FRAMES, camera).features.clamp(0, 1)
            images[name, frame] = folder / f"{name}-{frame}.png"
            imageio.imwrite(images[name, frame], np.rint(picture.numpy() * 255).astype(np.uint8))
        now = scene.evaluate(frame / FRAMES)
        rgb = np.rint(now.features * 255).astype(np.uint8)
        seeds[frame] = folder / f"seeds-{frame}.ply"
        write_points(seeds[frame], Points(now.means, rgb))
    capture = Capture(cameras, images, FRAMES, splits={"cam00": "test"}, fps=24.0, frame_start=3, seeds=seeds)
    return read_capture(write_capture(folder, capture))


def heldout_psnr(trainer: Trainer, capture: Capture) -> float:
    errors = []
    for name, frame in capture.views("test"):
        with torch.no_grad():
            rendered = trainer.backend.rasterize_spacetime(
                trainer.parameters.spacetime, capture.time(frame), capture.cameras[name]
            ).features
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


def test_same_seed_same_result_and_resuming_changes_nothing(capture: Capture, tmp_path: Path) -> None:
    backend = get_backend()
    straight = Trainer(capture, QUICK, backend)
    straight.run(lambda progress: None)
    first = Trainer(capture, QUICK, backend)
    first.run(lambda progress: None, until=23)
    path = tmp_path / "state.pt"
    torch.save(first.state(), path)
    second = Trainer(capture, QUICK, backend)
    second.load_state(torch.load(path, weights_only=True))
    second.run(lambda progress: None)
    for name, value in straight.parameters.tensors.items():
        assert torch.equal(value, second.parameters.tensors[name]), name
    assert len(straight.parameters) != len(first.parameters) or straight.iteration == second.iteration == 40


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
    trainer = train_reel(capture, out, QUICK, get_backend(), lambda progress: None, resume=True)
    assert not paths.checkpoint.exists()
    loaded = load_gaussians(out)
    assert (loaded.fps, loaded.frame_start, loaded.frame_count) == (24.0, 3, FRAMES)
    np.testing.assert_array_equal(loaded.gaussians.means, trainer.gaussians().means)
    record = json.loads(paths.record.read_text())
    assert record["gaussians"] == len(loaded.gaussians)
    assert record["config"]["iterations"] == 40


def test_ctrl_c_in_the_middle_of_a_step_leaves_a_whole_state(capture: Capture, tmp_path: Path) -> None:
    backend, out = get_backend(), tmp_path / "d.reel"
    calls = 0

    class Interrupting:
        """The backend, but Ctrl-C comes between the Adam steps of two tensors."""

        def __getattr__(self, name: str) -> object:
            return getattr(backend, name)

        def adam_step(self, *arguments: object) -> None:
            nonlocal calls
            calls += 1
            if calls == 13 * 9 + 4:
                signal.raise_signal(signal.SIGINT)
            backend.adam_step(*arguments)

    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        train_reel(capture, out, QUICK, Interrupting(), lambda progress: None)
    assert signal.getsignal(signal.SIGINT) is before
    assert torch.load(RunPaths(out).checkpoint, weights_only=True)["iteration"] == 14
    resumed = train_reel(capture, out, QUICK, backend, lambda progress: None, resume=True)
    straight = Trainer(capture, QUICK, backend)
    straight.run(lambda progress: None)
    for name, value in straight.parameters.tensors.items():
        assert torch.equal(value, resumed.parameters.tensors[name]), name


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
    RunPaths(out).checkpoint.write_bytes(b"not a checkpoint")
    with pytest.raises(HoloreelError, match="not a readable checkpoint"):
        train_reel(capture, out, QUICK, get_backend(), lambda progress: None, resume=True)
