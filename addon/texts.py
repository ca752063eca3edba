# SPDX-License-Identifier: GPL-3.0-or-later
"""Sentences in panels: a label shows one line, and cuts off what does not fit."""

import textwrap

import bpy

_PIXELS_PER_LETTER = 6.5  # of Blender's own font, at its usual size; a little too many is better than a word cut off
_MARGIN_PIXELS = 70  # with an icon
_FEWEST = 16


def letters_in(region: bpy.types.Region) -> int:
    """Return how many letters fit into a line of a region."""
    pixels = region.width / (bpy.context.preferences.system.ui_scale or 1.0)  # 0 in background mode
    return max(_FEWEST, int((pixels - _MARGIN_PIXELS) / _PIXELS_PER_LETTER))


def draw_text(layout: bpy.types.UILayout, text: str, letters: int, icon: str = "NONE") -> None:
    """Draw a text over as many lines of so many letters as it takes."""
    column = layout.column(align=True)
    for number, line in enumerate(textwrap.wrap(text, letters, break_on_hyphens=False)):
        column.label(text=line, icon="BLANK1" if number and icon != "NONE" else icon)
