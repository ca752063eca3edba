# SPDX-License-Identifier: GPL-3.0-or-later
"""`holoreel train videorf CAPTURE --out REEL`: train a VideoRF."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tqdm import tqdm

from ..capture import CaptureOptions, read_capture
from ..status import StatusWriter
from ..videorf.config import PRESETS as PRESETS
from ..videorf.config import VideoConfig
from ..videorf.encode import reel_size
from ..videorf.run import RunPaths, TrainedVideo, VideoProgress, train_video

DEFAULT = "standard"


def command(preset: str) -> Callable[..., None]:
    """Return the command with a preset's settings as defaults."""

    def run(
        method: tyro.conf.Positional[Literal["videorf"]],
        capture: tyro.conf.Positional[Path],
        /,
        out: Path,
        preset: str = preset,
        resume: bool = False,
        workers: int = 1,
        keep_model: bool = True,
        status: Path | None = None,
        options: Annotated[CaptureOptions, tyro.conf.arg(name="")] = CaptureOptions(),  # noqa: B008
        config: Annotated[VideoConfig, tyro.conf.arg(name="")] = PRESETS[preset],
    ) -> None:
        """Train a reel from a capture with masks. Ctrl-C leaves a checkpoint beside the reel.

        Args:
            method: what to train: videorf, a radiance field as a video of feature images.
            capture: folder of a capture in any layout that `holoreel info` knows, its pictures with alpha or masks.
            out: the reel to write, NAME.reel.
            preset: settings to start from; the flags below change them.
            resume: go on behind the last frame that a stopped run has finished.
            workers: coarse fields that are trained at once, on machines with many cores.
            keep_model: keep NAME.model, from which other rungs can be made.
            status: JSON file that says how far the run is, for programs that look in; a preview lies beside it. Then
                there is no progress line.
            options: how the capture is read.
            config: the preset's settings.
        """
        train(capture, options, out, resume, workers, keep_model, StatusWriter(status), config)

    return run


def train(
    folder: Path,
    options: CaptureOptions,
    out: Path,
    resume: bool,
    workers: int,
    keep_model: bool,
    status: StatusWriter,
    config: VideoConfig,
) -> None:
    """Train, with a progress line on the terminal unless there is a status file."""
    capture = read_capture(folder, options)
    for note in capture.notes:
        print(note)
    with tqdm(unit="it", dynamic_ncols=True, desc="train", disable=status.path is not None) as bar:

        def show(progress: VideoProgress) -> None:
            done, total = progress.iteration, progress.iterations
            bar.n, bar.total = done, total
            bar.set_description(progress.stage, refresh=False)
            place = f"{progress.frame + 1}/{progress.frames}"
            quality = {} if progress.psnr is None else {"psnr": f"{progress.psnr:.2f}"}
            bar.set_postfix(frame=place, **quality, left=f"{progress.seconds_left:.0f}s")
            figures = {"frame": place} | ({} if progress.psnr is None else {"PSNR": f"{progress.psnr:.2f} dB"})
            status.tell(progress.stage, done, total, progress.seconds_left, figures, progress.preview)

        try:
            trained = train_video(capture, out, config, show, resume, workers=workers, keep_model=keep_model)
        except KeyboardInterrupt:
            bar.close()
            print(f"checkpoint: {RunPaths(out).checkpoint} (go on with --resume)")
            raise
    for line in summary(trained):
        print(line)


def summary(trained: TrainedVideo) -> list[str]:
    """Say in lines what a run made."""
    reel, model = trained.reel, trained.model
    seconds = ", ".join(f"{stage} {value:.0f} s" for stage, value in trained.seconds.items())
    vertices = ", ".join(f"{table.count:,}" for table in model.tables)
    lines = [
        f"{reel.path}: {reel.frame_count} frames in {len(reel.groups)} groups of {vertices} vertices",
        f"trained in {sum(trained.seconds.values()):.0f} s: {seconds}",
    ]
    for index, rung in enumerate(reel.rungs):
        size = reel_size(reel, index).per_frame / 1000
        lines.append(f"  rung {index}: {rung.codec} QP {rung.qp}, {size:.1f} KB per frame, all counted")
    return lines
