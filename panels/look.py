# SPDX-License-Identifier: GPL-3.0-or-later
"""In the sidebar: how the active reel is shown, and what of it."""

import bpy

from ..addon import compat
from ..addon.crop import crop_problem
from ..addon.exact import ends_rays_early
from ..addon.nodes.crop import OFF
from ..addon.nodes.show import HULL, LINEAR, POINTS, SPLATS
from ..addon.reels import modifier_of
from ..addon.texts import draw_text, letters_in
from ..operators.add_crop_box import HOLOREEL_OT_add_crop_box
from ..operators.let_rays_through import HOLOREEL_OT_let_rays_through
from ..operators.make_native_splats import HOLOREEL_OT_make_native_splats
from ..operators.setup_exact_render import HOLOREEL_OT_setup_exact_render
from .reel import SubPanel

INPUTS = {SPLATS: ("Low Pass", "Near", "Follow View"), HULL: ("Low Pass",), POINTS: ("Point Size", "Hide Fainter Than")}


class HOLOREEL_PT_look(SubPanel, bpy.types.Panel):
    """How the reel is shown: only the settings that matter now."""

    bl_label = "Look"
    bl_order = 2

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the look, its own settings, the color mode, and what stands in the way."""
        modifier = modifier_of(context.object)
        look = compat.get_input(modifier, "Look")
        self.inputs(context, "Look", *INPUTS.get(look, ()), "Color")
        for sentence in look_problems(context.scene, look, compat.get_input(modifier, "Color")):
            draw_text(self.layout, sentence, letters_in(context.region), "ERROR")
        if _shows_preview(context):
            draw_text(self.layout, "A preview: Solid shows gray points", letters_in(context.region), "INFO")
        if look == POINTS:
            return
        if ends_rays_early(context.scene):
            self.layout.operator(HOLOREEL_OT_let_rays_through.bl_idname, icon="LIGHT")
        if look == SPLATS:
            self.layout.operator(HOLOREEL_OT_setup_exact_render.bl_idname, icon="RENDER_STILL")
        if compat.has_native_splats():
            self.layout.operator(HOLOREEL_OT_make_native_splats.bl_idname, icon="OUTLINER_OB_POINTCLOUD")


class HOLOREEL_PT_crop(SubPanel, bpy.types.Panel):
    """What of the reel is shown."""

    bl_label = "Crop"
    bl_order = 3
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only for reels that know crops."""
        modifier = modifier_of(context.object)
        return modifier is not None and "Crop" in compat.input_names(modifier.node_group)

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the mode and the object, and a button that adds a box."""
        modifier = modifier_of(context.object)
        self.inputs(context, "Crop")
        if compat.get_input(modifier, "Crop") != OFF:
            self.inputs(context, "Crop Object")
        if problem := crop_problem(context.object):
            draw_text(self.layout, problem, letters_in(context.region), "ERROR")
        self.layout.operator(HOLOREEL_OT_add_crop_box.bl_idname, icon="CUBE")


def look_problems(scene: bpy.types.Scene, look: str, color: str) -> list[str]:
    """Say in sentences what keeps a look from being right in a scene."""
    found = []
    engine, camera = scene.render.engine, scene.camera
    if color != LINEAR and scene.view_settings.view_transform != "Raw":
        found.append("Exact only with the view transform Raw")
    if look == SPLATS and camera is None:
        found.append("Splats face the active camera: add one")
    if look == SPLATS and camera is not None and camera.type == "CAMERA" and camera.data.type in ("PANO", "CUSTOM"):
        found.append("Splats need a perspective camera: take Hull")
    if engine == "BLENDER_WORKBENCH":
        found.append("A preview: Workbench shows gray points")
    if look == HULL and engine == compat.eevee_engine():
        found.append("Hulls are for Cycles; EEVEE shows a preview")
    if look != POINTS and ends_rays_early(scene):
        found.append("Cycles ends rays early: dark or noisy")
    return found


def _shows_preview(context: bpy.types.Context) -> bool:
    shading = getattr(context.space_data, "shading", None)
    return shading is not None and shading.type in ("SOLID", "WIREFRAME")


register, unregister = bpy.utils.register_classes_factory((HOLOREEL_PT_look, HOLOREEL_PT_crop))
