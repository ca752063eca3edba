# SPDX-License-Identifier: GPL-3.0-or-later
"""Looks: node groups that take evaluated Gaussians and return something that renders."""

from ...core.gaussians.model import OPACITY_MIN
from ..materials import QUAD_ATTRIBUTE, point_material, splat_material
from .builder import Boolean, Float, Geometry, Tree
from .library import node_group
from .view import View

LOW_PASS_PX2, NEAR, JACOBIAN_CLAMP = 0.3, 0.2, 1.3  # the rules the models were trained under
QUAD_MARGIN = 1.01  # a little larger than where alpha reaches 1/255, so that no edge shows

POINTS_PANEL, SPLATS_PANEL = "Points", "Splats"


def points_inputs(tree: Tree) -> dict[str, Float]:
    """Declare the inputs of the look Points; return them by name."""
    return {
        "Point Size": tree.float_input(
            "Point Size", "Radius of a point, in standard deviations of its Gaussian", 1.5, 0.0, panel=POINTS_PANEL
        ),
        "Hide Fainter Than": tree.float_input(
            "Hide Fainter Than",
            "Leave out points below this opacity, which would look solid",
            0.3,
            0.0,
            1.0,
            POINTS_PANEL,
        ),
    }


def camera_inputs(tree: Tree) -> dict[str, Float | Boolean]:
    """Declare what looks have to know of the camera and the picture; return them by name."""
    panel = SPLATS_PANEL
    pixels = "of the rendered picture in pixels; follows the scene's resolution by itself"
    return {
        "Render Width": tree.float_input("Render Width", f"Width {pixels}", 1920.0, 1.0, panel=panel),
        "Render Height": tree.float_input("Render Height", f"Height {pixels}", 1080.0, 1.0, panel=panel),
        "Low Pass": tree.float_input(
            "Low Pass", "Blur that every splat gets against aliasing, in square pixels", LOW_PASS_PX2, 0.0, panel=panel
        ),
        "Follow View": tree.boolean_input(
            "Follow View",
            "In a 3D viewport that looks through no camera, face its own view; sorting takes time while it turns",
            True,
            panel,
        ),
    }


def near_input(tree: Tree) -> dict[str, Float]:
    """Declare the distance that splats keep from the camera; return it by name."""
    tooltip = "Splats nearer to the camera are left out, in the reel's own units"
    return {"Near": tree.float_input("Near", tooltip, NEAR, 0.0, panel=SPLATS_PANEL)}


@node_group("Holoreel sRGB to Linear", 1, "Convert one display-referred value to scene-linear")
def linear_from_srgb(tree: Tree) -> None:
    """IEC 61966-2-1, the linear branch going on below zero."""
    value = tree.float_input("Value", "sRGB value, 0 to 1", is_field=True)
    curve = ((value + 0.055) * (1.0 / 1.055)).at_least(0.0).power(2.4)
    bright = value.above(0.04045)
    tree.output("Value", value * (1.0 / 12.92) * (1.0 - bright) + curve * bright)


@node_group("Holoreel Linear Color", 1, "Convert the color of Gaussians from sRGB to scene-linear")
def linear_color(tree: Tree) -> None:
    """Rewrites the attribute `rgb`."""
    points = tree.geometry_input()
    convert = linear_from_srgb()
    channels = tree.attribute("rgb", "FLOAT_COLOR").channels()[:3]
    linear = [Float(tree, tree.group(convert, {"Value": channel}).outputs[0]) for channel in channels]
    tree.output("Geometry", tree.store(points, "rgb", tree.color(*linear), "FLOAT_COLOR"), "Gaussians")


@node_group("Holoreel Points", 1, "Show evaluated Gaussians as opaque points, in any render engine")
def points(tree: Tree) -> None:
    """One point per Gaussian; the geometric mean of its scales, so that long thin ones do not bury the others."""
    cloud = tree.geometry_input()
    inputs = points_inputs(tree)
    faint = tree.attribute("opacity", "FLOAT").below(inputs["Hide Fainter Than"])
    cloud = tree.delete_points(cloud, faint)
    x, y, z = tree.attribute("scale", "FLOAT_VECTOR").axes()
    radius = (x * y * z).power(1 / 3) * inputs["Point Size"]
    cloud = tree.geometry("GeometryNodeSetPointRadius", {"Points": cloud, "Radius": radius})
    cloud = tree.geometry("GeometryNodeSetMaterial", {"Geometry": cloud, "Material": point_material()})
    tree.output("Geometry", cloud, "Points")


@node_group(
    "Holoreel Splats", 5, "Show evaluated Gaussians as the splats they were trained as, seen by the active camera"
)
def splats(tree: Tree) -> None:
    """One quad per Gaussian, parallel to the image plane (EWA splatting), far ones first.

    In the plane at the center's depth z, the projected Gaussian has the covariance Σ' = A Aᵀ + low-pass, where row 0 of
    A is S Rᵀ (right − x/z · forward), row 1 the same with up and y/z: the Jacobian of the projection times z. A quad
    whose axes are the columns of the Cholesky factor of Σ', with exp(−r²/2) on it, is what the rasterizer draws, and
    sorting by z is its order. Lengths are the world's, so that the object may be scaled and sheared.
    """
    cloud = tree.geometry_input()
    inputs = camera_inputs(tree) | near_input(tree)
    view = View(tree, inputs["Follow View"], inputs["Render Width"], inputs["Render Height"])

    center = tree.position()
    offset = center - view.location
    depth = -offset.dot(view.behind)
    cloud = tree.delete_points(cloud, depth.below(inputs["Near"] * view.scale))
    cloud = tree.geometry("GeometryNodeSortElements", {"Geometry": cloud, "Sort Weight": -depth}, domain="POINT")

    perspective = 1.0 - view.orthographic
    distance = depth * perspective + view.orthographic
    slopes = [
        _clamped(offset.dot(axis) / depth, middle, tangent * JACOBIAN_CLAMP) * perspective
        for axis, middle, tangent in (
            (view.across, view.middle_x, view.tangent_x),
            (view.above, view.middle_y, view.tangent_y),
        )
    ]
    unrotate = tree.attribute("rotation", "QUATERNION").inverted()
    scale = tree.attribute("scale", "FLOAT_VECTOR")
    rows = [
        unrotate.rotate(axis + view.behind * slope) * scale
        for axis, slope in zip((view.across, view.above), slopes, strict=True)
    ]
    blur_x, blur_y = (_square(distance * pixel) * inputs["Low Pass"] for pixel in (view.pixel_x, view.pixel_y))
    xx, xy, yy = rows[0].dot(rows[0]) + blur_x, rows[0].dot(rows[1]), rows[1].dot(rows[1]) + blur_y
    l00 = xx.sqrt()
    l10 = xy / l00
    l11 = (yy - l10 * l10).sqrt()

    # As far as alpha exceeds 1/255: d² = 2 ln(255 o).
    reach = ((tree.attribute("opacity", "FLOAT") * (1.0 / OPACITY_MIN)).log() * 2.0).sqrt()
    columns = [view.right * (l00 * reach) + view.up * (l10 * reach), view.up * (l11 * reach), view.back, center]
    cloud = tree.store(cloud, "splat_transform", tree.matrix(columns), "FLOAT4X4")
    tree.output("Geometry", _quads(tree, cloud), "Splats")


def _square(value: Float) -> Float:
    return value * value


def _clamped(value: Float, middle: Float, reach: Float) -> Float:
    return value.at_most(middle + reach).at_least(middle - reach)


def _quads(tree: Tree, cloud: Geometry) -> Geometry:
    """Put a quad on every point by its `splat_transform`; carry only what the material reads."""
    size = 2.0 * QUAD_MARGIN
    quad = tree.geometry("GeometryNodeMeshGrid", {"Size X": size, "Size Y": size, "Vertices X": 2, "Vertices Y": 2})
    quad = tree.store(quad, QUAD_ATTRIBUTE, tree.position(), "FLOAT_VECTOR")
    quad = tree.geometry("GeometryNodeSetMaterial", {"Geometry": quad, "Material": splat_material()})
    for used_up in ("rotation", "scale"):
        cloud = tree.geometry("GeometryNodeRemoveAttribute", {"Geometry": cloud, "Name": used_up})
    cloud = tree.geometry("GeometryNodeInstanceOnPoints", {"Points": cloud, "Instance": quad})
    transform = tree.attribute("splat_transform", "FLOAT4X4")
    cloud = tree.geometry("GeometryNodeSetInstanceTransform", {"Instances": cloud, "Transform": transform})
    cloud = tree.geometry("GeometryNodeRemoveAttribute", {"Geometry": cloud, "Name": "splat_transform"})
    return tree.geometry("GeometryNodeRealizeInstances", {"Geometry": cloud})
