# SPDX-License-Identifier: GPL-3.0-or-later
"""`holoreel render FILE ...`: pictures of a reel, PLY, .splatv or trained model."""

import math
import sys
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from tqdm import tqdm

from ..camera import read_camera
from ..capture import Capture, read_capture
from ..draw import Drawing, Player, Quality, open_player
from ..errors import HoloreelError
from ..gaussians.decoder import Activation
from ..images import picture_path, write_image
from ..reel import Triple
from ..render import Backend


def run(
    file: tyro.conf.Positional[Path],
    /,
    out: Path,
    camera: Path | None = None,
    cameras: Path | None = None,
    split: Literal["all", "train", "test"] = "all",
    time: float | None = None,
    frame: float | None = None,
    background: str | None = None,
    format: Literal["png", "exr"] = "png",
    rung: str | None = None,
    quality: Quality | None = None,
    decoder_output: Activation | None = None,
    backend: Backend = "auto",
) -> None:
    """Draw a reel, PLY or .splatv: one picture of one camera, or all frames of all cameras of a capture.

    Colors are display-referred, in EXR as well; an EXR also holds alpha, and depth in its channel Z.

    Args:
        file: the .reel, .ply, .stgc or .splatv, or the NAME.model of a VideoRF.
        out: FILE.png or FILE.exr for one camera; a folder for a set (OUT/CAMERA/FRAME.png).
        camera: CAMERA.json with model, width, height, fx, fy, cx, cy, world_to_camera.
        cameras: instead, a capture (folder or transforms.json) whose cameras look.
        split: which cameras of the capture.
        time: normalized time, 0 at the first frame, 1 after the last.
        frame: instead, a frame of the timeline; sub-frames allowed (a VideoRF shows the frame before).
        background: color behind a lite model or a VideoRF as R,G,B from 0 to 1; the reel's own without it.
        format: what pictures of a set are written as.
        rung: of a VideoRF: which rate, by its QP as 20, or with its codec as hevc:20; the best without it.
        quality: of a VideoRF: full takes the steps of its training, fast and draft longer ones; full without it.
        decoder_output: what the decoder of a bare full model (.ply with a .pt beside it) ends in; sigmoid without it.
        backend: which rasterizer.
    """
    if (camera is None) == (cameras is None):
        raise HoloreelError("say who looks: either --camera CAMERA.json or --cameras CAPTURE.")
    if (time is not None and frame is not None) or (camera and time is None and frame is None):
        raise HoloreelError("say when, once: either --time from 0 to 1, or --frame.")
    if not all(math.isfinite(moment) for moment in (time or 0.0, frame or 0.0)):
        raise HoloreelError("--time and --frame are finite numbers: give one like 0.5.")
    if camera and out.suffix.lower() not in (".png", ".exr"):
        raise HoloreelError(f"--out {out}: one picture is written as .png or .exr; choose one of these endings.")
    color = None if background is None else parse_color(background)
    one = read_camera(camera) if camera else None
    many = read_capture(cameras) if cameras else None
    player = open_player(file, backend, decoder_output=decoder_output, rung=rung, quality=quality)
    if color is not None and not player.takes_background:
        raise HoloreelError(f"--background: the decoder of {file} colors every pixel; leave it away.")
    moment = frame if time is None else player.frame_at(time)
    for sentence in player.report:
        print(f"note: {sentence}", file=sys.stderr)
    if one and moment is not None:
        write_drawing(out, player.draw(one, moment, color))
        print(out)
    elif many:
        shots = plan(player, many, split, moment)
        for name, shown, label in tqdm(shots, unit="picture", dynamic_ncols=True, disable=not sys.stderr.isatty()):
            drawing = player.draw(many.cameras[name], shown, color)
            write_drawing(picture_path(out, name, label, f".{format}"), drawing)
        print(f"{len(shots)} pictures in {out}")


def plan(player: Player, capture: Capture, split: str, moment: float | None) -> list[tuple[str, float, str]]:
    """Return camera name, frame to draw and file name of each picture of a set: all of the capture's frames, or one.

    Frames that a truncated file lost are left out, as the player's report says.
    """
    names = capture.camera_names(None if split == "all" else split)
    if not names:
        raise HoloreelError(f"{capture.source} has no camera in the split '{split}': name another with --split.")
    if moment is not None:
        moments = [(moment, f"{moment:04g}")]
    else:
        lost = set(player.missing())
        numbered = enumerate(player.frames_of(capture), capture.frame_start)
        moments = [(shown, f"{number:04d}") for number, shown in numbered if shown not in lost]
    return [(name, shown, label) for name in names for shown, label in moments]


def write_drawing(path: Path, drawing: Drawing) -> None:
    """Write a PNG of the colors, or an EXR of colors, alpha and depth."""
    if path.suffix.lower() == ".exr":
        write_image(path, np.concatenate([drawing.image, drawing.alpha[:, :, None]], axis=2), drawing.depth)
    else:
        write_image(path, drawing.image)


def parse_color(text: str) -> Triple:
    """Read R,G,B as three numbers from 0 to 1."""
    try:
        red, green, blue = (float(part) for part in text.split(","))
    except ValueError:
        red = green = blue = -1.0
    if not all(0.0 <= part <= 1.0 for part in (red, green, blue)):
        raise HoloreelError(f"--background {text}: give three numbers from 0 to 1, like 0,0.5,1.")
    return red, green, blue
