# SPDX-License-Identifier: GPL-3.0-or-later
"""`holoreel export FILE --to FORM --out OUT`: files for other programs, and smaller ones."""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray
from tqdm import tqdm

from ..camera import read_camera
from ..capture import read_capture
from ..errors import HoloreelError
from ..export import (
    Form,
    Source,
    check_ending,
    export_moments,
    export_payload,
    export_points,
    export_reel,
    export_splatv,
    open_frames,
)
from ..gaussians.decoder import Activation

MOMENTS = ("3dgs", "points")  # forms that hold one frame


def run(
    file: tyro.conf.Positional[Path],
    /,
    to: Form,
    out: Path,
    frame: float | None = None,
    frames: str | None = None,
    segment: int | None = None,
    camera: Path | None = None,
    cameras: Path | None = None,
    rung: str | None = None,
    decoder_output: Activation | None = None,
) -> None:
    """Write a reel, PLY, .stgc or .splatv in another form.

    splatv: for the web viewer splaTV (lite; a full model gets one color for each Gaussian). 3dgs: what is visible at a
    frame as an ordinary 3D Gaussian PLY, for any viewer of those. ply: the layout of the paper's authors, with a .pt
    beside it for a full model. compact: about a fourth of a PLY's size, for Holoreel. points: a frame of a VideoRF as
    colored points with densities, for Blender.

    Args:
        file: the .reel, .ply, .stgc or .splatv, or the NAME.model of a VideoRF.
        to: what to write.
        out: NAME.splatv; NAME.ply; NAME.stgc; NAME.reel for a reel with payloads of that form; a folder for --frames.
        frame: the frame of the timeline to write as 3dgs (sub-frames allowed) or points.
        frames: instead, a range FIRST:LAST, both included, as OUT/FRAME.ply.
        segment: which segment of a reel, from 0; a NAME.reel holds all of them without it.
        camera: CAMERA.json from which a full model's or a VideoRF's colors are taken, and where a .splatv begins.
        cameras: of points, instead: a capture; colors are means over its training cameras. With neither, means over
            directions from all around.
        rung: of points: which rate, by its QP as 20, or with its codec as hevc:20; the best without it.
        decoder_output: what the decoder of a bare full model (.ply with a .pt beside it) ends in; sigmoid without it.
    """
    moments = (frame is not None) + (frames is not None)
    if (to in MOMENTS) != (moments == 1) or (to in MOMENTS and segment is not None):
        raise HoloreelError(
            f"--to {MOMENTS[0]} or {MOMENTS[1]} needs --frame N or --frames FIRST:LAST, without --segment; others need "
            "neither."
        )
    if to != "points" and (cameras is not None or rung is not None):
        raise HoloreelError("--cameras and --rung are for --to points alone: leave them away.")
    chosen = parse_range(frames) if frames is not None else [] if frame is None else [frame]
    if frames is None:
        check_ending(to, out, file)
    if to == "points":
        video, eyes = open_frames(file, rung), read_eyes(camera, cameras)
        write_moments(lambda name: export_points(video, chosen, name, eyes), chosen, out, frames)
        print(out)
        return
    source = Source(file, read_camera(camera) if camera else None, decoder_output)
    for sentence in source.first.report:
        print(f"note: {sentence}", file=sys.stderr)
    if source.first.decoder and source.viewpoint is None and to in ("splatv", "3dgs"):
        print(
            "note: no viewpoint is known, so colors are those of the base alone; name one with --camera.",
            file=sys.stderr,
        )
    if to == "3dgs":
        write_moments(lambda name: export_moments(source, chosen, name), chosen, out, frames)
    elif to == "splatv":
        export_splatv(source, out, segment)
    elif out.suffix.lower() == ".reel":
        export_reel(source, out, ".ply" if to == "ply" else ".stgc", segment)
    else:
        export_payload(source, out, segment)
    print(out)


def write_moments(
    write: Callable[[Callable[[float], Path]], Iterator[object]], chosen: list[float], out: Path, frames: str | None
) -> None:
    """Write one moment as the file `out`, or, where a range of `frames` was asked for, many into the folder."""
    many = frames is not None

    def name(frame: float) -> Path:
        return out / f"{int(frame):04d}.ply" if many else out

    silent = not (many and sys.stderr.isatty())
    for _ in tqdm(write(name), total=len(chosen), unit="frame", dynamic_ncols=True, disable=silent):
        pass


def read_eyes(camera: Path | None, cameras: Path | None) -> NDArray | None:
    """Return the places (K, 3) from which points are colored: one camera's, a capture's training cameras', or none."""
    if camera is not None and cameras is not None:
        raise HoloreelError("--camera and --cameras both say who looks: give one of them.")
    if camera is not None:
        return read_camera(camera).center[None]
    if cameras is None:
        return None
    capture = read_capture(cameras)
    names = capture.camera_names("train") or list(capture.cameras)
    return np.stack([capture.cameras[name].center for name in names])


def parse_range(text: str) -> list[float]:
    """Read FIRST:LAST as the frames from one to the other, both included."""
    first, _, last = text.partition(":")
    try:
        start, end = int(first), int(last)
    except ValueError:
        start, end = 1, 0
    if not start <= end or end - start >= 10**6:
        raise HoloreelError(f"--frames {text}: give the first and the last frame, like 1:50.")
    return [float(frame) for frame in range(start, end + 1)]
