# SPDX-License-Identifier: GPL-3.0-or-later
"""The look Hull: every Gaussian a small closed surface on which each ray finds its own alpha."""

from ...core.gaussians.model import OPACITY_MIN
from ..materials import hull_material
from .builder import Tree
from .library import node_group

# Radius of the icosahedron that contains the unit sphere: 1 / 0.7946..., and a little more.
HULL_RADIUS = 1.26
FLATTEST = 1e-3  # thinnest against longest axis, so that a flat Gaussian keeps an inside


@node_group("Holoreel Hull", 1, "Show evaluated Gaussians to any ray: fisheye cameras, mirrors, lamps")
def hull(tree: Tree) -> None:
    """One icosahedron per Gaussian, around the ellipsoid on which its alpha falls to 1/255 (d² = 2 ln(255 o))."""
    cloud = tree.geometry_input()
    scale = tree.attribute("scale", "FLOAT_VECTOR")
    x, y, z = scale.axes()
    reach = ((tree.attribute("opacity", "FLOAT") * (1.0 / OPACITY_MIN)).log() * 2.0).sqrt()
    thinnest = x.at_least(y).at_least(z) * FLATTEST
    axes = [axis.at_least(thinnest) * reach for axis in (x, y, z)]
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
