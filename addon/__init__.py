# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender side: building blocks. Nothing is imported before `register`."""

import atexit
from types import ModuleType


def _modules() -> tuple[ModuleType, ...]:
    from .. import operators, panels
    from . import checkup, commands, engine, jobs, preferences, previews, synthesis, training, viewport, worker

    return (
        preferences,
        checkup,
        previews,
        training,
        synthesis,
        jobs,
        viewport,
        worker,
        engine,
        commands,
        operators,
        panels,
    )


def register() -> None:
    """Register operators, then the panels that show them."""
    import bpy

    for module in _modules():
        module.register()
    if bpy.app.module:  # at its end it would wait for what is left, or crash; the program Blender sees to that itself
        atexit.register(unregister)


def unregister() -> None:
    """Take everything out again, in reverse."""
    atexit.unregister(unregister)
    for module in reversed(_modules()):
        module.unregister()
