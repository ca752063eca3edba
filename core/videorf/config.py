# SPDX-License-Identifier: GPL-3.0-or-later
"""Training settings: the fields are the flags of `holoreel train videorf`, and a run writes them beside its result."""

from dataclasses import dataclass, field, replace
from typing import Literal

from ..errors import HoloreelError
from .coarse import CoarseConfig
from .grouping import LONGEST
from .mapping import Layout
from .occupancy import GAMMA, WEIGHT_SHARE
from .quantize import EMPTY_DENSITY, Ranges
from .shading import ShadingShape

# Where a frame inside a group starts from. `warm`: everything from the frame before, as the paper's sequential training
# suggests. `coarse_density`: densities from the frame's own coarse field, features from the frame before. `coarse`:
# everything from the frame's own coarse field.
Start = Literal["coarse_density", "warm", "coarse"]
Codec = Literal["h264", "hevc", "av1"]


@dataclass(frozen=True)
class VideoConfig:
    """One training run of a VideoRF reel."""

    resolution: int = 96
    """vertices along the longest side of the subject's box"""
    coarse_share: float = 0.67
    """the lattice of the coarse fields has this part of them"""
    gamma: float = GAMMA
    """a vertex counts where its opacity over one spacing exceeds this (Sec. 4.1)"""
    weight_share: float = WEIGHT_SHARE
    """and where it is among the heaviest vertices that hold this part of all that rays see"""
    border: int = 5
    """pixels around a mask whose rays are looked at, too"""
    image: int = 0
    """pixels along a side of the feature image; 0: the smallest that holds the fullest frame and `headroom`"""
    headroom: float = 1.15
    """how much larger a group's union may be than the fullest frame, where `image` is 0"""
    grouping: bool = True
    """frames share mapping tables (Eq. 4); without, every frame has its own"""
    longest: int = LONGEST
    """frames in a group at most: a player that seeks decodes half a group on average"""
    image_layout: Layout = "blocks"
    """how vertices are laid out in the image: blocks is the paper's; macroblocks and superblocks also put blocks in
    Morton order inside squares of 16 and 64 pixels; raster has no Morton order, rows no blocks"""
    features: int = 7
    """channels beside the density: 7 fit the profile `universal`, up to 15 `quality`"""
    frequencies: int | None = 1
    """of the view direction's encoding; None: colors do not hang on the direction"""
    hidden: int = 16
    """units in each of the two hidden layers of the shading network"""
    shading_groups: int = 2
    """the network learns from the first frames of so many groups at once, then it is frozen"""
    start: Start = "coarse_density"
    """where a frame inside a group starts from: its own coarse density and the features of the frame before, the whole
    frame before, or its own coarse field alone"""
    rays: int = 4096
    """pixels that a step looks at"""
    first_iterations: int = 1000
    """steps for each of the frames the network learns from"""
    head_iterations: int = 800
    """steps for the first frame of other groups"""
    iterations: int = 600
    """steps for every other frame"""
    density_rate: float = 0.3
    """Adam's step for raw densities"""
    feature_rate: float = 0.025
    """Adam's step for features"""
    shading_rate: float = 5e-3
    """Adam's step for the network"""
    final_rate: float = 0.05
    """all rates decay to this part of themselves over a frame"""
    spatial: float = 2e-6
    """weight of the total variation of the feature image, in steps of the quantizer (Eq. 5)"""
    temporal: float = 5e-6
    """weight of the difference from the frame before, in steps of the quantizer (Eq. 6)"""
    seam: float = 1.0
    """how much differences across the borders of 8 x 8 blocks count among them"""
    smooth: float = 6e-6
    """weight of the total variation in space, between neighbors in the lattice, in steps of the quantizer; 0 is the
    published method"""
    noise_from: float = 0.5
    """from this part of a frame's steps on, rows bear the quantizer's noise; 1: never"""
    random_background: bool = True
    """lay pictures over another color at every ray, so that no background is learned; else over white"""
    density_max: float = 8.0
    """raw densities stay under this"""
    feature_max: float = 1.0
    """features stay between minus this and this"""
    step: float = 0.5
    """of the ray march, in spacings"""
    transmittance_min: float = 1e-4
    """a ray ends when it is this dark"""
    codec_from: float = 0.8
    """from this part of a frame's steps on, rows are seen through a real codec; 1: never"""
    codec_qps: tuple[int, ...] = (20, 24, 28, 32, 36)
    """the QPs of that codec, one after the other: rows are then good at all of them"""
    codec_every: int = 8
    """steps between two passes through it"""
    qps: tuple[int, ...] = (20, 24, 28, 33, 36)
    """constant QPs of the rungs that are written, on the codec's own scale; a player begins with the first"""
    codecs: tuple[Codec, ...] = ("h264",)
    """codecs of the rungs that are written"""
    seed: int = 0
    """of the run's random numbers"""
    coarse: CoarseConfig = field(default_factory=CoarseConfig)
    """the coarse fields"""

    def __post_init__(self) -> None:
        counts = ("rays", "first_iterations", "head_iterations", "iterations", "longest", "shading_groups")
        for name in (*counts, "codec_every"):
            self._demand(getattr(self, name) >= 1, name, "1 or more")
        for name in ("noise_from", "codec_from"):
            self._demand(0 <= getattr(self, name) <= 1, name, "0 to 1")
        for name in ("density_rate", "feature_rate", "shading_rate", "final_rate", "density_max", "feature_max"):
            self._demand(getattr(self, name) > 0, name, "more than 0")
        for name in ("spatial", "temporal", "seam", "smooth"):
            self._demand(getattr(self, name) >= 0, name, "0 or more")
        self._demand(0 < self.coarse_share <= 1, "coarse_share", "more than 0, at most 1")
        self._demand(0 <= self.image <= 2048 and self.image % 16 == 0, "image", "a multiple of 16 up to 2048, or 0")
        self._demand(self.headroom >= 1, "headroom", "1 or more")
        for name in ("qps", "codecs", "codec_qps"):
            self._demand(len(getattr(self, name)) > 0, name, "at least one")
        self._demand(all(0 <= qp <= 51 for qp in self.codec_qps), "codec_qps", "0 to 51, which H.264 has")

    def _demand(self, right: bool, name: str, wanted: str) -> None:
        if not right:
            raise HoloreelError(f"--{name.replace('_', '-')} is {getattr(self, name)}: take {wanted}.")

    @property
    def shape(self) -> ShadingShape:
        """What decides the sizes of the network's layers."""
        return ShadingShape(self.features, self.frequencies, self.hidden)

    @property
    def ranges(self) -> Ranges:
        """Where rows are kept while they are trained: the quantizer's steps follow from it."""
        low = (EMPTY_DENSITY, *[-self.feature_max] * self.features)
        return Ranges(low, (self.density_max, *[self.feature_max] * self.features))

    @property
    def profile(self) -> str:
        """The video's profile: `universal` where it has room for all channels."""
        return "universal" if self.features <= 7 else "quality"


# `fast` is for a first look; `paper` is the published method with nothing added: plain warm starts, plain losses.
PRESETS = {
    "standard": VideoConfig(),
    "fast": VideoConfig(
        resolution=64,
        first_iterations=400,
        head_iterations=300,
        iterations=150,
        rays=3072,
        coarse=CoarseConfig(iterations=150),
    ),
    "paper": VideoConfig(
        start="warm",
        features=11,
        frequencies=4,
        resolution=128,
        rays=8192,
        density_max=16.0,
        feature_max=2.0,
        spatial=8e-6,
        temporal=1e-5,
        smooth=0.0,
        codec_from=1.0,
    ),
}

# What each part of the method brings is measured without it (Fig. 7).
ABLATIONS: dict[str, dict[str, object]] = {
    "no spatial loss": {"spatial": 0.0, "smooth": 0.0},
    "no temporal loss": {"temporal": 0.0},
    "no Morton order": {"image_layout": "raster"},
    "no blocks": {"image_layout": "rows"},
    "no grouping": {"grouping": False},
}


def without(config: VideoConfig, part: str) -> VideoConfig:
    """Return the settings without one part of the method, a key of `ABLATIONS`."""
    return replace(config, **ABLATIONS[part])  # type: ignore[arg-type]
