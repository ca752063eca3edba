# SPDX-License-Identifier: GPL-3.0-or-later
"""`holoreel synth`."""

import re
import time
from collections import deque
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tqdm import tqdm

from ..blender import find_blender
from ..errors import HoloreelError
from ..images import Image, read_image
from ..rig import request as rig_request
from ..runs import PREVIEW_PIXELS
from ..status import StatusWriter
from ..synth import SynthJob, synthesize


def run(
    scene: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE.blend")],
    /,
    out: Path,
    frames: str,
    rig: Literal["arc", "dome"] = "arc",
    cameras: int = 12,
    size: str = "320x180",
    samples: int = 64,
    holdout: tuple[int, ...] = (0,),
    film: Literal["opaque", "transparent"] = "opaque",
    depth: bool = False,
    seed_points: int = 20_000,
    denoise: bool = True,
    engine: Literal["cycles"] = "cycles",
    target: tuple[float, float, float] | None = None,
    radius: float | None = None,
    azimuth: float | None = None,
    elevation: float | None = None,
    fov: float | None = None,
    span: float | None = None,
    rise: float | None = None,
    seed: int = 0,
    blender: Path | None = None,
    overwrite: bool = False,
    status: Path | None = None,
) -> None:
    """Render a multi-view capture from a Blender scene; a call that was stopped goes on when it is repeated.

    Args:
        scene: The .blend file.
        out: Folder of the capture; transforms.json is written there when all views are done.
        frames: First and last frame, both included, as 1:12.
        rig: How the cameras stand: on an arc in front of the scene, or on a dome all around a subject.
        cameras: Number of cameras; cam00 is the one in the middle of the arc.
        size: Width and height of the pictures in pixels, as 320x180.
        samples: Cycles samples per pixel.
        holdout: Cameras kept out of the training, for evaluation.
        film: Whether the background is part of the pictures, or transparent: then only a subject is captured, and the
            box around all its motion is written down.
        depth: Also write depth maps (EXR, planar z).
        seed_points: Seed points per frame, from the depth of the training cameras; 0 for none.
        denoise: Denoise the pictures.
        engine: Render engine.
        target: The point the rig aims at, instead of what the scene suggests.
        radius: Distance from the target, instead of the active camera's.
        azimuth: Direction of the rig's middle in degrees from +x, instead of the active camera's.
        elevation: Elevation of the rig's middle in degrees, instead of the active camera's (of the dome: 30).
        fov: Horizontal field of view in degrees, instead of the active camera's.
        span: Degrees of azimuth that the rig spans: 50 of the arc, 360 of the dome.
        rise: Degrees by which cameras stand higher and lower than the middle: 4 on the arc, 35 on the dome.
        seed: Seed of all that is random.
        blender: The blender executable, or a Python that has bpy.
        overwrite: Replace the capture of another job in this folder.
        status: JSON file that says how far the job is, for programs that look in; a small picture of the latest view
            lies beside it. Then there is no progress line.
    """
    width, height = parse_size(size)
    request = rig_request(
        rig, cameras, width, height, target=target, radius=radius, azimuth_degrees=azimuth,
        elevation_degrees=elevation, fov_degrees=fov, span_degrees=span, rise_degrees=rise,
    )  # fmt: skip
    job = SynthJob(scene, request, parse_frames(frames), rig, samples, holdout, film, depth, seed_points, denoise, seed)
    begin, told = time.monotonic(), StatusWriter(status)
    with tqdm(unit="view", dynamic_ncols=True, smoothing=0.1, disable=status is not None) as bar:
        pictures: deque[Path] = deque(maxlen=1)
        before: list[int] = []  # the views of an earlier call, which say nothing about the speed of this one

        def show(done: int, total: int) -> None:
            if not before:
                before.append(done)
                bar.total, bar.initial = total, done
            bar.update(done - bar.n)
            made = done - before[0]
            left = (time.monotonic() - begin) / made * (total - done) if made else None
            preview = partial(small_picture, pictures[-1]) if pictures else None
            told.tell("render", done, total, left, {"views": f"{done} of {total}"}, preview)

        result = synthesize(
            job, out, lambda: find_blender(blender), overwrite=overwrite, on_progress=show, on_picture=pictures.append
        )
    for warning in result.warnings:
        print(f"warning: {warning}: is the camera inside something, or does it see nothing?")
    seconds = time.monotonic() - begin
    print(
        f"{result.transforms}: {cameras} cameras x {job.frame_count} frames, {result.rendered} views in {seconds:.1f} s"
    )


def small_picture(path: Path) -> Image:
    """Read every so many pixels of a picture: as few as a preview has."""
    picture = read_image(path)
    step = -(-max(picture.shape[:2]) // PREVIEW_PIXELS)
    return picture[step // 2 :: step, step // 2 :: step]


def parse_size(text: str) -> tuple[int, int]:
    """Read `320x180` as width and height."""
    match = re.fullmatch(r"(\d{1,6})[x×](\d{1,6})", text.strip())
    if not match:
        raise HoloreelError(f"--size {text!r} is not understood: write width and height in pixels, as 320x180.")
    return int(match[1]), int(match[2])


def parse_frames(text: str) -> tuple[int, int]:
    """Read `1:12` as the first and the last frame; a single number is a single frame."""
    match = re.fullmatch(r"(\d{1,7})(?::(\d{1,7}))?", text.strip())
    if not match:
        raise HoloreelError(f"--frames {text!r} is not understood: write the first and the last frame, as 1:12.")
    return int(match[1]), int(match[2] or match[1])
