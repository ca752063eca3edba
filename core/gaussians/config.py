# SPDX-License-Identifier: GPL-3.0-or-later
"""Training settings: the fields are the flags of `holoreel train stg`, and a run writes them beside its result."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class LearningRates:
    """Adam step sizes. Positions and motions are in footprints: what one pixel covers at the scene's median depth."""

    means: float = 0.3
    """footprints per step, decaying to `means_final`"""
    means_final: float = 0.01
    """footprints per step at the end"""
    motions: float = 0.6
    """footprints per step and segment, for b_1, b_2 and b_3 alike"""
    features: float = 0.015
    """display-referred color"""
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
    final_factor: float = 0.1
    """all rates but that of the positions decay to this part of themselves"""


@dataclass(frozen=True)
class DensityConfig:
    """When Gaussians are cloned, split, pruned and reset; sizes in footprints, moments as parts of the whole run."""

    start: float = 0.1
    """first densification, as a part of all iterations"""
    stop: float = 0.5
    """last densification"""
    events: int = 6
    """how many densifications lie between"""
    gradient: float = 8e-4
    """a Gaussian is cloned or split where the loss pulls its projected mean harder than this, per half image width"""
    split_footprints: float = 3.0
    """larger Gaussians are split in two, smaller ones are cloned"""
    max_gaussians: int = 150_000
    """never grow beyond this number"""
    prune_opacity: float = 0.02
    """Gaussians whose opacity stays under this at all frames are deleted"""
    prune_every: int = 100
    """iterations between two prunings"""
    prune_depth: float = 0.2
    """Gaussians nearer to a training camera than this part of the nearest seed are deleted"""
    reset_at: tuple[float, ...] = ()
    """opacities are capped at `reset_opacity` at these parts of the run; a short run is better off without: what comes
    back is fainter, and pictures need more layers of it"""
    reset_opacity: float = 0.01
    """the cap of a reset"""


@dataclass(frozen=True)
class TrainConfig:
    """One training run of a Spacetime Gaussian reel."""

    iterations: int = 3500
    """steps; each looks at one picture"""
    seed: int = 0
    """of the run's one random generator"""
    dssim_weight: float = 0.2
    """loss = (1 − w) L1 + w (1 − SSIM) (Sec. 4.3)"""
    max_seeds: int = 40_000
    """at most this many Gaussians to begin with"""
    seed_opacity: float = 0.3
    """opacity of a fresh Gaussian"""
    static_width: float = 1.5
    """temporal width, in segments, of seeds that stand still"""
    moving_width: float = 0.25
    """temporal width, in segments, of seeds that are there in some frames only"""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """color behind everything, where a capture is transparent"""
    clamp_colors: bool = True
    """keep colors in [0, 1], where every viewer shows them alike (EEVEE drops negative light, .splatv has 8 bits)"""
    checkpoint_every: int = 1000
    """iterations between two checkpoints"""
    rates: LearningRates = field(default_factory=LearningRates)
    """learning rates"""
    density: DensityConfig = field(default_factory=DensityConfig)
    """density control"""


PRESETS = {"lite": TrainConfig()}
