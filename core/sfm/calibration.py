# SPDX-License-Identifier: GPL-3.0-or-later
"""Does the calibration of each camera agree with what the pictures say?

Matches are found without regard to the poses, so they can contradict them. Each pair of cameras is asked how far its
matches lie from each other's epipolar plane, and each three cameras how far the point that fits their rays best misses
one of them (which also finds a camera that is turned along its epipolar lines). One camera that stands elsewhere than
its calibration says spoils every pair and triple it is part of, and no other: it is named.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..errors import HoloreelError
from .jobs import Found

Triple = tuple[int, int, int]
Members = tuple[int, int] | Triple
Array = NDArray[np.float64]

MIN_PIXELS = 1.5
MIN_DIAGONAL_SHARE = 0.002  # of a picture's diagonal: 3 px of 1280 x 720
TIMES_TYPICAL = 4.0  # a contradiction is this much larger than what the best pairs and triples show,
TIMES_FLOOR = 2.5  # though never more than this much larger than the least that counts: all may be wrong

_MIN_MATCHES = 15  # for a pair or a triple to have a say
_MIN_EVIDENCE = 100  # bad matches, with two other cameras, that it takes to accuse one: chance finds a few that agree
_MAX_SAMPLE = 300  # matches of one pair or triple of one frame
_MAX_TRIPLES = 1500
_MIN_RAY_ANGLE = np.radians(1.0)


@dataclass(frozen=True)
class CameraCheck:
    """What the matches say about one camera."""

    name: str
    residual_px: float | None  # median over its pairs and triples; None where it has no matches
    inlier_ratio: float | None  # of its matches, those within the limit
    matches: int
    contradicts: bool

    def to_json(self) -> dict[str, object]:
        """The entry of sfm.json."""
        return {
            "name": self.name,
            "residual_px": None if self.residual_px is None else round(self.residual_px, 3),
            "inlier_ratio": None if self.inlier_ratio is None else round(self.inlier_ratio, 3),
            "matches": self.matches,
        }


class CalibrationCheck:
    """Collects residuals of several frames of the same cameras, and judges."""

    def __init__(self, cameras: Sequence[Camera]) -> None:
        self._cameras = list(cameras)
        self._residuals: dict[Members, list[Array]] = {}
        self._matches = np.zeros(len(cameras), np.int64)

    def add(self, found: Found) -> None:
        """Add one frame's matches."""
        rays = [camera.rays(found.keypoints[index])[1] for index, camera in enumerate(self._cameras)]
        for (a, b), matches in found.matches.items():
            self._matches[[a, b]] += len(matches)
            self._put((a, b), self._pair(a, b, rays[a][matches[:, 0]], rays[b][matches[:, 1]]))
        partners = {pair: _partners(matches, len(rays[pair[0]])) for pair, matches in found.matches.items()}
        for triple in _triples(partners, len(self._cameras)):
            rows = _seen_by_three(triple, partners)
            rows = rows[:: max(len(rows) // _MAX_SAMPLE, 1)]
            if len(rows):
                self._put(triple, self._triple(triple, [rays[c][rows[:, k]] for k, c in enumerate(triple)]))

    def judge(self) -> list[CameraCheck]:
        """Return what the matches so far say about each camera, in order."""
        tests = {members: np.concatenate(parts) for members, parts in self._residuals.items()}
        tests = {members: values for members, values in tests.items() if len(values) >= _MIN_MATCHES}
        medians = {members: float(np.median(values)) for members, values in tests.items()}
        limit = self._limit(medians)
        suspects = _contradictions(medians, limit, len(self._cameras))
        wrong = {index for index in suspects if self._evident(index, tests, limit)}
        checks = []
        for index, camera in enumerate(self._cameras):
            others = [set(members) - {index} for members in medians]
            mine = [
                m
                for m, rest in zip(medians, others, strict=True)
                if index in m and (index in wrong or not rest & wrong)
            ]
            pairs = [tests[members] for members in mine if len(members) == 2]
            every = np.concatenate(pairs) if pairs else np.empty(0)
            checks.append(
                CameraCheck(
                    camera.name,
                    float(np.median([medians[members] for members in mine])) if mine else None,
                    float(np.mean(every <= limit)) if len(every) else None,
                    int(self._matches[index]),
                    index in wrong,
                )
            )
        return checks

    def _evident(self, index: int, tests: dict[Members, Array], limit: float) -> bool:
        """Whether enough matches speak against a camera: one pair of pictures may have been matched wrongly."""
        bad = {members: values for members, values in tests.items() if index in members and np.median(values) > limit}
        partners = {other for members in bad for other in members} - {index}
        enough = sum(map(len, bad.values())) >= _MIN_EVIDENCE
        return enough and len(partners) >= min(2, len(self._cameras) - 1)

    def _put(self, members: Members, residuals: Array) -> None:
        residuals = residuals[np.isfinite(residuals)]
        self._residuals.setdefault(members, []).append(residuals[:: max(len(residuals) // _MAX_SAMPLE, 1)])

    def _limit(self, medians: dict[Members, float]) -> float:
        diagonals = [float(np.hypot(camera.width, camera.height)) for camera in self._cameras]
        floor = max(MIN_PIXELS, MIN_DIAGONAL_SHARE * float(np.mean(diagonals)))
        if not medians:
            return floor
        typical = float(np.quantile(list(medians.values()), 0.2, method="lower"))
        return min(max(floor, TIMES_TYPICAL * typical), TIMES_FLOOR * floor)

    def _focal(self, index: int) -> float:
        """Pixels per radian in the middle of a picture."""
        return float(np.sqrt(self._cameras[index].fx * self._cameras[index].fy))

    def _pair(self, a: int, b: int, rays_a: Array, rays_b: Array) -> Array:
        """How far matches miss each other's epipolar plane, the mean of both pictures, in pixels."""
        baseline = self._cameras[b].center - self._cameras[a].center
        length = np.linalg.norm(baseline)
        if length < 1e-9:
            return np.empty(0)
        normal_a, normal_b = np.cross(baseline / length, rays_a), np.cross(baseline / length, rays_b)
        sine_a, sine_b = np.linalg.norm(normal_a, axis=1), np.linalg.norm(normal_b, axis=1)
        usable = (sine_a > _MIN_RAY_ANGLE) & (sine_b > _MIN_RAY_ANGLE)  # others look along the baseline
        in_b = np.abs(np.einsum("ij,ij->i", normal_a, rays_b))[usable] / sine_a[usable]
        in_a = np.abs(np.einsum("ij,ij->i", normal_b, rays_a))[usable] / sine_b[usable]
        return (np.arcsin(np.minimum(in_a, 1)) * self._focal(a) + np.arcsin(np.minimum(in_b, 1)) * self._focal(b)) / 2

    def _triple(self, triple: Members, rays: list[Array]) -> Array:
        """The largest of three distances between ray and best point, in pixels."""
        centers = np.array([self._cameras[index].center for index in triple])
        focals = np.array([self._focal(index) for index in triple])
        directions = np.stack(rays, axis=1)  # (N, 3 cameras, 3)
        cosines = [np.einsum("ij,ij->i", directions[:, k], directions[:, k - 1]) for k in range(3)]
        wide = np.min(cosines, axis=0) < np.cos(_MIN_RAY_ANGLE)
        directions = directions[wide]
        if not len(directions):
            return np.empty(0)
        across = np.eye(3) - directions[..., :, None] * directions[..., None, :]  # off the ray
        weights = np.broadcast_to(focals**2, directions.shape[:2])
        for _ in range(3):  # distances in pixels need to know how far the point is
            matrix = np.einsum("nk,nkij->nij", weights, across)
            right = np.einsum("nk,nkij,kj->ni", weights, across, centers)
            points = np.linalg.solve(matrix, right[..., None])[..., 0]
            to_points = points[:, None] - centers
            distances = np.maximum(np.linalg.norm(to_points, axis=2), 1e-12)
            weights = (focals / distances) ** 2
        cosine = np.einsum("nki,nki->nk", to_points, directions) / distances
        return np.asarray((np.arccos(np.clip(cosine, -1, 1)) * focals).max(axis=1))


def refuse_contradictions(checks: Iterable[CameraCheck], source: object) -> None:
    """Raise `HoloreelError` naming the cameras whose calibration contradicts the others, with the figures."""
    checks = list(checks)
    wrong = [check for check in checks if check.contradicts]
    if not wrong:
        return
    names = " ".join(check.name for check in wrong)
    if len(wrong) == len(checks):
        listed = ", ".join(repr(check.name) for check in wrong)
        figures = f"matches of cameras {listed} miss each other by {_px(wrong)} (median)"
        raise HoloreelError(
            f"{source}: {figures}, so at least one of them is not where its calibration says; calibrate them again."
        )
    facts = "; ".join(
        f"camera {check.name!r} misses the others' matches by {_px([check])} (median) and {_percent(check)} of its "
        "matches fit" for check in wrong
    )  # fmt: skip
    rest = [check for check in checks if not check.contradicts and check.residual_px is not None]
    others = f", while the others agree within {_px(rest)}" if rest else ""
    it, its = ("it", "its calibration") if len(wrong) == 1 else ("them", "their calibrations")
    raise HoloreelError(
        f"{source}: {facts}{others}: {its} must be wrong; calibrate {it} again, or leave {it} out with "
        f"--without {names}."
    )


def _px(checks: Sequence[CameraCheck]) -> str:
    return f"{max(check.residual_px or 0.0 for check in checks):.1f} px"


def _percent(check: CameraCheck) -> str:
    return f"{100 * (check.inlier_ratio or 0.0):.0f} %"


def _contradictions(medians: dict[Members, float], limit: float, count: int) -> set[int]:
    """Take away the camera that has most part in what is wrong, until the rest agrees."""
    wrong: set[int] = set()
    while len(wrong) < count:
        tests = {members: value for members, value in medians.items() if not wrong & set(members)}
        blame = {index: _blame(index, tests, limit) for index in range(count) if index not in wrong}
        worst = max(blame.values())
        if worst[0] <= 0.5:
            return wrong
        guilty = [index for index, value in blame.items() if value[:2] == worst[:2]]
        involved = {index for members in tests for index in members}
        if set(guilty) >= involved:  # each is as likely as the others
            return wrong | set(guilty)
        wrong.add(max(guilty, key=lambda index: blame[index]))
    return wrong


def _blame(index: int, tests: dict[Members, float], limit: float) -> tuple[float, float, float]:
    """The larger share of bad pairs and bad triples among one camera's, their sum, and the median residual."""
    shares = []
    for size in (2, 3):
        mine = [value > limit for members, value in tests.items() if index in members and len(members) == size]
        shares.append(float(np.mean(mine)) if mine else 0.0)
    values = [value for members, value in tests.items() if index in members]
    return round(max(shares), 6), round(sum(shares), 6), float(np.median(values)) if values else 0.0


def _partners(matches: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """The keypoint that each of `count` keypoints is matched with, -1 where there is none."""
    partners = np.full(count, -1, np.int64)
    partners[matches[:, 0]] = matches[:, 1]
    return partners


def _triples(partners: Mapping[tuple[int, int], NDArray[np.int64]], count: int) -> list[Triple]:
    """The triples of cameras that are matched with each other, or as many of them as there is time for."""
    triples = [
        (a, b, c)
        for a, b, c in combinations(range(count), 3)
        if (a, b) in partners and (a, c) in partners and (b, c) in partners
    ]
    if len(triples) <= _MAX_TRIPLES:
        return triples
    chosen = np.random.default_rng(0).choice(len(triples), _MAX_TRIPLES, replace=False)
    return [triples[index] for index in np.sort(chosen)]


def _seen_by_three(
    triple: tuple[int, int, int], partners: Mapping[tuple[int, int], NDArray[np.int64]]
) -> NDArray[np.int64]:
    """Keypoints (N, 3) of which each is matched with both others: three matches that agree are hardly wrong."""
    a, b, c = triple
    rows = np.flatnonzero((partners[a, b] >= 0) & (partners[a, c] >= 0))
    rows = rows[partners[b, c][partners[a, b][rows]] == partners[a, c][rows]]
    return np.stack([rows, partners[a, b][rows], partners[a, c][rows]], axis=1)
