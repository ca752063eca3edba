# SPDX-License-Identifier: GPL-3.0-or-later
"""The group that a reel's modifier holds: timeline → evaluation → crop, color, look."""

from .builder import Tree
from .evaluation import detail_inputs, play, timeline_inputs
from .library import node_group
from .show import (
    COLOR_TOOLTIP,
    COLORS,
    DISPLAY,
    HULL,
    LINEAR,
    LOOK_PANEL,
    LOOKS,
    POINTS,
    SPLATS,
    set_show_defaults,
    show,
    show_inputs,
)

__all__ = [
    "COLORS",
    "COLOR_TOOLTIP",
    "DISPLAY",
    "HULL",
    "LINEAR",
    "LOOKS",
    "LOOK_PANEL",
    "NAME",
    "POINTS",
    "SPLATS",
    "reel",
]

NAME = "Holoreel Reel"


@node_group(NAME, 9, "Play Spacetime Gaussians on the timeline")
def reel(tree: Tree) -> None:
    """Takes the points of `attributes.TABLE`."""
    cloud = tree.geometry_input()
    mapping, kept, shown = timeline_inputs(tree), detail_inputs(tree), show_inputs(tree)
    tree.output("Geometry", show(tree, play(tree, cloud, mapping, kept), shown), "What renders")
    set_show_defaults(tree)
    tree.set_menu_default("Repeat", "Hold")
