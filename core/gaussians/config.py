# SPDX-License-Identifier: GPL-3.0-or-later
"""Training settings: the fields are the flags of `holoreel train stg`, and a run writes them beside its result."""

from dataclasses import dataclass, field, replace
from typing import Literal

from .decoder import Activation

Model = Literal["lite", "full"]
Strategy = Literal["density", "mcmc"]
Unit = Literal["footprint", "extent"]


@dataclass(frozen=True)
class LearningRates:
    """Adam step sizes. Positions and motions are in the run's unit of length (`unit`)."""

    means: float = 0.3
    """units per step, decaying to `means_final`"""
    means_final: float = 0.01
    """units per step at the end"""
    motions: float = 0.6
    """units per step and segment, for b_1, b_2 and b_3 alike"""
    features: float = 0.015
    """display-referred color, and what a full model knows about directions"""
    features_time: float = 0.015
    """what a full model knows about time, per segment"""
    opacities: float = 0.05
    """logit"""
    scales: float = 0.02
    """log scale"""
    quats: float = 6e-3
    """raw quaternion at the temporal center"""
    omegas: float = 0.01
    """raw change of the quaternion over a segment"""
    trbf_centers: float = 1e-3
    """segments"""
    trbf_scales: float = 0.04
    """log width"""
    decoder: float = 0.01
    """weights of a full model's network"""
    final_factor: float = 0.1
    """all rates but that of the positions decay to this part of themselves"""


@dataclass(frozen=True)
class DensityConfig:
    """When Gaussians are cloned, split, pruned and reset; sizes in units, moments as parts of the whole run."""

    start: float = 0.1
    """first densification, as a part of all iterations"""
    stop: float = 0.5
    """last densification"""
    events: int = 6
    """how many densifications lie between: the quota"""
    gradient: float = 8e-4
    """a Gaussian is cloned or split where the loss pulls its projected mean harder than this, per half image width"""
    split_size: float = 3.0
    """larger Gaussians, in units, are split in two, smaller ones are cloned"""
    split_shrink: float = 1.6
    """the two children of a split Gaussian are this much smaller"""
    random_centers: bool = False
    """give clones and children a random temporal center, as the authors do"""
    max_gaussians: int = 150_000
    """never grow beyond this number"""
    prune_opacity: float = 0.02
    """Gaussians whose opacity stays under this at all frames are deleted"""
    prune_every: int = 100
    """iterations between two prunings"""
    prune_stop: float = 1.0
    """last pruning by opacity, as a part of the run"""
    prune_depth: float = 0.2
    """Gaussians nearer to a training camera than this part of the nearest seed are deleted"""
    prune_box_at: tuple[float, ...] = ()
    """Gaussians outside the box of the seed points are deleted at these parts of the run"""
    reset_at: tuple[float, ...] = ()
    """opacities are capped at `reset_opacity` at these parts of the run; a short run is better off without: what comes
    back is fainter, and pictures need more layers of it"""
    reset_opacity: float = 0.01
    """the cap of a reset"""


@dataclass(frozen=True)
class McmcConfig:
    """The other strategy: dead Gaussians are moved to where live ones are, and all of them wander a little."""

    start: float = 0.05
    """first round, as a part of all iterations"""
    stop: float = 0.8
    """last round"""
    growth: float = 0.05
    """how much the number may grow at a time"""
    dead_opacity: float = 0.005
    """Gaussians whose opacity stays under this at all frames are moved"""
    every: int = 100
    """iterations between two rounds"""
    noise: float = 0.2
    """how far Gaussians wander, as a part of their covariance in units, at the start; it decays with the positions"""
    opacity_weight: float = 0.01
    """of the mean opacity in the loss"""
    scale_weight: float = 0.001
    """of the mean size, in units, in the loss"""


@dataclass(frozen=True)
class GuidedConfig:
    """Guided sampling (Sec. 4.4): new Gaussians along rays through the patches with the largest errors."""

    times: int = 3
    """how often at most; 0 turns it off"""
    start: float = 0.1
    """not before this part of the run, and not before the loss is stable"""
    stop: float = 0.6
    """not after this part of the run"""
    stable: float = 0.05
    """the loss is stable when it falls by less than this part of itself over a fiftieth of the run"""
    patch: int = 16
    """pixels along a side of the patches over which errors are averaged"""
    share: float = 0.03
    """at most this part of all patches is sampled"""
    contrast: float = 2.0
    """only patches whose error is this many times the median patch's are sampled"""
    sparse: float = 0.25
    """only patches into which fewer seeds fall than this part of the mean are sampled"""
    samples: int = 8
    """new Gaussians along each ray"""
    near: float = 0.7
    """rays begin at this part of the largest depth the camera sees"""
    far: float = 7.5
    """rays end at this multiple of the largest depth the camera sees"""
    noise: float = 0.1
    """of the new centers, in patches"""
    opacity: float = 0.1
    """of a new Gaussian"""


@dataclass(frozen=True)
class TrainConfig:
    """One training run of a Spacetime Gaussian reel."""

    iterations: int = 3500
    """steps"""
    schedule: int = 0
    """how many iterations learning rates and moments are planned for; 0: `iterations`"""
    batch: int = 1
    """pictures that a step looks at"""
    seed: int = 0
    """of the run's one random generator"""
    model: Model = "lite"
    """lite: a Gaussian has a color; full: nine features, and a network per pixel (Sec. 4.2)"""
    decoder_output: Activation = "none"
    """what follows the network of a full model"""
    temporal_opacity: bool = True
    """Eq. 7; without, Gaussians are always there"""
    motion: int = 3
    """order of the polynomial motion, 0 to 3 (Eq. 8)"""
    rotation: int = 1
    """order of the polynomial rotation, 0 or 1 (Eq. 9)"""
    detach_time: bool = False
    """let temporal centers learn from opacity alone, as the authors do"""
    strategy: Strategy = "density"
    """how the number of Gaussians is controlled"""
    unit: Unit = "footprint"
    """lengths in rates and density: what one pixel covers at each Gaussian's place, or the extent of the cameras"""
    dssim_weight: float = 0.2
    """loss = (1 − w) L1 + w (1 − SSIM) (Sec. 4.3)"""
    segment: int = 50
    """longer captures are cut into segments of at most so many frames, each a model of its own; 0: never"""
    overlap: int = 2
    """frames beyond its own on either side that a segment learns from too"""
    share_static: bool = True
    """let a segment begin with what stood still in the one before it, so that nothing jumps between them"""
    inherited_pace: float = 0.1
    """what a segment began with learns at this part of all rates"""
    max_seeds: int = 40_000
    """at most this many Gaussians to begin with"""
    seed_frames: int = 1
    """take the seed points of every so many frames"""
    sparse_share: float = 1.0
    """of all frames but the first take this part of the points alone, those farthest from their neighbors"""
    split_static: bool = True
    """let points that nearly every frame has become one long-lived Gaussian"""
    seed_opacity: float = 0.3
    """opacity of a fresh Gaussian"""
    static_width: float = 1.5
    """temporal width, in segments, of seeds that stand still"""
    moving_width: float = 0.25
    """temporal width, in segments, of seeds that are there in some frames only"""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """color behind everything, where a capture is transparent"""
    clamp_colors: bool = True
    """keep a lite model's colors in [0, 1], where every viewer shows them alike (EEVEE drops negative light, .splatv
    has 8 bits)"""
    checkpoint_every: int = 1000
    """iterations between two checkpoints"""
    picture_memory: int = 2 << 30
    """bytes of pictures that are kept in memory"""
    rates: LearningRates = field(default_factory=LearningRates)
    """learning rates"""
    density: DensityConfig = field(default_factory=DensityConfig)
    """density control"""
    mcmc: McmcConfig = field(default_factory=McmcConfig)
    """the other strategy"""
    guided: GuidedConfig = field(default_factory=GuidedConfig)
    """guided sampling"""

    @property
    def planned(self) -> int:
        """How many iterations the whole schedule has; a run may end before."""
        return self.schedule or self.iterations


# The settings of the authors' runs, in their units: lengths in extents, moments in parts of 30,000 iterations. What
# their code does to single data sets (deleting what lies below a height, stopping rotations) is left out; the pruning
# near cameras stands in its place.
_PAPER_RATES = LearningRates(
    means=1.6e-4,
    means_final=1.6e-6,
    motions=2.8e-4,
    features=2.5e-3,
    features_time=1e-3,
    opacities=0.05,
    scales=1.5e-3,
    quats=1e-3,
    omegas=1e-4,
    trbf_centers=1e-4,
    trbf_scales=0.03,
    decoder=1e-4,
    final_factor=1.0,
)
_PAPER_DENSITY = DensityConfig(
    start=600 / 30_000,
    stop=1100 / 30_000,
    events=6,
    gradient=2e-4,
    split_size=0.01,
    random_centers=True,
    max_gaussians=2_000_000,
    prune_opacity=0.005,
    prune_stop=7000 / 30_000,
    prune_box_at=(10_000 / 30_000,),
    reset_at=(0.1, 0.2),
)
_PAPER_GUIDED = GuidedConfig(times=2, start=1600 / 30_000, stop=7000 / 30_000)
_N3V = TrainConfig(
    iterations=25_000,
    schedule=30_000,
    batch=2,
    model="full",
    decoder_output="sigmoid",
    detach_time=True,
    unit="extent",
    max_seeds=2_000_000,
    split_static=False,
    seed_opacity=0.1,
    moving_width=1.0,
    clamp_colors=False,
    rates=_PAPER_RATES,
    density=_PAPER_DENSITY,
    guided=_PAPER_GUIDED,
)
_TECHNICOLOR = replace(
    _N3V,
    decoder_output="clamp",
    moving_width=0.135,
    rates=replace(_PAPER_RATES, scales=5e-3),
    density=replace(_PAPER_DENSITY, events=12, stop=1700 / 30_000),
)
_IMMERSIVE = replace(
    _N3V,
    iterations=20_000,
    decoder_output="none",
    rates=replace(_PAPER_RATES, means=1.6e-5, motions=4e-6),
    density=replace(_PAPER_DENSITY, random_centers=False, prune_stop=9000 / 30_000),
    guided=replace(_PAPER_GUIDED, times=3),
)

PRESETS = {
    "lite": TrainConfig(),
    "full": TrainConfig(model="full"),
    "n3v": _N3V,
    "technicolor": _TECHNICOLOR,
    "immersive": _IMMERSIVE,
}
