# SPDX-License-Identifier: GPL-3.0-or-later
"""Cropping: keep or remove the Gaussians whose centers lie in an object's box or mesh."""

from typing import Any

from .builder import Boolean, Float, Geometry, Matrix, Tree, Vector
from .library import node_group

CROP_PANEL = "Crop"
OFF, KEEP, REMOVE = "Off", "Keep Inside", "Remove Inside"
MODES = {
    OFF: "Show everything",
    KEEP: "Show only what lies inside the crop object",
    REMOVE: "Show only what lies outside the crop object",
}
ANYWHERE = (0.0731, 0.1127, 0.9909)  # direction of the rays that tell inside from outside; along no usual edge
FAR = 1e6


def crop_inputs(tree: Tree) -> dict[str, Any]:
    """Declare the inputs of the crop; return them by name."""
    return {
        "Crop": tree.menu_input("Crop", "What to show of what lies inside the crop object", panel=CROP_PANEL),
        "Crop Object": tree.object_input(
            "Crop Object",
            "A closed mesh, or an Empty that stands for the box from -1 to 1 of its own axes (display it as Cube, size "
            "1); without one, everything is shown",
            CROP_PANEL,
        ),
    }


@node_group("Holoreel Crop", 1, "Keep or remove the points inside an object")
def crop(tree: Tree) -> None:
    """Points are tested in the crop object's own space, so that it may be placed by any transform."""
    cloud = tree.geometry_input()
    inputs = crop_inputs(tree)
    placed = tree.node("GeometryNodeObjectInfo", {"Object": inputs["Crop Object"]}, transform_space="RELATIVE")
    own = tree.node("GeometryNodeObjectInfo", {"Object": inputs["Crop Object"]}, transform_space="ORIGINAL")
    local = Matrix(tree, placed.outputs["Transform"]).inverted().transform(tree.position())
    mesh = Geometry(tree, own.outputs["Geometry"])
    size = tree.node("GeometryNodeAttributeDomainSize", {"Geometry": mesh}, component="MESH")
    is_box = Float(tree, size.outputs["Face Count"]).below(0.5)
    inside = tree.choose(is_box, _in_box(local), _in_mesh(tree, mesh, local), "BOOLEAN")
    shown = {
        OFF: cloud,
        KEEP: tree.delete_points(cloud, ~inside),
        REMOVE: tree.delete_points(cloud, inside),
    }
    cropped = tree.switch(inputs["Crop"], {name: (tip, shown[name]) for name, tip in MODES.items()}, "GEOMETRY")
    # An object that is not there has no scale.
    absent = Vector(tree, placed.outputs["Scale"]).length().below(1e-12)
    tree.output("Geometry", tree.choose(absent, cloud, cropped, "GEOMETRY"), "Points")
    tree.set_menu_default("Crop", OFF)


def _in_box(local: Vector) -> Boolean:
    x, y, z = (axis.absolute() for axis in local.axes())
    return ~(-x.at_least(y).at_least(z)).below(-1.0)


def _in_mesh(tree: Tree, mesh: Geometry, local: Vector) -> Boolean:
    """From inside, the first face that a ray meets is seen from behind."""
    inputs = {"Target Geometry": mesh, "Source Position": local, "Ray Direction": ANYWHERE, "Ray Length": FAR}
    ray = tree.node("GeometryNodeRaycast", inputs)
    facing = Vector(tree, ray.outputs["Hit Normal"]).dot(ANYWHERE)
    return Boolean(tree, ray.outputs["Is Hit"]) & ~facing.below(0.0)
