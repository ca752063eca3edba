# SPDX-License-Identifier: GPL-3.0-or-later
"""`holoreel export FILE --to FORM --out OUT`: files for other programs, and smaller ones."""

import sys
from pathlib import Path

import tyro
from tqdm import tqdm

from ..camera import read_camera
from ..errors import HoloreelError
from ..export import Form, Source, check_ending, export_moments, export_payload, export_reel, export_splatv
from ..gaussians.decoder import Activation


def run(
    file: tyro.conf.Positional[Path],
    /,
    to: Form,
    out: Path,
    frame: float | None = None,
    frames: str | None = None,
    segment: int | None = None,
    camera: Path | None = None,
    decoder_output: Activation | None = None,
) -> None:
    """Write a reel, PLY, .stgc or .splatv in another form.

    splatv: for the web viewer splaTV (lite; a full model gets one color for each Gaussian). 3dgs: what is visible at a
    frame as an ordinary 3D Gaussian PLY, for any viewer of those. ply: the layout of the paper's authors, with a .pt
    beside it for a full model. compact: about a fourth of a PLY's size, for Holoreel.

    Args:
        file: the .reel, .ply, .stgc or .splatv.
        to: what to write.
        out: NAME.splatv; NAME.ply; NAME.stgc; NAME.reel for a reel with payloads of that form; a folder for --frames.
        frame: the frame of the timeline to write as 3dgs; sub-frames allowed.
        frames: instead, a range FIRST:LAST, both included, as OUT/FRAME.ply.
        segment: which segment of a reel, from 0; a NAME.reel holds all of them without it.
        camera: CAMERA.json from which a full model's colors are taken, and where a .splatv begins.
        decoder_output: what the decoder of a bare full model (.ply with a .pt beside it) ends in; sigmoid without it.
    """
    moments = (frame is not None) + (frames is not None)
    if (to == "3dgs") != (moments == 1) or (to == "3dgs" and segment is not None):
        raise HoloreelError("--to 3dgs needs --frame N or --frames FIRST:LAST, without --segment; others need neither.")
    chosen = parse_range(frames) if frames is not None else [] if frame is None else [frame]
    if frames is None:
        check_ending(to, out, file)
    source = Source(file, read_camera(camera) if camera else None, decoder_output)
    for sentence in source.first.report:
        print(f"note: {sentence}", file=sys.stderr)
    if source.first.decoder and source.viewpoint is None and to in ("splatv", "3dgs"):
        print(
            "note: no viewpoint is known, so colors are those of the base alone; name one with --camera.",
            file=sys.stderr,
        )
    if to == "3dgs":
        write_moments(source, chosen, out, many=frames is not None)
    elif to == "splatv":
        export_splatv(source, out, segment)
    elif out.suffix.lower() == ".reel":
        export_reel(source, out, ".ply" if to == "ply" else ".stgc", segment)
    else:
        export_payload(source, out, segment)
    print(out)


def write_moments(source: Source, frames: list[float], out: Path, many: bool) -> None:
    """Write one moment as the file `out`, or many into the folder."""

    def name(frame: float) -> Path:
        return out / f"{int(frame):04d}.ply" if many else out

    done = export_moments(source, frames, name)
    for _ in tqdm(
        done, total=len(frames), unit="frame", dynamic_ncols=True, disable=not (many and sys.stderr.isatty())
    ):
        pass


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
