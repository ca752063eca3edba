# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures in panels: the newest preview of each job, loaded when it is drawn."""

from pathlib import Path

import bpy
import bpy.utils.previews

_pictures: bpy.utils.previews.ImagePreviewCollection | None = None
_numbers: dict[str, int] = {}


def icon(name: str, number: int, path: Path) -> int:
    """Return the icon of a picture file; it is loaded anew when `number` has changed. 0 where there is none."""
    if _pictures is None or number == 0:
        return 0
    if _numbers.get(name) != number:
        forget(name)
        tuple(_pictures.load(name, str(path), "IMAGE", True).image_size)  # now: else it blinks while it is loaded
        _numbers[name] = number
    return _pictures[name].icon_id


def forget(name: str) -> None:
    """Free a picture."""
    if _pictures is not None and name in _pictures:
        del _pictures[name]
    _numbers.pop(name, None)


def register() -> None:
    """Make room for pictures."""
    global _pictures
    _pictures = bpy.utils.previews.new()


def unregister() -> None:
    """Free them all."""
    global _pictures
    if _pictures is not None:
        bpy.utils.previews.remove(_pictures)
    _pictures = None
    _numbers.clear()
