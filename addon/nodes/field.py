# SPDX-License-Identifier: GPL-3.0-or-later
"""A VideoRF on the timeline, as node groups: a frame of the movie → the points that can be seen then → colors → look.

Geometry Nodes read the movie as it lies on the disk: Closest, by pixel, so that codes arrive as they were decoded.
"""

from typing import Any

import bpy
import numpy as np

from ...core.videorf.occupancy import GAMMA
from ...core.videorf.package import VideoReel
from ...core.videorf.shading import Shading
from .. import timeline
from ..compat import set_wildcard
from .builder import Boolean, Float, Geometry, Image, Tree, Value, Vector
from .decoder import WIDTH, decoder, feature_sockets, fits, sigmoid
from .evaluation import time, timeline_inputs
from .library import TAG, ensure_group
from .show import POINTS, set_show_defaults, show, show_inputs
from .view import View

NAME, VERSION = "Holoreel Field Reel", 3
SAMPLE = "Holoreel Field Frame"
FIELD_PANEL = "Field"
PREFIX = "field_"
UV, FIRST, LAST, DENSITY = (f"{PREFIX}{name}" for name in ("uv", "first", "last", "density"))

# A splat of this width, in spacings, covers as much of the picture as one cell of the lattice: 2 π σ² = spacing².
SPLAT_WIDTH = 0.3989423
POINT_SIZE = 2.2  # in such widths: points of neighbors then overlap along the diagonals of cells, too

CAMERA, DIRECTION = "Camera", "Direction"
VIEWS = {
    CAMERA: "Color each point as the active camera sees it",
    DIRECTION: "Color all points as seen along one direction, wherever the camera is",
}
BROKEN = (1.0, 0.0, 1.0)  # the color that says: the movie is missing


def feature_attributes(features: int) -> list[str]:
    """Return the names of the attributes that hold the features, three each."""
    return [f"{PREFIX}features_{first + 1}" for first in range(0, features, WIDTH)]


def field_reel(reel: VideoReel, shading: Shading) -> bpy.types.NodeTree:
    """Return the group that plays `reel`, built once per .blend file for all reels of one training.

    It takes points with the attributes `field_uv` (the pixel of channel 0), `field_first` and `field_last` (the frames
    that their group has).
    """
    return ensure_group(NAME, _version(reel), "Play a VideoRF on the timeline", lambda tree: _fill(tree, reel, shading))


def field_frame(reel: VideoReel) -> bpy.types.NodeTree:
    """Return the group that deletes what cannot be seen in a frame and stores the others' `opacity` and features."""
    tooltip = "Read a frame of a VideoRF from its movie and delete the points that cannot be seen in it"
    return ensure_group(SAMPLE, _version(reel), tooltip, lambda tree: _fill_frame(tree, reel))


def plays(group: bpy.types.NodeTree, reel: VideoReel) -> bool:
    """Return whether a group was built, in whatever version, for the training that a reel is of."""
    return str(group.get(TAG, "")).partition("-")[2] == _training(reel)


def _version(reel: VideoReel) -> str:
    return f"{VERSION}-{_training(reel)}"


def _training(reel: VideoReel) -> str:
    """Return what tells all that is a constant in the groups: the reel's meaning and its length."""
    return f"{reel.meaning[:16]}-{reel.frame_count}"


def _fill(tree: Tree, reel: VideoReel, shading: Shading) -> None:
    cloud = tree.geometry_input()
    mapping = timeline_inputs(tree)
    movie = tree.image_input("Movie", "The movie with the reel's features, as it lies beside the reel", FIELD_PANEL)
    held = tree.integer_input(
        "Movie Frames",
        "Frames that the movie holds, fewer than the reel's if it is cut off; set when a movie is chosen",
        reel.frame_count,
        0,
        FIELD_PANEL,
    )
    view = tree.menu_input("Seen From", "The colors of a VideoRF depend on the direction of view", FIELD_PANEL)
    along = tree.vector_input(
        "Direction", "From the eye into the scene, in the reel's own axes", (0.0, 1.0, 0.0), FIELD_PANEL
    )
    cut = tree.float_input(
        "Minimum Opacity", "Points that absorb less over one spacing are deleted", GAMMA, 0.0, 1.0, FIELD_PANEL
    )
    shown = show_inputs(tree)

    reel_frame = Float(tree, tree.group(time(), mapping).outputs["Reel Frame"])
    frame = (reel_frame + timeline.FRAME_ROUNDING).floor().at_least(0.0).at_most(reel.frame_count - 1.0)
    cloud = tree.delete_points(cloud, _of_other_groups(tree, frame))
    broken = _broken(tree, reel, movie, held, frame)
    sampled = _chain(
        tree, field_frame(reel), {"Geometry": cloud, "Movie": movie, "Frame": frame, "Minimum Opacity": cut}
    )
    directions = {CAMERA: _from_camera(tree, shown, along), DIRECTION: along.normalized()}
    seen = tree.switch(view, {name: (tip, directions[name]) for name, tip in VIEWS.items()}, "VECTOR")
    colored = _colored(tree, reel, shading, sampled, seen)
    cloud = tree.choose(broken, _alarmed(tree, cloud), colored, "GEOMETRY")
    cloud = _as_gaussians(tree, cloud, reel.lattice.spacing * SPLAT_WIDTH)
    tree.output("Geometry", show(tree, cloud, shown), "What renders")
    set_show_defaults(tree, POINTS)
    for name, default in (("Repeat", timeline.HOLD), ("Seen From", CAMERA)):
        tree.set_menu_default(name, default)


def _of_other_groups(tree: Tree, frame: Float) -> Boolean:
    first, last = tree.attribute(FIRST, "FLOAT"), tree.attribute(LAST, "FLOAT")
    return ((frame - first) * (last - frame)).below(-0.5)


def _broken(tree: Tree, reel: VideoReel, movie: Image, held: Float, frame: Float) -> Boolean:
    """Whether the movie has no such frame of the right size; says so in the modifier."""
    height, width = reel.tiling.picture
    info = tree.node("GeometryNodeImageInfo", {"Image": movie, "Frame": frame + 1.0}).outputs
    right = (Float(tree, info["Width"]) - width).is_zero() * (Float(tree, info["Height"]) - height).is_zero()
    right = right * (Float(tree, info["Frame Count"]).at_most(held) - frame).above(0.5)
    broken = right.below(0.5)
    message = "The movie of this VideoRF is missing, cut off, or another one: see Holoreel > Field"
    tree.node("GeometryNodeWarning", {"Show": broken, "Message": message}, warning_type="ERROR")
    return broken


def _alarmed(tree: Tree, cloud: Geometry) -> Geometry:
    """Show all points of the group in a color that nobody takes for the subject's: never silently empty."""
    cloud = tree.store(cloud, "opacity", 1.0, "FLOAT")
    return tree.store(cloud, "rgb", tree.color(*BROKEN), "FLOAT_COLOR")


def _colored(tree: Tree, reel: VideoReel, shading: Shading, cloud: Geometry, seen: Vector) -> Geometry:
    features = shading.shape.features
    values = [tree.attribute(name, "FLOAT_VECTOR") for name in feature_attributes(features)]
    if fits(shading.shape):
        inputs = dict(zip(feature_sockets(features), values, strict=True))
        decoded = tree.group(decoder(shading), {**inputs, "Direction": seen})
        color = Vector(tree, decoded.outputs["Color"])
    else:
        low, high = (np.pad(side[1:4], (0, WIDTH))[:WIDTH] for side in (reel.ranges.low, reel.ranges.high))
        color = (values[0] - tuple(low.tolist())) * tuple((1.0 / np.maximum(high - low, 1e-12)).tolist())
    return tree.store(cloud, "rgb", tree.color(*color.axes()), "FLOAT_COLOR")


def _from_camera(tree: Tree, inputs: dict[str, Any], without: Vector) -> Vector:
    """Return the direction from the camera to each point, in the object's space; `without` one, that direction."""
    view = View(tree, inputs["Follow View"], inputs["Render Width"], inputs["Render Height"])
    perspective = 1.0 - view.orthographic
    ahead = view.back * -1.0 * view.orthographic  # of an orthographic camera
    seen = (tree.position() - view.location) * perspective + ahead
    return tree.choose(view.exists, seen, without, "VECTOR").normalized()


def _as_gaussians(tree: Tree, cloud: Geometry, width: float) -> Geometry:
    """Give points what looks read beside `rgb` and `opacity`, and take away what has been used up."""
    cloud = tree.store(cloud, "scale", (width, width, width), "FLOAT_VECTOR")
    node = tree.node("GeometryNodeRemoveAttribute", {"Geometry": cloud, "Name": f"{PREFIX}*"})
    set_wildcard(node)
    return Geometry(tree, node.outputs[0])


def _fill_frame(tree: Tree, reel: VideoReel) -> None:
    """Stores `field_density` (raw), `opacity` over one spacing, 1 - exp(-softplus(density)), and the features."""
    cloud = tree.geometry_input()
    movie = tree.image_input("Movie", "The movie with the reel's features")
    frame = tree.integer_input("Frame", "Frame of the reel, counted from 0", 0, 0)
    cut = tree.float_input("Minimum Opacity", "Points that absorb less over one spacing are deleted", GAMMA, 0.0, 1.0)
    channel = _Channels(tree, reel, movie, frame)

    cloud = tree.store(cloud, DENSITY, channel(0), "FLOAT")
    # exp(-softplus(d)) is 1 / (1 + exp(d)).
    cloud = tree.store(cloud, "opacity", sigmoid(tree.attribute(DENSITY, "FLOAT")), "FLOAT")
    cloud = tree.delete_points(cloud, tree.attribute("opacity", "FLOAT").below(cut))
    features = reel.shading.features
    for index, name in enumerate(feature_attributes(features)):
        numbers = [WIDTH * index + 1 + part for part in range(WIDTH)]
        values = [channel(number) if number <= features else 0.0 for number in numbers]
        cloud = tree.store(cloud, name, tree.vector(*values), "FLOAT_VECTOR")
    tree.output("Geometry", cloud, "Points of that frame")


class _Channels:
    """The channels of a frame at each point, dequantized."""

    def __init__(self, tree: Tree, reel: VideoReel, movie: Image, frame: Float) -> None:
        self.tree, self.reel, self.movie = tree, reel, movie
        self.scene_frame = frame + 1.0  # Blender counts a movie's frames from 1
        self.uv = tree.attribute(UV, "FLOAT_VECTOR")

    def __call__(self, index: int) -> Float:
        """Return channel `index`: the same pixel of another tile."""
        tiling, ranges = self.reel.tiling, self.reel.ranges
        tile = (index % tiling.columns / tiling.columns, -(index // tiling.columns) / tiling.rows, 0.0)
        node = self.tree.node(
            "GeometryNodeImageTexture",
            {"Image": self.movie, "Vector": self.uv + tile, "Frame": self.scene_frame},
            interpolation="Closest",
            extension="EXTEND",
        )
        red = self.tree.node("FunctionNodeSeparateColor", {0: Value(self.tree, node.outputs["Color"])}).outputs[0]
        return Float(self.tree, red) * (ranges.high[index] - ranges.low[index]) + ranges.low[index]


def _chain(tree: Tree, group: bpy.types.NodeTree, inputs: dict[str, Any]) -> Geometry:
    return Geometry(tree, tree.group(group, inputs).outputs["Geometry"])
