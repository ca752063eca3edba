# SPDX-License-Identifier: GPL-3.0-or-later
"""Draw Spacetime Gaussians as a camera sees them at a frame: from a reel, PLY or .splatv to a picture in numpy."""

from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..camera import Camera
from ..draw import Drawing, Player
from ..reel import Loaded, Triple, load_gaussians
from ..render import Backend, get_backend
from ..render.contract import Rules, SpacetimeTensors
from ..render.lifetimes import Lifetimes
from ..render.view import DecoderTensors, decoder_tensors, render_view
from ..render.warp import lens_warp
from .decoder import Activation, decoder_path
from .model import SpacetimeGaussians

SEGMENTS_HELD = 2  # in memory at a time: going back and forth over a seam reads nothing twice


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


class GaussianPlayer(Player):
    """Draws the frames of one file, lite or full, with few of its segments in memory at a time.

    Sub-frames are allowed. A full model has no background: its decoder colors every pixel. `decoder_output` is as in
    `core.reel.load_gaussians`.
    """

    def __init__(self, path: str | Path, backend: Backend = "auto", decoder_output: Activation | None = None):
        self.path = Path(path)
        self.backend = get_backend(backend)
        self.backend_name = self.backend.__name__.rpartition(".")[2]
        self.first: Loaded = load_gaussians(self.path, decoder_output=decoder_output)
        self.report = self.first.report
        whole = self.first.reel or self.first
        self.frame_start, self.frame_count = whole.frame_start, whole.frame_count
        self.background = self.first.background
        self.takes_background = self.first.decoder is None
        self.numbered = self.first.reel is not None
        self.rules = Rules(near=self.first.reel.near) if self.first.reel else Rules()
        self._segment = lru_cache(maxsize=SEGMENTS_HELD)(self._load)

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
        color = self.background if background is None else background
        rules = rules or self.rules
        # The lists hold for the usual threshold of visibility, and where what has faded shall be left out.
        known = listed and rules.cull_faded and rules.alpha_min == lifetimes.alpha_min
        rows = lifetimes.rows(time) if known else None
        return draw(gaussians, time, camera, self.backend, color, decoder, rules, rows)

    def reach(self, camera: Camera) -> NDArray[np.bool_] | None:
        """Return the pixels (H, W) that the warp of a distorted lens can fill; None for a pinhole, which has none."""
        return None if camera.model == "PINHOLE" else lens_warp(camera).valid.numpy()

    def size(self) -> int:
        """Return the bytes of all payloads and decoders; a bare file's decoder counts too."""
        return model_size(self.first)

    def facts(self) -> dict[str, Any]:
        """Return how many Gaussians the first segment has."""
        return {"gaussians": len(self.first.gaussians)}

    def _load(self, segment: int) -> tuple[SpacetimeTensors, DecoderTensors | None, Lifetimes]:
        loaded = self.first if segment == 0 else load_gaussians(self.path, segment)
        decoder = decoder_tensors(loaded.decoder) if loaded.decoder else None
        tensors = to_tensors(loaded.gaussians, decoded=decoder is not None)
        frames = loaded.reel.segments[segment].frame_count if loaded.reel else loaded.frame_count
        lifetimes = Lifetimes(tensors, frames, Rules().alpha_min)
        return SpacetimeTensors(*(tensor.to(self.backend.DEVICE) for tensor in tensors)), decoder, lifetimes


def model_size(loaded: Loaded) -> int:
    """Return the bytes that all Gaussians and decoders of a file take on disk."""
    if loaded.reel:
        reel = loaded.reel
        files = [reel.payload(index) for index in range(len(reel.segments))]
        files += [file for index in range(len(reel.segments)) if (file := reel.decoder(index))]
    else:
        files = [loaded.path]
        if loaded.decoder:
            ours = decoder_path(loaded.path)
            files.append(ours if ours.is_file() else loaded.path.with_suffix(".pt"))
    return sum(file.stat().st_size for file in set(files))
