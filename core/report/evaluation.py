# SPDX-License-Identifier: GPL-3.0-or-later
"""What `core.evaluate` measured, for people: lines of text, a page per reel, and one file for a dataset's scenes."""

from pathlib import Path
from typing import Any

import numpy as np

from ..errors import HoloreelError
from ..files import read_json, write_json
from . import Card, Report, Section, Table, write_report

LABELS = {
    "psnr": "PSNR dB",
    "ssim": "SSIM",
    "dssim1": "DSSIM1",
    "dssim2": "DSSIM2",
    "lpips_alex": "LPIPS alex",
    "lpips_vgg": "LPIPS vgg",
}


def cells(means: dict[str, float]) -> list[str]:
    """Return measures as text, in the order of `LABELS`."""
    return [f"{means[name]:.2f}" if name == "psnr" else f"{means[name]:.4f}" for name in LABELS if name in means]


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
        texts = zip(labels, cells(means), strict=True)
        lines.append(f"{name:{width}}" + "".join(f"  {text:>{max(len(label), 7)}}" for label, text in texts))
    return "\n".join([*lines, *remarks(metrics)])


def remarks(metrics: dict[str, Any]) -> list[str]:
    """Return sentences on the model's size, its speed, and how pictures were compared."""
    size = metrics["size"]
    lines = [
        f"{size['bytes'] / 1e6:.2f} MB on disk, {size['bytes_per_frame'] / 1e3:.1f} kB per frame, "
        f"{size['bytes_per_300_frames'] / 1e6:.1f} MB per 300 frames."
    ]
    if "speed" in metrics:
        speed = metrics["speed"]
        played, plain = speed["speeds"]["listed"], speed["speeds"]["not culled"]
        lines.append(
            f"{played['fps']:.1f} frames per second at {speed['width']}x{speed['height']}; by the authors' protocol, "
            f"which leaves out no Gaussian, {plain['authors_fps']:.1f}."
        )
    lines.append(f"Compared: {metrics['precision']}.")
    return lines


def write_page(path: Path, metrics: dict[str, Any]) -> Path:
    """Write the page of one reel, with tables per camera and per frame; return its path."""
    mean, size = metrics["mean"], metrics["size"]
    labels = headings(mean)
    cards = [Card(label, text) for label, text in zip(labels, cells(mean), strict=True)]
    cards.append(Card("Size", f"{size['bytes'] / 1e6:.2f} MB", f"{size['bytes_per_frame'] / 1e3:.1f} kB per frame"))
    if "speed" in metrics:
        cards.append(Card("Frames per second", f"{metrics['speed']['speeds']['listed']['fps']:.1f}"))
    sections = [
        Section(title, table=Table((title, *labels), tuple((name, *cells(means)) for name, means in rows.items())))
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
