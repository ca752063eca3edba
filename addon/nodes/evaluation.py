# SPDX-License-Identifier: GPL-3.0-or-later
"""Time and the evaluation of Spacetime Gaussians, as node groups."""

from typing import Any

from ...core.gaussians.model import OPACITY_MIN
from .. import timeline
from ..attributes import PREFIX
from ..compat import set_wildcard
from .builder import Float, Geometry, Tree
from .library import node_group

TIMELINE_PANEL = "Timeline"


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
    }


@node_group("Holoreel Time", 1, "Map the scene's frame to a reel's time")
def time(tree: Tree) -> None:
    """Outputs: Time, normalized; Reel Frame. The same as `timeline.Timeline`."""
    inputs = timeline_inputs(tree)
    frame = Float(tree, tree.node("GeometryNodeInputSceneTime").outputs["Frame"])
    first = inputs["First Frame"]
    steps = (inputs["Last Frame"] - first).at_least(0.0)
    passed = (frame - inputs["Start Frame"]) * inputs["Speed"] + inputs["Offset"]
    there_and_back = passed.modulo(2.0 * steps)
    shown = {
        timeline.HOLD: passed.at_least(0.0).at_most(steps),
        timeline.LOOP: passed.modulo(steps + 1.0),
        timeline.PING_PONG: there_and_back.at_most(2.0 * steps - there_and_back),
    }
    choices = {name: (tooltip, shown[name]) for name, tooltip in timeline.REPEATS.items()}
    reel_frame = first + tree.switch(inputs["Repeat"], choices, "FLOAT")
    tree.output("Time", reel_frame / inputs["Frame Count"], "Time in the reel, from 0 to 1")
    tree.output("Reel Frame", reel_frame, "Frame of the reel, counted from 0, with its fraction")
    tree.set_menu_default("Repeat", timeline.HOLD)


@node_group("Holoreel Evaluate", 1, "Evaluate Spacetime Gaussians at a time and delete those that cannot be seen then")
def evaluate(tree: Tree) -> None:
    """Spacetime Gaussians, Eqs. 7 to 9. Consumes the attributes `stg_*`; stores `opacity` and `rotation`."""
    points = tree.geometry_input()
    now = tree.float_input("Time", "Time in the reel, from 0 to 1")
    cut = tree.float_input("Minimum Opacity", "Gaussians below this opacity are deleted", OPACITY_MIN, 0.0, 1.0)
    dt = now - tree.attribute("stg_center", "FLOAT")

    widths = dt * tree.attribute("stg_inverse_width", "FLOAT")
    opacity = tree.attribute("stg_opacity", "FLOAT") * (-(widths * widths)).exp()
    points = tree.store(points, "opacity", opacity, "FLOAT")
    points = tree.delete_points(points, tree.attribute("opacity", "FLOAT").below(cut))

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
    position = tree.position() + (motions[0] + (motions[1] + motions[2] * dt) * dt) * dt
    points = tree.geometry("GeometryNodeSetPosition", {"Geometry": points, "Position": position})
    tree.output("Geometry", _without_parameters(tree, points), "Gaussians at that time")


def _without_parameters(tree: Tree, points: Geometry) -> Geometry:
    """Remove what has been used up, so that looks need not carry it along."""
    node = tree.node("GeometryNodeRemoveAttribute", {"Geometry": points, "Name": f"{PREFIX}*"})
    set_wildcard(node)
    return Geometry(tree, node.outputs[0])
