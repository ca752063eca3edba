# SPDX-License-Identifier: GPL-3.0-or-later
"""Crop boxes: Empties whose box decides which Gaussians of a reel are shown."""

import bpy
import numpy as np
from mathutils import Matrix, Vector

from ..core.errors import HoloreelError
from .attributes import read
from .compat import get_input, set_input
from .nodes.crop import KEEP, OFF
from .reels import modifier_of

MIDDLE = (5.0, 95.0)  # percentiles between which most of a scene lies: outliers are often far away


def add_crop_box(played: bpy.types.Object, mode: str = KEEP) -> bpy.types.Object:
    """Return a new box around the middle of a reel's points, which now crops it.

    The box is an Empty, a child of the reel: it moves with it. Raises `HoloreelError` for an object that is no reel.
    """
    modifier = modifier_of(played)
    if modifier is None:
        raise HoloreelError(f"object {played.name!r} is no reel; select one that was imported by Holoreel.")
    box = bpy.data.objects.new(f"{played.name} Crop", None)
    box.empty_display_type, box.empty_display_size = "CUBE", 1.0
    for collection in played.users_collection:
        collection.objects.link(box)
    box.parent = played
    low, high = _middle(played)
    box.matrix_basis = Matrix.LocRotScale((low + high) / 2, None, (high - low) / 2)
    set_input(modifier, "Crop Object", box)
    set_input(modifier, "Crop", mode)
    return box


def crop_problem(played: bpy.types.Object) -> str:
    """Return in a sentence why the crop of a reel does not do what it seems to; nothing if all is well."""
    modifier = modifier_of(played)
    chosen = get_input(modifier, "Crop Object")
    if get_input(modifier, "Crop") == OFF:
        return ""
    if chosen is None:
        return "Choose a crop object, or add a crop box"
    if chosen.type == "EMPTY" and (chosen.empty_display_type != "CUBE" or chosen.empty_display_size != 1.0):
        return "The crop is a box from -1 to 1: display the Empty as Cube of size 1"
    if chosen.type not in ("EMPTY", "MESH"):
        return "Crops are Empties or closed meshes"
    return ""


def _middle(played: bpy.types.Object) -> tuple[Vector, Vector]:
    """Return two corners, at least a little apart."""
    places = read(played.data.attributes, "position")
    places = places[np.isfinite(places).all(axis=1)]
    if not len(places):
        return Vector((-1, -1, -1)), Vector((1, 1, 1))
    low, high = np.percentile(places, MIDDLE, axis=0)
    return Vector(low), Vector(np.maximum(high, low + 1e-3))
