# SPDX-License-Identifier: GPL-3.0-or-later
"""The render engine Holoreel in the properties editor, and how to get it from the sidebar."""

import bpy

from ..addon.engine_settings import COLOR, ENGINE, LINEAR
from ..core.camera_fisheye import EQUIDISTANT, EQUISOLID, POLYNOMIAL
from ..operators.setup_composite import HOLOREEL_OT_setup_composite
from ..operators.setup_engine import HOLOREEL_OT_setup_engine

EXACT_UNDER = {True: "Standard", False: "Raw"}
FISHEYE_SETTINGS = {
    EQUIDISTANT: ("fisheye_fov",),
    EQUISOLID: ("fisheye_lens", "fisheye_fov"),
    POLYNOMIAL: ("fisheye_fov", *(f"fisheye_polynomial_k{power}" for power in range(5))),
}


class _EnginePanel:
    """What the panels of the properties editor share."""

    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "render"
    COMPAT_ENGINES = {ENGINE}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only with this engine."""
        return context.engine in cls.COMPAT_ENGINES


class HOLOREEL_PT_engine(_EnginePanel, bpy.types.Panel):
    """Color, background and quality."""

    bl_label = "Holoreel"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the scene's settings."""
        layout, scene = self.layout, context.scene
        layout.use_property_split = True
        layout.use_property_decorate = False
        settings = scene.holoreel_engine
        layout.prop(settings, "color")
        exact = EXACT_UNDER[settings.color == LINEAR]
        if scene.view_settings.view_transform != exact:
            layout.label(text=f"Exact only with the view transform {exact}", icon="INFO")
        layout.prop(scene.render, "film_transparent", text="Transparent")
        column = layout.column()
        column.active = not scene.render.film_transparent
        column.prop(settings, "background")
        if settings.background == COLOR:
            column.prop(settings, "background_color", text="")
        layout.label(text="VideoRF")
        column = layout.column(align=True)
        column.prop(settings, "quality")
        column.prop(settings, "viewport_quality", text="Viewport")


class HOLOREEL_PT_engine_passes(_EnginePanel, bpy.types.Panel):
    """What is delivered beside the colors."""

    bl_label = "Passes"
    bl_context = "view_layer"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the passes that may be had."""
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        column = layout.column(heading="Include")
        column.prop(context.view_layer, "use_pass_z", text="Depth")
        column.prop(context.scene.holoreel_engine, "use_pass_alpha")


class HOLOREEL_PT_fisheye(_EnginePanel, bpy.types.Panel):
    """The lens of a panoramic camera, which Blender itself shows for Cycles alone."""

    bl_label = "Fisheye"
    bl_context = "data"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only for panoramic cameras with this engine."""
        return super().poll(context) and context.camera is not None and context.camera.type == "PANO"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw what the kind of lens has."""
        layout, camera = self.layout, context.camera
        layout.use_property_split = True
        layout.prop(camera, "panorama_type")
        if camera.panorama_type not in FISHEYE_SETTINGS:
            layout.label(text="Holoreel draws fisheye lenses alone", icon="ERROR")
        for name in FISHEYE_SETTINGS.get(camera.panorama_type, ()):
            layout.prop(camera, name)


class HOLOREEL_PT_rendering(bpy.types.Panel):
    """The tab in the sidebar: how reels are rendered exactly."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Holoreel"
    bl_label = "Exact Rendering"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the ways to render, and the one that is chosen."""
        layout = self.layout
        if context.engine == ENGINE:
            layout.label(text="The engine Holoreel draws the reels alone", icon="CHECKMARK")
        else:
            layout.operator(HOLOREEL_OT_setup_engine.bl_idname, icon="RENDER_STILL")
        layout.operator(HOLOREEL_OT_setup_composite.bl_idname, icon="NODE_COMPOSITING")


CLASSES = (HOLOREEL_PT_engine, HOLOREEL_PT_engine_passes, HOLOREEL_PT_fisheye, HOLOREEL_PT_rendering)

register, unregister = bpy.utils.register_classes_factory(CLASSES)
