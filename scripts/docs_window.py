# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender: set a window up, scene by scene, and ask for pictures of it (`docs_images.py` is the other side).

`blender --enable-event-simulate --python docs_window.py -- FOLDER JOB`. FOLDER/NAME.request asks for a picture; when it
is gone, the picture has been taken. JOB is JSON: the files to show.
"""

import json
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path

import bpy

TAB = "Holoreel"
STEP_SECONDS = 0.4
HEADERS = 54  # pixels of the viewport that its two header lines cover
LONG = 8  # steps in which shaders compile and pictures settle


class Window:
    """The main window, and what a hand does in it."""

    def __init__(self, folder: Path, job: dict[str, str]) -> None:
        self.folder = folder
        self.job = job

    @property
    def window(self) -> bpy.types.Window:
        return bpy.context.window_manager.windows[0]

    @property
    def area(self) -> bpy.types.Area:
        views = [area for area in self.window.screen.areas if area.type == "VIEW_3D"]
        return max(views, key=lambda area: area.width * area.height)

    @property
    def space(self) -> bpy.types.SpaceView3D:
        return self.area.spaces.active

    def region(self, kind: str) -> bpy.types.Region:
        return next(region for region in self.area.regions if region.type == kind)

    def context(self) -> bpy.types.Context:
        """The context of a user whose mouse is over the viewport."""
        return bpy.context.temp_override(window=self.window, area=self.area, region=self.region("WINDOW"))

    def click(self, x: int, y: int, ctrl: bool = False) -> None:
        """Click somewhere in the window."""
        for kind, value in (("MOUSEMOVE", "NOTHING"), ("LEFTMOUSE", "PRESS"), ("LEFTMOUSE", "RELEASE")):
            self.window.event_simulate(type=kind, value=value, x=x, y=y, ctrl=ctrl)

    def open_panel(self, below: int) -> None:
        """Open the panel whose title is so far below the sidebar's top, and close all others."""
        region = self.region("UI")
        self.click(region.x + 60, region.y + region.height - below, ctrl=True)

    def picture(self, name: str, what: str = "") -> Iterator[None]:
        """Ask for a picture and wait until it is taken: of the window, its VIEW beside the sidebar, or its SIDEBAR."""
        box = None
        if what:
            view, sidebar = self.region("WINDOW"), self.region("UI")
            left, right = (view.x, sidebar.x) if what == "VIEW" else (sidebar.x, sidebar.x + sidebar.width)
            top = self.window.height - view.y - view.height
            box = [left, top + HEADERS, right, top + view.height]
        request = self.folder / f"{name}.request"
        request.with_suffix(".part").write_text(json.dumps(box))
        request.with_suffix(".part").rename(request)
        while request.exists():
            yield

    def open_tab(self) -> Iterator[None]:
        """Open the sidebar at our tab: click along its edge until it is open."""
        self.space.show_region_ui = True
        self.space.show_region_toolbar = False
        yield from wait(3)
        for below in range(40, 700, 25):
            region = self.region("UI")
            if region.active_panel_category == TAB:
                return
            self.click(region.x + region.width - 12, region.y + region.height - below)
            yield
        raise RuntimeError(f"there is no tab {TAB}")

    def shade(self, kind: str) -> Iterator[None]:
        """Change the viewport's shading, and let shaders compile."""
        self.space.shading.type = kind
        yield from wait(3 * LONG if kind != "SOLID" else 3)


def wait(steps: int) -> Iterator[None]:
    """Let Blender draw."""
    for _ in range(steps):
        yield


def tour(window: Window) -> Iterator[None]:
    """All pictures, in the order of the tour."""
    yield from panels(window)
    yield from gaussians(window)
    if window.job.get("field"):
        yield from field(window)
    yield from preferences(window)


def panels(window: Window) -> Iterator[None]:
    """The panels that need no reel, one by one; titles are 28 pixels apart."""
    bpy.ops.wm.read_homefile(use_empty=True)
    yield from wait(LONG)
    yield from window.open_tab()
    for name, below in (("train", 163), ("synthesize", 69)):  # from below: what is above is closed by then
        window.open_panel(below)
        yield from wait(3)
        yield from window.picture(name, "SIDEBAR")
    window.open_panel(13)  # the reel's, which the others have closed
    yield from wait(3)


def gaussians(window: Window) -> Iterator[None]:
    """A reel in each shading, seen by its camera and from elsewhere."""
    bpy.ops.wm.open_mainfile(filepath=window.job["scene"], load_ui=False)
    yield from wait(LONG)  # Blender crashes where a new file's window is changed before it was drawn
    bpy.context.scene.frame_set(4)
    played = next(thing for thing in bpy.context.scene.objects if thing.type == "POINTCLOUD")
    bpy.context.view_layer.objects.active = played
    clear(window)
    window.space.region_3d.view_perspective = "CAMERA"
    with window.context():
        bpy.ops.view3d.view_center_camera()
    yield from window.open_tab()
    for kind in ("SOLID", "MATERIAL", "RENDERED"):
        yield from window.shade(kind)
        yield from window.picture(f"viewport-{kind.lower()}", "VIEW")
    yield from window.picture("window")
    window.space.region_3d.view_perspective = "PERSP"
    with window.context():
        bpy.ops.view3d.view_selected()
        bpy.ops.view3d.zoom(delta=4)
    yield from wait(LONG)
    yield from window.picture("viewport-free", "VIEW")


def field(window: Window) -> Iterator[None]:
    """A VideoRF."""
    bpy.ops.wm.read_homefile(use_empty=True)
    yield from wait(LONG)
    with window.context():
        bpy.ops.holoreel.import_reel(filepath=window.job["field"], set_scene_timing=True)
        bpy.ops.view3d.view_selected()
    clear(window)
    yield from window.open_tab()
    yield from window.shade("MATERIAL")
    yield from window.picture("videorf")


def clear(window: Window) -> None:
    """Draw nothing over the reel."""
    overlay = window.space.overlay
    overlay.show_floor = overlay.show_axis_x = overlay.show_axis_y = False
    overlay.show_outline_selected = overlay.show_cursor = overlay.show_object_origins = False


def preferences(window: Window) -> Iterator[None]:
    """The add-on's preferences, in an editor of their own."""
    module = next(name for name in bpy.context.preferences.addons.keys() if name.endswith(".holoreel"))  # noqa: SIM118
    window.area.ui_type = "PREFERENCES"
    bpy.context.preferences.active_section = "ADDONS"
    bpy.context.window_manager.addon_search = "Holoreel"
    bpy.ops.preferences.addon_expand(module=module)
    yield from wait(LONG)
    yield from window.picture("preferences")


def main(folder: Path, job: dict[str, str]) -> None:
    """Take one step of the tour every now and then; quit at its end."""
    bpy.context.preferences.view.show_splash = False
    steps = tour(Window(folder, job))

    def tick() -> float | None:
        try:
            next(steps)
        except StopIteration:
            bpy.ops.wm.quit_blender()
            return None
        except Exception:  # noqa: BLE001 - the other side reads what is printed
            traceback.print_exc()
            bpy.ops.wm.quit_blender()
            return None
        return STEP_SECONDS

    bpy.app.timers.register(tick, first_interval=2.0, persistent=True)


if __name__ == "__main__":
    arguments = sys.argv[sys.argv.index("--") + 1 :]
    main(Path(arguments[0]), json.loads(arguments[1]))
