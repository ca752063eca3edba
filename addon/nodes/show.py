# SPDX-License-Identifier: GPL-3.0-or-later
"""From evaluated points to what renders, whatever they come from: crop → color → look.

Looks read the attributes `rgb`, `opacity`, `scale` (standard deviations) and `rotation` (none: unrotated).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import bpy

from .builder import Boolean, Geometry, Tree
from .crop import OFF, crop, crop_inputs
from .hull import hull, hull_inputs
from .library import node_group
from .looks import camera_inputs, linear_color, near_input, points, points_inputs, splats
from .view import view_camera

SPLATS, HULL, POINTS = "Splats", "Hull", "Points"
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


@dataclass(frozen=True)
class Look:
    """One way to show points: its node group, the inputs that it has alone, and what the menu says of it."""

    tooltip: str
    group: Callable[[], bpy.types.NodeTree]
    inputs: Callable[[Tree], dict[str, Any]]


LOOKS = {
    SPLATS: Look(
        "The splats the model was trained as, facing the active camera; exact in Cycles and EEVEE",
        splats,
        near_input,
    ),
    HULL: Look(
        "A small closed surface around every Gaussian, for any ray: fisheye cameras, mirrors, shadows, instances. For "
        "Cycles; where Gaussians overlap, their order differs slightly from training",
        hull,
        hull_inputs,
    ),
    POINTS: Look("Opaque points; fast, for any camera and render engine", points, points_inputs),
}


def show_inputs(tree: Tree) -> dict[str, Any]:
    """Declare the inputs of look, color and crop; return them by name. Follow with `set_show_defaults`."""
    shown = {
        "Look": tree.menu_input("Look", "How the reel is shown", panel=LOOK_PANEL),
        "Color": tree.menu_input("Color", COLOR_TOOLTIP, panel=LOOK_PANEL),
        "Workbench": tree.boolean_input(
            "Workbench",
            "Show points, because Workbench draws nothing transparent; follows the scene's render engine by itself",
            False,
            LOOK_PANEL,
        ),
        "Holoreel Engine": tree.boolean_input(
            "Holoreel Engine",
            "Make nothing for renders, because the Holoreel engine draws the reel from its file; follows the scene's "
            "render engine by itself",
            False,
            LOOK_PANEL,
        ),
    }
    shown |= camera_inputs(tree)
    for look in LOOKS.values():
        shown |= look.inputs(tree)
    return shown | crop_inputs(tree)


def set_show_defaults(tree: Tree, look: str = SPLATS) -> None:
    """Choose what the menus of `show_inputs` show first, once `show` has linked them."""
    for name, item in (("Look", look), ("Color", LINEAR), ("Crop", OFF)):
        tree.set_menu_default(name, item)


@node_group("Holoreel Show", 5, "Crop evaluated points, choose their colors, and show them in one of the looks")
def show_group(tree: Tree) -> None:
    """The inputs are those of `show_inputs`."""
    cloud = tree.geometry_input()
    inputs = show_inputs(tree)
    cropping = {name: inputs[name] for name in ("Crop", "Crop Object")}
    cloud = _chain(tree, crop(), {"Geometry": cloud, **cropping})
    colored = {DISPLAY: cloud, LINEAR: _chain(tree, linear_color(), {"Geometry": cloud})}
    cloud = tree.switch(inputs["Color"], {name: (tip, colored[name]) for name, tip in COLORS.items()}, "GEOMETRY")
    shown = {name: (look.tooltip, _looking(tree, look, cloud, inputs)) for name, look in LOOKS.items()}
    # Without a camera there is nothing to face, and Workbench draws nothing transparent.
    view = tree.group(view_camera(), {name: inputs[name] for name in ("Follow View", "Workbench")}).outputs
    simple = shown[POINTS][1]
    faced = tree.choose(Boolean(tree, view["Is There"]), shown[SPLATS][1], simple, "GEOMETRY")
    shown[SPLATS] = (shown[SPLATS][0], faced)
    rendered = tree.switch(inputs["Look"], shown, "GEOMETRY")
    rendered = tree.choose(Boolean(tree, view["Opaque"]), simple, rendered, "GEOMETRY")
    in_viewport = Boolean(tree, tree.node("GeometryNodeIsViewport").outputs[0])
    rendered = tree.unless(inputs["Holoreel Engine"] & ~in_viewport, rendered)
    tree.output("Geometry", rendered, "What renders")
    set_show_defaults(tree)


def show(tree: Tree, cloud: Geometry, inputs: dict[str, Any]) -> Geometry:
    """Add the node that shows evaluated points; `inputs` comes from `show_inputs`."""
    return _chain(tree, show_group(), {"Geometry": cloud, **inputs})


def _looking(tree: Tree, look: Look, cloud: Geometry, inputs: dict[str, Any]) -> Geometry:
    group = look.group()
    own = {item.name for item in group.interface.items_tree if item.item_type == "SOCKET" and item.in_out == "INPUT"}
    return _chain(tree, group, {"Geometry": cloud, **{name: inputs[name] for name in own if name in inputs}})


def _chain(tree: Tree, group: bpy.types.NodeTree, inputs: dict[str, Any]) -> Geometry:
    return Geometry(tree, tree.group(group, inputs).outputs["Geometry"])
