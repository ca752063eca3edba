# SPDX-License-Identifier: GPL-3.0-or-later
"""The coarse fields of many frames: they do not know of each other, so many cores can train several at once."""

import signal
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path

from ..capture import Capture
from .coarse import Coarse, CoarseConfig, read_coarse, train_coarse
from .native import get_threads, set_threads
from .occupancy import Lattice
from .views import BORDER, FrameViews

Listener = Callable[[int, int, float], None]


@dataclass(frozen=True)
class CoarseJob:
    """Which coarse fields to train, and the folder to write them to.

    `seed` is that of frame 0; every frame has its own. `split` and `border` choose rays as `FrameViews` does.
    """

    capture: Capture
    lattice: Lattice
    folder: Path
    config: CoarseConfig = field(default_factory=CoarseConfig)
    seed: int = 0
    split: str | None = "train"
    border: int = BORDER

    def path(self, frame: int) -> Path:
        """The file of a frame's coarse field."""
        return self.folder / f"coarse_{frame:06d}.npz"

    def read(self, frame: int) -> Coarse:
        """Read the coarse field of a frame."""
        return read_coarse(self.path(frame))

    def train(self, frame: int, on_progress: Callable[[int, float], None] | None = None) -> None:
        """Train the coarse field of a frame and write it."""
        views = FrameViews(self.capture, frame, self.split, self.border)
        train_coarse(views, self.lattice, self.config, self.seed + frame, on_progress).write(self.path(frame))


def train_coarse_frames(
    job: CoarseJob, frames: Iterable[int], workers: int = 1, on_progress: Listener | None = None
) -> None:
    """Train the coarse fields of `frames` that have no file yet; the same bits for any number of `workers`.

    `on_progress` hears of a frame's steps and the PSNR of a batch, and of its last step alone where there are several
    workers, each a process of its own with its part of the cores.
    """
    missing = [frame for frame in frames if not job.path(frame).is_file()]
    if workers <= 1 or len(missing) <= 1:
        for frame in missing:
            job.train(frame, _of_frame(frame, on_progress))
        return
    workers = min(workers, len(missing))
    threads = max(1, get_threads() // workers)
    # Fresh processes: a fork would share torch's and the kernels' threads, which do not survive it.
    pool = ProcessPoolExecutor(workers, get_context("spawn"), _start_worker, (threads,))
    try:
        for done in as_completed([pool.submit(_last_step, job, frame) for frame in missing]):
            if on_progress:
                on_progress(*done.result())
            else:
                done.result()
    finally:
        pool.shutdown(cancel_futures=True)


def _of_frame(frame: int, on_progress: Listener | None) -> Callable[[int, float], None] | None:
    return None if on_progress is None else lambda iteration, psnr: on_progress(frame, iteration, psnr)


def _start_worker(threads: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent hears of Ctrl-C and ends the pool
    set_threads(threads)


def _last_step(job: CoarseJob, frame: int) -> tuple[int, int, float]:
    """Train a frame in a worker; return what its last report said."""
    last = (frame, 0, 0.0)

    def listen(iteration: int, psnr: float) -> None:
        nonlocal last
        last = (frame, iteration, psnr)

    job.train(frame, listen)
    return last
