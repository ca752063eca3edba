# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender side: building blocks. Nothing is imported before `register`."""


def register() -> None:
    """Register operators, then the panels that show them."""
    from .. import operators, panels

    operators.register()
    panels.register()


def unregister() -> None:
    """Take everything out again, in reverse."""
    from .. import operators, panels

    panels.unregister()
    operators.unregister()
