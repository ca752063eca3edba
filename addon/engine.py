# SPDX-License-Identifier: GPL-3.0-or-later
"""The render engine Holoreel: exact pictures of reels, drawn by the worker.

A reel is drawn as `holoreel render` draws it: full models by their decoder, a VideoRF by marching rays, lenses of
fisheye cameras included. Nothing else of the scene is drawn.
"""

import weakref
from collections.abc import Iterator

import bpy
import numpy as np

from ..core.camera import Camera
from ..core.errors import HoloreelError
from ..core.worker.frames import FAR
from ..core.worker.protocol import CancelledError, Shot
from . import engine_settings, worker
from .cameras import camera_from_object
from .engine_settings import ENGINE
from .engine_view import View
from .shots import COLOR, LINEAR, shot_of

# Panels of Blender's own that make sense with this engine: their module, and the beginning of their names.
_PANELS = (
    ("properties_output", ("RENDER_PT_",)),
    ("properties_render", ("RENDER_PT_color_management", "RENDER_PT_stamp")),
    ("properties_data_camera", ("DATA_PT_", "CAMERA_PT_")),
    ("properties_data_pointcloud", ("DATA_PT_",)),
    ("properties_view_layer", ("VIEWLAYER_PT_layer", "VIEWLAYER_PT_context_layer")),
)
_UNFIT = {"DATA_PT_camera_dof", "DATA_PT_camera_dof_aperture"}


class HOLOREEL_RE_engine(bpy.types.RenderEngine):
    """What Blender calls for F12, for animations and for the shading mode Rendered."""

    bl_idname = ENGINE
    bl_label = "Holoreel"
    bl_use_preview = False
    bl_use_eevee_viewport = True  # Material Preview stays EEVEE's
    bl_use_shading_nodes_custom = False
    bl_use_postprocess = True

    def update_render_passes(self, scene: bpy.types.Scene, layer: bpy.types.ViewLayer) -> None:
        """Name the passes: Combined, Depth where it is asked for, and what the reels cover."""
        self.register_pass(scene, layer, "Combined", 4, "RGBA", "COLOR")
        if layer.use_pass_z:
            self.register_pass(scene, layer, "Depth", 1, "Z", "VALUE")
        if scene.holoreel_engine.use_pass_alpha:
            self.register_pass(scene, layer, "Alpha", 1, "A", "VALUE")

    def render(self, depsgraph: bpy.types.Depsgraph) -> None:
        """Draw one frame. Never raises: Blender would crash with a result that is still open."""
        result = None
        try:
            camera, region = _camera(self, depsgraph)
            left, top, right, bottom = region or (0, 0, camera.width, camera.height)
            result = self.begin_result(0, 0, right - left, bottom - top, layer=depsgraph.view_layer.name)
            self._fill(result, depsgraph, camera, region)
        except CancelledError:
            self.end_result(result, cancel=True)
        except Exception as error:  # noqa: BLE001 - whatever it is, it must not get past Blender
            known = isinstance(error, HoloreelError)
            sentence = str(error) if known else f"Holoreel failed with {type(error).__name__}: {error}"
            self.report({"ERROR"}, sentence)
            self.error_set(sentence)
            if result is not None:
                self.end_result(result, cancel=True)
        else:
            self.end_result(result)

    def _fill(
        self,
        result: bpy.types.RenderResult,
        depsgraph: bpy.types.Depsgraph,
        camera: Camera,
        region: tuple[int, int, int, int] | None,
    ) -> None:
        passes = {found.name: found for found in result.layers[0].passes}
        shot = shot_of(depsgraph, camera, region=region)
        if shot is None:
            _fill_empty(passes, depsgraph.scene, result.resolution_x * result.resolution_y)
            return
        client = worker.worker()
        said = len(client.notes)
        self.update_stats("", f"Drawing {_count(shot)}")
        with client.draw(shot, stop=self.test_break, on_progress=self._progress) as drawing:
            pixels = drawing.pixels
            for name, values in (("Combined", pixels.rgba), ("Depth", pixels.depth), ("Alpha", pixels.alpha)):
                if name in passes:
                    passes[name].rect.foreach_set(values.ravel())
        for sentence in client.notes[said:]:
            self.report({"INFO"}, sentence)

    def _progress(self, done: int, of: int) -> None:
        self.update_progress(done / max(of, 1))

    def view_update(self, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        """Note that the scene has changed."""
        _view_of(self).changed()

    def view_draw(self, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        """Show the best picture there is of what the viewport looks at, and have a better one drawn."""
        try:
            _view_of(self).draw(self, context, depsgraph)
        except HoloreelError as error:
            self.update_stats("Holoreel", str(error))


_views: weakref.WeakSet[View] = weakref.WeakSet()


def _view_of(engine: HOLOREEL_RE_engine) -> View:
    """Return what a viewport's engine shows; only instances that draw viewports have it."""
    view = getattr(engine, "view", None)
    if view is None:
        view = engine.view = View()
        _views.add(view)
    return view


def setup_engine(scene: bpy.types.Scene) -> None:
    """Let a scene be rendered by this engine, so that an 8-bit picture shows the reel's own colors."""
    scene.render.engine = ENGINE
    scene.render.dither_intensity = 0.0
    scene.holoreel_engine.color = LINEAR
    view = scene.view_settings
    view.view_transform, view.look = "Standard", "None"
    view.exposure, view.gamma, view.use_curve_mapping = 0.0, 1.0, False


def _camera(
    engine: bpy.types.RenderEngine, depsgraph: bpy.types.Depsgraph
) -> tuple[Camera, tuple[int, int, int, int] | None]:
    """Return the camera that is rendered, and the part of its picture that is wanted, in pixels from the top left."""
    scene = depsgraph.scene
    camera_object = engine.camera_override or scene.camera
    if camera_object is None:
        raise HoloreelError(f"Scene '{scene.name}' has no camera: add one.")
    camera = camera_from_object(camera_object.original, scene, depsgraph)
    render = scene.render
    if not render.use_border:
        return camera, None
    # As Blender rounds it, in single precision, with the y axis pointing up.
    left, right = (int(np.float32(share) * camera.width) for share in (render.border_min_x, render.border_max_x))
    low, high = (int(np.float32(share) * camera.height) for share in (render.border_min_y, render.border_max_y))
    return camera, (left, camera.height - max(high, low + 1), max(right, left + 1), camera.height - low)


def _fill_empty(passes: dict[str, bpy.types.RenderPass], scene: bpy.types.Scene, count: int) -> None:
    """Show nothing but the background."""
    settings, rgba = scene.holoreel_engine, np.zeros((count, 4), np.float32)
    if not scene.render.film_transparent:
        color = np.array(settings.background_color if settings.background == COLOR else (0.0, 0.0, 0.0))
        if settings.color == LINEAR:
            color = np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)
        rgba[:] = (*color, 1.0)
    for name, values in (("Combined", rgba), ("Depth", np.full(count, FAR, np.float32)), ("Alpha", np.zeros(count))):
        if name in passes:
            passes[name].rect.foreach_set(values.astype(np.float32).ravel())


def _count(shot: Shot) -> str:
    return "1 reel" if len(shot.layers) == 1 else f"{len(shot.layers)} reels"


def _fitting_panels() -> Iterator[type]:
    """Yield the panels of Blender that shall be there with this engine."""
    import bl_ui

    for module_name, beginnings in _PANELS:
        module = getattr(bl_ui, module_name, None)
        for panel in getattr(module, "classes", ()):
            engines = getattr(panel, "COMPAT_ENGINES", None)
            if engines is not None and panel.__name__.startswith(beginnings) and panel.__name__ not in _UNFIT:
                yield panel


def register() -> None:
    """Register the engine and its settings, and let Blender's own panels show with it."""
    engine_settings.register()
    bpy.utils.register_class(HOLOREEL_RE_engine)
    for panel in _fitting_panels():
        panel.COMPAT_ENGINES.add(ENGINE)


def unregister() -> None:
    """Take all of it out again."""
    for view in list(_views):
        view.close()
    for panel in _fitting_panels():
        panel.COMPAT_ENGINES.discard(ENGINE)
    bpy.utils.unregister_class(HOLOREEL_RE_engine)
    engine_settings.unregister()
