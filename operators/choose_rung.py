# SPDX-License-Identifier: GPL-3.0-or-later
"""Choose Rate: another movie of the same VideoRF."""

import bpy

from ..addon.fields import field_modifier, rungs_of, set_rung
from ..addon.reels import source_of
from ..core.errors import HoloreelError
from ..core.videorf.package import read_video_reel

_held: list[tuple[str, str, str]] = []  # Blender does not keep the words of a menu that is made while it is shown


def _rungs(_operator: bpy.types.Operator, context: bpy.types.Context | None) -> list[tuple[str, str, str]]:
    _held.clear()
    if context is not None and field_modifier(context.object) is not None:
        try:
            reel = read_video_reel(source_of(context.object))
        except HoloreelError:
            return _held
        _held.extend((name, name, f"{file}, {size / 1e6:.1f} MB") for name, file, size in rungs_of(reel))
    return _held


class HOLOREEL_OT_choose_rung(bpy.types.Operator):
    """Play the active VideoRF at another rate."""

    bl_idname = "holoreel.choose_rung"
    bl_label = "Choose Rate"
    bl_description = "Play the active VideoRF from another of its movies: all show the same, at different quality"
    bl_options = {"REGISTER", "UNDO"}

    rung: bpy.props.EnumProperty(
        name="Rate", description="Codec and quantization of the movie: fewer is better, and larger", items=_rungs
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only for VideoRF reels."""
        cls.poll_message_set("Select a VideoRF reel first")
        return field_modifier(context.object) is not None

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Change the movie, or say why it cannot be played."""
        try:
            reel = read_video_reel(source_of(context.object))
            chosen = set_rung(context.object, reel, self.rung or None)
        except HoloreelError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"Playing {chosen}")
        return {"FINISHED"}


register, unregister = bpy.utils.register_classes_factory((HOLOREEL_OT_choose_rung,))
