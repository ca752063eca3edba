# SPDX-License-Identifier: GPL-3.0-or-later
"""In the sidebar: what a VideoRF alone has: its movie, and where its colors are seen from."""

import bpy

from ..addon.compat import get_input
from ..addon.fields import field_modifier, movie_of, movie_problem
from ..addon.nodes.field import DIRECTION
from ..addon.reels import INFO
from ..addon.texts import draw_text, letters_in
from ..operators.choose_rung import HOLOREEL_OT_choose_rung
from .reel import SubPanel


class HOLOREEL_PT_field(SubPanel, bpy.types.Panel):
    """The movie, the direction of view, and what is left out."""

    bl_label = "Field"
    bl_order = 2

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only for VideoRF reels."""
        return field_modifier(context.object) is not None

    def draw(self, context: bpy.types.Context) -> None:
        """Say which movie plays, or why none does; draw the settings."""
        played, layout = context.object, self.layout
        if (problem := movie_problem(played)) is not None:
            draw_text(layout, problem, letters_in(context.region), "ERROR")
        elif (movie := movie_of(played)) is not None:
            layout.label(text=bpy.path.basename(movie.filepath), icon="FILE_MOVIE")
        name = played.get(INFO, {}).get("rung", "")
        layout.operator_menu_enum(
            HOLOREEL_OT_choose_rung.bl_idname, "rung", text=f"Rate {name}", icon="RENDER_ANIMATION"
        )
        self.inputs(context, "Movie", "Seen From")
        if get_input(field_modifier(played), "Seen From") == DIRECTION or context.scene.camera is None:
            self.inputs(context, "Direction")
        self.inputs(context, "Minimum Opacity")


register, unregister = bpy.utils.register_classes_factory((HOLOREEL_PT_field,))
