# SPDX-License-Identifier: GPL-3.0-or-later
"""Asks the core environment how it is, beside Blender: the first import of torch may take a minute."""

import threading
from pathlib import Path

import bpy

from ..core.errors import HoloreelError
from .environment import check

_POLL_SECONDS = 0.2
_CHECKING = ("Asking the core environment …", "SORTTIME")

_lines: list[tuple[str, str]] = []
_thread: threading.Thread | None = None


def lines() -> list[tuple[str, str]]:
    """Return what is known since the last check, as (text, icon)."""
    return _lines


def begin(python: Path) -> None:
    """Ask; the answer is there when `lines` has it."""
    global _thread
    if _thread is not None and _thread.is_alive():
        return
    _lines[:] = [_CHECKING]
    _thread = threading.Thread(target=_ask, args=(python,), daemon=True)
    _thread.start()
    if not bpy.app.timers.is_registered(_look):
        bpy.app.timers.register(_look, first_interval=_POLL_SECONDS)


def wait() -> None:
    """Wait for the answer, where no window would freeze."""
    if _thread is not None:
        _thread.join()


def _ask(python: Path) -> None:
    try:
        said = check(python)
        answer = (", ".join(f"{name} {text}" for name, text in said.items()), "CHECKMARK")
    except HoloreelError as error:
        answer = (str(error), "ERROR")
    _lines[:] = [answer]


def _look() -> float | None:
    if _thread is not None and _thread.is_alive():
        return _POLL_SECONDS
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "PREFERENCES":
                area.tag_redraw()
    return None


def register() -> None:
    """Nothing is asked before somebody wants to know."""


def unregister() -> None:
    """Forget the answer."""
    if bpy.app.timers.is_registered(_look):
        bpy.app.timers.unregister(_look)
    _lines.clear()
