# SPDX-License-Identifier: GPL-3.0-or-later
"""Spacetime Gaussians as arrays, and their evaluation at a time (Spacetime Gaussians, Sec. 4.1). Needs numpy only."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float32]

OPACITY_MIN = 1.0 / 255.0  # under this no pixel can show a Gaussian: the rasterizers skip smaller alphas
ALWAYS_LOG_SCALE = (
    16.0  # log of a width at which the temporal opacity is 1 to the last float32 bit, anywhere near [0, 1]
)

# Shape of one row, and the range in which float32 arithmetic on it stays finite (a squared scale in pixels, the square
# of a quaternion). Rows outside are as useless as NaN. Widths may be as large as they like (always visible), scales as
# small (flat).
ROWS: dict[str, tuple[tuple[int, ...], float, float]] = {
    "means": ((3,), -1e12, 1e12),
    "motions": ((3, 3), -1e12, 1e12),
    "quats": ((4,), -1e12, 1e12),
    "omegas": ((4,), -1e12, 1e12),
    "log_scales": ((3,), -1e30, 30.0),
    "opacity_logits": ((), -1e30, 1e30),
    "features": ((3,), -1e12, 1e12),
    "trbf_centers": ((), -1e6, 1e6),
    "trbf_log_scales": ((), -40.0, 1e30),
}
FEATURES = {3: "lite", 9: "full"}


@dataclass
class EvaluatedGaussians:
    """N Gaussians at one time, ready to be drawn. Rows are those of the model, dead ones included; see `alive`."""

    means: Array  # (N, 3) μ(t), Eq. 8
    quats: Array  # (N, 4) q(t) of Eq. 9 as w x y z, unit length; (1, 0, 0, 0) where the sum is zero
    scales: Array  # (N, 3) standard deviations, in scene units
    opacities: Array  # (N,) σ(t) of Eq. 7, in [0, 1]
    features: Array  # (N, 3) color, or (N, 9) with the time part already multiplied by t - μ^τ (Eq. 10)

    def __len__(self) -> int:
        return len(self.means)

    @property
    def alive(self) -> NDArray[np.int64]:
        """Rows that a pixel can show: opacity of at least 1/255."""
        return np.flatnonzero(self.opacities >= OPACITY_MIN)

    def take(self, index: ArrayLike) -> Self:
        """Return the rows that `index` (integers or a mask) selects."""
        return type(self)(**{field.name: getattr(self, field.name)[index] for field in fields(self)})


@dataclass
class SpacetimeGaussians:
    """The parameters of N Spacetime Gaussians, raw as they are trained and stored.

    `features` has 3 columns for a lite model (display-referred RGB, no offset, no harmonics) and 9 for a full one
    (base, direction, time: Eq. 10). Time is normalized: a segment spans [0, 1).

    Whatever the arrays are given as, they are held as C-contiguous float32; a wrong shape is a ValueError.
    """

    means: Array  # (N, 3) position at the temporal center, b_0 of Eq. 8
    motions: Array  # (N, 3, 3) b_1, b_2, b_3 of Eq. 8: [order, axis]
    quats: Array  # (N, 4) w x y z, not normalized, c_0 of Eq. 9; all zero means no rotation
    omegas: Array  # (N, 4) c_1 of Eq. 9
    log_scales: Array  # (N, 3)
    opacity_logits: Array  # (N,)
    features: Array  # (N, 3) or (N, 9)
    trbf_centers: Array  # (N,) μ^τ of Eq. 7
    trbf_log_scales: Array  # (N,) log of the width w; s^τ = w⁻²

    def __post_init__(self) -> None:
        count = len(self.means)
        for name, (row, _, _) in ROWS.items():
            # Not ascontiguousarray, which would turn a scalar into one row.
            array = np.asarray(getattr(self, name), dtype=np.float32, order="C")
            allowed = [(count, width) for width in FEATURES] if name == "features" else [(count, *row)]
            if array.shape not in allowed:
                raise ValueError(f"{name} has shape {array.shape}, not {' or '.join(map(str, allowed))}")
            setattr(self, name, array)

    def __len__(self) -> int:
        return len(self.means)

    @property
    def variant(self) -> str:
        """`lite` (3 feature columns) or `full` (9)."""
        return FEATURES[self.features.shape[1]]

    def take(self, index: ArrayLike) -> Self:
        """Return the rows that `index` (integers, a slice or a mask) selects."""
        return type(self)(**{name: getattr(self, name)[index] for name in ROWS})

    def evaluate(self, time: float) -> EvaluatedGaussians:
        """Evaluate all Gaussians at `time` (Eqs. 7 to 10; the width is exp(trbf_log_scale), without the paper's 1/2).

        Computed in float64 and rounded once, so that other evaluations can be measured against this one. A row whose
        parameters are not finite comes out not finite.
        """
        dt = time - self.trbf_centers.astype(np.float64)
        with np.errstate(over="ignore", under="ignore", invalid="ignore", divide="ignore"):
            quats = self.quats + dt[:, None] * self.omegas
            lengths = np.linalg.norm(quats, axis=1, keepdims=True)
            quats = np.where(lengths == 0.0, [1.0, 0.0, 0.0, 0.0], quats / np.where(lengths == 0.0, 1.0, lengths))
            temporal = np.exp(-np.square(dt * np.exp(-self.trbf_log_scales.astype(np.float64))))
            opacities = sigmoid(self.opacity_logits.astype(np.float64)) * temporal
            features = self.features.astype(np.float64)
            if self.variant == "full":
                features[:, 6:] *= dt[:, None]
            return EvaluatedGaussians(
                self._positions(dt).astype(np.float32),
                quats.astype(np.float32),
                np.exp(self.log_scales.astype(np.float64)).astype(np.float32),
                opacities.astype(np.float32),
                features.astype(np.float32),
            )

    def _positions(self, dt: NDArray[np.float64]) -> NDArray[np.float64]:
        """Positions (N, 3) at `dt` (N,) after each temporal center: the cubic of Eq. 8 by Horner's rule."""
        step, motions = dt[:, None], self.motions.astype(np.float64)
        return self.means + step * (motions[:, 0] + step * (motions[:, 1] + step * motions[:, 2]))

    def lifetimes(self) -> NDArray[np.float64]:
        """Return (N, 2) first and last time at which each Gaussian reaches opacity 1/255; NaN where it never does."""
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            peak = sigmoid(self.opacity_logits.astype(np.float64))
            half = np.exp(self.trbf_log_scales.astype(np.float64)) * np.sqrt(np.log(peak / OPACITY_MIN))
        return np.stack([self.trbf_centers - half, self.trbf_centers + half], axis=1)

    def bounds(self, start: float = 0.0, end: float = 1.0) -> NDArray[np.float64] | None:
        """Return the box (2, 3), lowest and highest corner, of all visible centers in [start, end], or None if none is.

        Exact: a cubic takes its extremes where its derivative vanishes or at the ends of the time it is visible.
        """
        lives = self.lifetimes()
        seen = (lives[:, 0] <= end) & (lives[:, 1] >= start) & ~self.bad_rows()
        if not seen.any():
            return None
        visible, lives = self.take(seen), np.clip(lives[seen], start, end)
        first, last = (lives - visible.trbf_centers[:, None]).T
        places = [visible._positions(first), visible._positions(last)]
        for turn in visible._turning_points():
            places.append(visible._positions(np.where((turn > first) & (turn < last), turn, first)))
        return np.stack([np.min(places, axis=(0, 1)), np.max(places, axis=(0, 1))])

    def _turning_points(self) -> NDArray[np.float64]:
        """Return (6, N) times after the temporal center where an axis' derivative vanishes; not finite where none."""
        # The derivative is linear + 2 · half · dt + 3 · cubic · dt².
        linear, half, cubic = self.motions.astype(np.float64).transpose(1, 2, 0)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            # The form that does not cancel when the cubic is small.
            stable = -(half + np.copysign(np.sqrt(half * half - 3.0 * cubic * linear), half))
            return np.concatenate([stable / (3.0 * cubic), linear / stable])

    def columns(self, name: str) -> Array:
        """Return the parameter `name` as (N, columns), a view."""
        array = getattr(self, name)
        return array.reshape(len(array), math.prod(array.shape[1:]))

    def bad_rows(self) -> NDArray[np.bool_]:
        """Return an (N,) mask of rows that cannot be drawn: a value is NaN, infinite, or beyond what `ROWS` allows."""
        bad = np.zeros(len(self), dtype=bool)
        for name in ROWS:
            bad |= self._bad_values(name)
        return bad

    def _bad_values(self, name: str) -> NDArray[np.bool_]:
        _, lowest, highest = ROWS[name]
        values = self.columns(name)
        # Comparisons with NaN are false, so "not inside" catches it.
        return ~np.all((values >= lowest) & (values <= highest), axis=1)

    def without_bad_rows(self) -> Self:
        """Return the model without its `bad_rows`; the model itself where there are none."""
        bad = self.bad_rows()
        return self.take(~bad) if bad.any() else self

    def problems(self) -> list[str]:
        """Say in sentences what is unusual about this model; an empty list means nothing is."""
        found = []
        for name in ROWS:
            if count := int(self._bad_values(name).sum()):
                found.append(f"{rows(count)} with {name} that are not finite or beyond any use.")
        good = self.without_bad_rows()
        checks = {
            "zero quaternions and no rotation speed (drawn unrotated)": ~(good.quats.any(1) | good.omegas.any(1)),
            "an opacity that never reaches 1/255 (never visible)": ~(sigmoid(good.opacity_logits) >= OPACITY_MIN),
            "a temporal width under 1/1000 of the segment (a flash)": good.trbf_log_scales < np.log(1e-3),
            "a life that misses the segment [0, 1) (never visible)": good._never_in_segment(),
            "a scale above 1000 times the median (fog or streaks)": good._huge(),
        }
        found += [f"{rows(int(mask.sum()))} with {text}." for text, mask in checks.items() if mask.any()]
        return found

    def _never_in_segment(self) -> NDArray[np.bool_]:
        lives = self.lifetimes()
        return (lives[:, 1] < 0.0) | (lives[:, 0] >= 1.0)

    def _huge(self) -> NDArray[np.bool_]:
        largest = self.log_scales.max(axis=1, initial=-np.inf)
        return largest > np.median(largest) + np.log(1000.0) if len(self) else np.zeros(0, dtype=bool)


def recentered(model: SpacetimeGaussians, centers: NDArray[np.float64]) -> SpacetimeGaussians:
    """Return the same motion and rotation written around other temporal `centers` (N,), exactly but for rounding.

    Meant for centers that a file format rounds: then only the temporal opacity (and time feature) moves with them.
    """
    d = (centers - model.trbf_centers)[:, None]
    b1, b2, b3 = model.motions.astype(np.float64).transpose(1, 0, 2)
    turned = model.quats.any(axis=1, keepdims=True)  # where not, only the direction of dt · ω counts, at all times
    return SpacetimeGaussians(
        **vars(model)
        | {
            "means": model._positions(d[:, 0]),
            "motions": np.stack([b1 + d * (2 * b2 + 3 * d * b3), b2 + 3 * d * b3, b3], axis=1),
            "quats": np.where(turned, model.quats + d * model.omegas, 0.0),
            "trbf_centers": centers,
        }
    )


def unit_rotations(
    model: SpacetimeGaussians,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return `quats` and `omegas` (N, 4) that turn as the model's do, with quats of length 1 and w ≥ 0, or zero.

    Only the direction of q(t) counts, so that a common factor is free; where quats are zero, ω alone says how things
    are turned, at all times but one. Rows remain zero that are not turned at all.
    """
    quats, omegas = model.quats.astype(np.float64), model.omegas.astype(np.float64)
    turned = quats.any(axis=1, keepdims=True)
    quats, omegas = np.where(turned, quats, omegas), np.where(turned, omegas, 0.0)
    length = np.linalg.norm(quats, axis=1, keepdims=True)
    factor = np.where(quats[:, :1] < 0, -1.0, 1.0) / np.where(length > 0, length, 1.0)
    return quats * factor, omegas * factor


def rows(count: int) -> str:
    """Return `1 row` or `1,234 rows`, for reports."""
    return "1 row" if count == 1 else f"{count:,} rows"


def concatenate(models: Sequence[SpacetimeGaussians]) -> SpacetimeGaussians:
    """Return all rows of `models` (at least one, all lite or all full) in one model."""
    if len({model.variant for model in models}) != 1:
        raise ValueError("only models of one variant can be joined")
    return SpacetimeGaussians(**{name: np.concatenate([getattr(model, name) for model in models]) for name in ROWS})


def sigmoid(values: NDArray[Any]) -> NDArray[Any]:
    """Return 1 / (1 + e⁻ˣ), without overflow."""
    return 0.5 * (1.0 + np.tanh(0.5 * values))


def logit(values: NDArray[Any]) -> NDArray[Any]:
    """Return the inverse of `sigmoid`, for values inside (0, 1)."""
    return np.log(values) - np.log1p(-values)
