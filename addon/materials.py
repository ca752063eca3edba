# SPDX-License-Identifier: GPL-3.0-or-later
"""The materials of a reel's looks, built once per .blend file."""

import bpy

from ..core.gaussians.model import OPACITY_MIN
from .compat import enable_nodes
from .nodes.builder import Float, Tree, Vector
from .nodes.library import find, tag

ALPHA_MAX = 0.99  # as in training: no splat is fully opaque
QUAD_ATTRIBUTE = "splat_uv"  # place on the quad: alpha reaches 1/255 on the unit circle


def _new_material(name: str) -> tuple[bpy.types.Material, Tree]:
    material = bpy.data.materials.new(name)
    nodes = enable_nodes(material)
    nodes.nodes.clear()
    return material, Tree(nodes)


def _attribute(tree: Tree, name: str, output: str, kind: str = "GEOMETRY") -> bpy.types.NodeSocket:
    return tree.node("ShaderNodeAttribute", attribute_name=name, attribute_type=kind).outputs[output]


def _emit_through(tree: Tree, color: bpy.types.NodeSocket, alpha: Float) -> None:
    """Let the material emit `color` where it is not transparent."""
    emission = tree.node("ShaderNodeEmission", {"Strength": 1.0})
    tree.tree.links.new(color, emission.inputs["Color"])
    mix = tree.node("ShaderNodeMixShader", {0: alpha})
    tree.tree.links.new(tree.node("ShaderNodeBsdfTransparent").outputs[0], mix.inputs[1])
    tree.tree.links.new(emission.outputs[0], mix.inputs[2])
    output = tree.node("ShaderNodeOutputMaterial")
    tree.tree.links.new(mix.outputs[0], output.inputs["Surface"])
    tree.arrange()


def _alpha(opacity: Float, radius2: Float) -> Float:
    """Return min(0.99, o · (255 o)^(−r²)), and 0 under 1/255: r = 1 is where the Gaussian has fallen to 1/255."""
    gaussian = opacity * (-((opacity * (1.0 / OPACITY_MIN)).log() * radius2)).exp()
    return gaussian.at_most(ALPHA_MAX) * gaussian.above(OPACITY_MIN)


def _set_transparent(material: bpy.types.Material) -> None:
    material.surface_render_method = "BLENDED"  # EEVEE draws the quads in the order they have, which is far to near
    material.use_transparency_overlap = True
    material.use_backface_culling = False
    material.cycles.emission_sampling = "NONE"  # otherwise Cycles takes every face for a lamp


def splat_material() -> bpy.types.Material:
    """Return "Holoreel Splats": unlit color, alpha by the place on the quad."""
    name, version = "Holoreel Splats", 1
    found = find(bpy.data.materials, name, version)
    if found is not None:
        return found
    material, tree = _new_material(name)
    place = Vector(tree, _attribute(tree, QUAD_ATTRIBUTE, "Vector"))
    opacity = Float(tree, _attribute(tree, "opacity", "Fac"))
    _emit_through(tree, _attribute(tree, "rgb", "Color"), _alpha(opacity, place.dot(place)))
    _set_transparent(material)
    tag(material, name, version)
    return material


def hull_material() -> bpy.types.Material:
    """Return "Holoreel Hull": unlit color, alpha by how near the ray passes the Gaussian's center.

    In the space of the instance the Gaussian is round: a ray through p along the unit vector d passes its center at the
    distance |p × d|, wherever p lies on the hull. The far side alone counts, which is seen from inside, too; and only
    where the nearest point of the ray lies ahead of its start.
    """
    name, version = "Holoreel Hull", 1
    found = find(bpy.data.materials, name, version)
    if found is not None:
        return found
    material, tree = _new_material(name)
    exit_point = Vector(tree, tree.node("ShaderNodeTexCoord").outputs["Object"])
    geometry = tree.node("ShaderNodeNewGeometry")
    incoming = Vector(tree, geometry.outputs["Incoming"])
    inputs = {"Vector": incoming}
    node = tree.node(
        "ShaderNodeVectorTransform", inputs, vector_type="VECTOR", convert_from="WORLD", convert_to="OBJECT"
    )
    back = Vector(tree, node.outputs[0])  # toward the ray's start; as long as one world unit
    direction = back.normalized()
    distance = exit_point.cross(direction)
    ray_length = Float(tree, tree.node("ShaderNodeLightPath").outputs["Ray Length"]) * back.length()
    ahead = (ray_length + exit_point.dot(direction)).above(0.0)
    opacity = Float(tree, _attribute(tree, "opacity", "Fac", "INSTANCER"))
    far_side = Float(tree, geometry.outputs["Backfacing"])
    alpha = _alpha(opacity, distance.dot(distance)) * far_side * ahead
    _emit_through(tree, _attribute(tree, "rgb", "Color", "INSTANCER"), alpha)
    _set_transparent(material)
    tag(material, name, version)
    return material


def point_material() -> bpy.types.Material:
    """Return "Holoreel Points": unlit, opaque color."""
    name, version = "Holoreel Points", 1
    found = find(bpy.data.materials, name, version)
    if found is not None:
        return found
    material, tree = _new_material(name)
    emission = tree.node("ShaderNodeEmission", {"Strength": 1.0})
    tree.tree.links.new(_attribute(tree, "rgb", "Color"), emission.inputs["Color"])
    output = tree.node("ShaderNodeOutputMaterial")
    tree.tree.links.new(emission.outputs[0], output.inputs["Surface"])
    tree.arrange()
    material.cycles.emission_sampling = "NONE"
    tag(material, name, version)
    return material
