# SPDX-License-Identifier: GPL-3.0-or-later
"""What `holoreel bench videorf` compares: the method, the method without single parts, and what goes beyond the paper.

A variant changes settings of the training, or of the coding, or both. Variants are joined by their keys with a plus:
`superblocks+av1` is trained with one change and coded with another. What differs in the coding alone shares a training.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from ..errors import HoloreelError
from ..videorf.config import ABLATIONS, VideoConfig
from ..videorf.encode import DEFAULT_RUNGS

FULL = "full"

# Which frames are IDR frames, that refer to nothing before them. A reel has them at the heads of its groups; the others
# are measured alone: `frames`, every frame; `video`, the first one only, even where mapping tables change.
Heads = Literal["groups", "frames", "video"]


@dataclass(frozen=True)
class Coding:
    """How a trained model is written: the codec, the constant QPs on its own scale, and how values become codes."""

    codec: str = "h264"
    qps: tuple[int, ...] = tuple(rung.qp for rung in DEFAULT_RUNGS)
    percentile: float | None = None  # of a frame's values beyond the ranges at either end; None: the training's ranges
    heads: Heads = "groups"


@dataclass(frozen=True)
class Variant:
    """A row of the table: the fields that it changes of a `VideoConfig`, and of a `Coding`."""

    key: str
    title: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    coding: Mapping[str, Any] = field(default_factory=dict)

    def config(self, base: VideoConfig) -> VideoConfig:
        """Return the settings of its training."""
        return replace(base, **self.settings)

    @property
    def how(self) -> Coding:
        """Return how its model is coded."""
        return Coding(**self.coding)


def _ablation(part: str) -> Variant:
    return Variant(part.replace(" ", "_"), part, ABLATIONS[part])


VARIANTS = (
    Variant(FULL, "full"),
    *map(_ablation, ABLATIONS),
    Variant("image_only", "no total variation in space", {"smooth": 0.0}),
    Variant("space_only", "no total variation of the image", {"spatial": 0.0}),
    Variant("warm", "plain warm start", {"start": "warm"}),
    Variant("coarse", "start from the coarse field alone", {"start": "coarse"}),
    Variant("macroblocks", "blocks in Morton order in squares of 16", {"image_layout": "macroblocks"}),
    Variant("superblocks", "blocks in Morton order in squares of 64", {"image_layout": "superblocks"}),
    Variant("density_16", "density of -8 to 16", {"density_max": 16.0}),
    Variant("no_codec_loop", "no codec in the loop", {"codec_from": 1.0}),
    Variant("no_direction", "no view direction", {"frequencies": None}),
    Variant("no_noise", "no quantizer noise", {"noise_from": 1.0}),
    Variant("percentile", "ranges of 99.8 % of the values", coding={"percentile": 0.1}),
    Variant("key_frames", "an IDR in every frame", coding={"heads": "frames"}),
    Variant("one_idr", "one IDR at the start of the video", coding={"heads": "video"}),
    Variant("hevc", "HEVC", coding={"codec": "hevc"}),
    Variant("av1", "AV1", coding={"codec": "av1", "qps": (12, 20, 28, 36, 44, 52)}),
)
FIGURE_7 = (FULL, *(_ablation(part).key for part in ABLATIONS))


def find_variant(name: str) -> Variant:
    """Return the variant of a key, or of several keys joined by plus signs, the later ones last.

    Raises `HoloreelError` for a key that is unknown.
    """
    known = {variant.key: variant for variant in VARIANTS}
    parts = []
    for key in name.split("+"):
        if key not in known:
            raise HoloreelError(f"--rows {name}: there is no row '{key}'; take some of {', '.join(known)}.")
        if key != FULL:
            parts.append(known[key])
    settings = {field: value for part in parts for field, value in part.settings.items()}
    coding = {field: value for part in parts for field, value in part.coding.items()}
    title = ", ".join(part.title for part in parts) or FULL
    return Variant("+".join(part.key for part in parts) or FULL, title, settings, coding)


def training_of(variant: Variant) -> str:
    """Return the key of the training that a variant needs: that of its parts that change the training."""
    keys = [key for key in variant.key.split("+") if find_variant(key).settings]
    return "+".join(keys) or FULL
