# SPDX-License-Identifier: GPL-3.0-or-later
"""A training run on disk: checkpoints, resuming, and the reel it ends in."""

import pickle
import platform
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from types import ModuleType

import numpy as np
import torch

from ..capture import Capture
from ..errors import HoloreelError
from ..files import atomic_path, write_json
from ..reel import save_gaussians
from .config import TrainConfig
from .train import Progress, Trainer


@dataclass(frozen=True)
class RunPaths:
    """The files of a run, all beside the reel and named after it."""

    reel: Path

    @property
    def checkpoint(self) -> Path:
        """Where a stopped run goes on."""
        return self.reel.with_suffix(".checkpoint.pt")

    @property
    def record(self) -> Path:
        """What was trained how: configuration, versions, loss over time."""
        return self.reel.with_suffix(".train.json")


def train_reel(
    capture: Capture,
    out: Path,
    config: TrainConfig,
    backend: ModuleType,
    on_progress: Callable[[Progress], None],
    resume: bool = False,
) -> Trainer:
    """Train a reel from a capture and write it to `out` (a `.reel` path).

    Every `config.checkpoint_every` iterations, and when interrupted, the state is saved beside `out`; with `resume` the
    run goes on from there.
    Raises `HoloreelError` if `out` cannot be written or the checkpoint belongs to other settings.
    """
    if out.suffix != ".reel":
        raise HoloreelError(f"{out}: a reel's name ends in .reel; pass --out {out}.reel.")
    paths = RunPaths(out)
    _claim_folder(out.parent)
    if paths.checkpoint.exists() and not resume:
        raise HoloreelError(
            f"{paths.checkpoint}: a stopped run lies here; pass --resume to go on, or delete it to start anew."
        )
    trainer = Trainer(capture, config, backend)
    if resume:
        _resume(trainer, paths.checkpoint)
    try:
        while trainer.iteration < config.iterations:
            trainer.run(on_progress, until=trainer.iteration + config.checkpoint_every)
            if trainer.iteration < config.iterations:
                save_checkpoint(trainer, paths.checkpoint)
    except KeyboardInterrupt:
        save_checkpoint(trainer, paths.checkpoint)
        raise
    _write_result(trainer, paths)
    paths.checkpoint.unlink(missing_ok=True)
    return trainer


def _claim_folder(folder: Path) -> None:
    """Make sure that the result can be written before hours are spent on it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".holoreel-write-test"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise HoloreelError(f"{folder}: cannot write here ({error.strerror}); choose another --out.") from error


def save_checkpoint(trainer: Trainer, path: Path) -> None:
    """Write the trainer's state; an older checkpoint stays whole until the new one is."""
    with atomic_path(path) as temporary:
        torch.save(trainer.state(), temporary)


def _resume(trainer: Trainer, path: Path) -> None:
    if not path.exists():
        raise HoloreelError(f"{path}: no checkpoint to resume from; leave --resume away to start anew.")
    try:
        state = torch.load(path, weights_only=True)
    except (OSError, RuntimeError, ValueError, EOFError, pickle.UnpicklingError) as error:
        raise HoloreelError(f"{path}: not a readable checkpoint; delete it and train anew.") from error
    changed = _differences(state.get("config", {}), asdict(trainer.config))
    if changed:
        raise HoloreelError(f"{path}: was written with another {', '.join(changed)}; pass the same settings to resume.")
    trainer.load_state(state)


def _differences(old: Mapping, new: Mapping, prefix: str = "") -> list[str]:
    """Name the settings that two (nested) configurations do not share."""
    names = []
    for key in sorted(old.keys() | new.keys()):
        a, b = old.get(key), new.get(key)
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            names += _differences(a, b, f"{prefix}{key}.")
        elif _plain(a) != _plain(b) and key != "checkpoint_every":
            names.append(f"{prefix}{key}")
    return names


def _plain(value: object) -> object:
    return list(value) if isinstance(value, tuple | list) else value


def _write_result(trainer: Trainer, paths: RunPaths) -> None:
    write_json(paths.record, _record(trainer))
    save_gaussians(
        paths.reel,
        trainer.gaussians(),
        fps=trainer.capture.fps,
        frame_start=trainer.capture.frame_start,
        frame_count=trainer.capture.frame_count,
        up="Z",
        background=trainer.config.background,
        files={"config": paths.record.name},
        provenance={"capture": _capture_name(trainer), "iterations": trainer.iteration},
    )


def _capture_name(trainer: Trainer) -> str:
    return trainer.capture.source.resolve().parent.name


def _record(trainer: Trainer) -> dict[str, object]:
    return {
        "config": asdict(trainer.config),
        "capture": _capture_name(trainer),
        "train_cameras": trainer.capture.camera_names("train"),
        "gaussians": len(trainer.parameters),
        "seconds": round(trainer.seconds, 2),
        "versions": {"python": platform.python_version(), "torch": torch.__version__, "numpy": np.__version__},
        "history": [dict(zip(("iteration", "loss", "psnr", "gaussians"), row, strict=True)) for row in trainer.history],
    }
