# SPDX-License-Identifier: GPL-3.0-or-later
"""Imported reels and their files: read again, found again, kept in the .blend or beside the reel."""

from pathlib import Path

import bpy

from ..core.errors import HoloreelError
from ..core.reel import VIDEORF, load_segments, reel_kind
from ..core.videorf.package import read_video_reel
from . import clouds
from .compat import get_input, set_input
from .reels import INFO, describe, modifier_of, read_sequence, remember_source, source_of

KIND_VIDEORF = "videorf"


def reload_reel(context: bpy.types.Context, played: bpy.types.Object) -> list[str]:
    """Read a reel's file again and replace its points; what was set stays set. Returns sentences about the file.

    Points that are stored beside the reel are written anew there. Raises `HoloreelError` where the file is missing,
    damaged or of another kind; then the points stay as they were.
    """
    return _load(context, played, source_of(played))


def relink_reel(context: bpy.types.Context, played: bpy.types.Object, path: Path) -> list[str]:
    """Let a reel come from another file from now on, as `reload_reel` does from the same.

    Of a sequence, that is the first file; the others must lie beside it under their old names.
    """
    return _load(context, played, path)


def store_beside(played: bpy.types.Object) -> None:
    """Move a reel's points out of the .blend into one beside the reel. Raises as `source_of` does."""
    _demand_own(played)
    if played.data.library is None:
        clouds.store_beside(played.data, clouds.library_path(source_of(played), _detail(played)))


def store_inside(played: bpy.types.Object) -> None:
    """Take a reel's points into the .blend. Raises `HoloreelError` where they are missing."""
    _demand_own(played)
    clouds.store_inside(played.data, played.name)


def problem_of(played: bpy.types.Object) -> str | None:
    """Say in a sentence why a reel shows nothing or less than it should; None if all its files are there."""
    if is_field(played):
        from .fields import movie_problem

        return movie_problem(played)
    return clouds.missing_library(played.data)


def is_field(played: bpy.types.Object) -> bool:
    """Return whether a reel is a VideoRF."""
    return played.get(INFO, {}).get("kind") == KIND_VIDEORF


def _load(context: bpy.types.Context, played: bpy.types.Object, path: Path) -> list[str]:
    _demand_own(played)
    if (reel_kind(path) == VIDEORF) != is_field(played):
        raise HoloreelError(f"{path} is of another kind than object '{played.name}': import it anew.")
    if is_field(played):
        from .fields import set_rung

        set_rung(played, read_video_reel(path), played[INFO].get("rung"))
        remember_source(played, path)
        return []
    files = list(filter(None, str(played.get(INFO, {}).get("files", "")).split("\n")))
    parts = read_sequence([path.with_name(name) for name in files]) if files else load_segments(path)
    detail = _detail(played)
    beside = played.data.library is not None
    cloud = clouds.replace_points(context, played.data, clouds.join(parts, detail))
    if beside:
        clouds.store_beside(cloud, clouds.library_path(path, detail))
    info = describe(parts, detail)
    _follow_length(played, info["frame_count"])
    played[INFO] = info
    remember_source(played, path)
    return list(filter(None, info["report"].split("\n")))


def _detail(played: bpy.types.Object) -> float:
    return float(played.get(INFO, {}).get("detail", 100.0))


def _follow_length(played: bpy.types.Object, count: int) -> None:
    """Play a reel that has become longer or shorter to its end, if it was played to its end before."""
    before = played.get(INFO, {}).get("frame_count")
    if count == before:
        return
    modifier = modifier_of(played)
    if get_input(modifier, "Last Frame") == get_input(modifier, "Frame Count") - 1:
        set_input(modifier, "Last Frame", count - 1)
    set_input(modifier, "Frame Count", count)


def _demand_own(played: bpy.types.Object) -> None:
    if modifier_of(played) is None:
        raise HoloreelError(f"object '{played.name}' is no reel: choose one.")
    if played.library is not None or played.override_library is not None:
        raise HoloreelError(f"object '{played.name}' is linked from another .blend: change it there.")
