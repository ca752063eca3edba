# SPDX-License-Identifier: GPL-3.0-or-later
"""What each part of the method brings (Spacetime Gaussians, Table 4): train without it, with one budget, and compare.

Every row of the table is a run of its own in OUT/SCENE/ROW, measured on the views held out. A row that is finished is
kept as long as it was made with the same settings from the same capture; a stopped one goes on from its checkpoint.
"""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..capture import Capture, read_capture
from ..capture.media import VideoFrame
from ..draw import Drawing
from ..errors import HoloreelError
from ..evaluate import evaluate
from ..files import read_json, write_json
from ..gaussians.config import PRESETS, TrainConfig
from ..gaussians.run import RunPaths, train_reel
from ..images import picture_path, read_image, write_png
from ..lpips import Lpips
from ..report import Picture, Report, Row, Section, Table, write_report

CROP = 8  # crops are this part of the picture, along its longer side


@dataclass(frozen=True)
class Part:
    """A row of the table: its title in the paper, and the settings it is trained with."""

    key: str
    title: str
    change: Callable[[TrainConfig], TrainConfig]


PARTS = (
    Part("temporal_opacity", "w/o Temporal Opacity", lambda config: replace(config, temporal_opacity=False)),
    Part("motion", "w/o Polynomial Motion", lambda config: replace(config, motion=0)),
    Part("rotation", "w/o Polynomial Rotation", lambda config: replace(config, rotation=0)),
    Part("features", "w/o Feature Splatting", lambda config: replace(config, model="lite")),
    Part(
        "guided",
        "w/o Guided Sampling of Gaussians",
        lambda config: replace(config, guided=replace(config.guided, times=0)),
    ),
    Part("full", "Ours Full", lambda config: config),
)
FULL = "full"


@dataclass(frozen=True)
class Finished:
    """A row that was trained and measured: the means of `core.evaluate`, Gaussians and seconds of training."""

    part: Part
    mean: dict[str, float]
    gaussians: int
    seconds: float


def run_ablation(
    scenes: Sequence[Path],
    out: Path,
    iterations: int,
    gaussians: int,
    parts: Sequence[str],
    lpips: Sequence[Lpips],
    backend: ModuleType,
) -> Iterator[str]:
    """Make the tables of several captures; yield what there is to print: each scene's table, and the page's path.

    Raises `HoloreelError` where two captures have one name, or as `ablate` does.
    """
    if iterations < 1 or gaussians < 1:
        raise HoloreelError("--iterations and --gaussians must be 1 or more.")
    named = {scene.resolve().name: scene for scene in scenes}
    if not named or len(named) < len(scenes):
        raise HoloreelError("--scenes: name one capture or more, each in a folder of another name.")
    config = default_config(iterations, gaussians)
    results: dict[str, dict[str, Finished]] = {}
    for name, scene in named.items():
        results[name] = ablate(scene, out / name, config, backend, parts, lpips)
        yield f"{name}\n{as_text(table(results[name]))}\n"
    yield str(write_results(out, named, results, config))


def ablate(
    scene: Path,
    out: Path,
    config: TrainConfig,
    backend: ModuleType,
    parts: Sequence[str] = (),
    lpips: Sequence[Lpips] = (),
    on_progress: Callable[[Part, int, int], None] | None = None,
) -> dict[str, Finished]:
    """Train and measure rows of the table on one capture, all of them or those named; return them by key.

    `on_progress(part, iteration, iterations)` hears of the training. Raises `HoloreelError` for an unknown row, or
    where the capture holds no camera out.
    """
    chosen = [part for part in PARTS if not parts or part.key in parts]
    if unknown := set(parts) - {part.key for part in PARTS}:
        known = ", ".join(part.key for part in PARTS)
        raise HoloreelError(f"--parts {sorted(unknown)[0]}: the table has no such row; take some of {known}.")
    capture = read_capture(scene)
    if not capture.views("test"):
        raise HoloreelError(
            f"{scene}: every camera is trained on; hold one out, so that there is something to measure."
        )
    digest = fingerprint(capture)
    rows = {
        part.key: _row(capture, digest, out / part.key, part, part.change(config), backend, lpips, on_progress)
        for part in sorted(chosen, key=lambda part: part.key != FULL)  # what all others are compared with comes first
    }
    return {part.key: rows[part.key] for part in chosen}


def fingerprint(capture: Capture) -> str:
    """Return a digest of what a run depends on: cameras, splits, bounds, and the sizes and times of pictures, masks and
    seeds."""
    text = [repr((name, camera.to_json(), capture.split(name))) for name, camera in capture.cameras.items()]
    every = (*capture.images.values(), *capture.masks.values())
    pictures = (media.path if isinstance(media, VideoFrame) else media for media in every)
    files = sorted({*pictures, *capture.seeds.values()})
    text += [f"{path.name} {(state := path.stat()).st_size} {state.st_mtime_ns}" for path in files]
    return hashlib.sha256("\n".join([str(capture.frame_count), str(capture.bounds), *text]).encode()).hexdigest()


def _row(
    capture: Capture,
    digest: str,
    folder: Path,
    part: Part,
    config: TrainConfig,
    backend: ModuleType,
    lpips: Sequence[Lpips],
    on_progress: Callable[[Part, int, int], None] | None,
) -> Finished:
    record_path = folder / "row.json"
    made_of = {"config": plain(asdict(config)), "capture": digest}
    record = read_json(record_path) if record_path.is_file() else {}
    reel = folder / "model.reel"
    if {key: record.get(key) for key in made_of} != made_of:
        trained = train_reel(
            capture,
            reel,
            config,
            backend,
            lambda now: on_progress(part, now.iteration, now.iterations) if on_progress else None,
            resume=RunPaths(reel).checkpoint.exists(),
        )
        record = {**made_of, "gaussians": trained.gaussians, "seconds": round(trained.seconds, 1)}
        _measure(reel, capture, folder, record, lpips)
    elif not {measure.name for measure in lpips} <= set(record["mean"]):
        _measure(reel, capture, folder, record, lpips)
    return Finished(part, record["mean"], record["gaussians"], record["seconds"])


def _measure(reel: Path, capture: Capture, folder: Path, record: dict[str, Any], lpips: Sequence[Lpips]) -> None:
    def keep(camera: str, frame: int, drawing: Drawing) -> None:
        write_png(picture_path(folder, camera, frame), drawing.image)

    metrics = evaluate(reel, capture, on_picture=keep, lpips=lpips)
    write_json(folder / "metrics.json", metrics)
    record["mean"] = metrics["mean"]
    write_json(folder / "row.json", record)


def plain(value: Any) -> Any:
    """Return a configuration as JSON gives it back."""
    if isinstance(value, dict):
        return {key: plain(part) for key, part in value.items()}
    return [plain(part) for part in value] if isinstance(value, tuple | list) else value


def columns(rows: dict[str, Finished]) -> list[str]:
    """Return the measures of the table: the paper's, LPIPS only where every row has it."""
    wanted = ["psnr", "dssim1", "lpips_alex", "lpips_vgg"]
    return [name for name in wanted if rows and all(name in row.mean for row in rows.values())]


HEADINGS = {"psnr": "PSNR dB", "dssim1": "DSSIM1", "lpips_alex": "LPIPS alex", "lpips_vgg": "LPIPS vgg"}


def table(rows: dict[str, Finished]) -> list[tuple[str, ...]]:
    """Return the table of one scene as text: heading, then its rows with the differences against Full."""
    names = columns(rows)
    full = rows[FULL].mean if FULL in rows else {}
    lines: list[tuple[str, ...]] = [("Method", *(HEADINGS[name] for name in names), "Gaussians", "seconds")]
    for key, row in rows.items():
        cells = []
        for name in names:
            text = f"{row.mean[name]:.2f}" if name == "psnr" else f"{row.mean[name]:.4f}"
            if full and key != FULL:
                difference = row.mean[name] - full[name]
                text += f" ({difference:+.2f})" if name == "psnr" else f" ({difference:+.4f})"
            cells.append(text)
        lines.append((row.part.title, *cells, str(row.gaussians), f"{row.seconds:.0f}"))
    return lines


def as_text(lines: list[tuple[str, ...]]) -> str:
    """Return a table in columns."""
    widths = [max(len(line[column]) for line in lines) for column in range(len(lines[0]))]
    return "\n".join("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) for line in lines)


def write_results(
    out: Path, scenes: dict[str, Path], results: dict[str, dict[str, Finished]], config: TrainConfig
) -> Path:
    """Write ablation.json and the page index.html with tables and crops; return the page's path.

    A crop shows the same part of the first held-out camera's middle frame in every row: where the rows differ most.
    """
    write_json(
        out / "ablation.json",
        {
            "config": plain(asdict(config)),
            "scenes": {
                name: {
                    key: {**row.mean, "gaussians": row.gaussians, "seconds": row.seconds} for key, row in rows.items()
                }
                for name, rows in results.items()
            },
        },
    )
    sections = []
    for name, rows in results.items():
        lines = table(rows)
        capture = read_capture(scenes[name])
        truth = capture.image(*shown_view(capture), background=(0.0, 0.0, 0.0))
        crops = write_crops(out / name, capture, {key: row.part.title for key, row in rows.items()}, truth)
        sections.append(Section(name, rows=(crops,), table=Table(lines[0], tuple(lines[1:]))))
    intro = (
        f"Each row was trained without one part of the method, for {config.iterations} iterations like the full one, "
        "and measured on views that were held out. In parentheses: the difference against Full."
    )
    page = out / "index.html"
    write_report(page, Report("Ablation", intro, sections=tuple(sections), pixelated=True))
    return page


def shown_view(capture: Capture) -> tuple[str, int]:
    """Return the view that pages show: the first camera held out, and the middle frame counted from 0."""
    return capture.camera_names("test")[0], capture.frame_count // 2


def write_crops(folder: Path, capture: Capture, titles: dict[str, str], truth: NDArray[np.uint8]) -> Row:
    """Write crops of the pictures in FOLDER/KEY to FOLDER/crops and return them as a row of the page, the truth first.

    They are of `shown_view`, of which `truth` (H, W, 3) is the picture. `titles` has the keys, and what is said below.
    """
    name, index = shown_view(capture)
    drawn = {
        title: read_image(picture_path(folder / key, name, capture.frame_start + index))[..., :3]
        for key, title in titles.items()
    }
    corner, side = worst_place([np.square(image - truth / 255.0).sum(axis=2) for image in drawn.values()])
    pictures = []
    for number, (title, image) in enumerate({"Truth": truth.astype(np.float32) / 255.0, **drawn}.items()):
        crop = image[corner[0] : corner[0] + side, corner[1] : corner[1] + side]
        file = folder / "crops" / f"{number}.png"
        write_png(file, crop.repeat(3, axis=0).repeat(3, axis=1))
        pictures.append(Picture(title, f"{folder.name}/crops/{file.name}"))
    return Row(f"{name}, frame {capture.frame_start + index}", tuple(pictures))


def worst_place(errors: list[NDArray[np.floating]]) -> tuple[tuple[int, int], int]:
    """Return the corner (row, column) and the side of the square in which errors (H, W) of the rows differ most."""
    spread = np.ptp(np.stack(errors), axis=0) if len(errors) > 1 else errors[0]
    height, width = spread.shape
    side = min(max(height, width) * 2 // CROP, height, width)
    total = np.zeros((height + 1, width + 1))
    total[1:, 1:] = spread.cumsum(axis=0).cumsum(axis=1)
    sums = total[side:, side:] - total[:-side, side:] - total[side:, :-side] + total[:-side, :-side]
    row, column = np.unravel_index(int(sums.argmax()), sums.shape)
    return (int(row), int(column)), side


def default_config(iterations: int, gaussians: int) -> TrainConfig:
    """Return the settings of the full row: `gaussians` at most to begin with, and 2.5 times as many in the end."""
    full = PRESETS["full"]
    density = replace(full.density, max_gaussians=gaussians * 5 // 2)
    return replace(full, iterations=iterations, max_seeds=gaussians, density=density)
