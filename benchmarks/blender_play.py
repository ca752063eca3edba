# SPDX-License-Identifier: GPL-3.0-or-later
"""Reels in Blender: seconds to import, milliseconds per frame to evaluated points, and memory beyond empty Blender.

Times by the clock, and of all cores together (which others' work disturbs less).

Run by a Python that has `bpy`: `.venv-bpy52/bin/python benchmarks/blender_play.py [FILE ...] [--json FILE]`. Without
files it makes one of 100,000 and one of 1,000,000 random Gaussians. Each file is measured in a process of its own.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from holoreel.addon import compat, reels
from holoreel.addon.nodes.reel import DISPLAY, POINTS
from holoreel.core.gaussians.model import SpacetimeGaussians
from holoreel.core.gaussians.ply import write_ply

MADE = (100_000, 1_000_000)
FRAMES = 25


def make_model(count: int) -> SpacetimeGaussians:
    """Return random Gaussians, about 95 % of them visible at any time."""
    random = np.random.default_rng(0)

    def normal(scale: float, *shape: int) -> np.ndarray:
        return scale * random.standard_normal((count, *shape), dtype=np.float32)

    return SpacetimeGaussians(
        means=normal(1.0, 3),
        motions=normal(0.1, 3, 3),
        quats=normal(1.0, 4),
        omegas=normal(0.1, 4),
        log_scales=normal(0.5, 3) - 5.0,
        opacity_logits=normal(2.0),
        features=random.random((count, 3), dtype=np.float32),
        trbf_centers=random.random(count, dtype=np.float32),
        trbf_log_scales=normal(1.0) + 1.0,
    )


def measure(path: Path) -> dict[str, Any]:
    """Import a reel into an empty file and play it; times in seconds, memory in megabytes (10^6 bytes)."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    empty = _memory_mb()
    began = _clocks()
    played = reels.import_reel(bpy.context, path)
    imported = _clocks() - began
    modifier = reels.modifier_of(played)
    compat.set_input(modifier, "Look", POINTS)
    compat.set_input(modifier, "Color", DISPLAY)
    compat.set_input(modifier, "Hide Fainter Than", 0.0)
    seconds, shown = [], 0
    for index in range(FRAMES + 1):
        began = _clocks()
        bpy.context.scene.frame_set(1 + index * 7 % 50, subframe=0.5)
        geometry = played.evaluated_get(bpy.context.evaluated_depsgraph_get()).evaluated_geometry()
        shown = len(geometry.pointcloud.points)
        seconds.append(_clocks() - began)
        del geometry
    frame_s, frame_cpu_s = np.median(seconds[1:], axis=0).tolist()
    return {
        "file": path.name,
        "blender": bpy.app.version_string,
        "points": len(played.data.points),
        "visible": shown,
        "import_s": float(imported[0]),
        "import_cpu_s": float(imported[1]),
        "frame_ms": 1e3 * frame_s,
        "frame_cpu_ms": 1e3 * frame_cpu_s,
        "memory_mb": _memory_mb() - empty,
        "peak_mb": _peak_mb() - empty,
    }


def _clocks() -> np.ndarray:
    """Return the time and the processors' time, in seconds."""
    return np.array([time.perf_counter(), time.process_time()])


def _memory_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def _peak_mb() -> float:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:")) * 1024 / 1e6


def _in_own_process(path: Path) -> dict[str, Any]:
    command = [sys.executable, __file__, "--one", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return json.loads(next(line for line in reversed(done.stdout.splitlines()) if line.startswith("{")))


def main() -> None:
    """Measure the files, print a table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("files", nargs="*", type=Path, help="reels of Gaussians; without any, random ones")
    parser.add_argument("--json", type=Path, help="write the figures there")
    parser.add_argument("--one", type=Path, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.one is not None:
        print(json.dumps(measure(chosen.one)))
        return
    with tempfile.TemporaryDirectory() as folder:
        files = chosen.files
        if not files:
            files = [Path(folder, f"{count}.ply") for count in MADE]
            for path, count in zip(files, MADE, strict=True):
                write_ply(path, make_model(count))
        figures = [_in_own_process(path) for path in files]
    for one in figures:
        print(
            f"{one['file']}: {one['points']:,} points, {one['visible']:,} visible; import {one['import_s']:.2f} s "
            f"(processors {one['import_cpu_s']:.2f} s); {one['frame_ms']:.1f} ms a frame (processors "
            f"{one['frame_cpu_ms']:.1f} ms); memory {one['memory_mb']:.0f} MB "
            f"(peak {one['peak_mb']:.0f} MB), Blender {one['blender']}"
        )
    if chosen.json:
        chosen.json.write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    main()
