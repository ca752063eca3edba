# SPDX-License-Identifier: GPL-3.0-or-later
"""File > Import > Holoreel reel."""

from pathlib import Path

import bpy
from bpy_extras.io_utils import ImportHelper

from ..addon import reels
from ..core.errors import HoloreelError
from ..core.reel import load_gaussians

UNTURNED = "UNTURNED"


class HOLOREEL_OT_import_reel(bpy.types.Operator, ImportHelper):
    """The importer, for one file or several."""

    bl_idname = "holoreel.import_reel"
    bl_label = "Import Reel"
    bl_description = (
        "Import Spacetime Gaussians from .reel, .ply, .stgc or .splatv files; each becomes a point cloud that plays "
        "on the timeline"
    )
    bl_options = {"REGISTER", "UNDO"}

    filename_ext = ".reel"
    filter_glob: bpy.props.StringProperty(default="*.reel;*.ply;*.stgc;*.splatv", options={"HIDDEN"})
    files: bpy.props.CollectionProperty(type=bpy.types.OperatorFileListElement, options={"HIDDEN", "SKIP_SAVE"})
    directory: bpy.props.StringProperty(subtype="DIR_PATH", options={"HIDDEN", "SKIP_SAVE"})

    pace: bpy.props.EnumProperty(
        name="Pace",
        description="How fast the reel plays if its frame rate is not the scene's",
        items=[
            (reels.FRAME_BY_FRAME, "Frame by Frame", "Show one reel frame per scene frame"),
            (reels.REAL_TIME, "Real Time", "Keep the reel's own speed, whatever the scene's frame rate"),
        ],
        default=reels.FRAME_BY_FRAME,
    )
    up: bpy.props.EnumProperty(
        name="Up",
        description="The file's axis that shall point up",
        items=[
            (UNTURNED, "Unturned", "Turn nothing, so that the reel stays where its cameras saw it"),
            (reels.FROM_FILE, "From File", "Turn as the file says, if it says so"),
            *((axis, axis, f"{axis} of the file points up") for axis in reels.UPRIGHT),
        ],
        default=UNTURNED,
    )
    set_scene_timing: bpy.props.BoolProperty(
        name="Set Scene Frame Range",
        description="Set the scene's frame range and frame rate to the reel's; otherwise the scene stays as it is",
        default=False,
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only in Object Mode."""
        cls.poll_message_set("Reels are imported in Object Mode")
        return context.mode == "OBJECT"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Read all files, then add an object for each; a file that cannot be read stops before anything is added."""
        try:
            loaded = [load_gaussians(path) for path in self._paths()]
        except HoloreelError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        for chosen in context.selected_objects:
            chosen.select_set(False)
        for one in loaded:
            up = None if self.up == UNTURNED else self.up
            created = reels.add_reel(context, one, pace=self.pace, up=up, set_scene_timing=self.set_scene_timing)
            created.select_set(True)
            context.view_layer.objects.active = created
            for sentence in reels.report_of(one):
                self.report({"WARNING"}, sentence)
        return {"FINISHED"}

    def _paths(self) -> list[Path]:
        names = [file.name for file in self.files if file.name]
        return [Path(self.directory, name) for name in names] if names else [Path(self.filepath)]


def _draw_menu(self: bpy.types.Menu, _context: bpy.types.Context) -> None:
    self.layout.operator(HOLOREEL_OT_import_reel.bl_idname, text="Holoreel reel (.reel, .ply, .stgc, .splatv)")


def register() -> None:
    """Register the operator and its entry in File > Import."""
    bpy.utils.register_class(HOLOREEL_OT_import_reel)
    bpy.types.TOPBAR_MT_file_import.append(_draw_menu)


def unregister() -> None:
    """Take both out again."""
    bpy.types.TOPBAR_MT_file_import.remove(_draw_menu)
    bpy.utils.unregister_class(HOLOREEL_OT_import_reel)
