# SPDX-License-Identifier: GPL-3.0-or-later
"""What the synthesis panel asks for, and the job that it becomes: `holoreel synth` on a copy of the open file."""

import sys
from pathlib import Path

import bpy

from ..core.errors import HoloreelError
from ..core.jobs import Command, JobRecord
from .environment import version_check
from .training import STATUS_FILE, split_options, whole_path

SCENE_COPY = "scene.blend"

_RIGS = (
    ("arc", "Arc", "Cameras on an arc in front of the scene, around the active camera's place"),
    ("dome", "Dome", "Cameras on a dome all around a subject"),
)


class HoloreelSynthSettings(bpy.types.PropertyGroup):
    """Which cameras film what, and where the capture goes; kept in the scene."""

    out: bpy.props.StringProperty(
        name="Capture",
        description="Folder of the capture to render",
        subtype="DIR_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    rig: bpy.props.EnumProperty(name="Rig", description="How the cameras stand", items=_RIGS)
    cameras: bpy.props.IntProperty(
        name="Cameras",
        description="How many cameras film; cam00 is held out for evaluation",
        default=12,
        min=1,
        max=1000,
    )
    size: bpy.props.IntVectorProperty(
        name="Size",
        description="Width and height of the pictures in pixels",
        size=2,
        default=(640, 360),
        min=8,
        max=16384,
    )
    samples: bpy.props.IntProperty(name="Samples", description="Cycles samples per pixel", default=64, min=1)
    scene_range: bpy.props.BoolProperty(
        name="Scene Range", description="Render the frame range of the scene", default=True
    )
    first_frame: bpy.props.IntProperty(name="First Frame", description="First frame to render", default=1, min=0)
    last_frame: bpy.props.IntProperty(name="Last Frame", description="Last frame to render", default=12, min=0)
    transparent: bpy.props.BoolProperty(
        name="Transparent",
        description="Render a subject without its background, as VideoRF needs it; otherwise all that is there",
    )
    depth: bpy.props.BoolProperty(name="Depth", description="Write depth maps too")
    options: bpy.props.StringProperty(
        name="Options", description="More flags of `holoreel synth`, as on the command line, such as --span 70 --rise 8"
    )


def synthesis(settings: HoloreelSynthSettings, scene: bpy.types.Scene, python: Path) -> JobRecord:
    """Return the job that renders what the settings ask for; raises `HoloreelError` where they cannot work.

    Its scene is `SCENE_COPY` in the job's folder, which `save_copy` puts there.
    """
    out = whole_path(settings.out, "Capture")
    first, last = settings.first_frame, settings.last_frame
    if settings.scene_range:
        first, last = scene.frame_start, scene.frame_end
    if not 0 <= first <= last:
        raise HoloreelError(f"frames {first} to {last} are no range: change them in the panel Synthesize.")
    argv = [str(python), "-I", "-m", "holoreel.core", "synth", f"{{job}}/{SCENE_COPY}", "--out", str(out)]
    argv += ["--frames", f"{first}:{last}", "--rig", settings.rig, "--cameras", str(settings.cameras)]
    argv += ["--size", "x".join(map(str, settings.size)), "--samples", str(settings.samples)]
    argv += ["--film", "transparent" if settings.transparent else "opaque"]
    argv += ["--depth"] if settings.depth else []
    argv += ["--blender", this_blender(), "--status", STATUS_FILE, *split_options(settings.options)]
    return JobRecord("synth", f"Synthesize {out.name}", [version_check(python), Command("", argv)], result=str(out))


def save_copy(folder: Path) -> None:
    """Save the open file, as it is now, into a folder; the open file keeps its name. Raises `HoloreelError`."""
    path = folder / SCENE_COPY
    try:
        bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True, check_existing=False)
    except RuntimeError as error:
        raise HoloreelError(f"{path} cannot be written ({error}): choose a log folder with room left.") from error
    if not path.is_file():
        raise HoloreelError(f"{path} could not be saved: choose a log folder with room left.")


def this_blender() -> str:
    """Return this Blender's program: the executable, or the Python that has the module bpy."""
    return bpy.app.binary_path or sys.executable


def register() -> None:
    """Let scenes keep what to synthesize."""
    bpy.utils.register_class(HoloreelSynthSettings)
    bpy.types.Scene.holoreel_synth = bpy.props.PointerProperty(
        type=HoloreelSynthSettings, name="Synthesis", description="What the panel Synthesize asks for"
    )


def unregister() -> None:
    """Take that out again."""
    del bpy.types.Scene.holoreel_synth
    bpy.utils.unregister_class(HoloreelSynthSettings)
