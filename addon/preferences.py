# SPDX-License-Identifier: GPL-3.0-or-later
"""The add-on's preferences, and how the rest of it asks for them.

Where Holoreel runs as a plain package (a checkout registered by a script), Blender keeps no preferences for it: the
functions below then give the defaults.
"""

from pathlib import Path

import bpy

from ..core.errors import HoloreelError
from . import checkup, environment
from .environment import PACKAGE
from .texts import draw_text

_DEVICES = (
    ("auto", "Automatic", "The graphics card where the core environment has a working CUDA, else the processor"),
    ("cpu", "Processor", "The processor, with Holoreel's own kernels"),
    ("cuda", "Graphics Card", "An NVIDIA graphics card; needs a torch for CUDA and gsplat in the core environment"),
)
_LETTERS = 80  # in a line
_DEFAULTS = {"python": "", "device": "auto", "cache_mb": 2048, "log_folder": ""}


class HoloreelPreferences(bpy.types.AddonPreferences):
    """What holds for all files."""

    bl_idname = PACKAGE

    python: bpy.props.StringProperty(
        name="Core Environment",
        description=(
            "The Python that trains, synthesizes and renders outside Blender: an interpreter, or the folder of a "
            "virtual environment, in which Holoreel is installed. Empty takes $HOLOREEL_PYTHON, or the environment "
            "that Create has made"
        ),
        subtype="FILE_PATH",
        default=_DEFAULTS["python"],
    )
    device: bpy.props.EnumProperty(
        name="Device", description="What training and the render engine compute on", items=_DEVICES
    )
    cache_mb: bpy.props.IntProperty(
        name="Cache",
        description="Megabytes of memory in which the render engine keeps reels it has opened",
        default=_DEFAULTS["cache_mb"],
        min=64,
        max=1 << 20,
    )
    log_folder: bpy.props.StringProperty(
        name="Log Folder",
        description="Where jobs keep their logs and their state; empty takes a folder among the extension's own files",
        subtype="DIR_PATH",
        default=_DEFAULTS["log_folder"],
    )

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the core environment and how it is, then the rest."""
        layout = self.layout
        layout.use_property_split, layout.use_property_decorate = True, False
        layout.prop(self, "python")
        try:
            found, icon = str(core_python()), "CONSOLE"
        except HoloreelError as error:
            found, icon = str(error), "ERROR"
        draw_text(layout, found, _LETTERS, icon)
        for line, icon in checkup.lines():
            draw_text(layout, line, _LETTERS, icon)
        row = layout.row()
        row.operator("holoreel.check_environment", icon="CHECKMARK")
        row.operator("holoreel.create_environment", icon="ADD")
        for name in ("device", "cache_mb", "log_folder"):
            layout.prop(self, name)


def _get(name: str) -> object:
    entry = bpy.context.preferences.addons.get(PACKAGE)
    stored = getattr(entry, "preferences", None)
    return _DEFAULTS[name] if stored is None else getattr(stored, name)


def core_python() -> Path:
    """Return the interpreter of the core environment; raises `HoloreelError` with a remedy where there is none."""
    return environment.find_python(str(_get("python")))


def device() -> str:
    """Return `auto`, `cpu` or `cuda`, as --backend takes them."""
    return str(_get("device"))


def cache_mb() -> int:
    """Return how many megabytes the render engine may keep reels in."""
    return int(_get("cache_mb"))  # type: ignore[call-overload]


def log_folder() -> Path:
    """Return the folder of logs and of the state of jobs; it need not exist yet."""
    chosen = str(_get("log_folder"))
    return Path(chosen).expanduser() if chosen else environment.user_folder("logs")


def choose_environment(python: str) -> None:
    """Take this core environment from now on, where Blender keeps preferences for the add-on."""
    entry = bpy.context.preferences.addons.get(PACKAGE)
    if entry is not None and entry.preferences is not None:
        entry.preferences.python = python


def register() -> None:
    """Register the preferences."""
    bpy.utils.register_class(HoloreelPreferences)


def unregister() -> None:
    """Take them out again."""
    bpy.utils.unregister_class(HoloreelPreferences)
