# SPDX-License-Identifier: GPL-3.0-or-later
"""What `core.evaluate` measured, for people: lines of text, a page per reel, and one file for a dataset's scenes."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import HoloreelError
from ..evaluate import DECIBELS
from ..files import read_json, write_json
from . import Card, Report, Section, Table, write_report

LABELS = {
    "psnr": "PSNR dB",
    "ssim": "SSIM",
    "dssim1": "DSSIM1",
    "dssim2": "DSSIM2",
    "psnr_mask": "PSNR mask dB",
    "ssim_crop": "SSIM crop",
    "ssim_gauss": "SSIM 11x11",
    "lpips_alex": "LPIPS alex",
    "lpips_vgg": "LPIPS vgg",
    "lpips_alex_crop": "LPIPS alex crop",
    "lpips_vgg_crop": "LPIPS vgg crop",
}


def cells(means: dict[str, float], names: Iterable[str] | None = None) -> list[str]:
    """Return measures as text, in the order of `LABELS`: those in `names`, or all that are there."""
    wanted = means if names is None else set(names)
    return [_cell(name, means) for name in LABELS if name in wanted]


def _cell(name: str, means: dict[str, float]) -> str:
    if name not in means:
        return "-"
    return f"{means[name]:.2f}" if name in DECIBELS else f"{means[name]:.4f}"


def headings(means: dict[str, float]) -> list[str]:
    """Return the labels of the measures that are there."""
    return [label for name, label in LABELS.items() if name in means]


def as_text(metrics: dict[str, Any]) -> str:
    """Return the means per camera and over all pictures, and a sentence each on size and speed."""
    rows = [*metrics["cameras"].items(), ("mean", metrics["mean"])]
    width = max(len(name) for name, _ in rows)
    labels = headings(metrics["mean"])
    lines = [" " * width + "".join(f"  {label:>7}" for label in labels)]
    for name, means in rows:
        texts = zip(labels, cells(means, metrics["mean"]), strict=True)
        lines.append(f"{name:{width}}" + "".join(f"  {text:>{max(len(label), 7)}}" for label, text in texts))
    return "\n".join([*lines, *remarks(metrics)])


def remarks(metrics: dict[str, Any]) -> list[str]:
    """Return sentences on the model's size, its speed, and how pictures were compared."""
    size = metrics["size"]
    lines = [
        f"{size['bytes'] / 1e6:.2f} MB on disk, {size['bytes_per_frame'] / 1e3:.1f} kB per frame, "
        f"{size['bytes_per_300_frames'] / 1e6:.1f} MB per 300 frames."
    ]
    measured = metrics.get("rung")
    for name, text in metrics.get("rungs", {}).items():
        lines.append(f"Rung {name}{' (measured)' if name == measured else ''}: {text}")
    if "speed" in metrics:
        lines.append(metrics["speed"]["sentence"])
    pooled = metrics["pooled"]
    if "psnr_mask" in pooled:
        lines.append(
            f"From the mean squared error of all pictures: {pooled['psnr']:.2f} dB, {pooled['psnr_mask']:.2f} dB over "
            "the pixels of the masks."
        )
    lines.append(f"Compared: {metrics['precision']}.")
    if protocol := metrics.get("protocol"):
        measures = ", ".join(LABELS[name] for name in protocol["measures"] if name in metrics["mean"])
        lines.append(f"Protocol of {protocol['name']} (held out: {', '.join(protocol['held_out'])}): {measures}.")
    return lines


def write_page(path: Path, metrics: dict[str, Any]) -> Path:
    """Write the page of one reel, with tables per camera and per frame; return its path."""
    mean, size = metrics["mean"], metrics["size"]
    labels = headings(mean)
    cards = [Card(label, text) for label, text in zip(labels, cells(mean), strict=True)]
    cards.append(Card("Size", f"{size['bytes'] / 1e6:.2f} MB", f"{size['bytes_per_frame'] / 1e3:.1f} kB per frame"))
    if "speed" in metrics:
        cards.append(Card("Frames per second", f"{metrics['speed']['fps']:.1f}"))
    sections = [
        Section(
            title, table=Table((title, *labels), tuple((name, *cells(means, mean)) for name, means in rows.items()))
        )
        for title, rows in (("Camera", metrics["cameras"]), ("Frame", metrics["frames"]))
    ]
    intro = f"{metrics['reel']} against the {metrics['split']} pictures of {metrics['capture']}. "
    write_report(
        path,
        Report(f"{metrics['capture']}: evaluation", intro + " ".join(remarks(metrics)), tuple(cards), tuple(sections)),
    )
    return path


def merge(path: Path, metrics: dict[str, Any]) -> None:
    """Add a reel's result to a file of several, under its capture's name, and take the means over the scenes anew.

    Raises `HoloreelError` where the file is something else.
    """
    held = read_json(path) if path.exists() else {"scenes": {}}
    scenes = held.get("scenes")
    if not isinstance(scenes, dict) or not all(isinstance(s, dict) and "mean" in s for s in scenes.values()):
        raise HoloreelError(f"{path}: 'scenes' does not hold results of holoreel eval; name another file with --json.")
    scenes[metrics["capture"]] = metrics
    names = [name for name in LABELS if all(name in scene["mean"] for scene in scenes.values())]
    mean = {name: round(float(np.mean([scene["mean"][name] for scene in scenes.values()])), 6) for name in names}
    write_json(path, {"mean": mean, "scenes": scenes})
