# SPDX-License-Identifier: GPL-3.0-or-later
"""Write a trained model in one of the ways that `holoreel bench videorf` compares, and measure what comes out of it."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..capture import Capture
from ..draw import Player
from ..evaluate import evaluate_player
from ..videorf.codec import FeatureVideo, encode_video
from ..videorf.encode import RungSpec, Size, lumas_of, reel_size, write_reel
from ..videorf.model import FieldVideo, in_memory
from ..videorf.player import FieldPlayer, VideoPlayer
from ..videorf.quantize import Ranges, fit_ranges
from ..videorf.tiles import PROFILES, tiling_of
from .variants import Coding

MEASURES = ("mean", "pooled", "cameras", "pooled_cameras", "frames")


def measure_model(model: FieldVideo, capture: Capture) -> dict[str, Any]:
    """Measure a model as it was trained, before anything is coded, as `measure` does."""
    return measure(FieldPlayer(model), capture)


def measure(player: Player, capture: Capture, **more: Any) -> dict[str, Any]:
    """Return the measures of the views held out as `core.evaluate` defines them, without those of single pictures."""
    metrics = evaluate_player(player, capture, **more)
    return {name: metrics[name] for name in MEASURES}


def coded_rungs(model: FieldVideo, coding: Coding, reel: Path) -> Iterator[tuple[int, Size, Player]]:
    """Yield the QP, the size and a player of every rung; the rungs are written to `reel` where a reel can hold them."""
    ranges = model.ranges if coding.percentile is None else _ranges(model, coding.percentile)
    if coding.heads != "groups":
        yield from _without_reel(model, coding, ranges, reel)
        return
    specs = [RungSpec(qp, coding.codec) for qp in coding.qps]
    written = write_reel(model, reel, specs, profile_of(model), ranges=ranges)
    for index, qp in enumerate(coding.qps):
        yield qp, reel_size(written, index), VideoPlayer(reel, index)


def profile_of(model: FieldVideo) -> str:
    """Return the first profile with room for all channels of a model."""
    return next(name for name, limits in PROFILES.items() if limits.columns * limits.rows >= model.channels)


def _ranges(model: FieldVideo, percentile: float) -> Ranges:
    tables = (model.rows(frame) for frame in range(model.frame_count))
    return fit_ranges(tables, model.ranges.low[0], percentile)


def _without_reel(model: FieldVideo, coding: Coding, ranges: Ranges, path: Path) -> Iterator[tuple[int, Size, Player]]:
    """Code with IDR frames where no reel has them; all else counts as in a reel of one rung."""
    tiling = tiling_of(profile_of(model), model.channels, *model.tables[0].size)
    frames = range(model.frame_count)
    counts = [1] * len(frames) if coding.heads == "frames" else [len(frames)]
    written = write_reel(model, path, [RungSpec(coding.qps[-1], coding.codec)], profile_of(model), ranges=ranges)
    others = reel_size(written)
    for qp in coding.qps:
        file = path.with_suffix(".mp4")
        lumas = lumas_of(model, ranges, tiling)
        coded = encode_video(file, lumas, counts, fps=model.fps, qp=qp, codec=coding.codec, meaning=written.meaning)
        video = FeatureVideo(file, coded, tiling.picture, written.meaning)
        codes = (model.table_of(frame).to_rows(tiling.unpack(video.luma(frame))) for frame in frames)
        decoded = replace(model, ranges=ranges, load=in_memory([ranges.decode(part) for part in codes]))
        total = others.total - others.video + coded.size
        size = others._replace(video=coded.size, total=total, per_frame=total / len(frames))
        yield qp, size, FieldPlayer(decoded)
