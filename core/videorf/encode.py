# SPDX-License-Identifier: GPL-3.0-or-later
"""From a trained model to a `.reel`: quantize, tile, encode every rung, and write what a player needs beside it.

Everything is counted: video, tables, shading network, and the manifest with ranges and checksums.
"""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import HoloreelError
from .codec import RUNGS, check_rung, code_lumas, encode_video
from .mapping import MappingTable
from .model import FieldVideo
from .package import Rung, VideoReel, write_tables, write_video_reel
from .quantize import Ranges
from .shading import shading_bytes, write_shading
from .tiles import Tiling, tiling_of


class RungSpec(NamedTuple):
    """A rung to encode: the constant QP, on the codec's own scale, and the codec."""

    qp: int
    codec: str = "h264"


class Size(NamedTuple):
    """What a player fetches for a rung, in bytes; `per_frame` is the total over the frames."""

    video: int
    tables: int
    shading: int
    manifest: int
    total: int
    per_frame: float


DEFAULT_RUNGS = tuple(RungSpec(qp) for qp in RUNGS)
Report = Callable[[int, int], None]


def write_reel(
    model: FieldVideo,
    out: str | Path,
    rungs: Sequence[RungSpec] = DEFAULT_RUNGS,
    profile: str = "universal",
    *,
    ranges: Ranges | None = None,
    files: dict[str, str] | None = None,
    provenance: dict[str, Any] | None = None,
    on_progress: Report | None = None,
) -> VideoReel:
    """Encode a model and write the reel `out`, with everything it names beside it; returns it.

    `ranges` are the quantizer's, the model's own without. `files` are further files of the reel, `provenance` is added
    to the model's. `on_progress(done, all)` hears of every frame of every rung. The manifest comes last: without it,
    there is no reel. Raises `HoloreelError` where a profile has no room for the model, a rung is impossible, or there
    is no encoder for it.
    """
    out = Path(out)
    ranges = ranges or model.ranges
    height, width = model.tables[0].size
    tiling = tiling_of(profile, model.channels, height, width)
    if not rungs or len(set(rungs)) < len(rungs):
        raise HoloreelError(f"The rungs {[tuple(rung) for rung in rungs]} of {out} are none or not all different.")
    for rung in rungs:
        check_rung(rung.qp, rung.codec)
    counts = [group.count for group in model.groups]
    write_shading(out.with_suffix(".shading"), model.shading)
    reel = VideoReel(
        path=out,
        fps=model.fps,
        frame_start=model.frame_start,
        lattice=model.lattice,
        ranges=ranges,
        tiling=tiling,
        profile=profile,
        layout=model.tables[0].layout,
        shading=model.shading.shape,
        shading_file=out.with_suffix(".shading").name,
        shading_sha256=hashlib.sha256(shading_bytes(model.shading)).hexdigest(),
        tables_file=out.with_suffix(".tables").name,
        groups=write_tables(out.with_suffix(".tables"), model.tables, counts),
        rungs=(),
        up=model.up,
        background=model.background,
        step=model.step,
        transmittance_min=model.transmittance_min,
        files=files or {},
        provenance=model.provenance | (provenance or {}),
    )
    coded = []
    for index, spec in enumerate(rungs):
        name = _video_name(out, spec)
        done = _progress(on_progress, index * model.frame_count, len(rungs) * model.frame_count)
        lumas = lumas_of(model, ranges, tiling, done)
        qp, codec = spec
        video = encode_video(
            out.with_name(name), lumas, counts, fps=model.fps, qp=qp, codec=codec, meaning=reel.meaning
        )
        coded.append(Rung(qp, codec, name, video))
    reel = replace(reel, rungs=tuple(coded))
    write_video_reel(reel)
    return reel


def lumas_of(
    model: FieldVideo, ranges: Ranges, tiling: Tiling, on_frame: Callable[[], None] = lambda: None
) -> Iterator[NDArray[np.uint8]]:
    """Yield the luma (H, W) of every frame of a model: what goes into the encoder."""
    empty = ranges.encode(ranges.empty)
    for frame in range(model.frame_count):
        yield tiling.pack(model.table_of(frame).to_image(ranges.encode(model.rows(frame)), empty))
        on_frame()


def decoded_rows(reel: VideoReel, rung: int = 0) -> Iterator[tuple[int, MappingTable, NDArray[np.float32]]]:
    """Yield frame, mapping table and rows (N, C) of every frame, as a player has them after decoding a rung.

    Vertices without a rank have `reel.ranges.empty`. Raises `HoloreelError` where the reel's files are not as it says.
    """
    video = reel.video(rung)
    for index, (first, group) in enumerate(zip(reel.firsts, reel.groups, strict=True)):
        table = reel.table(index)
        for frame in range(first, first + group.frames):
            codes = table.to_rows(reel.tiling.unpack(video.luma(frame)))
            yield frame, table, reel.ranges.decode(codes)


def reel_size(reel: VideoReel, rung: int = 0) -> Size:
    """Return what a player fetches for a rung."""
    parts = {
        "video": reel.rungs[rung].video.size,
        "tables": sum(group.size for group in reel.groups),
        "shading": 4 * reel.shading.count,
        "manifest": reel.path.stat().st_size,
    }
    total = sum(parts.values())
    return Size(**parts, total=total, per_frame=total / reel.frame_count)


def round_trip(
    images: Sequence[NDArray[np.uint8]], tiling: Tiling, qp: int, codec: str = "h264"
) -> tuple[list[NDArray[np.uint8]], int]:
    """Send a group's feature images (H, W, C) through a codec, in memory: what a player sees of them, and their bytes.

    The first image becomes an IDR frame, the others refer to those before them: bit for bit what `write_reel` makes of
    them. The bytes are those of the fragment, with the half KB in which x264 signs the first one of every video.
    """
    decoded, size = code_lumas([tiling.pack(image) for image in images], qp, codec)
    return [tiling.unpack(luma) for luma in decoded], size


def _video_name(out: Path, rung: RungSpec) -> str:
    return f"{out.stem}.qp{rung.qp}{'' if rung.codec == 'h264' else f'.{rung.codec}'}.mp4"


def _progress(report: Report | None, start: int, total: int) -> Callable[[], None]:
    done = start

    def step() -> None:
        nonlocal done
        done += 1
        if report is not None:
            report(done, total)

    return step
