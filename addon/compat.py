# SPDX-License-Identifier: GPL-3.0-or-later
"""Everything in which the supported Blender versions (4.5 LTS, 5.2 LTS) differ.

Features are detected where they can be; nothing outside this file asks for a version.
"""

from typing import Any

import bpy
from bpy_extras import anim_utils

# --- Geometry Nodes modifiers ---------------------------------------------------------------------------------------
# Up to 4.5 the inputs of a modifier are ID properties, `modifier["Socket_2"]`; later they are real properties,
# `modifier.properties.inputs.Socket_2.value`, and the old form raises.


def has_input_properties(modifier: bpy.types.NodesModifier) -> bool:
    """Return whether the modifier's inputs are real properties."""
    return hasattr(modifier, "properties")


def input_identifier(group: bpy.types.NodeTree, name: str) -> str:
    """Return the identifier of the group input called `name`; KeyError if there is none."""
    for item in group.interface.items_tree:
        if item.item_type == "SOCKET" and item.in_out == "INPUT" and item.name == name:
            return item.identifier
    raise KeyError(name)


def input_names(group: bpy.types.NodeTree) -> set[str]:
    """Return the names of the group's inputs."""
    items = group.interface.items_tree
    return {item.name for item in items if item.item_type == "SOCKET" and item.in_out == "INPUT"}


def _menu_values(modifier: bpy.types.NodesModifier, identifier: str) -> dict[str, int]:
    items = modifier.id_properties_ui(identifier).as_dict().get("items") or ()
    return {item[0]: item[4] for item in items}


def get_input(modifier: bpy.types.NodesModifier, name: str) -> Any:
    """Return the value of the modifier's input `name`; a menu's value is the name of its item."""
    identifier = input_identifier(modifier.node_group, name)
    if has_input_properties(modifier):
        return getattr(modifier.properties.inputs, identifier).value
    value = modifier[identifier]
    if isinstance(value, int) and not isinstance(value, bool):
        for item, number in _menu_values(modifier, identifier).items():
            if number == value:
                return item
    return value


def set_input(modifier: bpy.types.NodesModifier, name: str, value: Any) -> None:
    """Set the modifier's input `name`; a menu takes the name of its item."""
    identifier = input_identifier(modifier.node_group, name)
    if has_input_properties(modifier):
        getattr(modifier.properties.inputs, identifier).value = value
    else:
        current = modifier[identifier]
        if isinstance(value, str) and isinstance(current, int):
            value = _menu_values(modifier, identifier)[value]
        modifier[identifier] = type(current)(value) if isinstance(current, (bool, int, float)) else value
    modifier.id_data.update_tag()  # neither kind tells the dependency graph that it changed


def input_path(modifier: bpy.types.NodesModifier, name: str) -> str:
    """Return the data path from the object to the modifier's input `name`, for drivers and keyframes."""
    identifier = input_identifier(modifier.node_group, name)
    if has_input_properties(modifier):
        return f'modifiers["{modifier.name}"].properties.inputs.{identifier}.value'
    return f'modifiers["{modifier.name}"]["{identifier}"]'


def draw_input(
    layout: bpy.types.UILayout, modifier: bpy.types.NodesModifier, name: str, text: str | None = None
) -> None:
    """Draw the modifier's input `name` in a panel."""
    identifier = input_identifier(modifier.node_group, name)
    label = name if text is None else text
    if has_input_properties(modifier):
        layout.prop(getattr(modifier.properties.inputs, identifier), "value", text=label)
    else:
        layout.prop(modifier, f'["{identifier}"]', text=label)


# --- Animation ------------------------------------------------------------------------------------------------------


def find_fcurve(animated: bpy.types.ID, path: str) -> bpy.types.FCurve | None:
    """Return the keys of a property (`path` from the data-block), None if it has none."""
    animation = animated.animation_data
    if animation is None or animation.action is None:
        return None
    channels = anim_utils.action_get_channelbag_for_slot(animation.action, animation.action_slot)
    return None if channels is None else channels.fcurves.find(path)


# --- Point clouds ---------------------------------------------------------------------------------------------------


def new_point_cloud(context: bpy.types.Context, name: str, count: int) -> bpy.types.Object:
    """Return a new POINTCLOUD object with `count` points at the origin, linked to the context's collection.

    Needs Object Mode where `PointCloud.resize` is missing (4.5), because a mesh is converted there.
    """
    if hasattr(bpy.types.PointCloud, "resize"):
        cloud = bpy.data.pointclouds.new(name)
        cloud.resize(count)
        created = bpy.data.objects.new(name, cloud)
        context.collection.objects.link(created)
        return created
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(count)
    created = bpy.data.objects.new(name, mesh)
    # The operator finds only what the view layer shows, which the context's collection need not be part of.
    context.scene.collection.objects.link(created)
    context.view_layer.update()
    with context.temp_override(
        object=created, active_object=created, selected_objects=[created], selected_editable_objects=[created]
    ):
        bpy.ops.object.convert(target="POINTCLOUD")
    if mesh.users == 0:
        bpy.data.meshes.remove(mesh)
    if context.collection != context.scene.collection:
        context.collection.objects.link(created)
        context.scene.collection.objects.unlink(created)
    return created


NATIVE_SPLATS = "GAUSSIAN_SPLAT"  # Blender 5.3 gives point clouds a type


def has_native_splats() -> bool:
    """Return whether point clouds can be Gaussian splats that Blender draws itself."""
    kinds = bpy.types.PointCloud.bl_rna.properties.get("type")
    return kinds is not None and NATIVE_SPLATS in kinds.enum_items


def set_native(cloud: bpy.types.PointCloud) -> None:
    """Let Blender draw a point cloud as Gaussian splats; see `has_native_splats`."""
    cloud.type = NATIVE_SPLATS


# --- Nodes and materials --------------------------------------------------------------------------------------------


def enable_nodes(block: bpy.types.Material | bpy.types.World) -> bpy.types.NodeTree:
    """Return a material's or world's node tree (later versions always have one, and warn of `use_nodes`)."""
    if block.node_tree is None:
        block.use_nodes = True
    return block.node_tree


def set_wildcard(node: bpy.types.Node) -> None:
    """Let a Remove Named Attribute node take a pattern with `*`."""
    if "Pattern Mode" in node.inputs:
        node.inputs["Pattern Mode"].default_value = "Wildcard"
    else:
        node.pattern_mode = "WILDCARD"


# --- Rendering ------------------------------------------------------------------------------------------------------


def eevee_engine() -> str:
    """Return the identifier of EEVEE: `BLENDER_EEVEE_NEXT` in 4.5, `BLENDER_EEVEE` later."""
    engines = bpy.types.RenderSettings.bl_rna.properties["engine"].enum_items.keys()
    return "BLENDER_EEVEE_NEXT" if "BLENDER_EEVEE_NEXT" in engines else "BLENDER_EEVEE"


def set_image_format(settings: bpy.types.ImageFormatSettings, file_format: str) -> None:
    """Choose an image format; where formats are sorted by media type, choose that first."""
    if hasattr(settings, "media_type"):
        settings.media_type = "MULTI_LAYER_IMAGE" if file_format == "OPEN_EXR_MULTILAYER" else "IMAGE"
    settings.file_format = file_format


# --- Compositing ----------------------------------------------------------------------------------------------------


def compositor_tree(scene: bpy.types.Scene) -> bpy.types.NodeTree:
    """Return a scene's compositor nodes, made where there are none.

    Up to 4.5 a scene owns them, and they end in a Composite node; later they are a node group with an output.
    """
    if not hasattr(scene, "compositing_node_group"):
        scene.use_nodes = True
        return scene.node_tree
    if scene.compositing_node_group is None:
        tree = bpy.data.node_groups.new(f"{scene.name} Compositing", "CompositorNodeTree")
        tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
        scene.compositing_node_group = tree
    return scene.compositing_node_group


def compositor_output(tree: bpy.types.NodeTree) -> bpy.types.NodeSocket:
    """Return the socket that the picture goes into, of a node made where there is none."""
    kind = "CompositorNodeComposite" if hasattr(bpy.types, "CompositorNodeComposite") else "NodeGroupOutput"
    node = next((node for node in tree.nodes if node.bl_idname == kind), None) or tree.nodes.new(kind)
    return node.inputs[0]


def set_depth_combine(node: bpy.types.Node) -> None:
    """Let a Z Combine node lay what is nearer over what is farther by its alpha, without smoothing of edges."""
    if "Use Alpha" in node.inputs:
        node.inputs["Use Alpha"].default_value = True
        node.inputs["Anti-Alias"].default_value = False
    else:
        node.use_alpha, node.use_antialias_z = True, False
