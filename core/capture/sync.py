# SPDX-License-Identifier: GPL-3.0-or-later
"""Matching the frames of several cameras to one clock, from the moment each frame was taken."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import HoloreelError
from .capture import MAX_FRAMES
from .tables import read_table

FILE_NAME = "timestamps.csv"
COLUMNS = ("cam_id", "frame_time")
_MAX_BYTES = 1 << 30
_MAX_TIME_S = 1e12


@dataclass(frozen=True)
class Synchronization:
    """Which frame of each video is nearest to each tick of a common, even clock."""

    interval_s: float
    frames: dict[str, NDArray[np.int64]]  # by camera, (ticks,): index of the frame in its video
    offsets_s: dict[str, NDArray[np.float64]]  # by camera, (ticks,): the frame's moment minus the tick's

    @property
    def ticks(self) -> int:
        """How many frames the common clock has."""
        return len(next(iter(self.frames.values())))

    @property
    def note(self) -> str:
        """What was measured, in a sentence."""
        parts = [
            f"{name} {1e3 * float(np.mean(offset)):+.1f} (at most {1e3 * float(np.abs(offset).max()):.1f})"
            for name, offset in self.offsets_s.items()
        ]
        return (
            f"{self.ticks} frames on a common clock of {1e3 * self.interval_s:.2f} ms; mean offsets in ms: "
            f"{', '.join(parts)}."
        )

    def check(self, source: Path, tolerance: float) -> None:
        """Raise `HoloreelError` where a frame is more than `tolerance` intervals from its tick."""
        worst = {name: float(np.abs(offset).max()) / self.interval_s for name, offset in self.offsets_s.items()}
        name = max(worst, key=lambda key: worst[key])
        if worst[name] > tolerance:
            offset = self.offsets_s[name]
            tick = int(np.abs(offset).argmax())
            raise HoloreelError(
                f"{source}: at frame {tick} camera {name} is {1e3 * offset[tick]:+.1f} ms from the common clock, "
                f"{worst[name]:.2f} of a frame interval (allowed: {tolerance:g}); synchronize the recording, or accept "
                f"it by --sync-tolerance {math.ceil(worst[name] * 100) / 100:g}."
            )


def synchronize(source: Path, times: Mapping[str, NDArray[np.float64]]) -> Synchronization:
    """Fit an even clock to the moments (in seconds, increasing) at which each camera took its frames.

    Each camera's frames are numbered by whole intervals (so that a dropped frame leaves a gap), one interval length is
    fitted to all of them, and the clock's phase is the middle one of the cameras'. Ticks span what all cameras saw.
    """
    usual = float(np.median(np.concatenate([np.diff(moments) for moments in times.values()])))
    counts = {name: np.concatenate([[0], np.cumsum(np.rint(np.diff(t) / usual))]) for name, t in times.items()}
    covariance = sum(float(((n - n.mean()) * (times[name] - times[name].mean())).sum()) for name, n in counts.items())
    variance = sum(float(((n - n.mean()) ** 2).sum()) for n in counts.values())
    interval = covariance / variance if variance > 0 and covariance > 0 else usual
    starts = np.array([float(np.mean(times[name] - interval * n)) for name, n in counts.items()])
    phases = (starts - starts[0] + interval / 2) % interval - interval / 2  # about the first camera's
    phase = starts[0] + float(np.median(phases))
    latest, soonest = max(times, key=lambda name: times[name][0]), min(times, key=lambda name: times[name][-1])
    first = math.ceil((float(times[latest][0]) - phase) / interval - 0.5)
    last = math.floor((float(times[soonest][-1]) - phase) / interval + 0.5)
    if not first <= last < first + MAX_FRAMES:
        late = float(times[latest][0] - times[soonest][-1])
        raise HoloreelError(
            f"{source}: camera {latest} starts {late:.3f} s after camera {soonest} ends; give videos of one event."
            if late > 0
            else f"{source}: {last - first} frames are more than {MAX_FRAMES}; cut the recording."
        )
    ticks = phase + interval * np.arange(first, last + 1)
    frames = {name: _nearest(moments, ticks) for name, moments in times.items()}
    return Synchronization(interval, frames, {name: times[name][index] - ticks for name, index in frames.items()})


def _nearest(moments: NDArray[np.float64], ticks: NDArray[np.float64]) -> NDArray[np.int64]:
    after = np.clip(np.searchsorted(moments, ticks), 1, len(moments) - 1)
    return after - (ticks - moments[after - 1] < moments[after] - ticks)


def read_timestamps(file: Path) -> dict[str, NDArray[np.float64]]:
    """Read the columns cam_id and frame_time (seconds) of a CSV: by camera, the moments of its frames in order."""
    table = read_table(file, COLUMNS, _MAX_BYTES)
    times: dict[str, list[float]] = {}
    for number, row in enumerate(table, start=2):
        try:
            moment = float(row["frame_time"])
            if not abs(moment) < _MAX_TIME_S:
                raise ValueError("not a time in seconds")
        except ValueError as error:
            raise HoloreelError(
                f"{file}: line {number}: frame_time {row['frame_time']!r} is no number of seconds."
            ) from error
        times.setdefault(row["cam_id"], []).append(moment)
    for name, moments in times.items():
        if len(moments) < 2 or not (np.diff(moments) > 0).all():
            raise HoloreelError(f"{file}: frame_time of camera {name} must increase over two or more frames.")
    if not times:
        raise HoloreelError(f"{file} has no rows; take it away, or write it again.")
    return {name: np.array(moments) for name, moments in times.items()}
