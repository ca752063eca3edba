# SPDX-License-Identifier: GPL-3.0-or-later
"""What the training panel asks for, and the job that it becomes: `holoreel train` in the core environment."""

import shlex
from pathlib import Path

import bpy

from ..core import presets
from ..core.errors import HoloreelError
from ..core.jobs import Command, JobRecord
from .environment import version_check

STATUS_FILE = "{job}/status.json"  # `core.jobs.begin` puts the job's folder in

_METHODS = (
    ("stg", "Spacetime Gaussians", "Whole scenes: Gaussians that move, turn, come and go"),
    ("videorf", "VideoRF", "A subject with masks: a radiance field whose features are a video"),
)


class HoloreelTrainSettings(bpy.types.PropertyGroup):
    """What to train, from what, and where it goes; kept in the scene."""

    capture: bpy.props.StringProperty(
        name="Capture",
        description="Folder of a multi-view recording, in any layout that `holoreel info` knows",
        subtype="DIR_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    out: bpy.props.StringProperty(
        name="Reel",
        description="The .reel file to write; its data go into files beside it",
        subtype="FILE_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    method: bpy.props.EnumProperty(name="Method", description="What kind of reel to train", items=_METHODS)
    stg_preset: bpy.props.EnumProperty(
        name="Preset", description="Settings to train Spacetime Gaussians with", items=presets.STG
    )
    videorf_preset: bpy.props.EnumProperty(
        name="Preset", description="Settings to train a VideoRF with", items=presets.VIDEORF
    )
    all_frames: bpy.props.BoolProperty(
        name="All Frames", description="Take all frames that the capture has", default=True
    )
    first_frame: bpy.props.IntProperty(
        name="First Frame", description="First frame to take, numbered as the capture's files number them", min=0
    )
    last_frame: bpy.props.IntProperty(
        name="Last Frame",
        description="Last frame to take, numbered as the capture's files number them",
        default=49,
        min=0,
    )
    options: bpy.props.StringProperty(
        name="Options",
        description="More flags of `holoreel train`, as on the command line, such as --iterations 7000 --scale 2",
    )
    go_on: bpy.props.BoolProperty(
        name="Go On",
        description="Go on from the checkpoint that a stopped run has left beside the reel, with the same settings",
    )
    overwrite: bpy.props.BoolProperty(name="Overwrite", description="Replace a reel of this name")
    import_when_done: bpy.props.BoolProperty(
        name="Import It", description="Import the reel into this scene once it is trained", default=True
    )

    @property
    def preset(self) -> str:
        """The preset of the method that is chosen."""
        return str(self.stg_preset if self.method == "stg" else self.videorf_preset)


def training(settings: HoloreelTrainSettings, python: Path, device: str) -> JobRecord:
    """Return the job that trains what the settings ask for; raises `HoloreelError` where they cannot work."""
    capture, out = whole_path(settings.capture, "Capture"), whole_path(settings.out, "Reel")
    if not capture.exists():
        raise HoloreelError(f"{capture}: there is no capture here; choose its folder in the panel Train.")
    if out.suffix != ".reel":
        out = out.with_name(f"{out.name}.reel")
    checkpoint = out.with_suffix(".checkpoint")
    if out.exists() and not settings.overwrite:
        raise HoloreelError(f"{out} is there already: choose another name, or tick Overwrite.")
    if checkpoint.exists() and not settings.go_on:
        raise HoloreelError(
            f"{checkpoint}: a stopped run lies here; tick Go On, resume it in the panel Jobs, or delete it."
        )
    argv = [str(python), "-I", "-m", "holoreel.core", "train", settings.method, str(capture), "--out", str(out)]
    argv += ["--preset", settings.preset, "--status", STATUS_FILE]
    if not settings.all_frames:
        argv += ["--frames", f"{settings.first_frame}:{settings.last_frame}"]
    if settings.method == "stg" and device != "auto":
        argv += ["--backend", device]
    argv += split_options(settings.options)
    if checkpoint.exists():
        argv.append("--resume")
    return JobRecord(
        "train",
        f"Train {out.stem}",
        [version_check(python), Command("", argv)],
        result=str(out),
        checkpoint=str(checkpoint),
        resume_flag="--resume",
    )


def whole_path(text: str, name: str) -> Path:
    """Return a path of a panel's field as a whole one; raises `HoloreelError` where that cannot be told."""
    if not text:
        raise HoloreelError(f"{name} is empty: choose a path in the panel.")
    if text.startswith("//") and not bpy.data.filepath:
        raise HoloreelError(f"{name} is {text}, beside a file that has no place yet: save the .blend first.")
    path = Path(bpy.path.abspath(text)).expanduser()
    if not path.is_absolute():
        raise HoloreelError(
            f"{name} is {text}: give the whole path, or one that begins with // for the .blend's folder."
        )
    return path


def split_options(text: str) -> list[str]:
    """Return flags as a shell would split them; raises `HoloreelError` for quotes that do not close."""
    try:
        return shlex.split(text)
    except ValueError as error:
        raise HoloreelError(f"Options are not understood ({error}): write them as on the command line.") from error


def register() -> None:
    """Let scenes keep what to train."""
    bpy.utils.register_class(HoloreelTrainSettings)
    bpy.types.Scene.holoreel_train = bpy.props.PointerProperty(
        type=HoloreelTrainSettings, name="Training", description="What the panel Train asks for"
    )


def unregister() -> None:
    """Take that out again."""
    del bpy.types.Scene.holoreel_train
    bpy.utils.unregister_class(HoloreelTrainSettings)
