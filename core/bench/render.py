# SPDX-License-Identifier: GPL-3.0-or-later
"""Measure how fast a reel is drawn, with temporal culling and as the authors do it: every Gaussian in every frame."""

import statistics
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from ..camera import Camera, read_camera
from ..capture import read_capture
from ..draw import Drawing
from ..errors import HoloreelError
from ..gaussians.decoder import Activation
from ..gaussians.player import GaussianPlayer
from ..render import Backend

PASSES, DROPPED = 4, 11  # the authors': passes over all frames, and how many at the start of each do not count


class Method(NamedTuple):
    """A way of drawing."""

    listed: bool  # what is alive is known beforehand, as the player has it; else the kernels find out
    cull_faded: bool  # else what has faded out is drawn too


LISTED, NOT_CULLED = "listed", "not culled"
METHODS = {LISTED: Method(True, True), "culled": Method(False, True), NOT_CULLED: Method(False, False)}


@dataclass
class Speed:
    """One way of drawing: frames per second by our protocol and by the authors'."""

    fps: float
    """1 / median over all frames of all passes, when each had been drawn before"""
    authors_fps: float
    """1 / mean over the frames that count: in each of 4 passes all but the first 11"""


@dataclass
class Result:
    """What was measured; every frame was the same picture all ways, to the last bit."""

    width: int
    height: int
    frames: int
    speeds: dict[str, Speed]

    @property
    def gain(self) -> float:
        """How many times faster the frames are drawn as the player does than without culling."""
        return self.speeds[LISTED].fps / self.speeds[NOT_CULLED].fps

    def as_dict(self) -> dict[str, object]:
        """Return the figures for JSON."""
        return asdict(self) | {"gain": self.gain}


def measure(
    path: Path,
    view: Path | Camera,
    size: tuple[int, int] | None = None,
    backend: Backend = "auto",
    decoder_output: Activation | None = None,
) -> Result:
    """Measure a file as `measure_player` does: `view`, or its CAMERA.json, or a capture's first camera looks.

    `decoder_output` is as in `core.reel.load_gaussians`.
    """
    camera = view if isinstance(view, Camera) else view_camera(view)
    return measure_player(GaussianPlayer(path, backend, decoder_output), camera.scaled(*size) if size else camera)


def measure_player(player: GaussianPlayer, camera: Camera) -> Result:
    """Draw all frames of a file as a camera sees them.

    The ways take turns, pass by pass, so that a busy machine is busy for all. Raises `HoloreelError` where a frame is
    not the same in all of them.
    """
    frames = [float(player.frame_start + index) for index in range(player.frame_count)]
    for frame in frames:  # also reads every segment and warms everything up
        wanted = _draw(player, camera, frame, METHODS[NOT_CULLED])
        if not all(_same(_draw(player, camera, frame, method), wanted) for method in METHODS.values()):
            raise HoloreelError(
                f"{player.path}: frame {frame:g} is another picture without culling; report this as a bug."
            )
    seconds: dict[str, list[list[float]]] = {name: [] for name in METHODS}
    for _ in range(PASSES):
        for name, method in METHODS.items():
            seconds[name].append([_time(player, camera, frame, method) for frame in frames])
    speeds = {name: _speed(passes) for name, passes in seconds.items()}
    return Result(camera.width, camera.height, len(frames), speeds)


def _speed(passes: list[list[float]]) -> Speed:
    dropped = DROPPED if len(passes[0]) > DROPPED else 0
    counted = [seconds for one in passes for seconds in one[dropped:]]
    middle = statistics.median(seconds for one in passes for seconds in one)
    return Speed(1.0 / middle, 1.0 / statistics.mean(counted))


def _draw(player: GaussianPlayer, camera: Camera, frame: float, method: Method) -> Drawing:
    rules = replace(player.rules, cull_faded=method.cull_faded)
    return player.draw(camera, frame, rules=rules, listed=method.listed)


def _time(player: GaussianPlayer, camera: Camera, frame: float, method: Method) -> float:
    start = time.perf_counter()
    _draw(player, camera, frame, method)
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter() - start


def _same(one: Drawing, other: Drawing) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


def view_camera(view: Path) -> Camera:
    """Return the camera of a CAMERA.json, or a capture's first one that is held out."""
    if view.is_file() and view.suffix == ".json" and view.name != "transforms.json":
        return read_camera(view)
    capture = read_capture(view)
    names = capture.camera_names("test") or list(capture.cameras)
    return capture.cameras[names[0]]


def report(result: Result) -> str:
    """Return the lines that are printed."""
    lines = [f"{result.frames} frames at {result.width}x{result.height}; the same pictures all ways"]
    for name, speed in result.speeds.items():
        lines.append(
            f"{name:>10}: {speed.fps:7.1f} frames per second ({speed.authors_fps:.1f} by the authors' protocol)"
        )
    lines.append(f"temporal culling is {result.gain:.2f} times faster: {LISTED} against {NOT_CULLED}")
    return "\n".join(lines)
