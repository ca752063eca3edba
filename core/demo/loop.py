# SPDX-License-Identifier: GPL-3.0-or-later
"""The steps of the loop, in order; each leaves files that the next one and the report read."""

import shutil
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

from ..blender import Blender, run_in_blender
from ..capture import Capture, read_capture
from ..draw import open_player
from ..errors import HoloreelError
from ..evaluate import evaluate
from ..files import write_json
from ..gaussians.config import PRESETS
from ..gaussians.run import train_reel
from ..images import read_image, write_png
from ..machine import machine
from ..metrics import psnr
from ..render import get_backend
from ..rig import RigRequest
from ..synth import SynthJob, synthesize
from .pages import write_pages
from .path import orbit

EEVEE_PICTURES = 2  # the software OpenGL of a machine without a GPU takes its time
MOVING_PICTURES = 16  # of the moving camera, spread over the reel, sub-frames included
OnProgress = Callable[[int, int], None]


class Steps(Protocol):
    """Whoever shows how far the loop is: `with steps("title") as on_progress: ... on_progress(done, total)`."""

    def __call__(self, title: str) -> AbstractContextManager[OnProgress]:
        """Begin a step."""


@dataclass(frozen=True)
class DemoSettings:
    """What goes round the loop, and where its files go: `out` is made anew."""

    scene: Path
    out: Path
    blender: Blender
    cameras: int = 12
    frames: tuple[int, int] = (1, 12)
    width: int = 320
    height: int = 180
    samples: int = 16
    iterations: int = PRESETS["lite"].iterations


@dataclass
class Results:
    """What the steps found, for `metrics.json` and the report."""

    evaluation: dict[str, Any] = field(default_factory=dict)
    comparison: dict[str, list[float]] = field(default_factory=dict)  # PSNR against our raster, by engine and frame
    seconds: dict[str, float] = field(default_factory=dict)  # by step
    blender: str = ""
    gaussians: int = 0
    train_seconds: float = 0.0


def run_demo(settings: DemoSettings, steps: Steps) -> dict[str, Any]:
    """Run the loop and return what `metrics.json` holds. Raises `HoloreelError` where a step cannot be done."""
    began = time.perf_counter()
    out = settings.out
    _clear(out)
    results = Results()

    def timed(title: str, work: Callable[[OnProgress], None]) -> None:
        start = time.perf_counter()
        with steps(title) as on_progress:
            work(on_progress)
        results.seconds[title] = round(time.perf_counter() - start, 2)

    reel = out / f"{settings.scene.stem}.reel"
    timed("synthesize", lambda show: _synthesize(settings, show))
    capture = read_capture(out / "capture")
    timed("train", lambda show: _train(settings, capture, reel, results, show))
    timed("evaluate", lambda show: _evaluate(reel, capture, results, out / "raster", show))
    timed("Blender, Cycles", lambda show: _render(settings, reel, capture, results, "CYCLES", show))
    timed("Blender, EEVEE", lambda show: _render(settings, reel, capture, results, "EEVEE", show))
    timed("moving camera", lambda show: _move(settings, reel, capture, show))
    results.seconds["total"] = round(time.perf_counter() - began, 2)
    metrics = _metrics(settings, results)
    write_json(out / "metrics.json", metrics)
    write_pages(out, settings.scene.stem, reel, capture, metrics)
    return metrics


def _clear(out: Path) -> None:
    """Take away an earlier demo, and nothing that is not one."""
    if out.exists() and any(out.iterdir()):
        if not (out / ".demo").exists():
            raise HoloreelError(f"{out}: the folder holds other things; choose another --out, or empty it.")
        shutil.rmtree(out)
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / ".demo").touch()
    except OSError as error:
        raise HoloreelError(f"{out}: cannot write here ({error.strerror}); choose another --out.") from error


def _synthesize(settings: DemoSettings, show: OnProgress) -> None:
    request = RigRequest(settings.cameras, settings.width, settings.height)
    job = SynthJob(settings.scene, request, settings.frames, samples=settings.samples, holdout=(0,))
    synthesize(job, settings.out / "capture", lambda: settings.blender, on_progress=show)


def _train(settings: DemoSettings, capture: Capture, reel: Path, results: Results, show: OnProgress) -> None:
    config = replace(PRESETS["lite"], iterations=settings.iterations)
    trained = train_reel(
        capture, reel, config, get_backend(), lambda progress: show(progress.iteration, progress.iterations)
    )
    results.gaussians, results.train_seconds = trained.gaussians, round(trained.seconds, 2)


def _evaluate(reel: Path, capture: Capture, results: Results, folder: Path, show: OnProgress) -> None:
    results.evaluation = evaluate(
        reel,
        capture,
        on_progress=show,
        on_picture=lambda name, frame, drawing: write_png(folder / f"{name}-{frame:04d}.png", drawing.image),
    )


def _render(
    settings: DemoSettings, reel: Path, capture: Capture, results: Results, engine: str, show: OnProgress
) -> None:
    """Render the held-out view in Blender and compare it with our own raster."""
    name = capture.camera_names("test")[0]
    frames = range(capture.frame_count)
    if engine == "EEVEE":
        frames = range(0, capture.frame_count, -(-capture.frame_count // EEVEE_PICTURES))
    player, camera = open_player(reel), capture.cameras[name]
    folder = settings.out / engine.lower()
    paths = {frame: folder / f"{name}-{capture.frame_start + frame:04d}.exr" for frame in frames}
    shots = [
        {"camera": camera.to_json(), "time": capture.time(frame), "out": str(path.absolute())}
        for frame, path in paths.items()
    ]
    job = {"setting": {"reel": str(reel.absolute()), "engine": engine}, "shots": shots}
    outcome = run_in_blender(
        settings.blender,
        "holoreel.addon.render:main",
        job,
        log=folder / "blender.log",
        on_event=lambda event: show(event["index"] + 1, event["count"]),
    )
    results.blender = outcome["blender"]
    scores = []
    for frame, path in paths.items():
        rendered = read_image(path)[..., :3]
        drawn = player.draw(camera, float(capture.frame_start + frame), background=(0.0, 0.0, 0.0)).image
        scores.append(psnr(rendered, drawn))
        write_png(path.with_suffix(".png"), rendered)
    results.comparison[engine] = scores


def _move(settings: DemoSettings, reel: Path, capture: Capture, show: OnProgress) -> None:
    """Render a new camera that moves while the reel plays, sub-frames included, and save the scene that does so."""
    last = capture.frame_count - 1
    cameras = orbit(list(capture.cameras.values()), MOVING_PICTURES)
    moments = [index / (MOVING_PICTURES - 1) * last for index in range(MOVING_PICTURES)]  # in frames of the reel
    setting = {"reel": str(reel.absolute()), "background": list(open_player(reel).background)}
    shots = [
        {
            "camera": camera.to_json(),
            "time": moment / capture.frame_count,
            "out": str((settings.out / "moving" / f"{index:04d}.png").absolute()),
        }
        for index, (camera, moment) in enumerate(zip(cameras, moments, strict=True))
    ]
    log = settings.out / "moving" / "blender.log"
    run_in_blender(
        settings.blender,
        "holoreel.addon.render:main",
        {"setting": setting, "shots": shots},
        log=log,
        on_event=lambda event: show(event["index"] + 1, event["count"]),
    )
    path = [(capture.frame_start + moment, camera.to_json()) for camera, moment in zip(cameras, moments, strict=True)]
    stage = {"out": str((settings.out / "scene.blend").absolute()), "path": path}
    run_in_blender(settings.blender, "holoreel.addon.render:save_scene", {"setting": setting, "stage": stage}, log=log)


def _metrics(settings: DemoSettings, results: Results) -> dict[str, Any]:
    mean = results.evaluation["mean"]
    worst = {engine: min(scores) for engine, scores in results.comparison.items()}
    return {
        "scene": settings.scene.name,
        "heldout_psnr": mean["psnr"],
        "heldout_ssim": mean["ssim"],
        "heldout_dssim1": mean["dssim1"],
        "heldout_dssim2": mean["dssim2"],
        "cycles_vs_raster_psnr": round(worst["CYCLES"], 3),
        "eevee_vs_raster_psnr": round(worst["EEVEE"], 3),
        "gaussians": results.gaussians,
        "train_seconds": results.train_seconds,
        "total_seconds": results.seconds["total"],
        "iterations": settings.iterations,
        "seconds": results.seconds,
        "frames": results.evaluation["frames"],
        "cameras": settings.cameras,
        "size": [settings.width, settings.height],
        "samples": settings.samples,
        "blender": results.blender,
        "machine": machine(),
    }
