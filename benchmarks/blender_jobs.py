# SPDX-License-Identifier: GPL-3.0-or-later
"""What jobs cost Blender: milliseconds per tick of the timer, while jobs run, and right after a start.

Run by a Python that has `bpy`: `.venv-bpy52/bin/python benchmarks/blender_jobs.py [--running 4] [--ended 200]`. The
jobs do nothing but write a status ten times a second.
"""

import argparse
import shutil
import statistics
import sys
import tempfile
import time
from pathlib import Path

import holoreel
from holoreel.addon import jobs, preferences
from holoreel.core.jobs import Command, JobRecord

TICKS = 60
BUSY = """
import json, os, sys, time
for step in range(10**6):
    with open(sys.argv[1] + ".new", "w") as file:
        json.dump({"stage": "train", "done": step, "total": 10**6, "seconds_left": 9.5, "previews": 0,
                   "figures": {"loss": "0.1", "PSNR": "20 dB"}}, file)
    os.replace(sys.argv[1] + ".new", sys.argv[1])
    time.sleep(0.1)
"""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--running", type=int, default=4)
    parser.add_argument("--ended", type=int, default=200)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        preferences._DEFAULTS["log_folder"] = folder
        holoreel.register()
        try:
            _measure(options.running, options.ended)
        finally:
            for job in jobs.known():
                if job.state.alive:
                    job.stop(at_once=True)
            while any(job.state.alive for job in jobs.known()):
                time.sleep(0.1)
                jobs.tick()
            holoreel.unregister()


def _measure(running: int, ended: int) -> None:
    python = Path(sys.executable)
    quick = JobRecord("train", "Quick", [Command("", [sys.executable, "-c", ""])], "nowhere.reel")
    first = jobs.start(quick, python)
    while first.state.alive:
        time.sleep(0.1)
        jobs.tick()
    for index in range(ended - 1):
        shutil.copytree(first.folder, first.folder.with_name(f"{first.name}-{index}"))
    busy = JobRecord("train", "Busy", [Command("", [sys.executable, "-c", BUSY, "{job}/status.json"])], "nowhere.reel")
    started = [jobs.start(busy, python) for _ in range(running)]
    while any(job.status.done == 0 for job in started):
        time.sleep(0.1)
        jobs.tick()
    begin = time.perf_counter()
    jobs.scan()
    print(f"look for {ended} jobs of other sessions: {1000 * (time.perf_counter() - begin):.1f} ms")
    _report(
        f"adopt {jobs.ADOPTED_PER_TICK} of them per tick", [_tick(0.0) for _ in range(ended // jobs.ADOPTED_PER_TICK)]
    )
    _report(f"{running} running, {ended} ended", [_tick(0.15) for _ in range(TICKS)])


def _tick(pause: float) -> float:
    time.sleep(pause)
    begin = time.perf_counter()
    jobs.tick()
    return 1000 * (time.perf_counter() - begin)


def _report(title: str, milliseconds: list[float]) -> None:
    print(f"{title}: median {statistics.median(milliseconds):.2f} ms, longest {max(milliseconds):.2f} ms")


if __name__ == "__main__":
    main()
