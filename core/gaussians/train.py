# SPDX-License-Identifier: GPL-3.0-or-later
"""Training of Spacetime Gaussians from a capture (Spacetime Gaussians, Sec. 4)."""

import math
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from types import ModuleType

import numpy as np
import torch
from torch import Tensor

from ..camera import Camera
from ..capture import Capture, View
from ..capture.stream import PictureStream
from ..errors import HoloreelError
from ..render.contract import Rendering, Rules
from ..render.view import DecoderTensors, render_view
from ..runs import one_torch_thread, preview_camera
from ..status import Preview
from .config import TrainConfig
from .decoder import SHAPES, Decoder
from .density import SETTINGS, DensityControl
from .guided import (
    Patches,
    Stability,
    depth_range,
    measure_patches,
    new_gaussians,
    sample_rays,
    with_seeds,
    worst_patches,
)
from .mcmc import McmcControl
from .model import SpacetimeGaussians
from .parameters import Parameters, Rate
from .scale import measure_scene
from .seeds import as_trained, gaussians_from_points

GUIDED_VIEWS = 24  # pictures that guided sampling looks at, or as many as there are cameras
STABLE_PART = 0.02  # of a run over which the loss is averaged to see whether it is stable
FEWEST_PART = 0.01  # of the largest number of Gaussians: with fewer, a scene has been pruned to nothing
SEED_PIXELS = (0.3, 60.0)  # smallest and largest standard deviation of a seed


@dataclass(frozen=True)
class Progress:
    """What a run has to say every few iterations; `preview` draws what it has learned, if it is called at once."""

    iteration: int
    iterations: int
    loss: float
    psnr: float
    gaussians: int
    seconds_left: float
    preview: Preview | None = field(default=None, compare=False, repr=False)


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


def valid_pixels(camera: Camera) -> Tensor | None:
    """Return which pixels of a distorted lens can be rendered, (H, W) bool; None where all of them can."""
    if camera.model == "PINHOLE":
        return None
    from ..render.warp import lens_warp

    return torch.as_tensor(lens_warp(camera).valid)


class Trainer:
    """One run: from a capture's seed points, or given Gaussians, to trained ones; resumable at any iteration.

    `seeds` are lite or full Gaussians to begin with instead of those made of the capture's points; for full ones,
    `decoder` may be the network they were trained with. The first `inherited` of them have been trained before, and
    learn at the pace `config.inherited_pace`.
    Raises `HoloreelError` where there is nothing to learn from or to begin with.
    """

    def __init__(
        self,
        capture: Capture,
        config: TrainConfig,
        backend: ModuleType,
        seeds: SpacetimeGaussians | None = None,
        decoder: Decoder | None = None,
        inherited: int = 0,
    ):
        self.capture, self.config, self.backend = capture, config, backend
        self.views = capture.views("train")
        if not self.views:
            raise HoloreelError(
                f"{capture.source}: no camera of the training split has a picture; hold fewer cameras out."
            )
        points = [capture.seed_points(frame) for frame in range(capture.frame_count)]
        xyz = np.concatenate([frame.xyz for frame in points]) if seeds is None else seeds.means
        if not len(xyz):
            raise HoloreelError(
                f"{capture.source}: the capture has no seed points; make them of its pictures with `holoreel sfm`, or "
                "synthesize it with --seed-points."
            )
        self.device: str = backend.DEVICE
        self.scene = measure_scene(capture, xyz).to(self.device)
        self.measure = self.scene.footprints if config.unit == "footprint" else self.scene.extents
        # Ray origins are the network's one input in world units; this makes them comparable with the others.
        self._origin_scale = 1.0 / max(float(self.scene.centers.norm(dim=1).max()), self.scene.nearest * 1e-3)
        self.times = torch.tensor(capture.times, dtype=torch.float32, device=self.device)
        self.background = torch.tensor(config.background, device=self.device)
        # What is too near to a camera to stay must not be too near to be seen.
        near = 0.5 * config.density.prune_depth * self.scene.nearest or Rules.near
        self.rules = Rules(near=min(Rules.near, near), detach_motion_time=config.detach_time)
        self.rng = torch.Generator().manual_seed(config.seed)
        if seeds is None:
            seeds = self._fitted(gaussians_from_points(points, config, np.random.default_rng(config.seed)))
        self.parameters = Parameters(as_trained(seeds, config), self._network(decoder), self.measure, self.device)
        self.inherited = inherited
        self.seed_means = seeds.means.copy()  # the parameters may learn in the very same memory
        self.parameters.paces[:inherited] = config.inherited_pace
        self.pictures = PictureStream(capture, self.views, config.background, config.seed, config.picture_memory)
        control = DensityControl if config.strategy == "density" else McmcControl
        self.control: DensityControl | McmcControl = control(config, self.scene, self.times)
        self.iteration = 0
        self.seconds = 0.0
        self.history: list[tuple[int, float, float, int]] = []
        self.most = len(self.parameters)
        self.lost: Counter[str] = Counter()
        self.stability = Stability(round(STABLE_PART * config.planned), config.guided.stable)
        self.guided_at: list[int] = []

    def _fitted(self, seeds: SpacetimeGaussians) -> SpacetimeGaussians:
        """Keep seeds from being specks or fog where neighbors are no measure of their size."""
        footprints = self.scene.footprints(torch.from_numpy(seeds.means).to(self.device)).cpu().numpy()[:, None]
        low, high = (np.log(pixels * footprints) for pixels in SEED_PIXELS)
        seeds.log_scales = np.clip(seeds.log_scales, low, high).astype(np.float32)
        return seeds

    def _network(self, decoder: Decoder | None) -> dict[str, Tensor]:
        """Return the first weights of a full model's network: what a new one adds to the base color is zero."""
        if self.config.model == "lite":
            return {}
        if decoder is not None:
            return {name: torch.from_numpy(getattr(decoder, name)) for name in SHAPES}
        bound = 1.0 / math.sqrt(SHAPES["hidden"][1])
        hidden = (2.0 * torch.rand(SHAPES["hidden"], generator=self.rng) - 1.0) * bound
        hidden[:, 6:9] *= self._origin_scale
        return {"hidden": hidden, "output": torch.zeros(SHAPES["output"])}

    def run(self, on_progress: Callable[[Progress], None], until: int | None = None, every: int = 20) -> None:
        """Train up to iteration `until` (default: to the end), reporting every few iterations.

        Ctrl-C raises KeyboardInterrupt between two steps, so that `state` is whole.
        """
        until = self.config.iterations if until is None else min(until, self.config.iterations)
        with one_torch_thread(), _interrupts_between_steps() as check_interrupt:
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
                        self.iteration,
                        self.config.iterations,
                        loss_mean / counted,
                        psnr,
                        len(self.parameters),
                        left,
                        self.preview,
                    )
                )
                loss_mean = mse_mean = 0.0
                counted = 0
            check_interrupt()

    def step(self) -> tuple[float, float]:
        """Look at one picture (a batch of them) and learn from it; return the loss and the mean squared error."""
        loss = mse = 0.0
        width = 0
        for _ in range(self.config.batch):
            view, picture = self.pictures.next()
            one_loss, one_mse = self._learn(view, picture)
            loss, mse = loss + one_loss / self.config.batch, mse + one_mse / self.config.batch
            width = max(width, self.capture.cameras[view[0]].width)
        self.control.before_step(self.parameters)
        self.parameters.step(self._rates(), self.backend)
        self.iteration += 1
        with torch.no_grad():
            self._control_number(loss, 0.5 * width * self.config.batch)
        return loss, mse

    def _learn(self, view: View, picture: np.ndarray) -> tuple[float, float]:
        """Render one view, compare it, and add to the gradients."""
        camera = self.capture.cameras[view[0]]
        target = torch.from_numpy(picture)
        rendering = self.render(camera, self.capture.time(view[1]), training=True)
        colors, valid = rendering.features, valid_pixels(camera)
        if valid is not None:  # equal outside, so that nothing is learned there
            colors, target = colors * valid[..., None].to(colors.device), target * valid[..., None]
        loss, squared_error = self.backend.picture_loss(colors, target, self.config.dssim_weight)
        value = float(loss.detach())
        if not math.isfinite(value):
            raise HoloreelError(
                f"{self.capture.source}: the loss is not finite at iteration {self.iteration + 1} (camera "
                f"{view[0]!r}, frame {view[1]}); lower the learning rates, --rates.means and --rates.scales first."
            )
        (loss if self.config.batch == 1 else loss / self.config.batch).backward()
        if valid is not None:
            squared_error /= max(float(valid.to(torch.float32).mean()), 1e-6)
        return value, squared_error

    def render(self, camera: Camera, time: float, training: bool = False) -> Rendering:
        """Render what has been learned as a camera sees it at a normalized time: colors (H, W, 3), alpha, depth."""
        network = self.parameters.network
        decoder = DecoderTensors(**network, activation=self.config.decoder_output) if network else None
        return render_view(
            self.backend,
            self.parameters.spacetime,
            time,
            camera,
            self.background,
            decoder,
            self.rules,
            self.parameters.stats if training else None,
        )

    @torch.no_grad()
    def preview(self) -> np.ndarray:
        """Draw the middle frame of what has been learned, small, (H, W, 3)."""
        middle = self.capture.time(self.capture.frame_count // 2)
        return self.render(preview_camera(self.capture), middle).features.cpu().numpy()

    def _pace(self) -> float:
        """Return what is left of the positions' learning rate."""
        rates = self.config.rates
        return (rates.means_final / rates.means) ** (self.iteration / self.config.planned)

    def _rates(self) -> dict[str, Rate]:
        """Return the learning rate of each tensor at this iteration."""
        config, rates = self.config, self.config.rates
        paces = self.parameters.paces if self.inherited else None
        units = self.parameters.units if paces is None else self.parameters.units * paces
        decay = rates.final_factor ** (self.iteration / config.planned)
        orders = (torch.arange(9, device=self.device) // 3 < config.motion).to(torch.float32)
        if config.model == "lite":
            colors = Rate(rates.features * decay, paces, None, *((0.0, 1.0) if config.clamp_colors else ()))
        else:
            columns = [rates.features] * 6 + [rates.features_time] * 3
            colors = Rate(decay, paces, torch.tensor(columns, device=self.device))
        inputs = torch.ones(SHAPES["hidden"][1], device=self.device)
        inputs[6:9] = self._origin_scale
        temporal = decay if config.temporal_opacity else 0.0
        return {
            "means": Rate(rates.means * self._pace(), units),
            "motions": Rate(rates.motions * decay if config.motion else 0.0, units, orders),
            "quats": Rate(rates.quats * decay, paces),
            "omegas": Rate(rates.omegas * decay if config.rotation else 0.0, paces),
            "log_scales": Rate(rates.scales * decay, paces),
            "opacity_logits": Rate(rates.opacities * decay, paces),
            "features": colors,
            "trbf_centers": Rate(rates.trbf_centers * temporal, paces),
            "trbf_log_scales": Rate(rates.trbf_scales * temporal, paces),
            "hidden": Rate(rates.decoder * decay, None, inputs),
            "output": Rate(rates.decoder * decay),
        }

    def _control_number(self, loss: float, pixels: float) -> None:
        """Add and delete Gaussians where it is time to."""
        lost = self.control.after_step(self.parameters, self.iteration, pixels, self._pace(), self.rng)
        self.lost.update(lost)
        guided, done = self.config.guided, self.iteration / self.config.planned
        if self.stability.add(loss) and len(self.guided_at) < guided.times and guided.start <= done <= guided.stop:
            self._sample_guided()
        count = len(self.parameters)
        self.most = max(self.most, count)
        if count <= FEWEST_PART * self.most:
            reasons = ", ".join(f"{number} {cause}" for cause, number in self.lost.most_common() if number)
            setting = SETTINGS[self.lost.most_common(1)[0][0]]
            raise HoloreelError(
                f"{self.capture.source}: {count} Gaussians are left at iteration {self.iteration}, of {self.most} at "
                f"most (deleted: {reasons}); {setting}, or check the cameras and the seed points."
            )

    def _sample_guided(self) -> None:
        """Add Gaussians along rays through the worst patches (Sec. 4.4)."""
        config = self.config.guided
        self.guided_at.append(self.iteration)
        self.stability.reset()
        count = min(len(self.views), max(GUIDED_VIEWS, len(self.scene.centers)))
        views = [self.views[index] for index in torch.randperm(len(self.views), generator=self.rng)[:count].tolist()]
        looked = [self._measure_view(view) for view in views]
        chosen = worst_patches([patches for patches, *_ in looked], config.share, config.contrast)
        random = np.random.default_rng([self.config.seed, self.iteration])
        room = self.config.density.max_gaussians - len(self.parameters)
        for view, patches, (_, depth, alpha) in zip(views, chosen, looked, strict=True):
            patches = patches.take(np.arange(min(len(patches.errors), max(room, 0) // config.samples)))
            reach = depth_range(depth, alpha, config.near, config.far)
            if reach is None or not len(patches.errors):
                continue
            camera = self.capture.cameras[view[0]]
            points, sizes = sample_rays(camera, patches, config.patch, reach, config, random)
            colors = np.repeat(patches.colors, config.samples, axis=0)
            fresh = new_gaussians(
                points, sizes, colors, self.capture.time(view[1]), self.config.static_width, config.opacity
            )
            fresh = as_trained(fresh.without_bad_rows(), self.config)
            self.parameters.append({name: torch.from_numpy(getattr(fresh, name)) for name in self.parameters.tensors})
            room -= len(fresh)

    def _measure_view(self, view: View) -> tuple[Patches, np.ndarray, np.ndarray]:
        """Return a view's patches with their errors, its coarse depth map, and its alpha."""
        camera = self.capture.cameras[view[0]]
        truth = self.capture.image(*view, background=self.config.background).astype(np.float32) / 255.0
        rendering = self.render(camera, self.capture.time(view[1]))
        valid = valid_pixels(camera)
        size, sparse = self.config.guided.patch, self.config.guided.sparse
        patches = measure_patches(
            rendering.features.cpu().numpy(), truth, size, None if valid is None else valid.numpy()
        )
        patches = with_seeds(patches, size, camera, self.seed_means, sparse)
        return patches, rendering.depth.cpu().numpy(), rendering.alpha.cpu().numpy()

    def gaussians(self) -> SpacetimeGaussians:
        """Copy the trained Gaussians out."""
        return self.parameters.to_gaussians()

    def decoder(self) -> Decoder | None:
        """Copy a full model's network out; None for a lite one."""
        if not self.parameters.network:
            return None
        weights = {name: value.detach().cpu().numpy().copy() for name, value in self.parameters.network.items()}
        return Decoder(**weights, activation=self.config.decoder_output)

    def state(self) -> dict[str, object]:
        """Everything needed to go on from here bit for bit."""
        return {
            "config": asdict(self.config),
            "parameters": self.parameters.state(),
            "rng": self.rng.get_state(),
            "pictures": self.pictures.state(),
            "iteration": self.iteration,
            "seconds": self.seconds,
            "history": [list(row) for row in self.history],
            "most": self.most,
            "lost": dict(self.lost),
            "stability": self.stability.state(),
            "guided_at": list(self.guided_at),
        }

    def load_state(self, state: Mapping) -> None:
        """Go on where `state` was taken."""
        self.parameters = Parameters.from_state(state["parameters"], self.measure, self.device)
        self.rng.set_state(state["rng"])
        self.pictures.load_state(state["pictures"])
        self.iteration, self.seconds = int(state["iteration"]), float(state["seconds"])
        self.history = [(int(i), float(a), float(b), int(n)) for i, a, b, n in state["history"]]
        self.most, self.lost = int(state["most"]), Counter(state["lost"])
        self.stability.load_state(state["stability"])
        self.guided_at = [int(at) for at in state["guided_at"]]
