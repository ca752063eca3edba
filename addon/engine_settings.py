# SPDX-License-Identifier: GPL-3.0-or-later
"""What a scene says to the render engine Holoreel: `scene.holoreel_engine`."""

import bpy

from .nodes.reel import COLOR_TOOLTIP
from .shots import COLOR, DISPLAY, LINEAR, REEL

_QUALITIES = (
    ("FULL", "Full", "The steps along each ray that the VideoRF was trained with"),
    ("FAST", "Fast", "Steps twice as long"),
    ("DRAFT", "Draft", "Steps four times as long"),
)


ENGINE = "HOLOREEL"


class HoloreelEngineSettings(bpy.types.PropertyGroup):
    """Settings of one scene."""

    color: bpy.props.EnumProperty(
        name="Color",
        description=COLOR_TOOLTIP,
        items=(
            (LINEAR, "Scene-Linear", "Convert the colors to scene-linear; exact under the view transform Standard"),
            (DISPLAY, "Display-Referred", "Leave the colors as they were trained; exact under the view transform Raw"),
        ),
        default=LINEAR,
    )
    background: bpy.props.EnumProperty(
        name="Background",
        description="What lies behind the reels, unless the film is transparent",
        items=(
            (REEL, "Reel", "The color that the first reel was trained over, or what its decoder makes of nothing"),
            (COLOR, "Color", "A color of your own"),
        ),
        default=REEL,
    )
    background_color: bpy.props.FloatVectorProperty(
        name="Background Color",
        description="The color behind the reels, as it is displayed",
        subtype="COLOR_GAMMA",
        size=3,
        min=0.0,
        max=1.0,
        default=(0.0, 0.0, 0.0),
    )
    quality: bpy.props.EnumProperty(
        name="Quality", description="How finely rays are marched through a VideoRF when rendering", items=_QUALITIES
    )
    viewport_quality: bpy.props.EnumProperty(
        name="Viewport Quality",
        description="How finely rays are marched through a VideoRF in the viewport",
        items=_QUALITIES,
        default="FAST",
    )
    is_chosen: bpy.props.BoolProperty(
        name="Is Chosen",
        description="Whether the scene is rendered by the Holoreel engine; reels need not make any geometry then",
        get=lambda settings: settings.id_data.render.engine == ENGINE,
    )
    use_pass_alpha: bpy.props.BoolProperty(
        name="Alpha",
        description="Deliver the pass Alpha: what the reels cover, whatever lies behind them",
        default=False,
    )


def register() -> None:
    """Give every scene its settings."""
    bpy.utils.register_class(HoloreelEngineSettings)
    bpy.types.Scene.holoreel_engine = bpy.props.PointerProperty(type=HoloreelEngineSettings)


def unregister() -> None:
    """Take them away again."""
    del bpy.types.Scene.holoreel_engine
    bpy.utils.unregister_class(HoloreelEngineSettings)
