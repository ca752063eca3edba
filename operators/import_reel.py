# SPDX-License-Identifier: GPL-3.0-or-later
"""File > Import > Holoreel reel, and files dropped into Blender."""

from pathlib import Path

import bpy
from bpy_extras.io_utils import ImportHelper, poll_file_object_drop

from ..addon import reels
from ..core.errors import HoloreelError

UNTURNED = "UNTURNED"
OWN_START, SCENE_START, CURRENT_FRAME = "OWN", "SCENE", "CURRENT"
ENDINGS = (".reel", ".ply", ".stgc", ".splatv")


class HOLOREEL_OT_import_reel(bpy.types.Operator, ImportHelper):
    """The importer, for one file or several."""

    bl_idname = "holoreel.import_reel"
    bl_label = "Import Reel"
    bl_description = (
        "Import Spacetime Gaussians from .reel, .ply, .stgc or .splatv files, or VideoRFs from .reel files; each "
        "becomes a point cloud that plays on the timeline"
    )
    bl_options = {"REGISTER", "UNDO", "PRESET"}

    filename_ext = ".reel"
    filter_glob: bpy.props.StringProperty(default=";".join(f"*{ending}" for ending in ENDINGS), options={"HIDDEN"})
    files: bpy.props.CollectionProperty(type=bpy.types.OperatorFileListElement, options={"HIDDEN", "SKIP_SAVE"})
    directory: bpy.props.StringProperty(subtype="DIR_PATH", options={"HIDDEN", "SKIP_SAVE"})

    sequence: bpy.props.BoolProperty(
        name="Sequence",
        description=(
            "Take several .ply, .stgc or .splatv files as the frames of one reel, in the order of their names; "
            "otherwise each becomes a reel"
        ),
        default=False,
    )
    start_at: bpy.props.EnumProperty(
        name="Start At",
        description="The scene frame that shows the first frame of the reel",
        items=[
            (OWN_START, "Own First Frame", "The reel's own first frame; the scene's, for files that have none"),
            (SCENE_START, "Scene Start", "The first frame of the scene"),
            (CURRENT_FRAME, "Current Frame", "The frame that the scene shows now"),
        ],
        default=OWN_START,
    )
    pace: bpy.props.EnumProperty(
        name="Pace",
        description="How fast the reel plays if its frame rate is not the scene's",
        items=[
            (reels.FRAME_BY_FRAME, "Frame by Frame", "Show one reel frame per scene frame"),
            (reels.REAL_TIME, "Real Time", "Keep the reel's own speed, whatever the scene's frame rate"),
        ],
        default=reels.FRAME_BY_FRAME,
    )
    set_scene_timing: bpy.props.BoolProperty(
        name="Set Scene Frame Range",
        description="Set the scene's frame range and frame rate to the reel's; otherwise the scene stays as it is",
        default=False,
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
    scale: bpy.props.FloatProperty(
        name="Scale",
        description="Blender units for one unit of the file",
        default=1.0,
        min=1e-6,
        max=1e6,
        soft_min=0.001,
        soft_max=1000.0,
    )
    detail: bpy.props.FloatProperty(
        name="Detail",
        description=(
            "Percentage of the Gaussians to import, the most important first; Detail in the sidebar hides some later "
            "without losing them"
        ),
        subtype="PERCENTAGE",
        default=100.0,
        min=0.01,
        max=100.0,
    )
    beside: bpy.props.BoolProperty(
        name="Store Beside the Reel",
        description=(
            "Keep the points of Gaussians in a .blend beside the reel, to which this file links, so that this file "
            "stays small; otherwise this file holds them and needs the reel no more"
        ),
        default=False,
    )
    rung: bpy.props.StringProperty(
        name="Rate",
        description="Which movie of a VideoRF to play, by its QP, as 20 or hevc:20; empty plays the best that is there",
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only in Object Mode."""
        cls.poll_message_set("Reels are imported in Object Mode")
        return context.mode == "OBJECT"

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        """Ask for files; for those that were dropped, ask for the options alone."""
        return self.invoke_popup(context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Read all files, then add an object for each; if a file is refused, nothing is added."""
        added: list[bpy.types.Object] = []
        try:
            paths = self._paths()
            together = self.sequence and len(paths) > 1
            found = [reels.read_sequence(paths)] if together else [reels.read(path) for path in paths]
            for one in found:
                added.append(reels.add_reel(context, one, self._options(context.scene)))
        except HoloreelError as error:
            for created in added:
                reels.remove_reel(created)
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        for chosen in context.selected_objects:
            chosen.select_set(False)
        for created in added:
            created.select_set(True)
            context.view_layer.objects.active = created
            for sentence in filter(None, created[reels.INFO]["report"].split("\n")):
                self.report({"WARNING"}, sentence)
        self.report({"INFO"}, f"Imported {', '.join(reels.summary(created) for created in added)}")
        return {"FINISHED"}

    def _options(self, scene: bpy.types.Scene) -> reels.Options:
        return reels.Options(
            start={SCENE_START: scene.frame_start, CURRENT_FRAME: scene.frame_current}.get(self.start_at),
            pace=self.pace,
            up=None if self.up == UNTURNED else self.up,
            scale=self.scale,
            set_scene_timing=self.set_scene_timing,
            detail=self.detail,
            beside=self.beside,
            rung=self.rung.strip() or None,
        )

    def _paths(self) -> list[Path]:
        names = [file.name for file in self.files if file.name]
        return [Path(self.directory, name) for name in names] if names else [Path(self.filepath)]


class HOLOREEL_FH_reel(bpy.types.FileHandler):
    """Reels dropped into the 3D viewport or the Outliner. A .ply may be anything: it goes through the menu."""

    bl_idname = "HOLOREEL_FH_reel"
    bl_label = "Holoreel"
    bl_import_operator = HOLOREEL_OT_import_reel.bl_idname
    bl_file_extensions = ";".join(ending for ending in ENDINGS if ending != ".ply")

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        """Where objects are dropped."""
        return poll_file_object_drop(context)


def _draw_menu(self: bpy.types.Menu, _context: bpy.types.Context) -> None:
    self.layout.operator(HOLOREEL_OT_import_reel.bl_idname, text=f"Holoreel reel ({', '.join(ENDINGS)})")


def register() -> None:
    """Register the operator, its entry in File > Import, and what takes dropped files."""
    bpy.utils.register_class(HOLOREEL_OT_import_reel)
    bpy.utils.register_class(HOLOREEL_FH_reel)
    bpy.types.TOPBAR_MT_file_import.append(_draw_menu)


def unregister() -> None:
    """Take them out again."""
    bpy.types.TOPBAR_MT_file_import.remove(_draw_menu)
    bpy.utils.unregister_class(HOLOREEL_FH_reel)
    bpy.utils.unregister_class(HOLOREEL_OT_import_reel)
