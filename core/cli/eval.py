# SPDX-License-Identifier: GPL-3.0-or-later
"""`holoreel eval REEL CAPTURE`: measure a reel against the held-out views of its capture."""

import sys
from pathlib import Path
from typing import Any, Literal

import tyro
from tqdm import tqdm

from ..capture import read_capture
from ..draw import Backend, Drawing
from ..evaluate import evaluate
from ..files import write_json
from ..images import picture_path, write_png


def run(
    file: tyro.conf.Positional[Path],
    capture: tyro.conf.Positional[Path],
    /,
    split: Literal["test", "train", "all"] = "test",
    out: Path | None = None,
    pictures: bool = True,
    backend: Backend = "auto",
) -> None:
    """Measure PSNR, SSIM, DSSIM1 and DSSIM2 per camera and frame.

    Args:
        file: the .reel, .ply or .splatv.
        capture: folder with transforms.json, or that file.
        split: which cameras of the capture.
        out: folder for metrics.json and the drawn pictures (OUT/CAMERA/FRAME.png); without it, only the table is shown.
        pictures: write the drawn pictures too.
        backend: which rasterizer.
    """
    recording = read_capture(capture)

    def keep(camera: str, frame: int, drawing: Drawing) -> None:
        if out and pictures:
            write_png(picture_path(out, camera, frame), drawing.image)

    with tqdm(unit="picture", dynamic_ncols=True, desc="eval", disable=not sys.stderr.isatty()) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        metrics = evaluate(file, recording, split, backend, show, keep)
    print(table(metrics))
    if out:
        write_json(out / "metrics.json", metrics)
        print(out / "metrics.json")


def table(metrics: dict[str, Any]) -> str:
    """Return the means per camera, and over all pictures, as lines of text."""
    rows = [*metrics["cameras"].items(), ("mean", metrics["mean"])]
    width = max(len(name) for name, _ in rows)
    lines = [f"{'':{width}}  PSNR dB    SSIM  DSSIM1  DSSIM2"]
    lines += [
        f"{name:{width}}  {m['psnr']:7.2f}  {m['ssim']:.4f}  {m['dssim1']:.4f}  {m['dssim2']:.4f}" for name, m in rows
    ]
    return "\n".join(lines)
