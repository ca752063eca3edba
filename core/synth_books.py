# SPDX-License-Identifier: GPL-3.0-or-later
"""The job of a synthesis, and the books on its folder: which file belongs to which view, and what is done."""

import hashlib
import json
import os
import shutil
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .camera import Camera
from .capture import Capture, View, read_points, write_points
from .capture.images import read_depth, read_picture, write_depth
from .capture.seeding import merge_points, seeds_from_depth
from .errors import HoloreelError
from .files import atomic_path, write_json
from .rig import MAX_CAMERAS, PRESETS, RigRequest, camera_name

MAX_FRAMES = 100_000
RECORD = "synth.json"
_VERSION = 1
_FILMS = ("opaque", "transparent")


@dataclass(frozen=True)
class SynthJob:
    """Everything that decides what the capture looks like. `frames` are the first and the last, both included."""

    scene: Path
    rig: RigRequest
    frames: tuple[int, int]
    preset: str = "arc"
    samples: int = 64
    holdout: tuple[int, ...] = (0,)
    film: str = "opaque"
    depth: bool = False
    seed_points: int = 20_000
    denoise: bool = True
    seed: int = 0

    @property
    def frame_count(self) -> int:
        """How many frames are rendered."""
        return self.frames[1] - self.frames[0] + 1

    def check(self) -> None:
        """Raise `HoloreelError` for what cannot be rendered."""
        rig, (first, last) = self.rig, self.frames
        if not self.scene.is_file():
            raise HoloreelError(f"{self.scene} is not there: give a .blend file.")
        if self.preset not in PRESETS:
            raise HoloreelError(f"there is no rig {self.preset!r}; take one of {', '.join(PRESETS)}.")
        if not 1 <= rig.cameras <= MAX_CAMERAS:
            raise HoloreelError(f"--cameras must be 1 to {MAX_CAMERAS}, not {rig.cameras}.")
        if not 0 <= first <= last or self.frame_count > MAX_FRAMES:
            raise HoloreelError(f"--frames {first}:{last} is no range of 1 to {MAX_FRAMES} frames; write FIRST:LAST.")
        if not (8 <= rig.width <= 1 << 14 and 8 <= rig.height <= 1 << 14):
            raise HoloreelError(f"--size {rig.width}x{rig.height} must lie between 8 and {1 << 14} pixels a side.")
        if not 1 <= self.samples <= 1 << 20:
            raise HoloreelError(f"--samples must be 1 or more, not {self.samples}.")
        if self.film not in _FILMS:
            raise HoloreelError(f"--film must be one of {', '.join(_FILMS)}, not {self.film!r}.")
        if self.seed_points < 0:
            raise HoloreelError(f"--seed-points must be 0 or more, not {self.seed_points}.")
        if wrong := [index for index in self.holdout if not 0 <= index < rig.cameras]:
            raise HoloreelError(f"--holdout {wrong[0]} is no camera: they are 0 to {rig.cameras - 1}.")
        if len(set(self.holdout)) == rig.cameras:
            raise HoloreelError("--holdout leaves no camera to train with: hold out fewer, or take more --cameras.")

    def to_json(self) -> dict[str, Any]:
        """The job as what decides it: the scene by its content."""
        value = asdict(self) | {"scene": self.scene.name, "scene_sha256": _digest(self.scene)}
        return plain(value)


@dataclass
class Books:
    """What is where, and what is done."""

    job: SynthJob
    out: Path
    cameras: list[Camera] = field(default_factory=list)
    scene: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def file(self, folder: str, name: str, frame: int, suffix: str) -> Path:
        return self.out / folder / name / f"{self.job.frames[0] + frame:06d}{suffix}"

    def image(self, view: View) -> Path:
        return self.file("images", *view, ".png")

    def depth(self, view: View) -> Path:
        return self.file("depth", *view, ".exr")

    def part(self, view: View) -> Path:
        """Seed points of one view, until those of the frame are complete."""
        return self.file(".work", *view, ".ply")

    def seeds(self, frame: int) -> Path:
        return self.file("seeds", "", frame, ".ply")

    def camera_names(self) -> list[str]:
        count = self.job.rig.cameras
        return [camera_name(index, count) for index in range(count)]

    def training_names(self) -> list[str]:
        return [name for index, name in enumerate(self.camera_names()) if index not in self.job.holdout]

    def views(self) -> list[View]:
        """All views, all cameras of a frame before the next frame."""
        return [(name, frame) for frame in range(self.job.frame_count) for name in self.camera_names()]

    def is_done(self, view: View) -> bool:
        """Whether a view has all its files, whole."""
        width, height = self.job.rig.width, self.job.rig.height
        try:
            read_picture(self.image(view), width, height)
            if self.job.depth:
                read_depth(self.depth(view), width, height)
            if self._gives_seeds(view) and not self.seeds(view[1]).is_file():
                read_points(self.part(view))
        except HoloreelError:
            return False
        return True

    def _gives_seeds(self, view: View) -> bool:
        return self.job.seed_points > 0 and view[0] in self.training_names()

    def take(self, view: View, picture_file: Path, layers_file: Path | None) -> None:
        """Take a view that Blender rendered into the capture."""
        camera = self.cameras[self.camera_names().index(view[0])]
        picture = read_picture(picture_file, camera.width, camera.height)
        if (picture[..., :3] == picture[0, 0, :3]).all():
            self.warnings.append(f"{view[0]} sees a single color at frame {self.job.frames[0] + view[1]}")
        if layers_file:
            depth = read_depth(layers_file, camera.width, camera.height)
            if self.job.depth:
                write_depth(self.depth(view), depth)
            if self._gives_seeds(view) and not self.seeds(view[1]).is_file():
                rng = np.random.default_rng((self.job.seed, view[1], self.camera_names().index(view[0])))
                share = -(-self.job.seed_points // len(self.training_names()))
                write_points(self.part(view), seeds_from_depth(camera, picture, depth, share, rng))
            layers_file.unlink()
        with atomic_path(self.image(view)) as temporary:
            os.replace(picture_file, temporary)
        self.merge_seeds(view[1])

    def merge_seeds(self, frame: int) -> None:
        """Put a frame's seed points together once all its training cameras gave theirs."""
        parts = [self.part((name, frame)) for name in self.training_names()]
        if self.job.seed_points and not self.seeds(frame).is_file() and all(part.is_file() for part in parts):
            write_points(self.seeds(frame), merge_points(read_points(part) for part in parts))
            for part in parts:
                part.unlink()

    def capture(self) -> Capture:
        job, views = self.job, self.views()
        names = self.camera_names()
        box = self.scene.get("bounds")
        return Capture(
            cameras=dict(zip(names, self.cameras, strict=True)),
            images={view: self.image(view) for view in views},
            frame_count=job.frame_count,
            splits={names[index]: "test" for index in job.holdout},
            fps=self.scene["fps"],
            frame_start=job.frames[0],
            depths={view: self.depth(view) for view in views} if job.depth else {},
            seeds={frame: self.seeds(frame) for frame in range(job.frame_count)} if job.seed_points else {},
            bounds=(tuple(box[0]), tuple(box[1])) if box else None,
            source=self.out / "transforms.json",
        )

    def save(self) -> None:
        cameras = [camera.to_json() for camera in self.cameras]
        write_json(
            self.out / RECORD,
            {"version": _VERSION, "job": self.job.to_json(), "scene": self.scene, "cameras": cameras},
        )

    def remove_results(self) -> None:
        """Delete the files that a job in this folder made, and no others."""
        (self.out / "transforms.json").unlink(missing_ok=True)
        shutil.rmtree(self.out / ".work", ignore_errors=True)
        for view in self.views():
            self.image(view).unlink(missing_ok=True)
            self.depth(view).unlink(missing_ok=True)
            self.seeds(view[1]).unlink(missing_ok=True)


def plain(value: dict[str, Any]) -> dict[str, Any]:
    """The same value as JSON gives it back: lists for tuples, text for paths."""
    return json.loads(json.dumps(value, default=str))


def _digest(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
