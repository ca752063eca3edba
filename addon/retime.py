# SPDX-License-Identifier: GPL-3.0-or-later
"""From a mapping with a speed to keys on the reel frame, which can then be bent in the Graph Editor."""

import math

import bpy

from ..core.errors import HoloreelError
from . import compat
from .reels import modifier_of, timeline_of
from .timeline import Timeline

MAX_KEYS = 100_000


def key_reel_frames(scene: bpy.types.Scene, played: bpy.types.Object) -> int:
    """Key Reel Frame so that a reel plays as it did, and switch Retime on; returns how many keys there are.

    A constant Speed becomes two keys. A keyed Speed becomes one key per scene frame, at the reel frame that has been
    reached by then: unlike the mapping itself, which multiplies the whole time passed by the speed of the moment, that
    is how far a ramp of speeds really gets. Raises `HoloreelError` where the reel stands still.
    """
    modifier = modifier_of(played)
    if modifier is None:
        raise HoloreelError(f"object '{played.name}' is no reel: choose one.")
    timeline = timeline_of(played)
    if timeline.retime:
        raise HoloreelError(f"object '{played.name}' is retimed already: edit the keys of Reel Frame.")
    speed = compat.find_fcurve(played, compat.input_path(modifier, "Speed"))
    keys = _ends(played, timeline) if speed is None else _ramp(scene, timeline, speed)
    path = compat.input_path(modifier, "Reel Frame")
    for frame, shown in keys:
        compat.set_input(modifier, "Reel Frame", shown)
        played.keyframe_insert(path, frame=frame)
    curve = compat.find_fcurve(played, path)
    curve.extrapolation = "LINEAR"  # so that repeats go on
    for key in curve.keyframe_points:
        key.interpolation = "LINEAR"
    compat.set_input(modifier, "Retime", True)
    return len(keys)


def _ends(played: bpy.types.Object, timeline: Timeline) -> list[tuple[float, float]]:
    """Return (scene frame, reel frame) where the range begins and where it ends; backward for negative speeds."""
    if timeline.speed == 0.0:
        raise HoloreelError(f"object '{played.name}' has Speed 0: set its speed first, or key Reel Frame yourself.")
    ends = (0.0, float(timeline.last_frame - timeline.first))
    keys = [((passed - timeline.offset) / timeline.speed + timeline.start, timeline.first + passed) for passed in ends]
    return sorted(keys)


def _ramp(scene: bpy.types.Scene, timeline: Timeline, speed: bpy.types.FCurve) -> list[tuple[float, float]]:
    """Return (scene frame, reel frame) for every frame from the start on: the speed added up, by the trapezoid rule."""
    first, last = math.ceil(timeline.start), max(scene.frame_end, math.ceil(timeline.start))
    if last - first >= MAX_KEYS:
        raise HoloreelError(f"the scene has {last - first:,} frames after the reel's start: end it sooner.")
    passed = timeline.offset + (first - timeline.start) * speed.evaluate(timeline.start)
    keys = []
    for frame in range(first, last + 1):
        keys.append((float(frame), timeline.first + passed))
        passed += 0.5 * (speed.evaluate(frame) + speed.evaluate(frame + 1))
    return keys
