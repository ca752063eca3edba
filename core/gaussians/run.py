# SPDX-License-Identifier: GPL-3.0-or-later
"""A training run on disk: segment after segment, checkpoints, resuming, and the reel it ends in."""

import platform
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch

from ..capture import Capture
from ..errors import HoloreelError
from ..files import atomic_path, write_json
from ..reel import Reel, SegmentPayload, write_segments
from ..runs import claim_run, differences
from .config import TrainConfig
from .decoder import Decoder
from .model import ROWS, SpacetimeGaussians
from .segments import SegmentPlan, inherited, plan_segments, to_played, warm_seeds
from .train import Progress, Trainer


@dataclass(frozen=True)
class RunPaths:
    """The files of a run, all beside the reel and named after it."""

    reel: Path

    @property
    def checkpoint(self) -> Path:
        """Folder of a run that is not finished: where it stands, and the segments it has finished."""
        return self.reel.with_suffix(".checkpoint")

    @property
    def state(self) -> Path:
        """The state of the segment that was being trained."""
        return self.checkpoint / "state.pt"

    def segment(self, index: int) -> Path:
        """A finished segment."""
        return self.checkpoint / f"segment_{index:03d}.pt"

    @property
    def record(self) -> Path:
        """What was trained how: configuration, versions, loss over time."""
        return self.reel.with_suffix(".train.json")


@dataclass(frozen=True)
class Trained:
    """What a run made: the reel, its number of Gaussians in all segments, and the seconds spent training."""

    reel: Reel
    gaussians: int
    seconds: float


@dataclass(frozen=True)
class _Finished:
    """A segment that is done: what is played, what the next one inherits, and what the record says."""

    payload: SegmentPayload
    static: SpacetimeGaussians
    record: dict[str, Any]


def train_reel(
    capture: Capture,
    out: Path,
    config: TrainConfig,
    backend: ModuleType,
    on_progress: Callable[[Progress], None],
    resume: bool = False,
) -> Trained:
    """Train a reel from a capture and write it to `out` (a `.reel` path).

    Every `config.checkpoint_every` iterations, and when interrupted, the state is saved beside `out`; with `resume` the
    run goes on from there. `on_progress` hears of all segments as one long run.
    Raises `HoloreelError` if `out` cannot be written or the checkpoint belongs to other settings.
    """
    paths = RunPaths(out)
    claim_run(out, paths.checkpoint, resume)
    plans = plan_segments(capture.frame_count, config.segment, config.overlap)
    finished: list[_Finished] = []
    for plan in plans:
        done = _load_segment(paths.segment(plan.index), config) if resume else None
        if done is None:
            trainer = _trainer(capture, plan, config, backend, finished[-1] if finished else None)
            if resume and paths.state.exists():
                _resume(trainer, plan, paths.state)
            _train_segment(trainer, plan, len(plans), paths, on_progress)
            done = _finish(trainer, plan, capture)
            if len(plans) > 1:
                _save_segment(paths.segment(plan.index), done, config)
                paths.state.unlink(missing_ok=True)
        finished.append(done)
    reel = _write_result(capture, config, finished, paths)
    shutil.rmtree(paths.checkpoint, ignore_errors=True)
    return Trained(
        reel, sum(len(done.payload.gaussians) for done in finished), sum(done.record["seconds"] for done in finished)
    )


def _trainer(
    capture: Capture, plan: SegmentPlan, config: TrainConfig, backend: ModuleType, before: _Finished | None
) -> Trainer:
    part = capture.frames(plan.train_start, plan.train_count)
    if before is None or not config.share_static:
        return Trainer(part, config, backend)
    points = [part.seed_points(frame) for frame in range(part.frame_count)]
    seeds = warm_seeds(points, before.static, config, np.random.default_rng([config.seed, plan.index]))
    return Trainer(part, config, backend, seeds=seeds, decoder=before.payload.decoder, inherited=len(before.static))


def _train_segment(
    trainer: Trainer, plan: SegmentPlan, segments: int, paths: RunPaths, on_progress: Callable[[Progress], None]
) -> None:
    iterations = trainer.config.iterations

    def tell(progress: Progress) -> None:
        left = progress.seconds_left + (segments - plan.index - 1) * iterations * trainer.seconds / progress.iteration
        on_progress(
            replace(
                progress,
                iteration=plan.index * iterations + progress.iteration,
                iterations=segments * iterations,
                seconds_left=left,
            )
        )

    try:
        while trainer.iteration < iterations:
            trainer.run(tell, until=trainer.iteration + trainer.config.checkpoint_every)
            if trainer.iteration < iterations:
                save_checkpoint(trainer, plan, paths.state)
    except KeyboardInterrupt:
        save_checkpoint(trainer, plan, paths.state)
        raise


def _finish(trainer: Trainer, plan: SegmentPlan, capture: Capture) -> _Finished:
    gaussians = trainer.gaussians()
    payload = SegmentPayload(
        to_played(gaussians, plan), trainer.decoder(), capture.frame_start + plan.start, plan.count
    )
    record = {
        "frame_start": payload.frame_start,
        "frame_count": payload.frame_count,
        "gaussians": len(gaussians),
        "near": trainer.rules.near,
        "seconds": round(trainer.seconds, 2),
        "history": [list(row) for row in trainer.history],
    }
    return _Finished(payload, inherited(gaussians, trainer.scene.footprint, trainer.config), record)


def save_checkpoint(trainer: Trainer, plan: SegmentPlan, path: Path) -> None:
    """Write the trainer's state; an older checkpoint stays whole until the new one is."""
    path.parent.mkdir(exist_ok=True)
    with atomic_path(path) as temporary:
        torch.save({"segment": plan.index, **trainer.state()}, temporary)


def _resume(trainer: Trainer, plan: SegmentPlan, path: Path) -> None:
    state = _load(path, trainer.config)
    if state.get("segment") != plan.index:
        raise HoloreelError(f"{path}: is not of segment {plan.index}; delete {path.parent} and train anew.")
    trainer.load_state(state)


def _save_segment(path: Path, done: _Finished, config: TrainConfig) -> None:
    path.parent.mkdir(exist_ok=True)
    payload = done.payload
    decoder = payload.decoder
    with atomic_path(path) as temporary:
        torch.save(
            {
                "config": asdict(config),
                "gaussians": _tensors(payload.gaussians),
                "static": _tensors(done.static),
                "decoder": None
                if decoder is None
                else {
                    "hidden": torch.from_numpy(decoder.hidden),
                    "output": torch.from_numpy(decoder.output),
                    "activation": decoder.activation,
                },
                "record": done.record,
            },
            temporary,
        )


def _load_segment(path: Path, config: TrainConfig) -> _Finished | None:
    if not path.exists():
        return None
    state = _load(path, config)
    decoder = state["decoder"] and Decoder(
        state["decoder"]["hidden"].numpy(), state["decoder"]["output"].numpy(), state["decoder"]["activation"]
    )
    record = state["record"]
    payload = SegmentPayload(
        _gaussians(state["gaussians"]), decoder or None, record["frame_start"], record["frame_count"]
    )
    return _Finished(payload, _gaussians(state["static"]), record)


def _load(path: Path, config: TrainConfig) -> dict[str, Any]:
    """Read a checkpoint and make sure that it belongs to these settings."""
    try:
        state = torch.load(path, weights_only=True)
    except Exception as error:  # the unpickler raises what it likes
        raise HoloreelError(f"{path}: not a readable checkpoint; delete {path.parent} and train anew.") from error
    changed = differences(state.get("config", {}), asdict(config), ("checkpoint_every",))
    if changed:
        raise HoloreelError(f"{path}: was written with another {', '.join(changed)}; pass the same settings to resume.")
    return state


def _tensors(gaussians: SpacetimeGaussians) -> dict[str, torch.Tensor]:
    return {name: torch.from_numpy(getattr(gaussians, name)) for name in ROWS}


def _gaussians(tensors: Mapping[str, torch.Tensor]) -> SpacetimeGaussians:
    return SpacetimeGaussians(**{name: tensors[name].numpy() for name in ROWS})


def _write_result(capture: Capture, config: TrainConfig, finished: list[_Finished], paths: RunPaths) -> Reel:
    name = capture.name
    write_json(paths.record, _record(capture, config, finished, name))
    return write_segments(
        paths.reel,
        [done.payload for done in finished],
        fps=capture.fps,
        frame_start=capture.frame_start,
        up="Z",
        background=config.background,
        viewpoint=_middle_of(capture),
        near=min(done.record["near"] for done in finished),
        files={"config": paths.record.name},
        provenance={"capture": name, "iterations": config.iterations},
    )


def _middle_of(capture: Capture) -> tuple[float, float, float]:
    """Return where the training camera stands that is nearest to the mean of all."""
    centers = np.stack([capture.cameras[name].center for name in capture.camera_names("train")])
    x, y, z = centers[np.linalg.norm(centers - centers.mean(axis=0), axis=1).argmin()].tolist()
    return x, y, z


def _record(capture: Capture, config: TrainConfig, finished: list[_Finished], name: str) -> dict[str, object]:
    columns = ("iteration", "loss", "psnr", "gaussians")
    history = [
        dict(zip(columns, (index * config.iterations + row[0], *row[1:]), strict=True))
        for index, done in enumerate(finished)
        for row in done.record["history"]
    ]
    segments = [{key: value for key, value in done.record.items() if key != "history"} for done in finished]
    return {
        "config": asdict(config),
        "capture": name,
        "train_cameras": capture.camera_names("train"),
        "gaussians": sum(segment["gaussians"] for segment in segments),
        "seconds": round(sum(segment["seconds"] for segment in segments), 2),
        "segments": segments,
        "versions": {"python": platform.python_version(), "torch": torch.__version__, "numpy": np.__version__},
        "history": history,
    }
