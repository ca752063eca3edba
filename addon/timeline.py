# SPDX-License-Identifier: GPL-3.0-or-later
"""How scene frames become a reel's time. The node group "Holoreel Time" computes the same from Blender's Scene Time."""

from dataclasses import dataclass

import numpy as np

HOLD, LOOP, PING_PONG = "Hold", "Loop", "Ping-Pong"
REPEATS = {
    HOLD: "Show the first frame before the start and the last frame after the end",
    LOOP: "Start over after the last frame",
    PING_PONG: "Play forward, then backward, and so on",
}

FRAME_ROUNDING = 1e-3  # of a frame: what float32 leaves of a whole frame that was scaled is one


@dataclass(frozen=True)
class Timeline:
    """The mapping of a reel with `frame_count` frames, of which `first` to `last` (inclusive, from 0) are played.

    At scene frame f (sub-frames count), u = (f − start) · speed + offset reel frames have passed since `first`; or, if
    `retime` is set, u = at − first, whatever f is: `at` is the reel frame, to be keyed or driven. With
    L = last − first + 1:

        Hold       v = min(max(u, 0), L − 1)
        Loop       v = u mod L
        Ping-Pong  v = m if m ≤ L − 1 else 2 (L − 1) − m,   m = u mod 2 (L − 1)

    The reel shows its frame min(first + v, frame_count), that is its normalized time t = frame / frame_count.
    """

    frame_count: int
    start: float = 1.0
    speed: float = 1.0
    offset: float = 0.0
    first: int = 0
    last: int | None = None  # None: the reel's last frame
    repeat: str = HOLD
    retime: bool = False
    at: float = 0.0

    @property
    def last_frame(self) -> int:
        """The last reel frame that is played."""
        return self.frame_count - 1 if self.last is None else self.last

    def reel_frame(self, frame: float) -> np.float32:
        """Return the reel frame shown at a scene frame, rounded step by step as the nodes do (float32)."""
        number = np.float32
        steps = number(max(self.last_frame - self.first, 0))
        if self.retime:
            passed = number(self.at) - number(self.first)
        else:
            passed = (number(frame) - number(self.start)) * number(self.speed) + number(self.offset)
        if self.repeat == HOLD:
            shown = min(max(passed, number(0)), steps)
        elif self.repeat == LOOP:
            shown = _modulo(passed, steps + number(1))
        else:
            there_and_back = _modulo(passed, number(2) * steps)
            shown = min(there_and_back, number(2) * steps - there_and_back)
        return min(number(self.first) + shown, number(self.frame_count))

    def whole_frame(self, frame: float) -> int:
        """Return the frame of a VideoRF shown at a scene frame: it has no sub-frames, the earlier of two is shown."""
        shown = np.floor(self.reel_frame(frame) + np.float32(FRAME_ROUNDING))
        return min(max(int(shown), 0), self.frame_count - 1)

    def time(self, frame: float) -> np.float32:
        """Return the reel's normalized time at a scene frame."""
        return self.reel_frame(frame) / np.float32(self.frame_count)


def _modulo(value: np.float32, period: np.float32) -> np.float32:
    """Return value − period · floor(value / period), and 0 where the period is 0."""
    if period == 0:
        return np.float32(0)
    return value - np.floor(value / period) * period
