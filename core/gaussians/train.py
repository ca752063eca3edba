# SPDX-License-Identifier: GPL-3.0-or-later
"""Training of Spacetime Gaussians from a capture (Spacetime Gaussians, Sec. 4.3)."""

import math
import signal
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from types import ModuleType

import numpy as np
import torch
from torch import Tensor

from ..capture import Capture, View
from ..errors import HoloreelError
from .config import TrainConfig
from .density import SceneScale, densify, empty_stats, prune, reset_opacities
from .model import SpacetimeGaussians
from .parameters import Parameters
from .seeds import gaussians_from_points

CACHE_BYTES = 2 << 30


@dataclass(frozen=True)
class Progress:
    """What a run has to say every few iterations."""

    iteration: int
    iterations: int
    loss: float
    psnr: float
    gaussians: int
    seconds_left: float


class PictureCache:
    """Pictures of a capture as (H, W, 3) uint8, read when first asked for; the least recently used make room."""

    def __init__(self, capture: Capture, background: tuple[float, float, float], limit: int = CACHE_BYTES):
        self.capture, self.background, self.limit, self.bytes = capture, background, limit, 0
        self.pictures: OrderedDict[View, np.ndarray] = OrderedDict()

    def get(self, view: View) -> Tensor:
        """Return one picture in display-referred [0, 1], (H, W, 3) float32, over the background."""
        if view in self.pictures:
            self.pictures.move_to_end(view)
        else:
            self.pictures[view] = np.ascontiguousarray(self.capture.image(*view, background=self.background))
            self.bytes += self.pictures[view].nbytes
            while self.bytes > self.limit and len(self.pictures) > 1:
                self.bytes -= self.pictures.popitem(last=False)[1].nbytes
        return torch.from_numpy(self.pictures[view]).to(torch.float32).mul_(1.0 / 255.0)


@contextmanager
def _single_threaded_torch() -> Iterator[None]:
    """Keep torch's own threads asleep: they spin while they wait, beside the kernels' threads and at their cost."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@contextmanager
def _interrupts_between_steps() -> Iterator[Callable[[], None]]:
    """Hold Ctrl-C back, which Python may raise half-way through an optimizer step; yield what raises it when called."""
    caught: list[int] = []

    def check() -> None:
        if caught:
            raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():  # others get no signals, and may not ask for them
        yield check
        return
    before = signal.signal(signal.SIGINT, lambda number, _frame: caught.append(number))
    try:
        yield check
    finally:
        signal.signal(signal.SIGINT, before)


def measure_scene(capture: Capture, points: np.ndarray) -> SceneScale:
    """Measure what one pixel covers at the seeds' median depth, and how near the seeds come to the training cameras."""
    footprints, nearest = [], math.inf
    cameras = [capture.cameras[name] for name in capture.camera_names("train")]
    for camera in cameras:
        uv, depth = camera.project(points)
        seen = (depth > 0) & (uv >= 0).all(axis=1) & (uv < (camera.width, camera.height)).all(axis=1)
        if seen.any():
            footprints.append(np.median(depth[seen]) / camera.fx)
            nearest = min(nearest, float(np.quantile(depth[seen], 0.001)))
    if not footprints:
        raise HoloreelError(
            f"{capture.source}: no training camera sees any of the capture's seed points; "
            "check that points and cameras share one world."
        )
    centers = torch.tensor(np.stack([camera.center for camera in cameras]), dtype=torch.float32)
    return SceneScale(float(np.median(footprints)), nearest, centers)


class Trainer:
    """One run: from the capture's seed points to trained Gaussians, resumable at any iteration."""

    def __init__(self, capture: Capture, config: TrainConfig, backend: ModuleType):
        self.capture, self.config, self.backend = capture, config, backend
        self.views = capture.views("train")
        if not self.views:
            raise HoloreelError(
                f"{capture.source}: no camera of the training split has a picture; hold fewer cameras out."
            )
        points = [capture.seed_points(frame) for frame in range(capture.frame_count)]
        if not sum(len(frame.xyz) for frame in points):
            raise HoloreelError(
                f"{capture.source}: the capture has no seed points (ply_file_path in transforms.json); "
                "synthesize it with --seed-points or add a point cloud."
            )
        self.scene = measure_scene(capture, np.concatenate([frame.xyz for frame in points]))
        self.times = torch.tensor(capture.times, dtype=torch.float32)
        self.background = torch.tensor(config.background)
        self.rng = torch.Generator().manual_seed(config.seed)
        seeds = gaussians_from_points(points, config, np.random.default_rng(config.seed))
        self.parameters = Parameters(seeds)
        self.stats = empty_stats(len(self.parameters))
        self.pictures = PictureCache(capture, config.background)
        self.queue: list[int] = []
        self.iteration = 0
        self.seconds = 0.0
        self.history: list[tuple[int, float, float, int]] = []
        first, last = config.density.start * config.iterations, config.density.stop * config.iterations
        self.densify_at = (
            {round(at) for at in np.linspace(first, last, config.density.events)} if config.density.events else set()
        )
        self.reset_at = {round(part * config.iterations) for part in config.density.reset_at}

    def run(self, on_progress: Callable[[Progress], None], until: int | None = None, every: int = 20) -> None:
        """Train up to iteration `until` (default: to the end), reporting every few iterations.

        Ctrl-C raises KeyboardInterrupt between two steps, so that `state` is whole.
        """
        until = self.config.iterations if until is None else min(until, self.config.iterations)
        with _single_threaded_torch(), _interrupts_between_steps() as check_interrupt:
            self._run(on_progress, check_interrupt, until, every)

    def _run(
        self, on_progress: Callable[[Progress], None], check_interrupt: Callable[[], None], until: int, every: int
    ) -> None:
        started = time.perf_counter() - self.seconds
        loss_mean = mse_mean = 0.0
        counted = 0
        while self.iteration < until:
            loss, mse = self.step()
            loss_mean, mse_mean, counted = loss_mean + loss, mse_mean + mse, counted + 1
            self.seconds = time.perf_counter() - started
            if self.iteration % every == 0 or self.iteration == until:
                psnr = -10 * math.log10(max(mse_mean / counted, 1e-10))
                left = self.seconds / self.iteration * (self.config.iterations - self.iteration)
                self.history.append((self.iteration, loss_mean / counted, psnr, len(self.parameters)))
                on_progress(
                    Progress(
                        self.iteration, self.config.iterations, loss_mean / counted, psnr, len(self.parameters), left
                    )
                )
                loss_mean = mse_mean = 0.0
                counted = 0
            check_interrupt()

    def step(self) -> tuple[float, float]:
        """Look at one picture and learn from it; return the loss and the mean squared error."""
        view = self._next_view()
        camera, target = self.capture.cameras[view[0]], self.pictures.get(view)
        rendering = self.backend.rasterize_spacetime(
            self.parameters.spacetime, self.capture.time(view[1]), camera, self.background, density=self.stats
        )
        loss = self.backend.l1_dssim(rendering.features, target, self.config.dssim_weight)
        loss.backward()
        self.parameters.step(self._rates(), self.backend)
        if self.config.clamp_colors:
            with torch.no_grad():
                self.parameters.tensors["features"].clamp_(0.0, 1.0)
        self.iteration += 1
        mse = float((rendering.features.detach() - target).square().mean())
        self._control_density(camera.width)
        return float(loss.detach()), mse

    def _next_view(self) -> View:
        """Draw pictures in a random order, each once before any comes again."""
        if not self.queue:
            self.queue = torch.randperm(len(self.views), generator=self.rng).tolist()
        return self.views[self.queue.pop()]

    def _rates(self) -> Mapping[str, float]:
        """Return the learning rate of each tensor at this iteration."""
        rates, done = self.config.rates, self.iteration / self.config.iterations
        decay = rates.final_factor**done
        means = rates.means * (rates.means_final / rates.means) ** done
        return {
            "means": means * self.scene.footprint,
            "motions": rates.motions * self.scene.footprint * decay,
            "quats": rates.quats * decay,
            "omegas": rates.omegas * decay,
            "log_scales": rates.scales * decay,
            "opacity_logits": rates.opacities * decay,
            "features": rates.features * decay,
            "trbf_centers": rates.trbf_centers * decay,
            "trbf_log_scales": rates.trbf_scales * decay,
        }

    def _control_density(self, width: int) -> None:
        config = self.config.density
        if self.iteration in self.densify_at:
            densify(self.parameters, self.stats, config, self.scene, width, self.rng)
            self.stats = empty_stats(len(self.parameters))
        if self.iteration % config.prune_every == 0 or self.iteration == self.config.iterations:
            keep = prune(self.parameters, self.times, config, self.scene)
            for name in ("gradient", "views", "radius_px"):
                setattr(self.stats, name, getattr(self.stats, name)[keep])
            if not len(self.parameters):
                raise HoloreelError(
                    f"{self.capture.source}: every Gaussian was pruned at iteration {self.iteration}; "
                    "check the cameras, or lower --density.prune-opacity."
                )
        if self.iteration in self.reset_at:
            reset_opacities(self.parameters, config.reset_opacity)

    def gaussians(self) -> SpacetimeGaussians:
        """Copy the trained Gaussians out."""
        return self.parameters.to_gaussians()

    def state(self) -> dict[str, object]:
        """Everything needed to go on from here bit for bit."""
        return {
            "config": asdict(self.config),
            "parameters": self.parameters.state(),
            "stats": {"gradient": self.stats.gradient, "views": self.stats.views, "radius_px": self.stats.radius_px},
            "rng": self.rng.get_state(),
            "queue": list(self.queue),
            "iteration": self.iteration,
            "seconds": self.seconds,
            "history": [list(row) for row in self.history],
        }

    def load_state(self, state: Mapping) -> None:
        """Go on where `state` was taken."""
        self.parameters = Parameters.from_state(state["parameters"])
        self.stats = empty_stats(0)
        for name, value in state["stats"].items():
            setattr(self.stats, name, value.clone())
        self.rng.set_state(state["rng"])
        self.queue = list(state["queue"])
        self.iteration, self.seconds = int(state["iteration"]), float(state["seconds"])
        self.history = [(int(i), float(a), float(b), int(n)) for i, a, b, n in state["history"]]
