# SPDX-License-Identifier: GPL-3.0-or-later
"""The folder that a run leaves (its format: `core.capture.sfm_result`), and what of it is still good for the next."""

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from ..camera import Camera
from ..capture import Capture, write_points
from ..capture.sfm_result import FILE_NAME, VERSION
from ..errors import HoloreelError
from ..files import read_json, write_json
from .calibration import CameraCheck
from .jobs import Selection
from .settings import SfmSettings

_CHUNK = 1 << 20


@dataclass(frozen=True)
class FrameResult:
    """One frame done. The means are 0 where there are no points."""

    index: int
    file: str
    points: int
    reprojection_error_px: float
    track_length: float
    seconds: float
    key: str  # of all that the points depend on


@dataclass
class Record:
    """What is in sfm.json."""

    folder: Path
    capture: Capture
    cameras: list[Camera]
    posed_here: bool
    settings: SfmSettings
    frames: dict[int, FrameResult] = field(default_factory=dict)
    checks: list[dict[str, object]] = field(default_factory=list)
    normalization: dict[str, Any] | None = None
    pycolmap: str = ""
    seconds: float = 0.0

    @property
    def path(self) -> Path:
        """sfm.json."""
        return self.folder / FILE_NAME

    def add(self, index: int, chosen: Selection, seconds: float, key: str) -> FrameResult:
        """Write the points of a frame, then note it."""
        digits = max(4, len(str(self.capture.frame_count - 1)))
        count = len(chosen.points)
        result = FrameResult(
            index=index,
            file=f"points_{index:0{digits}d}.ply",
            points=count,
            reprojection_error_px=round(float(chosen.error.mean()), 4) if count else 0.0,
            track_length=round(float(chosen.track_lengths.mean()), 3) if count else 0.0,
            seconds=round(seconds, 2),
            key=key,
        )
        write_points(self.folder / result.file, chosen.points)
        self.frames[index] = result
        self.save()
        return result

    def note_checks(self, checks: Sequence[CameraCheck]) -> None:
        """Keep what was measured about the calibration."""
        self.checks = [check.to_json() for check in checks]

    def save(self) -> None:
        """Write sfm.json, atomically."""
        settings = asdict(self.settings)
        value = {
            "version": VERSION,
            "frame_start": self.capture.frame_start,
            "frame_count": self.capture.frame_count,
            "posed": "sfm" if self.posed_here else "capture",
            "settings": settings | {"without": list(self.settings.without)},
            "software": {"pycolmap": self.pycolmap},
            "seconds": round(self.seconds, 2),
            "normalization": self.normalization,
            "calibration": self.checks,
            "cameras": [camera.to_json() for camera in self.cameras],
            "frames": [asdict(self.frames[index]) for index in sorted(self.frames)],
        }
        write_json(self.path, value)

    def take_over(self, keys: dict[int, str]) -> str:
        """Keep the frames of an earlier run that would come out the same; return why the others would not, or ''.

        `keys` has the key of each frame to do. Files of frames that are not kept are removed.
        """
        if not self.path.is_file():
            return ""
        try:
            before = read_json(self.path)
            found = {int(frame["index"]): FrameResult(**frame) for frame in before["frames"]}
        except (HoloreelError, KeyError, TypeError, ValueError):
            return "sfm.json is damaged"
        self.frames = {
            index: frame
            for index, frame in found.items()
            if keys.get(index) == frame.key and os.path.isfile(self.folder / Path(frame.file).name)
        }
        self.checks = before.get("calibration") or []
        self.pycolmap = str((before.get("software") or {}).get("pycolmap", ""))
        for index, frame in found.items():
            if index not in self.frames:
                (self.folder / Path(frame.file).name).unlink(missing_ok=True)
        lost = [index for index in found if index in keys and index not in self.frames]
        if not lost:
            return ""
        then, now = before.get("settings") or {}, json.loads(json.dumps(asdict(self.settings)))
        changed = [f"{key} was {then.get(key)}, is {value}" for key, value in now.items() if then.get(key) != value]
        return "; ".join(changed) or "the pictures or the cameras have changed"


class Keys:
    """Makes the key of a frame from the contents of its pictures, the cameras, and the settings."""

    def __init__(self, capture: Capture, cameras: Sequence[Camera], pairs: Sequence[tuple[int, int]]) -> None:
        self._capture, self._names = capture, [camera.name for camera in cameras]
        self._common = {"cameras": [camera.to_json() for camera in cameras], "pairs": list(pairs)}
        self._hashes: dict[Path, str] = {}

    def key(self, frame: int, options: dict[str, Any]) -> str:
        """The key of one frame; `options` is what else its points depend on."""
        pictures = [self._picture(name, frame) for name in self._names]
        text = json.dumps([VERSION, self._common, options, pictures], sort_keys=True)
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()

    def _picture(self, name: str, frame: int) -> list[Any] | None:
        media = self._capture.images.get((name, frame))
        if media is None:
            return None
        path = media if isinstance(media, Path) else media.path
        return [self._hash(path), None if isinstance(media, Path) else media.index]

    def _hash(self, path: Path) -> str:
        if path not in self._hashes:
            digest = hashlib.blake2b(digest_size=16)
            try:
                with open(path, "rb") as file:
                    while chunk := file.read(_CHUNK):
                        digest.update(chunk)
            except OSError as error:
                raise HoloreelError(f"{path} cannot be read ({error.strerror or error}): fetch it again.") from error
            self._hashes[path] = digest.hexdigest()
        return self._hashes[path]
