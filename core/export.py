# SPDX-License-Identifier: GPL-3.0-or-later
"""What `holoreel export` writes: files for other programs, and smaller ones.

Needs numpy alone, torch for `.pt`, and PyAV to decode a VideoRF.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from .camera import Camera
from .errors import HoloreelError
from .gaussians.compact import write_compact
from .gaussians.decoder import Activation, decoder_path, write_decoder, write_pt
from .gaussians.flat import flattened
from .gaussians.ply import write_ply
from .gaussians.splat3d import write_moment
from .gaussians.splatv import write_splatv
from .reel import NEAR, VIDEORF, Loaded, SegmentPayload, load_gaussians, reel_kind, write_segments
from .videorf.decode import DecodedVideo, FrameSource
from .videorf.model import is_model, read_field_video
from .videorf.package import read_video_reel
from .videorf.points import field_points, write_field_points

Form = Literal["splatv", "3dgs", "ply", "compact", "points"]
ENDINGS: dict[Form, tuple[str, ...]] = {
    "splatv": (".splatv",),
    "3dgs": (".ply",),
    "ply": (".ply", ".reel"),
    "compact": (".stgc", ".reel"),
    "points": (".ply",),
}
_UP = {"X": (1, 0, 0), "Y": (0, 1, 0), "Z": (0, 0, 1)}
_VIEW = (1280, 720, 1000.0)  # width, height and focal length in pixels of a view that nobody chose


class Source:
    """A file to export from: its segments, loaded one at a time, and who looks where that matters."""

    def __init__(self, path: Path, camera: Camera | None = None, decoder_output: Activation | None = None):
        self.path, self._camera, self._output = path, camera, decoder_output
        self.first = load_gaussians(path, 0, decoder_output)
        self._last = (0, self.first)
        whole = self.first.reel or self.first
        self.frame_start, self.frame_count = whole.frame_start, whole.frame_count
        self.segments = len(self.first.reel.segments) if self.first.reel else 1

    def segment(self, index: int) -> Loaded:
        """Return a segment."""
        if index != self._last[0]:
            self._last = index, load_gaussians(self.path, index, self._output)
        return self._last[1]

    def only_segment(self, index: int | None) -> Loaded:
        """Return the segment that was asked for, or the only one there is."""
        if index is None and self.segments > 1:
            raise HoloreelError(
                f"{self.path} has {self.segments} segments, and such a file holds one: "
                f"name it with --segment from 0 to {self.segments - 1}."
            )
        return self.segment(index or 0)

    def at(self, frame: float) -> tuple[Loaded, float]:
        """Return the segment that shows a frame, and the frame's normalized time in it."""
        last = self.frame_start + self.frame_count - 1
        if not self.frame_start <= frame <= last:
            raise HoloreelError(f"{self.path} has no frame {frame:g}: take {self.frame_start} to {last}.")
        index, time = self.first.reel.locate(frame) if self.first.reel else (0, self.first.time_of(frame))
        return self.segment(index), time

    @property
    def viewpoint(self) -> tuple[float, ...] | None:
        """Where a full model's colors are taken from: the camera that was given, or what the reel says."""
        return self.first.viewpoint if self._camera is None else tuple(self._camera.center.tolist())

    def view(self, loaded: Loaded) -> Camera:
        """Return the camera that was given, or one that sees everything."""
        if self._camera is not None:
            return self._camera
        box = loaded.gaussians.bounds()
        low, high = box if box is not None else (-np.ones(3), np.ones(3))
        middle, across = (low + high) / 2, max(float(np.linalg.norm(high - low)), 1e-3)
        sign, axis = (-1.0, loaded.up[1:]) if loaded.up and loaded.up[0] == "-" else (1.0, loaded.up or "Z")
        up = sign * np.array(_UP[axis], float)
        ahead = np.roll(np.abs(up), -1)
        eye = middle - across * ahead if loaded.viewpoint is None else np.array(loaded.viewpoint)
        width, height, focal = _VIEW
        target = eye + ahead if np.allclose(eye, middle) else middle
        return Camera.look_at(eye, target, up, width=width, height=height, fx=focal)


def check_ending(form: Form, out: Path, source: Path) -> None:
    """Raise `HoloreelError` where `out` is not a name for files of this form, or is the file that is read."""
    if out.suffix.lower() not in ENDINGS[form]:
        raise HoloreelError(f"--out {out}: --to {form} writes {' or '.join(ENDINGS[form])}; choose such a name.")
    if out.exists() and source.exists() and out.samefile(source):
        raise HoloreelError(f"--out {out} is the file that is exported: choose another name.")


def export_splatv(source: Source, out: Path, segment: int | None = None) -> None:
    """Write one segment for the web viewer splaTV; a full model gets one color for each Gaussian."""
    loaded = source.only_segment(segment)
    write_splatv(out, flattened(loaded.gaussians, loaded.decoder, source.viewpoint), source.view(loaded))


def export_moments(
    source: Source, frames: list[float], name: Callable[[float], Path]
) -> Iterator[tuple[float, Path, int]]:
    """Write frames as ordinary 3D Gaussians, one file each; yield frame, file and how many Gaussians it has."""
    for frame in (frames[0], frames[-1]):
        source.at(frame)  # so that nothing is written where the range is wrong
    for frame in frames:
        loaded, time = source.at(frame)
        path = name(frame)
        yield frame, path, write_moment(path, loaded.gaussians, time, loaded.decoder, source.viewpoint)


def export_payload(source: Source, out: Path, segment: int | None = None) -> None:
    """Write `.ply` with its `.pt` (the authors' files), `.stgc` with its decoder, of one segment."""
    loaded = source.only_segment(segment)
    if out.suffix.lower() == ".ply":
        write_ply(out, loaded.gaussians)
        if loaded.decoder:
            write_pt(out.with_suffix(".pt"), loaded.decoder)
    else:
        write_compact(out, loaded.gaussians)
        if loaded.decoder:
            write_decoder(decoder_path(out), loaded.decoder)


def export_reel(source: Source, out: Path, suffix: str, segment: int | None = None) -> None:
    """Write a reel with payloads of another form (`.ply` or `.stgc`), of all segments or one."""
    chosen = range(source.segments) if segment is None else [segment]
    parts = [source.segment(index) for index in chosen]
    first = parts[0]
    write_segments(
        out,
        [SegmentPayload(part.gaussians, part.decoder, part.frame_start, part.frame_count) for part in parts],
        fps=first.fps,
        frame_start=first.frame_start,
        up=first.up,
        background=first.background,
        viewpoint=first.viewpoint,
        near=first.reel.near if first.reel else NEAR,
        provenance=first.reel.provenance if first.reel else {"file": source.path.name},
        suffix=suffix,
    )


def open_frames(path: Path, rung: str | None = None) -> FrameSource:
    """Open what points can be made of: a VideoRF reel, one of its rungs, or the folder of a trained model.

    Raises `HoloreelError` where it is neither.
    """
    if reel_kind(path) == VIDEORF:
        return DecodedVideo(read_video_reel(path), rung)
    if not is_model(path):
        raise HoloreelError(f"{path} is no VideoRF: make points of Gaussians with --to 3dgs.")
    if rung is not None:
        raise HoloreelError(f"{path} was not coded yet and has no rungs: leave --rung away.")
    return read_field_video(path)


def export_points(
    source: FrameSource, frames: list[float], name: Callable[[float], Path], eyes: NDArray | None = None
) -> Iterator[tuple[float, Path, int]]:
    """Write frames of the timeline as colored points, one file each; yield frame, file and how many points it has.

    Colors are as in `videorf.points.field_points`. Raises `HoloreelError` where there is no such frame.
    """
    first, last = source.frame_start, source.frame_start + source.frame_count - 1
    for frame in frames:
        if not (first <= frame <= last and frame == int(frame)):
            raise HoloreelError(f"There is no frame {frame:g} to make points of: take {first} to {last}.")
    for frame in frames:
        index = int(frame) - first
        points = field_points(source.lattice, source.table_of(index), source.rows(index), source.shading, eyes)
        path = name(frame)
        write_field_points(path, points)
        yield frame, path, len(points.xyz)
