# SPDX-License-Identifier: GPL-3.0-or-later
"""The engine in a viewport: a small picture at once, then the full one; a change gives up what is being drawn."""

from dataclasses import replace

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.camera import Camera
from ..core.camera_blender import camera_from_projection
from ..core.errors import HoloreelError
from ..core.worker.client import Client, Drawing
from ..core.worker.protocol import CancelledError, Shot
from . import worker
from .shots import shot_of

SHARES = (4, 1)  # pictures are drawn this many times smaller, one after the other
_POLL_SECONDS = 0.02

Array = NDArray[np.float32]


class Progressive:
    """One view's pictures: asks for the next finer one, and takes it when it is there.

    A small picture is always finished, so that there is something to see while the view moves on and on.
    """

    def __init__(self) -> None:
        self.shot: Shot | None = None
        self.finest = 0  # how many of `SHARES` were drawn of this shot
        self._drawing: Drawing | None = None
        self._drawn: Shot | None = None  # what is being drawn, at full size
        self._share = 0

    @property
    def is_waiting(self) -> bool:
        """Whether something is being drawn."""
        return self._drawing is not None

    @property
    def has_news(self) -> bool:
        """Whether `step` would find a picture, or an error."""
        return self._drawing is not None and self._drawing.done

    def step(self, client: Client, shot: Shot) -> Array | None:
        """Go on towards the picture of `shot`; return a new picture (H, W, 4) from the bottom up, if there is one.

        Raises `HoloreelError` once where the worker says that there will be none.
        """
        if self.shot is None or shot.to_json() != self.shot.to_json():
            self.shot, self.finest = shot, 0
            if self._drawing is not None and self._share > 0:
                self.close()
        picture = self._take() if self.has_news else None
        if self._drawing is None and self.finest < len(SHARES):
            self._drawn, self._share = self.shot, self.finest
            self._drawing = client.begin(_smaller(self.shot, SHARES[self.finest]))
        return picture

    def close(self) -> None:
        """Give up what is being drawn."""
        if self._drawing is not None:
            self._drawing.close()
            self._drawing = None

    def _take(self) -> Array | None:
        drawing, self._drawing = self._drawing, None
        assert drawing is not None
        try:
            drawing.wait()
            if self._drawn is self.shot:
                self.finest = self._share + 1
            return drawing.pixels.rgba.copy()
        except CancelledError:
            return None
        except HoloreelError:
            if self._drawn is self.shot:
                self.finest = len(SHARES)  # not again until something changes
            raise
        finally:
            drawing.close()


class View:
    """What the engine shows in one viewport."""

    def __init__(self) -> None:
        self._progress = Progressive()
        self._changed = True
        self._looking: tuple[object, ...] = ()
        self._shot: Shot | None = None
        self._texture: object | None = None  # gpu.types.GPUTexture
        self._is_polling = False
        self._engine: bpy.types.RenderEngine | None = None

    def changed(self) -> None:
        """The scene is not what it was."""
        self._changed = True

    def draw(self, engine: bpy.types.RenderEngine, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        """Show what there is, and see to more."""
        view, region = context.region_data, context.region
        looking = (*map(tuple, (*view.view_matrix, *view.window_matrix)), region.width, region.height)
        looking += _settings_of(depsgraph.scene)  # not every change of these is announced
        if self._changed or looking != self._looking:
            self._looking = ()  # if this fails, it fails again the next time
            quality = depsgraph.scene.holoreel_engine.viewport_quality.lower()
            camera = _camera_of(view, region)
            self._shot = shot_of(depsgraph, camera, quality=quality)
            self._looking, self._changed = looking, False
        if self._shot is None:
            self._progress.close()
            self._texture = None
            engine.update_stats("Holoreel", "There is no reel in this view layer")
            return
        try:
            picture = self._progress.step(worker.worker(), self._shot)
        except HoloreelError:
            self._paint(region.width, region.height)
            if self._progress.finest < len(SHARES):  # it was about another view
                engine.tag_redraw()
            raise
        if picture is not None:
            self._texture = _texture(picture)
        self._paint(region.width, region.height)
        done = self._progress.finest == len(SHARES) and not self._progress.is_waiting
        engine.update_stats("Holoreel", "" if done else "Drawing")
        if not self._progress.is_waiting:
            return
        self._engine = engine
        if not self._is_polling:
            self._is_polling = True
            bpy.app.timers.register(self._poll, first_interval=_POLL_SECONDS)

    def close(self) -> None:
        """Forget everything; the viewport is gone, or shows something else now."""
        self._progress.close()
        self._texture = self._engine = None

    def _poll(self) -> float | None:
        """Ask for a redraw once the worker has answered."""
        if self._progress.is_waiting and not self._progress.has_news:
            return _POLL_SECONDS
        self._is_polling = False
        engine, self._engine = self._engine, None  # which holds this view: not longer than it takes
        try:
            if engine is not None:
                engine.tag_redraw()
        except ReferenceError:  # the viewport shows something else by now
            self.close()
        return None

    def __del__(self) -> None:
        self._progress.close()

    def _paint(self, width: int, height: int) -> None:
        if self._texture is None:
            return
        import gpu
        from gpu_extras.presets import draw_texture_2d

        gpu.state.blend_set("ALPHA_PREMULT")
        draw_texture_2d(self._texture, (0, 0), width, height)
        gpu.state.blend_set("NONE")


def _settings_of(scene: bpy.types.Scene) -> tuple[object, ...]:
    settings = scene.holoreel_engine
    chosen = settings.color, settings.background, *settings.background_color, settings.viewport_quality
    return *chosen, scene.render.film_transparent, scene.frame_current_final


def _smaller(shot: Shot, share: int) -> Shot:
    """Return the same picture in fewer pixels."""
    if share == 1:
        return shot
    camera = shot.layers[0].camera
    width, height = max(1, camera.width // share), max(1, camera.height // share)
    layers = tuple(replace(layer, camera=layer.camera.scaled(width, height)) for layer in shot.layers)
    return replace(shot, layers=layers, quality="draft")


def _camera_of(view: bpy.types.RegionView3D, region: bpy.types.Region) -> Camera:
    if not view.is_perspective:
        raise HoloreelError("The Holoreel engine draws perspective views alone: press Numpad 5.")
    return camera_from_projection(np.array(view.view_matrix), np.array(view.window_matrix), region.width, region.height)


def _texture(picture: Array) -> object:
    import gpu

    height, width, _ = picture.shape
    pixels = gpu.types.Buffer("FLOAT", picture.size, picture.ravel())
    return gpu.types.GPUTexture((width, height), format="RGBA16F", data=pixels)
