# SPDX-License-Identifier: GPL-3.0-or-later
"""The panels Look and Crop: they show what matters, and say what stands in the way."""

from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import bpy
import holoreel
import pytest
from holoreel.addon import compat, reels
from holoreel.addon.exact import setup_exact_render
from holoreel.addon.nodes.crop import KEEP
from holoreel.addon.nodes.show import DISPLAY, HULL, LINEAR, LOOKS, POINTS, SPLATS
from holoreel.addon.timeline import Timeline
from holoreel.core.gaussians.model import SpacetimeGaussians


class Layout:
    """Stands for a layout: keeps what is drawn."""

    def __init__(self) -> None:
        self.labels: list[str] = []
        self.inputs: list[str] = []
        self.operators: list[str] = []

    def label(self, text: str, icon: str) -> None:
        """Keep a sentence."""
        assert icon in bpy.types.UILayout.bl_rna.functions["label"].parameters["icon"].enum_items
        self.labels.append(text)

    def column(self, align: bool) -> "Layout":
        """Below each other."""
        assert align
        return self

    def operator(self, name: str, icon: str) -> None:
        """Keep a button."""
        assert icon in bpy.types.UILayout.bl_rna.functions["operator"].parameters["icon"].enum_items
        self.operators.append(name)

    def prop(self, data: Any, name: str, text: str) -> None:
        """Keep a setting, which must be there."""
        assert hasattr(data, name) or data.path_resolve(name) is not None
        self.inputs.append(text)


@pytest.fixture
def draw(random_model: Callable[..., SpacetimeGaussians]) -> Iterator[Callable[..., Layout]]:
    """`draw(panel, Input=value, ...)` sets inputs of a new reel and draws a panel for it."""
    holoreel.register()
    reel = reels.create_reel_object(bpy.context, "reel", random_model(20), Timeline(10))
    bpy.context.view_layer.objects.active = reel

    def run(panel: str, shading: str = "RENDERED", **inputs: Any) -> Layout:
        for name, value in inputs.items():
            compat.set_input(reels.modifier_of(reel), name.replace("_", " "), value)
        layout, kind = Layout(), getattr(bpy.types, panel)
        space = SimpleNamespace(shading=SimpleNamespace(type=shading))
        region = SimpleNamespace(width=900)
        context = SimpleNamespace(object=reel, scene=bpy.context.scene, space_data=space, region=region)
        assert kind.poll(context)
        host = SimpleNamespace(layout=layout)
        host.inputs = lambda context, *names: kind.inputs(host, context, *names)
        kind.draw(host, context)
        return layout

    yield run
    holoreel.unregister()


def add_camera(kind: str = "PERSP") -> None:
    """Add the active camera."""
    data = bpy.data.cameras.new("camera")
    data.type = kind
    bpy.context.scene.camera = bpy.data.objects.new("camera", data)
    bpy.context.scene.collection.objects.link(bpy.context.scene.camera)


def test_each_look_shows_its_own_settings(draw: Callable[..., Layout]) -> None:
    own = {SPLATS: {"Low Pass", "Near", "Follow View"}, HULL: {"Low Pass"}, POINTS: {"Point Size", "Hide Fainter Than"}}
    assert set(own) == set(LOOKS)
    for look, names in own.items():
        assert set(draw("HOLOREEL_PT_look", Look=look).inputs) == {"Look", "Color"} | names


def test_nothing_to_say_when_all_is_set_up(draw: Callable[..., Layout]) -> None:
    add_camera()
    bpy.context.scene.render.engine = "CYCLES"
    setup_exact_render(bpy.context.scene)
    for look in LOOKS:
        assert draw("HOLOREEL_PT_look", Look=look, Color=DISPLAY).labels == []


def test_workbench_and_solid_shading_say_that_they_are_previews(draw: Callable[..., Layout]) -> None:
    add_camera()
    for look in LOOKS:
        assert "preview" in draw("HOLOREEL_PT_look", shading="SOLID", Look=look).labels[-1]
    bpy.context.scene.render.engine = "BLENDER_WORKBENCH"
    for look in LOOKS:
        assert "preview" in draw("HOLOREEL_PT_look", Look=look).labels[0]


def test_what_stands_in_the_way_is_said(draw: Callable[..., Layout]) -> None:
    scene = bpy.context.scene
    scene.render.engine = compat.eevee_engine()
    assert any("active camera" in label for label in draw("HOLOREEL_PT_look").labels)
    assert any("EEVEE" in label for label in draw("HOLOREEL_PT_look", Look=HULL).labels)
    assert any("Raw" in label for label in draw("HOLOREEL_PT_look", Color=DISPLAY).labels)
    add_camera("PANO")
    assert any("take Hull" in label for label in draw("HOLOREEL_PT_look", Look=SPLATS, Color=LINEAR).labels)
    scene.render.engine = "CYCLES"
    drawn = draw("HOLOREEL_PT_look", Look=HULL)
    assert any("ends rays early" in label for label in drawn.labels)
    assert "holoreel.let_rays_through" in drawn.operators
    samples = scene.cycles.samples
    assert bpy.ops.holoreel.let_rays_through() == {"FINISHED"}
    assert scene.cycles.samples == samples
    drawn = draw("HOLOREEL_PT_look", Look=HULL)
    assert (drawn.labels, drawn.operators) == ([], [])


def test_crop_panel_asks_for_an_object(draw: Callable[..., Layout]) -> None:
    drawn = draw("HOLOREEL_PT_crop")
    assert (drawn.inputs, drawn.labels, drawn.operators) == (["Crop"], [], ["holoreel.add_crop_box"])
    drawn = draw("HOLOREEL_PT_crop", Crop=KEEP)
    assert drawn.inputs == ["Crop", "Crop Object"]
    assert "Choose" in drawn.labels[0]
