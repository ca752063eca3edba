# SPDX-License-Identifier: GPL-3.0-or-later
"""The two materials of a reel, built once per .blend file."""

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


def _attribute(tree: Tree, name: str, output: str) -> bpy.types.NodeSocket:
    return tree.node("ShaderNodeAttribute", attribute_name=name, attribute_type="GEOMETRY").outputs[output]


def splat_material() -> bpy.types.Material:
    """Return "Holoreel Splats": unlit color, alpha = min(0.99, o · (255 o)^(−r²)), nothing under 1/255.

    The look scales its quads so that the Gaussian o · exp(−d²/2) falls to 1/255 at r = 1; hence the formula.
    """
    name, version = "Holoreel Splats", 1
    found = find(bpy.data.materials, name, version)
    if found is not None:
        return found
    material, tree = _new_material(name)
    place = Vector(tree, _attribute(tree, QUAD_ATTRIBUTE, "Vector"))
    opacity = Float(tree, _attribute(tree, "opacity", "Fac"))
    gaussian = opacity * (-((opacity * (1.0 / OPACITY_MIN)).log() * place.dot(place))).exp()
    alpha = gaussian.at_most(ALPHA_MAX) * gaussian.above(OPACITY_MIN)
    color = _attribute(tree, "rgb", "Color")
    emission = tree.node("ShaderNodeEmission", {"Strength": 1.0})
    tree.tree.links.new(color, emission.inputs["Color"])
    mix = tree.node("ShaderNodeMixShader", {0: alpha})
    tree.tree.links.new(tree.node("ShaderNodeBsdfTransparent").outputs[0], mix.inputs[1])
    tree.tree.links.new(emission.outputs[0], mix.inputs[2])
    output = tree.node("ShaderNodeOutputMaterial")
    tree.tree.links.new(mix.outputs[0], output.inputs["Surface"])
    tree.arrange()
    material.surface_render_method = "BLENDED"  # EEVEE draws the quads in the order they have, which is far to near
    material.use_transparency_overlap = True
    material.use_backface_culling = False
    material.cycles.emission_sampling = "NONE"  # otherwise Cycles takes every quad for a lamp
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
