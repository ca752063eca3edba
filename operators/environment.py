# SPDX-License-Identifier: GPL-3.0-or-later
"""Check and Create the core environment."""

import shlex
import sys
from pathlib import Path

import bpy

from ..addon import checkup, jobs
from ..addon.environment import checkout, creation, default_folder
from ..addon.preferences import core_python
from ..addon.texts import draw_text
from ..core.errors import HoloreelError
from ..core.jobs import JobRecord
from .reporting import NeedsCore, Reporting

_DIALOG_WIDTH, _DIALOG_LETTERS = 720, 100


class HOLOREEL_OT_check_environment(NeedsCore, bpy.types.Operator):
    """Versions, and what it draws by."""

    bl_idname = "holoreel.check_environment"
    bl_label = "Check Core Environment"
    bl_description = "Run the core environment's Python once, and show its versions and whether it suits this add-on"
    bl_options = {"REGISTER"}

    def run(self, context: bpy.types.Context) -> None:
        """Ask; the preferences show the answer. In background mode, wait for it and report it."""
        checkup.begin(core_python())
        if bpy.app.background:
            checkup.wait()
            ((text, icon),) = checkup.lines()
            if icon == "ERROR":
                raise HoloreelError(text)
            self.report({"INFO"}, text)


class HOLOREEL_OT_create_environment(Reporting, bpy.types.Operator):
    """A virtual environment with all that Blender's own Python lacks."""

    bl_idname = "holoreel.create_environment"
    bl_label = "Create Core Environment"
    bl_description = (
        "Make a Python environment for training and exact rendering, or bring the one there up to date; shows the "
        "commands before they run"
    )
    bl_options = {"REGISTER"}

    folder: bpy.props.StringProperty(
        name="Folder",
        description="Where the environment goes; empty takes a folder among the extension's own files",
        subtype="DIR_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    base: bpy.props.StringProperty(
        name="Base Python",
        description="The Python it is made with, 3.11 or newer; empty takes Blender's own",
        subtype="FILE_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    package: bpy.props.StringProperty(
        name="Package",
        description=(
            "What Holoreel is installed from: a source checkout, a wheel, or an address that pip understands. The "
            "extension itself holds only what Blender's Python can run"
        ),
        subtype="FILE_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    wheels: bpy.props.StringProperty(
        name="Wheels",
        description="Folder with wheels of all that is needed: then nothing comes from the network",
        subtype="DIR_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    cuda: bpy.props.BoolProperty(
        name="For a Graphics Card",
        description="Install a torch for CUDA and gsplat, several gigabytes; otherwise the small torch for processors",
    )

    def record(self) -> JobRecord:
        """Return the job; raises `HoloreelError` where it cannot work."""
        folder = Path(bpy.path.abspath(self.folder)).expanduser() if self.folder else default_folder()
        wheels = str(Path(bpy.path.abspath(self.wheels)).expanduser()) if self.wheels else ""
        return creation(folder, self.base_python(), self.package or checkout(), wheels, self.cuda)

    def base_python(self) -> Path:
        """Return the Python that makes the environment."""
        return Path(bpy.path.abspath(self.base)).expanduser() if self.base else Path(sys.executable)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask for the paths, and show the commands."""
        return context.window_manager.invoke_props_dialog(self, width=_DIALOG_WIDTH, confirm_text="Create")

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the paths and the exact commands."""
        layout = self.layout
        layout.use_property_split, layout.use_property_decorate = True, False
        for name in ("folder", "base", "package", "wheels", "cuda"):
            layout.prop(self, name)
        try:
            commands = self.record().commands[:-1]
        except HoloreelError as error:
            draw_text(layout, str(error), _DIALOG_LETTERS, "ERROR")
            return
        for command in commands:
            draw_text(layout, shlex.join(command.argv), _DIALOG_LETTERS, "CONSOLE")

    def run(self, context: bpy.types.Context) -> None:
        """Start the job."""
        base = self.base_python()
        if not base.is_file():
            raise HoloreelError(f"{base}: there is no Python here; give another Base Python.")
        jobs.start(self.record(), base)
        self.report({"INFO"}, "The core environment is being made; the panel Jobs in the sidebar shows how far it is")


CLASSES = (HOLOREEL_OT_check_environment, HOLOREEL_OT_create_environment)

register, unregister = bpy.utils.register_classes_factory(CLASSES)
