# SPDX-License-Identifier: GPL-3.0-or-later
"""The look Hull: every Gaussian a small closed surface on which each ray finds its own alpha."""

from ...core.gaussians.model import OPACITY_MIN
from ..materials import hull_material
from .builder import Float, Tree
from .library import node_group
from .looks import camera_inputs
from .view import View

# Radius of the icosahedron that contains the unit sphere: 1 / 0.7946..., and a little more.
HULL_RADIUS = 1.26
FLATTEST = 1e-3  # thinnest against longest axis, so that a flat Gaussian keeps an inside

HULL_PANEL = "Hull"


def hull_inputs(tree: Tree) -> dict[str, Float]:
    """Declare the inputs of the look Hull alone; return them by name."""
    tooltip = "Angle of a fisheye camera's pixel, in radians, which it follows by itself; 0: as a perspective lens says"
    return {"Pixel Angle": tree.float_input("Pixel Angle", tooltip, 0.0, 0.0, panel=HULL_PANEL)}


@node_group("Holoreel Hull", 2, "Show evaluated Gaussians to any ray: fisheye cameras, mirrors, lamps")
def hull(tree: Tree) -> None:
    """One icosahedron per Gaussian, around the ellipsoid on which its alpha falls to 1/255 (d² = 2 ln(255 o)).

    The blur against aliasing that splats get in the picture, Gaussians get in space: as wide as a pixel is there.
    """
    cloud = tree.geometry_input()
    inputs = camera_inputs(tree) | hull_inputs(tree)
    view = View(tree, inputs["Follow View"], inputs["Render Width"], inputs["Render Height"])
    pixel = view.pixel_at(tree.position(), inputs["Pixel Angle"])
    blur = tree.choose(view.exists, pixel * pixel * inputs["Low Pass"], 0.0, "FLOAT")
    scale = tree.attribute("scale", "FLOAT_VECTOR")
    x, y, z = scale.axes()
    reach = ((tree.attribute("opacity", "FLOAT") * (1.0 / OPACITY_MIN)).log() * 2.0).sqrt()
    thinnest = x.at_least(y).at_least(z) * FLATTEST
    axes = [(_square(axis.at_least(thinnest)) + blur).sqrt() * reach for axis in (x, y, z)]
    shape = tree.geometry("GeometryNodeMeshIcoSphere", {"Radius": HULL_RADIUS, "Subdivisions": 1})
    shape = tree.geometry("GeometryNodeSetMaterial", {"Geometry": shape, "Material": hull_material()})
    cloud = tree.geometry(
        "GeometryNodeInstanceOnPoints",
        {
            "Points": cloud,
            "Instance": shape,
            "Rotation": tree.attribute("rotation", "QUATERNION"),
            "Scale": tree.vector(*axes),
        },
    )
    for used_up in ("rotation", "scale"):
        cloud = tree.geometry("GeometryNodeRemoveAttribute", {"Geometry": cloud, "Name": used_up})
    tree.output("Geometry", cloud, "Hulls")


def _square(value: Float) -> Float:
    return value * value
