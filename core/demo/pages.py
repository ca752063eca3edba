# SPDX-License-Identifier: GPL-3.0-or-later
"""The report of the loop: what was seen, what was learned, and how near they are."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..capture import Capture
from ..draw import open_player
from ..gaussians.run import RunPaths
from ..images import read_image, write_png
from ..report import Card, Picture, Report, Row, Section, Table, write_report
from ..report.figures import (
    contact_sheet,
    difference,
    height_time_slice,
    plot_frames,
    plot_rig,
    plot_training,
    write_animation,
)

GAIN = 8.0  # of the shown differences
BLENDER_GAIN = 64.0
SLICE_STEPS = 8  # moments per frame in the height-time slice
SLICE_PIXELS = 6  # per moment


def write_pages(out: Path, title: str, reel: Path, capture: Capture, metrics: dict[str, Any]) -> None:
    """Write `report.html` and its pictures into `out`, from what the steps of the loop left there."""
    pictures = out / "report"
    name = capture.camera_names("test")[0]
    truth = [_picture(capture, name, frame) for frame in range(capture.frame_count)]
    write_report(
        out / "report.html",
        Report(
            title=f"Holoreel: {title}",
            intro=(
                f"{metrics['cameras']} cameras in Blender filmed {capture.frame_count} frames of {metrics['scene']}. "
                f"{metrics['cameras'] - 1} of them trained {metrics['gaussians']:,} Spacetime Gaussians on a CPU; "
                f"{name} was held out, and everything below is seen from where no training camera stood."
            ),
            cards=_cards(metrics),
            sections=(
                _comparison(out, pictures, name, capture, truth),
                _moving(out, pictures),
                _slices(pictures, name, reel, capture, truth),
                _capture(pictures, capture),
                _training(pictures, reel, metrics),
                _timing(metrics),
            ),
            footer=(
                f"{metrics['machine']['processor']}, {metrics['machine']['cores']} cores, no GPU. "
                f"Blender {metrics['blender']}. scene.blend opens ready to play; metrics.json holds every number."
            ),
        ),
    )


def _picture(capture: Capture, name: str, frame: int) -> NDArray[np.float32]:
    return capture.image(name, frame, background=(0, 0, 0)).astype(np.float32) / np.float32(255)


def _cards(metrics: dict[str, Any]) -> tuple[Card, ...]:
    return (
        Card("held-out PSNR", f"{metrics['heldout_psnr']:.2f} dB", "mean of all frames"),
        Card("held-out SSIM", f"{metrics['heldout_ssim']:.4f}", f"DSSIM₁ {metrics['heldout_dssim1']:.4f}"),
        Card("Cycles against raster", f"{metrics['cycles_vs_raster_psnr']:.1f} dB", "worst frame"),
        Card("EEVEE against raster", f"{metrics['eevee_vs_raster_psnr']:.1f} dB", "worst frame"),
        Card("Gaussians", f"{metrics['gaussians']:,}", f"{metrics['iterations']:,} iterations"),
        Card("training", f"{metrics['train_seconds']:.0f} s", f"whole loop {metrics['total_seconds']:.0f} s"),
    )


def _comparison(out: Path, pictures: Path, name: str, capture: Capture, truth: list[NDArray[np.float32]]) -> Section:
    rows = []
    for index in np.unique(np.linspace(0, capture.frame_count - 1, 4).round().astype(int)):
        frame = capture.frame_start + int(index)
        raster = read_image(out / "raster" / f"{name}-{frame:04d}.png")[..., :3]
        cycles = read_image(out / "cycles" / f"{name}-{frame:04d}.png")[..., :3]
        columns = {
            "Ground truth": truth[index],
            "Holoreel raster": raster,
            "Blender Cycles": cycles,
            "Difference": difference(raster, truth[index], GAIN),
            "Cycles − raster": difference(cycles, raster, BLENDER_GAIN),
        }
        notes = {"Difference": f"raster − truth, ×{GAIN:g}", "Cycles − raster": f"×{BLENDER_GAIN:g}"}
        shown = []
        for number, (label, picture) in enumerate(columns.items()):
            file = pictures / f"compare-{frame:04d}-{number}.png"
            write_png(file, picture)
            shown.append(Picture(label, f"report/{file.name}", notes.get(label, "")))
        rows.append(Row(f"Frame {frame}", tuple(shown)))
    text = "The held-out view. Raster is Holoreel's own; Cycles draws the same Gaussians from Blender's timeline."
    return Section("The view nobody trained on", text, rows=tuple(rows))


def _moving(out: Path, pictures: Path) -> Section:
    frames = [read_image(path)[..., :3] for path in sorted((out / "moving").glob("*.png"))]
    write_animation(pictures / "moving.webp", frames, fps=len(frames) / 3)
    write_png(
        pictures / "moving.png",
        contact_sheet([frames[index] for index in np.linspace(0, len(frames) - 1, 9).round().astype(int)], columns=3),
    )
    return Section(
        "A new camera, moving while the reel plays",
        "Rendered by Cycles from the imported reel, in slow motion: sub-frames are evaluated like any other time.",
        rows=(
            Row(
                "Moving camera",
                (Picture("Playing", "report/moving.webp", "in a loop"), Picture("Moments of it", "report/moving.png")),
            ),
        ),
    )


def _slices(pictures: Path, name: str, reel: Path, capture: Capture, truth: list[NDArray[np.float32]]) -> Section:
    """Follow the pixel column that changes most over time."""
    column = int(np.var(np.stack(truth), axis=0).mean(axis=(0, 2)).argmax())
    player, camera = open_player(reel), capture.cameras[name]
    moments = np.minimum(np.arange(capture.frame_count * SLICE_STEPS) / SLICE_STEPS, capture.frame_count - 1)
    drawn = [np.clip(player.draw(camera, capture.frame_start + float(at)).image, 0, 1) for at in moments]
    strips = {
        "truth": (truth, SLICE_STEPS * SLICE_PIXELS, "Ground truth", f"column {column}, {capture.frame_count} frames"),
        "frames": (drawn[::SLICE_STEPS], SLICE_STEPS * SLICE_PIXELS, "Holoreel", "the same frames"),
        "fine": (drawn, SLICE_PIXELS, "Holoreel", f"{SLICE_STEPS} moments per frame"),
    }
    shown = []
    for key, (source, width, label, note) in strips.items():
        write_png(pictures / f"slice-{key}.png", height_time_slice(source, column, width))
        shown.append(Picture(label, f"report/slice-{key}.png", note))
    text = "One pixel column of the held-out view, time running to the right (the paper's Fig. 6)."
    return Section("Height over time", text, rows=(Row("Height-time slices", tuple(shown)),))


def _capture(pictures: Path, capture: Capture) -> Section:
    middle = capture.frame_count // 2
    views = [_picture(capture, name, middle) for name in capture.cameras]
    write_png(pictures / "capture.png", contact_sheet(views, columns=4))
    held_out = set(capture.camera_names("test"))
    plot_rig(pictures / "rig.svg", list(capture.cameras.values()), held_out, capture.seed_points(0).xyz)
    return Section(
        "The capture",
        figures=(
            Picture("All cameras", "report/capture.png", f"at frame {capture.frame_start + middle}"),
            Picture(
                "The rig",
                "report/rig.svg",
                f"and the seed points, from above and from the side; {', '.join(held_out)} held out",
            ),
        ),
    )


def _training(pictures: Path, reel: Path, metrics: dict[str, Any]) -> Section:
    history = json.loads(RunPaths(reel).record.read_text())["history"]
    plot_training(pictures / "training.svg", history)
    frames = metrics["frames"]
    plot_frames(
        pictures / "frames.svg",
        [int(frame) for frame in frames],
        [scores["psnr"] for scores in frames.values()],
        [scores["ssim"] for scores in frames.values()],
    )
    figures = (Picture("Training", "report/training.svg"), Picture("Held-out view by frame", "report/frames.svg"))
    return Section("Training", figures=figures)


def _timing(metrics: dict[str, Any]) -> Section:
    rows = tuple((step, f"{seconds:.1f}") for step, seconds in metrics["seconds"].items())
    return Section("Time", table=Table(("step", "seconds"), rows))
