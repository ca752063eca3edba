# SPDX-License-Identifier: GPL-3.0-or-later
"""What `holoreel bench videorf` found, for people: tables, a plot of the curves, a page with crops."""

from collections.abc import Sequence
from dataclasses import asdict
from itertools import accumulate
from pathlib import Path
from typing import Any

from ..capture import Capture
from ..capture.images import composite
from ..files import write_json
from ..report import Picture, Report, Section, Table, write_report
from ..report.figures import plot_curves
from . import split
from .ablation import as_text, shown_view, write_crops
from .bdrate import rate_at
from .split import Split
from .variants import FULL
from .videorf import Finished, compare, score

MEASURES = {"psnr": "PSNR dB", "psnr_mask": "PSNR mask dB", "ssim": "SSIM"}
PLAIN = "warm"  # what the gains beyond the paper are measured against
APART = "apart"  # stands where two curves reach no common quality
LEGEND = (
    "Bytes against the full method at equal PSNR, PSNR over the pixels of the masks, and SSIM, and against plain warm "
    "starts at equal PSNR; at QP 20 the kB per frame with those of the tables, and the quality; PSNR before coding; "
    "groups of frames; seconds of training behind the coarse stage."
)
NEAR = 0.5  # dB: how far below the top rung a cheaper one is looked for
RULE = (
    "Every group starts with an IDR frame, since the codes of one mapping table say nothing about those of the next: "
    "without grouping, every frame is an IDR frame. key_frames has the same IDR frames over the full method's tables, "
    "and so says how much of that is the loss of prediction; no_grouping+one_idr predicts across tables."
)

Lines = list[tuple[str, ...]]


def overview(rows: dict[str, Finished]) -> Lines:
    """Return the table of rows, as `LEGEND` explains it."""
    measures = [name for name in MEASURES if all(name in row.model["mean"] for row in rows.values())]
    plain = rows.get(PLAIN)
    lines: Lines = [
        (
            "row",
            *(f"at {MEASURES[name].removesuffix(' dB')}" for name in measures),
            *([f"vs {PLAIN}"] if plain else []),
            "kB",
            "tables",
            *(MEASURES[name] for name in measures),
            "uncoded",
            "GOFs",
            "s/frame",
        )
    ]
    for row in rows.values():
        top, frames = row.top, row.frames
        lines.append(
            (
                row.variant.key,
                *(_change(rows[FULL], row, name) for name in measures),
                *([_change(plain, row, measures[0])] if plain else []),
                f"{top['size']['per_frame'] / 1000:.1f}",
                f"{top['size']['tables'] / frames / 1000:.2f}",
                *(_quality(name, score(top["scores"], name)) for name in measures),
                _quality("psnr", score(row.model, "psnr")),
                str(len(row.groups)),
                f"{row.seconds / frames:.1f}",
            )
        )
    return lines


def ladder(row: Finished) -> Lines:
    """Return the rungs of a row: bytes, what they consist of, quality, and the loss to the model before coding."""
    measures = [name for name in MEASURES if name in row.model["mean"]]
    titles = [MEASURES[name] for name in measures]
    lines: Lines = [
        ("QP", "kB/frame", f"of QP {row.top['qp']}", *titles, "loss dB", "video", "tables", "shading", "manifest")
    ]
    top = row.top["size"]["total"]
    for rung in row.rungs:
        size, scores = rung["size"], rung["scores"]
        lines.append(
            (
                str(rung["qp"]),
                f"{size['per_frame'] / 1000:.2f}",
                f"{size['total'] / top:.2f}",
                *(_quality(name, score(scores, name)) for name in measures),
                f"{score(row.model, 'psnr') - score(scores, 'psnr'):.2f}",
                *(f"{size[part]:,}" for part in ("video", "tables", "shading", "manifest")),
            )
        )
    pieces = [_quality(name, score(row.model, name)) for name in measures]
    return [*lines, ("before coding", "", "", *pieces, *[""] * 5)]


def remarks(row: Finished) -> list[str]:
    """Return sentences on a row: its cameras, the bytes for nearly the top quality, and drift."""
    top = row.top
    cameras = ", ".join(f"{name} {_cameras(scores)}" for name, scores in top["scores"]["pooled_cameras"].items())
    lines = [f"At QP {top['qp']}, by camera: {cameras}."]
    wanted = score(top["scores"], "psnr") - NEAR
    rate = rate_at(row.curve("psnr"), wanted)
    if rate is not None:
        lines.append(f"{NEAR} dB below QP {top['qp']} takes {rate * 1000 / top['size']['per_frame']:.2f} of its bytes.")
    drifts = drift(row)
    if drifts:
        change = ", ".join(f"{first:.2f} to {last:.2f}" for first, last in drifts)
        worst = max(first - last for first, last in drifts)
        lines.append(
            f"PSNR of a group's first and last frame: {change} dB; at most {worst:.2f} dB are lost on the way."
        )
    return lines


def drift(row: Finished) -> list[tuple[float, float]]:
    """Return the mean PSNR of the first and of the last frame of each group of several, from the top rung."""
    found = [means["psnr"] for means in row.top["scores"]["frames"].values()]
    ends = list(accumulate(frames for frames, _ in row.groups))
    return [
        (found[end - frames], found[end - 1]) for end, (frames, _) in zip(ends, row.groups, strict=True) if frames > 1
    ]


def positions(row: Finished) -> Lines:
    """Return the mean PSNR and SSIM of the frames at each place in their group, from the top rung."""
    found = list(row.top["scores"]["frames"].values())
    firsts = [0, *accumulate(frames for frames, _ in row.groups)]
    lines: Lines = [("place in its group", "frames", "PSNR dB", "SSIM")]
    for place in range(max(frames for frames, _ in row.groups)):
        here = [found[first + place] for first, (frames, _) in zip(firsts, row.groups, strict=False) if frames > place]
        means = {name: sum(scores[name] for scores in here) / len(here) for name in ("psnr", "ssim")}
        lines.append((str(place), str(len(here)), *(_quality(name, value) for name, value in means.items())))
    return lines


def write_results(
    out: Path, capture: Capture, rows: dict[str, Finished], splits: Sequence[Split], hardware: dict[str, Any]
) -> Path:
    """Write videorf.json, the curves as SVG, and the page index.html with tables, curves and crops; return its path.

    The pictures are of the middle rung of every row, of different sizes: bytes stand beside them.
    """
    found = {key: as_dict(rows, key) for key in rows}
    speed = [part.as_dict() for part in splits]
    write_json(out / "videorf.json", {"machine": hardware, "rows": found, "speed": speed})
    full = rows[FULL]
    measures = [name for name in MEASURES if name in full.model["mean"]]
    curves = {row.variant.title: [row.curve(name) for name in measures] for row in rows.values()}
    plot_curves(out / "curves.svg", curves, [MEASURES[name] for name in measures], "kB per frame")
    figure = Picture(
        "Quality over bytes", "curves.svg", "of the views held out, everything that a player fetches counted"
    )
    background = (1.0, 1.0, 1.0)
    truth = composite(capture.rgba(*shown_view(capture)), background)
    crops = write_crops(out / "rows", capture, {key: _caption(row) for key, row in rows.items()}, truth)
    lines = overview(rows)
    sections = [
        Section(
            "Rows", " ".join((LEGEND, RULE, *remarks(full))), (crops,), (figure,), Table(lines[0], tuple(lines[1:]))
        ),
        _section("PSNR by the place in a group", positions(full)),
        *([_section(split.title(splits), split.table(splits))] if splits else []),
        *(_section(f"Rungs of {row.variant.key}: {row.variant.title}", ladder(row)) for row in rows.values()),
    ]
    intro = (
        f"Quality over bytes on {capture.name}, {full.frames} frames, views held out. Decibels "
        "are those of the mean squared error of all pictures over white, or of the pixels of the masks alone; bytes "
        "are compared by BD-rate over the qualities that both curves reach."
    )
    page = out / "index.html"
    write_report(page, Report("VideoRF: quality over bytes", intro, sections=tuple(sections), pixelated=True))
    return page


def as_dict(rows: dict[str, Finished], key: str) -> dict[str, Any]:
    """Return a row for JSON: what was measured, and how it compares with the full method and the plain one."""
    row = rows[key]
    against = {
        other: {name: change._asdict() for name in MEASURES if (change := _compared(rows[other], row, name))}
        for other in (FULL, PLAIN)
        if other in rows
    }
    return {
        "title": row.variant.title,
        "settings": dict(row.variant.settings),
        "coding": asdict(row.variant.how),
        "against": against,
        "groups": row.groups,
        "seconds": row.seconds,
        "model": row.model,
        "rungs": row.rungs,
        "drift": drift(row),
    }


def text(rows: dict[str, Finished], splits: Sequence[Split] = ()) -> str:
    """Return what is printed: the table of rows, the full method's rungs, the sentences, and how fast it plays."""
    parts = [as_text(overview(rows)), as_text(ladder(rows[FULL])), "\n".join([*remarks(rows[FULL]), LEGEND, RULE])]
    if splits:
        parts.append(split.describe(splits))
    return "\n\n".join(parts)


def _compared(reference: Finished, other: Finished, measure: str) -> Any:
    has_both = measure in reference.model["mean"] and measure in other.model["mean"]
    return compare(reference, other, measure) if has_both else None


def _change(reference: Finished, other: Finished, measure: str) -> str:
    if reference is other:
        return "-"
    found = compare(reference, other, measure)
    return APART if found is None else f"{100 * found.change:+.1f} %"


def _quality(measure: str, value: float) -> str:
    return f"{value:.2f}" if measure.startswith("psnr") else f"{value:.4f}"


def _cameras(scores: dict[str, float]) -> str:
    return " / ".join(f"{value:.2f}" for value in scores.values()) + " dB"


def _caption(row: Finished) -> str:
    rung = row.rungs[len(row.rungs) // 2]
    return f"{row.variant.title}, QP {rung['qp']}, {rung['size']['per_frame'] / 1000:.1f} kB"


def _section(title: str, lines: Lines) -> Section:
    return Section(title, table=Table(lines[0], tuple(lines[1:])))
