# SPDX-License-Identifier: GPL-3.0-or-later
"""Quality over bytes of VideoRF: the whole method, without single parts (the paper's Fig. 7), and beyond the paper.

Every row of the table is a variant with a ladder of constant-QP rungs, measured on the views held out, from what a
player decodes; every byte that it fetches counts. Rows are compared by BD-rate, the bytes at equal quality. Trainings
lie in OUT/trainings, rows in OUT/rows; what is finished is kept as long as settings and capture are the same.
"""

import hashlib
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from ..capture import Capture, read_capture
from ..draw import Drawing
from ..errors import HoloreelError
from ..files import read_json, write_json
from ..images import picture_path, write_png
from ..videorf.codec import CODECS
from ..videorf.config import VideoConfig
from ..videorf.model import FieldVideo, read_field_video
from ..videorf.run import RunPaths, VideoProgress, train_video
from .ablation import fingerprint, plain
from .bdrate import Point, RateChange, bd_rate
from .coding import coded_rungs, measure, measure_model
from .variants import FULL, Variant, find_variant, training_of

COARSE_FIELDS = ("coarse", "resolution", "coarse_share", "gamma", "weight_share", "border", "seed")

TOP_QP = 20

OnProgress = Callable[[str, int, int], None]  # what is worked on, what is done of it, and all of it


@dataclass(frozen=True)
class Training:
    """A trained model, and how many seconds each stage took."""

    model: FieldVideo
    seconds: dict[str, float]


@dataclass(frozen=True)
class Finished:
    """A row that was coded and measured.

    `rungs` have `qp`, `size` (as `videorf.encode.Size`) and `scores`, from the best down; `model` are the scores before
    coding, `groups` the frames and vertices of each group, `seconds` those of the
    training behind the coarse stage, which rows share. Scores are the parts of
    `core.evaluate.evaluate_player` that `coding.MEASURES` names.
    """

    variant: Variant
    rungs: list[dict[str, Any]]
    model: dict[str, Any]
    groups: list[list[int]]
    seconds: float

    @property
    def top(self) -> dict[str, Any]:
        """The rung that is spoken of as the video's quality: that of `TOP_QP`, else the best."""
        return next((rung for rung in self.rungs if rung["qp"] == TOP_QP), self.rungs[0])

    @property
    def frames(self) -> int:
        """How many frames there are."""
        return sum(frames for frames, _ in self.groups)

    def curve(self, measure: str) -> list[Point]:
        """Return kB per frame and a measure of every rung: decibels are those of the mean squared error."""
        return [Point(rung["size"]["per_frame"] / 1000, score(rung["scores"], measure)) for rung in self.rungs]


def score(scores: dict[str, Any], measure: str) -> float:
    """Return a measure over all pictures: decibels of the mean squared error, the mean of anything else."""
    return float(scores["pooled"].get(measure, scores["mean"].get(measure)))


def compare(reference: Finished, other: Finished, measure: str) -> RateChange | None:
    """Return how much more bytes a row takes than another one at equal quality, None where their curves do not meet."""
    return bd_rate(reference.curve(measure), other.curve(measure))


@dataclass(frozen=True)
class VideoBench:
    """A bench on one capture: where things lie, and the settings that variants change."""

    capture: Capture
    out: Path
    base: VideoConfig
    on_progress: OnProgress = lambda what, done, total: None

    def row(self, variant: Variant) -> Finished:
        """Return a row: measured, or read where it is finished already."""
        folder = self.out / "rows" / variant.key
        path = folder / "row.json"
        coder = CODECS[variant.how.codec].options
        made_of = self._made_of(variant.config(self.base)) | {"coding": plain(asdict(variant.how)), "coder": coder}
        record = _record(path, made_of)
        if "rungs" not in record:
            record |= self._measured(variant, self.training(variant), folder)
            write_json(path, record)
        return Finished(variant, record["rungs"], record["model"], record["groups"], record["seconds"])

    def training(self, variant: Variant) -> Training:
        """Return the model that a variant codes: trained, gone on with, or read."""
        name = training_of(variant)
        config = replace(find_variant(name).config(self.base), qps=self.base.qps[-1:])  # the bench has its own rungs
        paths = RunPaths(self.out / "trainings" / name / "model.reel")
        record_path = paths.reel.with_name("training.json")
        record = _record(record_path, self._made_of(config))
        if "seconds" not in record:
            if not record_path.is_file() or read_json(record_path) != record:
                shutil.rmtree(paths.reel.parent, ignore_errors=True)
                write_json(record_path, record)
            trained = train_video(
                self.capture,
                paths.reel,
                config,
                lambda now: self._heard(name, now),
                resume=paths.checkpoint.exists(),
                coarse=self._coarse(config),
            )
            record["seconds"] = {stage: round(seconds, 1) for stage, seconds in trained.seconds.items()}
            write_json(record_path, record)
        return Training(read_field_video(paths.model), record["seconds"])

    def _made_of(self, config: VideoConfig) -> dict[str, Any]:
        return {"config": plain(asdict(config)), "capture": self.digest}

    @property
    def digest(self) -> str:
        """What tells captures apart."""
        return fingerprint(self.capture)

    def _coarse(self, config: VideoConfig) -> Path:
        """Return the folder of coarse fields that all trainings with the same coarse stage share."""
        told = {name: value for name, value in plain(asdict(config)).items() if name in COARSE_FIELDS}
        return self.out / "coarse" / hashlib.sha256(f"{self.digest} {told}".encode()).hexdigest()[:12]

    def _heard(self, name: str, now: VideoProgress) -> None:
        self.on_progress(f"{name}: {now.stage}, frame {now.frame}", now.iteration, now.iterations)

    def _measured(self, variant: Variant, training: Training, folder: Path) -> dict[str, Any]:
        model, qps = training.model, variant.how.qps
        rungs: list[dict[str, Any]] = []
        for qp, size, player in coded_rungs(model, variant.how, folder / "row.reel"):
            self.on_progress(f"{variant.key}: QP {qp}", len(rungs), len(qps))
            shown = qp == qps[len(qps) // 2]
            scores = measure(player, self.capture, on_picture=_keeper(folder) if shown else None)
            rungs.append({"qp": qp, "size": size._asdict(), "scores": scores})
        return {
            "rungs": rungs,
            "model": measure_model(model, self.capture),
            "groups": [[group.count, table.count] for group, table in zip(model.groups, model.tables, strict=True)],
            "seconds": sum(training.seconds.get(stage, 0.0) for stage in ("shading", "frames")),
        }


def _record(path: Path, made_of: dict[str, Any]) -> dict[str, Any]:
    """Return what a file holds, or what it is made of alone where it was made of something else."""
    record = read_json(path) if path.is_file() else {}
    return record if {key: record.get(key) for key in made_of} == made_of else dict(made_of)


def _keeper(folder: Path) -> Callable[[str, int, Drawing], None]:
    return lambda camera, frame, drawing: write_png(picture_path(folder, camera, frame), drawing.image)


def run_videorf(
    scene: Path, out: Path, base: VideoConfig, names: Sequence[str], on_progress: OnProgress
) -> dict[str, Finished]:
    """Make all rows named, and the full method's that all are compared with; return them by key.

    Raises `HoloreelError` where a row is unknown, or the capture has no camera held out.
    """
    variants = {variant.key: variant for variant in map(find_variant, (FULL, *names))}
    capture = read_capture(scene)
    if not capture.views("test"):
        raise HoloreelError(
            f"{scene}: every camera is trained on; hold one out, so that there is something to measure."
        )
    bench = VideoBench(capture, out, base, on_progress)
    return {key: bench.row(variant) for key, variant in variants.items()}
