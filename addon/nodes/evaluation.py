# SPDX-License-Identifier: GPL-3.0-or-later
"""Time and the evaluation of Spacetime Gaussians, as node groups."""

from typing import Any

from ...core.gaussians.model import OPACITY_MIN
from .. import timeline
from ..attributes import PREFIX
from ..compat import set_wildcard
from .builder import Boolean, Float, Geometry, Tree, Vector
from .library import node_group

TIMELINE_PANEL, DETAIL_PANEL = "Timeline", "Detail"


def timeline_inputs(tree: Tree) -> dict[str, Any]:
    """Declare the inputs of the timeline mapping; return them by name."""
    panel = TIMELINE_PANEL
    return {
        "Start Frame": tree.float_input("Start Frame", "Scene frame at which the reel starts", 1.0, panel=panel),
        "Speed": tree.float_input(
            "Speed", "Reel frames per scene frame: 1 plays frame by frame, 0.5 at half speed, 0 stops", 1.0, panel=panel
        ),
        "Offset": tree.float_input(
            "Offset",
            "Reel frames that have already passed at the start; key it and set Speed to 0 to choose frames",
            panel=panel,
        ),
        "First Frame": tree.integer_input("First Frame", "First reel frame to play, counted from 0", 0, 0, panel=panel),
        "Last Frame": tree.integer_input("Last Frame", "Last reel frame to play, counted from 0", 0, 0, panel=panel),
        "Frame Count": tree.integer_input("Frame Count", "Frames the reel was made from", 1, 1, panel=panel),
        "Repeat": tree.menu_input("Repeat", "What to show before the start and after the last frame", panel=panel),
        "Retime": tree.boolean_input(
            "Retime",
            "Show the reel frame below, keyed or driven, instead of following the scene's frames",
            False,
            panel,
        ),
        "Reel Frame": tree.float_input(
            "Reel Frame", "Reel frame to show with Retime, counted from 0; fractions show what is between", panel=panel
        ),
    }


def detail_inputs(tree: Tree) -> dict[str, Any]:
    """Declare the inputs that say how much is worked out of the points; return them by name."""
    return _percentages(tree) | {
        "Motion Blur": tree.boolean_input(
            "Motion Blur",
            "Say how fast each point moves (attribute velocity), which motion blur in Cycles needs",
            True,
            DETAIL_PANEL,
        )
    }


def _percentages(tree: Tree) -> dict[str, Float]:
    what = "Percentage of the points to show, the most important first, in"
    return {
        name: tree.float_input(name, f"{what} {where}", 100.0, 0.0, 100.0, DETAIL_PANEL)
        for name, where in (("Viewport Detail", "the viewport"), ("Render Detail", "renders"))
    }


@node_group("Holoreel Time", 3, "Map the scene's frame to a reel's time")
def time(tree: Tree) -> None:
    """Outputs: Time, normalized; Reel Frame; Rate. The first two are the same as those of `timeline.Timeline`.

    The rate is that of an unkeyed mapping, and 0 with Retime, whose keys nodes cannot look ahead in.
    """
    inputs = timeline_inputs(tree)
    clock = tree.node("GeometryNodeInputSceneTime").outputs
    frame = Float(tree, clock["Frame"])
    first = inputs["First Frame"]
    steps = (inputs["Last Frame"] - first).at_least(0.0)
    followed = (frame - inputs["Start Frame"]) * inputs["Speed"] + inputs["Offset"]
    passed = tree.choose(inputs["Retime"], inputs["Reel Frame"] - first, followed, "FLOAT")
    there_and_back = passed.modulo(2.0 * steps)
    inside = (1.0 - (-passed).above(0.0)) * (1.0 - passed.above(steps))
    shown = {  # and its direction: 1 forward, -1 backward, 0 held
        timeline.HOLD: (passed.at_least(0.0).at_most(steps), inside),
        timeline.LOOP: (passed.modulo(steps + 1.0), 1.0),
        timeline.PING_PONG: (
            there_and_back.at_most(2.0 * steps - there_and_back),
            1.0 - 2.0 * there_and_back.above(steps),
        ),
    }
    choices = {name: (tooltip, tree.vector(*shown[name], 0.0)) for name, tooltip in timeline.REPEATS.items()}
    offset, direction, _ = tree.switch(inputs["Repeat"], choices, "VECTOR").axes()
    reel_frame = (first + offset).at_most(inputs["Frame Count"])
    tree.output("Time", reel_frame / inputs["Frame Count"], "Time in the reel, from 0 to 1")
    tree.output("Reel Frame", reel_frame, "Frame of the reel, counted from 0, with its fraction")
    frames_per_second = frame / Float(tree, clock["Seconds"])
    rate = direction * inputs["Speed"] * frames_per_second
    still = tree.choose(inputs["Retime"], rate * 0.0, rate, "FLOAT")
    tree.output("Rate", still, "Reel frames per second of the scene; negative backward")
    tree.set_menu_default("Repeat", timeline.HOLD)


@node_group("Holoreel Segment", 2, "Keep the Gaussians of the segment that a frame lies in")
def segment(tree: Tree) -> None:
    """Outputs the points, their segment's normalized time, and how much of it passes in a second.

    A segment of the frames `stg_first` ... is shown from there until `stg_until`, which is beyond all frames for the
    last; the frame j of its `stg_frames` has the time j / `stg_frames`. Points without these belong to every frame.
    """
    points = tree.geometry_input()
    frame = tree.float_input("Reel Frame", "Frame of the reel, counted from 0")
    count = tree.float_input("Frame Count", "Frames of a reel without segments", 1.0)
    rate = tree.float_input("Rate", "Reel frames per second of the scene")
    first, segmented = tree.attribute("stg_first", "FLOAT"), tree.has_attribute("stg_first", "FLOAT")
    ended = ~frame.below(tree.attribute("stg_until", "FLOAT"))
    points = tree.delete_points(points, segmented & (frame.below(first) | ended))
    frames = tree.choose(segmented, tree.attribute("stg_frames", "FLOAT"), count, "FLOAT")
    tree.output("Geometry", points, "Gaussians of the segment")
    tree.output("Time", ((frame - first) / frames).at_most(1.0), "Time in the segment, from 0 to 1")
    tree.output("Time per Second", rate / frames, "Time of the segment that passes in a second of the scene")


@node_group("Holoreel Detail", 1, "Keep the first points: the most important, if they are sorted so")
def detail(tree: Tree) -> None:
    """Keeps the given percentage, rounded up."""
    points = tree.geometry_input()
    inputs = _percentages(tree)
    in_viewport = Boolean(tree, tree.node("GeometryNodeIsViewport").outputs[0])
    percent = tree.choose(in_viewport, inputs["Viewport Detail"], inputs["Render Detail"], "FLOAT")
    count = Float(tree, tree.node("GeometryNodeAttributeDomainSize", {0: points}, component="POINTCLOUD").outputs[0])
    index = Float(tree, tree.node("GeometryNodeInputIndex").outputs[0])
    fewer = tree.delete_points(points, ~index.below(count * percent / 100.0))
    tree.output("Geometry", tree.choose(percent.below(100.0), fewer, points, "GEOMETRY"), "Points that are kept")


def play(tree: Tree, cloud: Geometry, mapping: dict[str, Any], kept: dict[str, Any]) -> Geometry:
    """Add the nodes from the points of `attributes.TABLE` to the Gaussians that the scene's frame shows.

    `mapping` comes from `timeline_inputs`, `kept` from `detail_inputs`.
    """
    percentages = {name: value for name, value in kept.items() if name != "Motion Blur"}
    cloud = Geometry(tree, tree.group(detail(), {"Geometry": cloud, **percentages}).outputs["Geometry"])
    clock = tree.group(time(), mapping).outputs
    now = {name: Float(tree, clock[name]) for name in ("Reel Frame", "Rate")}
    current = tree.group(segment(), {"Geometry": cloud, "Frame Count": mapping["Frame Count"], **now}).outputs
    parts = {name: Float(tree, current[name]) for name in ("Time", "Time per Second")}
    parts |= {"Geometry": Geometry(tree, current["Geometry"]), "Motion Blur": kept["Motion Blur"]}
    return Geometry(tree, tree.group(evaluate(), parts).outputs["Geometry"])


@node_group("Holoreel Evaluate", 4, "Evaluate Spacetime Gaussians at a time and delete those that cannot be seen then")
def evaluate(tree: Tree) -> None:
    """Spacetime Gaussians, Eqs. 7 to 9. Consumes the attributes `stg_*`; stores `opacity`, `rotation` and `velocity`.

    The velocity, per second, is that of Eq. 8. Renderers would otherwise compare the points of two moments one by one,
    but points come and go, and looks sort them. For the same reason they get an `id`.
    """
    points = tree.geometry_input()
    now = tree.float_input("Time", "Time in the reel or the point's segment, from 0 to 1", is_field=True)
    cut = tree.float_input("Minimum Opacity", "Gaussians below this opacity are deleted", OPACITY_MIN, 0.0, 1.0)
    pace = tree.float_input("Time per Second", "Time that passes in a second of the scene", is_field=True)
    blurred = tree.boolean_input("Motion Blur", "Store the velocity", False)
    dt = now - tree.attribute("stg_center", "FLOAT")

    widths = dt * tree.attribute("stg_inverse_width", "FLOAT")
    opacity = tree.attribute("stg_opacity", "FLOAT") * (-(widths * widths)).exp()
    points = tree.store(points, "opacity", opacity, "FLOAT")

    quat = [
        start + speed * dt
        for start, speed in zip(
            tree.attribute("stg_quat", "FLOAT_COLOR").channels(),
            tree.attribute("stg_omega", "FLOAT_COLOR").channels(),
            strict=True,
        )
    ]
    points = tree.store(points, "rotation", tree.quaternion(*quat), "QUATERNION")

    motions = [tree.attribute(f"stg_motion_{order}", "FLOAT_VECTOR") for order in (1, 2, 3)]
    moving = tree.store(points, "velocity", _velocity(motions, dt) * pace, "FLOAT_VECTOR")
    index = Float(tree, tree.node("GeometryNodeInputIndex").outputs[0])
    moving = tree.geometry("GeometryNodeSetID", {"Geometry": moving, "ID": index})
    points = tree.choose(blurred, moving, points, "GEOMETRY")
    position = tree.position() + (motions[0] + (motions[1] + motions[2] * dt) * dt) * dt
    points = tree.geometry("GeometryNodeSetPosition", {"Geometry": points, "Position": position})
    # Points are deleted last, when there is least to copy of those that stay: half the memory.
    points = _without_parameters(tree, points)
    points = tree.delete_points(points, tree.attribute("opacity", "FLOAT").below(cut))
    tree.output("Geometry", points, "Gaussians at that time")


def _velocity(motions: list[Vector], dt: Float) -> Vector:
    """Return the derivative of the cubic of Eq. 8."""
    return motions[0] + (motions[1] * 2.0 + motions[2] * (dt * 3.0)) * dt


def _without_parameters(tree: Tree, points: Geometry) -> Geometry:
    """Remove what has been used up, so that looks need not carry it along."""
    node = tree.node("GeometryNodeRemoveAttribute", {"Geometry": points, "Name": f"{PREFIX}*"})
    set_wildcard(node)
    return Geometry(tree, node.outputs[0])
