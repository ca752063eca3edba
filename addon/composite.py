# SPDX-License-Identifier: GPL-3.0-or-later
"""Reels by the Holoreel engine and everything else by Cycles or EEVEE, in one picture, merged by depth.

A scene has one render engine, so the reels get a scene of their own, `NAME (Reels)`: same camera, format and frames,
the reels linked into it, the Holoreel engine, a transparent film. In the scene itself the reels move into a collection
that is not rendered, but seen in the viewport as before. The compositor merges both pictures pixel by pixel: the nearer
one lies over the farther one, by its alpha.
"""

import bpy

from ..core.errors import HoloreelError
from . import compat
from .engine_settings import ENGINE
from .reels import modifier_of
from .shots import LINEAR

COLLECTION = "Reels, Rendered by Holoreel"
MERGE, REELS, REST = "Holoreel Merge", "Holoreel Reels", "Holoreel Rest"
TAG = "holoreel_reels_of"  # custom property of the reels' scene: whose reels it has

# What both scenes share.
_RENDER = (
    *("resolution_x", "resolution_y", "resolution_percentage", "pixel_aspect_x", "pixel_aspect_y", "fps", "fps_base"),
    *("use_border", "use_crop_to_border", "border_min_x", "border_max_x", "border_min_y", "border_max_y"),
)
_FRAMES = ("frame_start", "frame_end", "frame_step", "camera")


def setup_composite(scene: bpy.types.Scene, view_layer: bpy.types.ViewLayer) -> bpy.types.Scene:
    """Set a scene up to be rendered by its own engine and by Holoreel; return the scene of the reels.

    Doing it again brings the reels' scene up to date. Raises `HoloreelError` where there is no reel, no camera, or the
    scene is rendered by Holoreel already.
    """
    if scene.render.engine == ENGINE:
        raise HoloreelError(
            f"Scene '{scene.name}' is rendered by the Holoreel engine: choose Cycles or EEVEE for what is no reel."
        )
    if scene.get(TAG) is not None:
        raise HoloreelError(f"Scene '{scene.name}' holds the reels of another one: set that one up.")
    played = [candidate for candidate in scene.objects if modifier_of(candidate) is not None]
    if not played:
        raise HoloreelError(f"Scene '{scene.name}' has no reel: import one.")
    if scene.camera is None:
        raise HoloreelError(f"Scene '{scene.name}' has no camera: add one.")
    reels_scene = _reels_scene(scene)
    _copy_settings(scene, reels_scene)
    _part(scene, reels_scene, played)
    view_layer.use_pass_z = True
    _merge(scene, view_layer, reels_scene)
    return reels_scene


def _reels_scene(scene: bpy.types.Scene) -> bpy.types.Scene:
    for candidate in bpy.data.scenes:
        if candidate.get(TAG) == scene:
            return candidate
    created = bpy.data.scenes.new(f"{scene.name} (Reels)")
    created[TAG] = scene
    return created


def _copy_settings(scene: bpy.types.Scene, to: bpy.types.Scene) -> None:
    for owner, other, names in ((scene.render, to.render, _RENDER), (scene, to, _FRAMES)):
        for name in names:
            setattr(other, name, getattr(owner, name))
    to.render.engine = ENGINE
    to.render.film_transparent = True
    to.holoreel_engine.color = LINEAR
    to.holoreel_engine.quality = scene.holoreel_engine.quality
    to.view_layers[0].use_pass_z = True
    to.timeline_markers.clear()
    for marker in scene.timeline_markers:  # they may switch cameras
        to.timeline_markers.new(marker.name, frame=marker.frame).camera = marker.camera


def _part(scene: bpy.types.Scene, reels_scene: bpy.types.Scene, played: list[bpy.types.Object]) -> None:
    """Link the reels into their scene, and put them where the scene itself does not render them."""
    hidden = next((child for child in scene.collection.children if child.name.startswith(COLLECTION)), None)
    if hidden is None:
        hidden = bpy.data.collections.new(COLLECTION)
        scene.collection.children.link(hidden)
    hidden.hide_render = True
    mine = {scene.collection, *scene.collection.children_recursive}
    for reel in played:
        if reels_scene.collection not in reel.users_collection:
            reels_scene.collection.objects.link(reel)
        if hidden not in reel.users_collection:
            hidden.objects.link(reel)
        for collection in set(reel.users_collection) & mine - {hidden}:
            collection.objects.unlink(reel)
    for left in set(reels_scene.collection.objects) - set(played):
        reels_scene.collection.objects.unlink(left)


def _merge(scene: bpy.types.Scene, view_layer: bpy.types.ViewLayer, reels_scene: bpy.types.Scene) -> None:
    """Merge both renders in the compositor, where the scene's own picture went before."""
    tree = compat.compositor_tree(scene)
    scene.render.use_compositing = True
    rest = _render_layers(tree, REST, scene, view_layer.name)
    reels = _render_layers(tree, REELS, reels_scene, reels_scene.view_layers[0].name)
    merge = tree.nodes.get(MERGE)
    if merge is None:
        merge = tree.nodes.new("CompositorNodeZcombine")
        merge.name = merge.label = MERGE
        taken = [link.to_socket for link in tree.links if link.from_socket == rest.outputs["Image"]]
        for socket in taken or [compat.compositor_output(tree)]:
            tree.links.new(merge.outputs[0], socket)
        rest.location, reels.location, merge.location = (-400, 200), (-400, -200), (-100, 0)
    compat.set_depth_combine(merge)
    inputs = merge.inputs
    for node, color, depth in ((reels, inputs[0], inputs[1]), (rest, inputs[2], inputs[3])):
        tree.links.new(node.outputs["Image"], color)
        tree.links.new(node.outputs["Depth"], depth)


def _render_layers(tree: bpy.types.NodeTree, name: str, scene: bpy.types.Scene, layer: str) -> bpy.types.Node:
    """Return the node of a scene's render: ours, or one that is there already."""
    node = tree.nodes.get(name)
    if node is None:
        there = [n for n in tree.nodes if n.bl_idname == "CompositorNodeRLayers" and n.scene == scene]
        node = there[0] if there else tree.nodes.new("CompositorNodeRLayers")
        node.name = name
    node.scene, node.layer = scene, layer
    return node
