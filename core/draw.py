# SPDX-License-Identifier: GPL-3.0-or-later
"""From a file to a picture in numpy: what every kind of player gives, and the player that a file needs."""

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .camera import Camera
from .capture import Capture
from .errors import HoloreelError
from .gaussians.decoder import Activation
from .reel import VIDEORF, Triple, reel_kind
from .render import Backend
from .videorf.model import is_model

Quality = Literal["full", "fast", "draft"]  # of a VideoRF's drawings: how long the steps of a march are


class Drawing(NamedTuple):
    """One picture: display-referred `image` (H, W, 3) over the background, `alpha` (H, W), `depth` (H, W).

    `depth` is the alpha-weighted mean of camera-space z, 0 where nothing is.
    """

    image: NDArray[np.float32]
    alpha: NDArray[np.float32]
    depth: NDArray[np.float32]


class Player(ABC):
    """Draws the frames of one file, with little of it in memory at a time.

    Frames are those of the timeline: `frame_start` to `frame_start + frame_count - 1`. `backend_name` says what draws,
    `report` in sentences what was assumed and what is unusual.
    """

    path: Path
    backend_name: str
    report: list[str]
    frame_start: int
    frame_count: int
    background: Triple  # what pictures lie over unless another color is asked for
    takes_background: bool = True  # whether another color may be asked for
    numbered: bool = True  # whether the file knows its frames' numbers
    subject_alone: ClassVar[bool] = False  # whether it shows a subject cut out of its surroundings

    def frame_at(self, time: float) -> float:
        """Return the frame at a normalized time of the whole file: 0 is the first one, 1 is just after the last."""
        return self.frame_start + time * self.frame_count

    def frames_of(self, capture: Capture) -> list[float]:
        """Return the frame to draw for each frame of a capture.

        A reel is matched by frame number; a bare file, which knows no numbers, by normalized time. Raises
        `HoloreelError` where the reel does not cover the capture: it was made from another one.
        """
        if not self.numbered:
            return [self.frame_at(time) for time in capture.times]
        first, last = self.frame_start, self.frame_start + self.frame_count - 1
        start, end = capture.frame_start, capture.frame_start + capture.frame_count - 1
        if start < first or end > last:
            raise HoloreelError(
                f"{self.path} holds frames {first} to {last}, {capture.source} frames {start} to {end}: "
                "give the capture that the reel was trained on."
            )
        return [float(frame) for frame in range(start, end + 1)]

    def missing(self) -> list[int]:
        """Return the frames of the timeline that cannot be drawn, because a file was cut off."""
        return []

    @abstractmethod
    def draw(self, camera: Camera, frame: float, background: Triple | None = None) -> Drawing:
        """Draw one frame through any lens, over the file's own background unless another is given."""

    @abstractmethod
    def reach(self, camera: Camera) -> NDArray[np.bool_] | None:
        """Return the pixels (H, W) that a drawing of this camera can reach; None where it reaches all."""

    @abstractmethod
    def size(self) -> int:
        """Return the bytes on disk of everything that is needed to play the file."""

    @abstractmethod
    def facts(self) -> dict[str, Any]:
        """Return what `metrics.json` says of the model."""


def open_player(
    path: str | Path,
    backend: Backend = "auto",
    *,
    decoder_output: Activation | None = None,
    rung: str | None = None,
    quality: Quality | None = None,
) -> Player:
    """Open the player that a file needs: of Gaussians (`.reel`, `.ply`, `.stgc`, `.splatv`), of a VideoRF (`.reel`), or
    of the folder of a trained VideoRF that was not coded yet.

    `decoder_output` is as in `core.reel.load_gaussians`; `rung` and `quality` are as in `videorf.player.VideoPlayer`.
    Raises `HoloreelError` where one is given that the file has no use for.
    """

    def refuse(**choices: str | None) -> None:
        for name, value in choices.items():
            if value is not None:
                raise HoloreelError(f"{path} has no use for --{name.replace('_', '-')}: leave it away.")

    if reel_kind(path) == VIDEORF:
        from .videorf.player import VideoPlayer

        refuse(decoder_output=decoder_output)
        return VideoPlayer(path, rung, quality or "full", backend)
    if is_model(path):
        from .videorf.player import FieldPlayer

        refuse(decoder_output=decoder_output, rung=rung)
        return FieldPlayer.open(path, quality or "full", backend)
    from .gaussians.player import GaussianPlayer

    refuse(rung=rung, quality=quality)
    return GaussianPlayer(path, backend, decoder_output)
