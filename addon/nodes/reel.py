# SPDX-License-Identifier: GPL-3.0-or-later
"""The group that a reel's modifier holds: timeline → evaluation → color → look."""

from typing import Any

import bpy

from .builder import Geometry, Tree
from .evaluation import detail_inputs, play, timeline_inputs
from .library import node_group
from .looks import linear_color, points, points_inputs, splats, splats_inputs

POINTS, SPLATS = "Points", "Splats"
LOOKS = {
    SPLATS: "The splats the model was trained as, facing the active camera; exact in Cycles and EEVEE",
    POINTS: "Opaque points; fast, for any camera and render engine",
}
LINEAR, DISPLAY = "Scene-Linear", "Display-Referred (Exact)"
COLORS = {
    LINEAR: "Convert the colors to scene-linear, to mix with an ordinary scene under Standard or AgX",
    DISPLAY: "Leave the colors as they were trained; exact with the view transform Raw",
}
COLOR_TOOLTIP = (
    "A reel's colors are those of a display. Scene-Linear converts them, so that the reel looks right in an ordinary "
    "scene under Standard or AgX, but soft edges blend slightly differently than in training. Display-Referred leaves "
    "them alone and blends as in training: exact, if the view transform is Raw"
)
LOOK_PANEL = "Look"
NAME = "Holoreel Reel"


@node_group(NAME, 3, "Play Spacetime Gaussians on the timeline")
def reel(tree: Tree) -> None:
    """Takes the points of `attributes.TABLE`."""
    cloud = tree.geometry_input()
    look = tree.menu_input("Look", "How the Gaussians are shown", panel=LOOK_PANEL)
    color = tree.menu_input("Color", COLOR_TOOLTIP, panel=LOOK_PANEL)
    mapping, kept = timeline_inputs(tree), detail_inputs(tree)
    of_points, of_splats = points_inputs(tree), splats_inputs(tree)

    cloud = play(tree, cloud, mapping, kept)
    colored = {DISPLAY: cloud, LINEAR: _chain(tree, linear_color(), {"Geometry": cloud})}
    cloud = tree.switch(color, {name: (tip, colored[name]) for name, tip in COLORS.items()}, "GEOMETRY")
    shown = {
        POINTS: _chain(tree, points(), {"Geometry": cloud, **of_points}),
        SPLATS: _chain(tree, splats(), {"Geometry": cloud, **of_splats}),
    }
    cloud = tree.switch(look, {name: (tip, shown[name]) for name, tip in LOOKS.items()}, "GEOMETRY")
    tree.output("Geometry", cloud, "What renders")
    for name, default in (("Look", SPLATS), ("Color", LINEAR), ("Repeat", "Hold")):
        tree.set_menu_default(name, default)


def _chain(tree: Tree, group: bpy.types.NodeTree, inputs: dict[str, Any]) -> Geometry:
    return Geometry(tree, tree.group(group, inputs).outputs["Geometry"])
