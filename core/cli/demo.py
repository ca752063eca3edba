# SPDX-License-Identifier: GPL-3.0-or-later
"""`holoreel demo`: the whole loop on one scene, ending in a report."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from tqdm import tqdm

from ..blender import find_blender
from ..demo import DemoSettings, run_demo
from ..gaussians.config import PRESETS
from .synth import parse_frames, parse_size

SAMPLE = Path(__file__).resolve().parents[2] / "sample_scenes" / "harbor.blend"


def run(
    out: Path,
    scene: Path = SAMPLE,
    cameras: int = 12,
    frames: str = "1:12",
    size: str = "320x180",
    samples: int = 16,
    iterations: int = PRESETS["lite"].iterations,
    blender: Path | None = None,
) -> None:
    """Synthesize a capture of a scene, train a reel, render it in Blender, and write a report.

    Args:
        out: Folder of the results, made anew; report.html, metrics.json and scene.blend are what to look at.
        scene: The .blend file; cam00, in the middle of the rig, is held out.
        cameras: Number of cameras on the arc.
        frames: First and last frame, both included, as 1:12.
        size: Width and height of the pictures in pixels, as 320x180.
        samples: Cycles samples per pixel of the capture.
        iterations: Steps of the training.
        blender: The blender executable, or a Python that has bpy.
    """
    width, height = parse_size(size)
    settings = DemoSettings(
        scene, out, find_blender(blender), cameras, parse_frames(frames), width, height, samples, iterations
    )
    metrics = run_demo(settings, show_step)
    for name in ("heldout_psnr", "heldout_ssim", "cycles_vs_raster_psnr", "eevee_vs_raster_psnr"):
        print(f"{name:<24}{metrics[name]:.4g}")
    print(f"{'gaussians':<24}{metrics['gaussians']}")
    print(f"{'total_seconds':<24}{metrics['total_seconds']:.0f}")
    print(f"look at {out / 'report.html'}; open {out / 'scene.blend'} in Blender")


@contextmanager
def show_step(title: str) -> Iterator[Callable[[int, int], None]]:
    """Show one step of the loop as a progress bar."""
    with tqdm(
        desc=f"{title:<16}", dynamic_ncols=True, bar_format="{desc}{percentage:3.0f}%|{bar}| {elapsed}<{remaining}"
    ) as bar:

        def show(done: int, total: int) -> None:
            bar.total, bar.n = total, done
            bar.refresh()

        yield show
