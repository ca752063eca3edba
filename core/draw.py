# SPDX-License-Identifier: GPL-3.0-or-later
"""Draw a reel, PLY or .splatv as a camera sees it at a frame: from a file to a picture in numpy."""

from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from .camera import Camera
from .capture import Capture
from .errors import HoloreelError
from .gaussians.decoder import Activation
from .gaussians.model import SpacetimeGaussians
from .reel import Loaded, Triple, load_gaussians
from .render import Backend, get_backend
from .render.contract import Rules, SpacetimeTensors
from .render.lifetimes import Lifetimes
from .render.view import DecoderTensors, decoder_tensors, render_view

SEGMENTS_HELD = 2  # in memory at a time: going back and forth over a seam reads nothing twice


class Drawing(NamedTuple):
    """One picture: display-referred `image` (H, W, 3) over the background, `alpha` (H, W), `depth` (H, W).

    `depth` is the alpha-weighted mean of camera-space z, 0 where nothing is.
    """

    image: NDArray[np.float32]
    alpha: NDArray[np.float32]
    depth: NDArray[np.float32]


def draw(
    gaussians: SpacetimeTensors,
    time: float,
    camera: Camera,
    backend: ModuleType,
    background: Triple = (0.0, 0.0, 0.0),
    decoder: DecoderTensors | None = None,
    rules: Rules | None = None,
    rows: torch.Tensor | None = None,
) -> Drawing:
    """Draw Gaussians at a normalized time through any lens; `backend` as `core.render.get_backend` returns it.

    With a `decoder`, `background` is ignored: it colors every pixel. `rows` are those that are drawn, all if None.
    """
    with torch.no_grad():
        color = torch.tensor(background, device=backend.DEVICE)
        rendering = render_view(backend, gaussians, time, camera, color, decoder, rules, rows=rows)
    return Drawing(*(part.cpu().numpy() for part in rendering))


def to_tensors(gaussians: SpacetimeGaussians, decoded: bool = False) -> SpacetimeTensors:
    """Return the parameters as tensors that can be drawn: of a full model, all features if they shall be `decoded`,
    else the base color alone."""
    arrays = {name: getattr(gaussians, name) for name in SpacetimeTensors._fields}
    if not decoded:
        arrays["features"] = np.ascontiguousarray(arrays["features"][:, :3])
    return SpacetimeTensors(**{name: torch.from_numpy(array) for name, array in arrays.items()})


class Player:
    """Draws the frames of one file, lite or full, with few of its segments in memory at a time.

    Frames are those of the timeline, sub-frames allowed: `frame_start` to `frame_start + frame_count - 1`.
    `decoder_output` is as in `core.reel.load_gaussians`.
    """

    def __init__(self, path: str | Path, backend: Backend = "auto", decoder_output: Activation | None = None):
        self.path = Path(path)
        self.backend = get_backend(backend)
        self.first: Loaded = load_gaussians(self.path, decoder_output=decoder_output)
        self.report = self.first.report
        whole = self.first.reel or self.first
        self.frame_start, self.frame_count = whole.frame_start, whole.frame_count
        self.rules = Rules(near=self.first.reel.near) if self.first.reel else Rules()
        self._segment = lru_cache(maxsize=SEGMENTS_HELD)(self._load)

    def frame_at(self, time: float) -> float:
        """Return the frame at a normalized time of the whole file: 0 is the first one, 1 is just after the last."""
        return self.frame_start + time * self.frame_count

    def frames_of(self, capture: Capture) -> list[float]:
        """Return the frame to draw for each frame of a capture.

        A reel is matched by frame number; a bare PLY or .splatv, which knows no numbers, by normalized time. Raises
        `HoloreelError` where the reel does not cover the capture: it was made from another one.
        """
        if self.first.reel is None:
            return [self.frame_at(time) for time in capture.times]
        first, last = self.frame_start, self.frame_start + self.frame_count - 1
        start, end = capture.frame_start, capture.frame_start + capture.frame_count - 1
        if start < first or end > last:
            raise HoloreelError(
                f"{self.path} holds frames {first} to {last}, {capture.source} frames {start} to {end}: "
                "give the capture that the reel was trained on."
            )
        return [float(frame) for frame in range(start, end + 1)]

    def draw(
        self,
        camera: Camera,
        frame: float,
        background: Triple | None = None,
        rules: Rules | None = None,
        listed: bool = True,
    ) -> Drawing:
        """Draw one frame, over the reel's own background unless another is given; a full model has none.

        `listed` draws only the rows that are alive at the frame: the same picture, sooner.
        """
        reel = self.first.reel
        segment, time = reel.locate(frame) if reel else (0, self.first.time_of(frame))
        gaussians, decoder, lifetimes = self._segment(segment)
        color = self.first.background if background is None else background
        rules = rules or self.rules
        # The lists hold for the usual threshold of visibility, and where what has faded shall be left out.
        known = listed and rules.cull_faded and rules.alpha_min == lifetimes.alpha_min
        rows = lifetimes.rows(time) if known else None
        return draw(gaussians, time, camera, self.backend, color, decoder, rules, rows)

    def _load(self, segment: int) -> tuple[SpacetimeTensors, DecoderTensors | None, Lifetimes]:
        loaded = self.first if segment == 0 else load_gaussians(self.path, segment)
        decoder = decoder_tensors(loaded.decoder) if loaded.decoder else None
        tensors = to_tensors(loaded.gaussians, decoded=decoder is not None)
        frames = loaded.reel.segments[segment].frame_count if loaded.reel else loaded.frame_count
        lifetimes = Lifetimes(tensors, frames, Rules().alpha_min)
        return SpacetimeTensors(*(tensor.to(self.backend.DEVICE) for tensor in tensors)), decoder, lifetimes
