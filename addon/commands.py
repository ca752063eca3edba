# SPDX-License-Identifier: GPL-3.0-or-later
"""`blender -b --command holoreel COMMAND ...`: the command line `holoreel`, from inside Blender.

`import`, and `render` with `--engine`, are done by Blender itself. Everything else is what the core environment's
`holoreel` makes of the same arguments, with this Blender as the one that synthesizes. The `bpy` wheels, which have no
`--command`, run the same as `python -m holoreel.addon COMMAND ...`.
"""

import argparse
import math
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import bpy

from ..core.blender import ENVIRONMENT_VARIABLE, Blender, find_blender, run_in_blender
from ..core.camera import Camera, read_camera
from ..core.capture import read_capture
from ..core.errors import HoloreelError
from ..core.images import picture_path
from ..core.reel import VIDEORF, load_gaussians, reel_kind
from ..core.videorf.package import read_video_reel
from . import reels, render
from .compat import set_input
from .environment import child_environment, version_check
from .nodes.reel import COLORS, LOOKS
from .preferences import core_python

NAME = "holoreel"
USAGE = """usage: holoreel COMMAND ...

done by Blender:
  import   import reels into a scene and save it as a .blend
  render   with --engine: pictures of a reel, drawn by Cycles or EEVEE

done by the core environment (Preferences > Add-ons > Holoreel, or $HOLOREEL_PYTHON), as on its own command line:
  render   without --engine: pictures of a reel, drawn by Holoreel's own renderer
  synth, train, eval, export, info, convert, ...

`holoreel COMMAND --help` explains one command."""


def run(arguments: Sequence[str]) -> int:
    """Run one command; return its exit status: 2 for anything the user can mend."""
    if not arguments or arguments[0] in ("-h", "--help"):
        _say(USAGE)
        return 0 if arguments else 2
    name, rest = arguments[0], list(arguments[1:])
    try:
        if name == "import":
            _import(rest)
        elif name == "render" and any(word == "--engine" or word.startswith("--engine=") for word in rest):
            _render(rest)
        else:
            return _pass_on([name, *rest])
    except HoloreelError as error:
        print(f"holoreel {name}: {error}", file=sys.stderr)  # noqa: T201 - this is a command line
        return 2
    except SystemExit as ending:  # argparse has said what is wrong, or helped
        return int(ending.code or 0)
    return 0


def _import(arguments: list[str]) -> None:
    parser = _Parser("import", "Import reels into a scene and save it as a .blend.")
    parser.add_argument("files", nargs="+", metavar="FILE", help="a .reel, .ply, .stgc or .splatv")
    parser.add_argument("--out", required=True, type=Path, metavar="SCENE.blend", help="where the scene is saved")
    parser.add_argument("--into", type=Path, metavar="SCENE.blend", help="the scene to add to; an empty one without it")
    parser.add_argument("--start", type=float, help="scene frame of the first frame; the reel's own without it")
    parser.add_argument(
        "--pace",
        choices=("frames", "real_time"),
        default="frames",
        help="frames: one reel frame per scene frame; real_time: keep the reel's own speed",
    )
    parser.add_argument(
        "--up",
        choices=("file", *reels.UPRIGHT),
        help="the file's axis that shall point up, as --up=-Y; nothing is turned without it",
    )
    parser.add_argument("--scale", type=float, default=1.0, help="Blender units for one unit of the file")
    parser.add_argument(
        "--set-scene-timing", action="store_true", help="set the scene's frame range and rate to the (last) reel's"
    )
    parser.add_argument(
        "--detail", type=float, default=100.0, help="percentage of the Gaussians to import, the most important first"
    )
    parser.add_argument(
        "--beside", action="store_true", help="keep the points in a .blend beside the reel instead of in this one"
    )
    parser.add_argument("--rung", help="of a VideoRF: which rate, by its QP as 20; the best without it")
    parser.add_argument("--look", choices=_words(LOOKS), help="how the reels are shown")
    parser.add_argument("--color", choices=_words(COLORS), help="scene-linear colors, or display-referred (exact) ones")
    chosen = parser.parse_args(arguments)
    if chosen.out.suffix.lower() != ".blend":
        raise HoloreelError(f"--out {chosen.out}: a scene is saved as a .blend; choose this ending.")
    if not (math.isfinite(chosen.scale) and chosen.scale > 0.0 and 0.0 < chosen.detail <= 100.0):
        raise HoloreelError("--scale is above 0, and --detail above 0 and at most 100: give numbers like these.")
    _open(chosen.into)
    for file in chosen.files:
        imported = reels.import_reel(
            bpy.context,
            file,
            start=chosen.start,
            pace=reels.REAL_TIME if chosen.pace == "real_time" else reels.FRAME_BY_FRAME,
            up=reels.FROM_FILE if chosen.up == "file" else chosen.up,
            scale=chosen.scale,
            set_scene_timing=chosen.set_scene_timing,
            detail=chosen.detail,
            beside=chosen.beside,
            rung=chosen.rung,
        )
        for title, word, items in (("Look", chosen.look, LOOKS), ("Color", chosen.color, COLORS)):
            if word:
                set_input(reels.modifier_of(imported), title, _words(items)[word])
        for sentence in filter(None, imported[reels.INFO].get("report", "").split("\n")):
            _say(f"{file}: {sentence}")
    render.save_blend(chosen.out)
    _say(str(chosen.out))


def _open(path: Path | None) -> None:
    """Start from the user's start-up file without its objects, or from a .blend, whose scripts do not run."""
    if path is None:
        bpy.ops.wm.read_homefile(use_empty=True)
        return
    try:
        bpy.ops.wm.open_mainfile(filepath=str(path.absolute()), load_ui=False, use_scripts=False)
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[-1]
        raise HoloreelError(f"--into {path}: Blender cannot open it ({reason}).") from error


def _render(arguments: list[str]) -> None:
    parser = _Parser("render", "Draw a reel by one of Blender's engines: pictures of one camera or of a capture's.")
    parser.add_argument("file", type=Path, metavar="FILE", help="a .reel, .ply, .stgc or .splatv")
    parser.add_argument("--engine", required=True, choices=("cycles", "eevee"), help="what draws")
    parser.add_argument(
        "--out",
        required=True,
        type=Path,
        help="FILE.png or FILE.exr for one camera; a folder for a set (OUT/CAMERA/FRAME.png)",
    )
    looks = parser.add_mutually_exclusive_group(required=True)
    looks.add_argument("--camera", type=Path, help="CAMERA.json, as for `holoreel render`")
    looks.add_argument("--cameras", type=Path, help="instead, a capture whose cameras look")
    parser.add_argument("--split", choices=("all", "train", "test"), default="all", help="which cameras of the capture")
    when = parser.add_mutually_exclusive_group()
    when.add_argument("--time", type=float, help="normalized time: 0 at the first frame, 1 after the last")
    when.add_argument("--frame", type=float, help="instead, a frame of the reel's timeline; sub-frames allowed")
    parser.add_argument("--format", choices=("png", "exr"), default="png", help="what pictures of a set are written as")
    parser.add_argument("--background", metavar="R,G,B", help="color behind the reel, from 0 to 1; none without it")
    parser.add_argument("--look", choices=_words(LOOKS), default="splats", help="how the reel is shown")
    parser.add_argument(
        "--color",
        choices=_words(COLORS),
        default="display-referred",
        help="display-referred (exact) colors, or scene-linear ones under the view Standard",
    )
    chosen = parser.parse_args(arguments)
    setting = {
        "reel": str(chosen.file.absolute()),
        "look": _words(LOOKS)[chosen.look],
        "engine": chosen.engine.upper(),
        "color": _words(COLORS)[chosen.color],
        "background": None if chosen.background is None else _color(chosen.background),
    }
    shots = _shots(chosen)
    log = (chosen.out if chosen.cameras else chosen.out.parent) / "blender.log"
    run_in_blender(_this_blender(), "holoreel.addon.render:main", {"setting": setting, "shots": shots}, log=log)
    log.unlink(missing_ok=True)
    _say(str(chosen.out) if chosen.camera else f"{len(shots)} pictures in {chosen.out}")


def _shots(chosen: argparse.Namespace) -> list[dict[str, Any]]:
    """Return the pictures to draw, as `render.Shot` takes them."""
    start, count, numbered = _span(chosen.file)
    moment = chosen.time
    if chosen.frame is not None:
        moment = (chosen.frame - start) / count
    if moment is not None and not math.isfinite(moment):
        raise HoloreelError("--time and --frame are finite numbers: give one like 0.5.")
    if chosen.camera:
        if moment is None:
            raise HoloreelError("say when, once: either --time from 0 to 1, or --frame.")
        if chosen.out.suffix.lower() not in (".png", ".exr"):
            raise HoloreelError(f"--out {chosen.out}: one picture is written as .png or .exr; choose one of these.")
        return [_shot(read_camera(chosen.camera), moment, chosen.out)]
    capture = read_capture(chosen.cameras)
    names = capture.camera_names(None if chosen.split == "all" else chosen.split)
    if not names:
        raise HoloreelError(f"{capture.source} has no camera in the split '{chosen.split}': name another with --split.")
    frames = range(capture.frame_start, capture.frame_start + capture.frame_count)
    if moment is not None:
        moments = [(moment, f"{moment:04g}")]
    elif numbered:
        moments = [((frame - start) / count, f"{frame:04d}") for frame in frames]
    else:
        moments = [(time, f"{frame:04d}") for time, frame in zip(capture.times, frames, strict=True)]
    return [
        _shot(capture.cameras[name], time, picture_path(chosen.out, name, label, f".{chosen.format}"))
        for name in names
        for time, label in moments
    ]


def _shot(camera: Camera, time: float, out: Path) -> dict[str, Any]:
    return {"camera": camera.to_json(), "time": min(max(time, 0.0), 1.0), "out": str(out.absolute())}


def _span(path: Path) -> tuple[int, int, bool]:
    """Return a file's first frame, its number of frames, and whether it knows its frames' numbers."""
    if reel_kind(path) == VIDEORF:
        reel = read_video_reel(path)
        return reel.frame_start, reel.frame_count, True
    loaded = load_gaussians(path)
    reel = loaded.reel or loaded
    return reel.frame_start, reel.frame_count, loaded.reel is not None


def _pass_on(arguments: list[str]) -> int:
    """Let the core environment do it; it writes to our terminal, and is told of this Blender."""
    python = core_python()
    environment = child_environment() | {ENVIRONMENT_VARIABLE: str(_this_blender().path)}
    try:
        checked = subprocess.run(
            version_check(python).argv, env=environment, capture_output=True, text=True, check=False
        )
        if checked.returncode:
            said = checked.stderr.strip().splitlines() or [f"it ends with status {checked.returncode}"]
            raise HoloreelError(f"{python} cannot be used ({said[-1].rstrip('.')}): choose another core environment.")
        command = [str(python), "-I", "-m", "holoreel.core", *arguments]
        done = subprocess.run(command, env=environment, check=False)
    except OSError as error:
        raise HoloreelError(f"{python} cannot be run ({error.strerror}): choose another core environment.") from error
    return done.returncode if done.returncode >= 0 else 128 - done.returncode


def _this_blender() -> Blender:
    """The Blender that runs this: the executable, or the Python whose module it is."""
    return find_blender(bpy.app.binary_path or sys.executable)


def _color(text: str) -> list[float]:
    try:
        color = [float(part) for part in text.split(",")]
    except ValueError:
        color = []
    if len(color) != 3 or not all(0.0 <= part <= 1.0 for part in color):
        raise HoloreelError(f"--background {text}: give three numbers from 0 to 1, like 0,0.5,1.")
    return color


def _words(items: Iterable[str]) -> dict[str, str]:
    """Map words for a command line to the names of a menu's items: `scene-linear` to `Scene-Linear`."""
    return {name.split(" (")[0].lower().replace(" ", "-"): name for name in items}


def _say(text: str) -> None:
    print(text, flush=True)  # noqa: T201 - this is a command line


class _Parser(argparse.ArgumentParser):
    """A parser that calls itself as the user does."""

    def __init__(self, name: str, description: str) -> None:
        super().__init__(prog=f"{NAME} {name}", description=description)


_handles: list[object] = []


def register() -> None:
    """Let Blender know the command."""
    _handles.append(bpy.utils.register_cli_command(NAME, run))


def unregister() -> None:
    """Let Blender forget it."""
    while _handles:
        bpy.utils.unregister_cli_command(_handles.pop())
