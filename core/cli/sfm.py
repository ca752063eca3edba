# SPDX-License-Identifier: GPL-3.0-or-later
"""`holoreel sfm CAPTURE`: points of every frame, and the poses of cameras that have none."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from tqdm import tqdm

from ..capture.options import CaptureOptions
from ..capture.sfm_result import FOLDER
from ..errors import HoloreelError
from ..sfm.calibration import CameraCheck
from ..sfm.run import SfmReport, run_sfm
from ..sfm.settings import PoseSettings, SfmSettings

_SETTINGS, _POSES, _OPTIONS = SfmSettings(), PoseSettings(), CaptureOptions()


def run(
    capture: tyro.conf.Positional[Path],
    /,
    out: Path | None = None,
    jobs: int = 0,
    settings: Annotated[SfmSettings, tyro.conf.arg(name="")] = _SETTINGS,
    poses: Annotated[PoseSettings, tyro.conf.arg(name="")] = _POSES,
    options: Annotated[CaptureOptions, tyro.conf.arg(name="")] = _OPTIONS,
) -> None:
    """Find points of the scene in every frame, the seeds of a training; a call that was stopped goes on when repeated.

    Where the capture has no poses (a folder of videos without calibration), they are found first, from a few frames.

    Args:
        capture: Folder of the capture.
        out: Folder for the result, instead of `sfm` in the capture's folder (where it is found by itself).
        jobs: Frames to do at a time; 0 takes one per core.
        settings: How to find points.
        poses: How to find poses.
        options: How to read the capture.
    """
    if jobs < 0:
        raise HoloreelError("--jobs must be 0 or more.")
    # This takes a moment; --help need not wait for it.
    from ..sfm.poses import open_capture

    folder = out or (capture if capture.is_dir() else capture.parent) / FOLDER
    opened = open_capture(capture, folder, settings, poses, options, on_message=print)
    with tqdm(unit="frame", dynamic_ncols=True, smoothing=0.1) as bar:

        def show(done: int, total: int) -> None:
            if bar.total is None:  # what an earlier call did is no speed of this one
                bar.total, bar.initial = total, done
            bar.update(done - bar.n)

        report = run_sfm(
            opened.capture,
            folder,
            settings,
            jobs=jobs,
            posed_here=opened.posed_here,
            normalization=opened.normalization,
            on_progress=show,
            on_message=bar.write,
        )
    _print(report)


def _print(report: SfmReport) -> None:
    if report.checks:
        print("camera                residual px  fitting  matches")
        for check in report.checks:
            print(_line(check))
    empty = [frame.index for frame in report.frames if not frame.points]
    if empty:
        print(f"warning: no points in {len(empty)} frames: {_shortened(empty)}")
    counts = [frame.points for frame in report.frames]
    errors = [frame.reprojection_error_px for frame in report.frames if frame.points]
    print(
        f"{report.folder}: {len(report.frames)} frames, {report.done_now} of them now, in {report.seconds:.1f} s; "
        f"points per frame {min(counts)} to {max(counts)} (median {np.median(counts):.0f}), "
        f"mean reprojection error {np.mean(errors) if errors else 0:.2f} px"
    )


def _line(check: CameraCheck) -> str:
    residual = "-" if check.residual_px is None else f"{check.residual_px:.2f}"
    ratio = "-" if check.inlier_ratio is None else f"{100 * check.inlier_ratio:.0f} %"
    return f"{check.name[:20]:<20} {residual:>12} {ratio:>8} {check.matches:>8}"


def _shortened(numbers: Sequence[int], most: int = 8) -> str:
    text = ", ".join(map(str, numbers[:most]))
    return text + (", ..." if len(numbers) > most else "")
