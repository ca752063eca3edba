# SPDX-License-Identifier: GPL-3.0-or-later
"""Holoreel: 6-DoF video for Blender.

The repository root is the package: `holoreel` for the command line, `bl_ext.<repository>.holoreel` inside Blender.
Importing it loads nothing; `register` and `unregister` are what Blender calls.
"""


def register() -> None:
    """Add Holoreel's operators, panels and menus to Blender."""
    from . import addon

    addon.register()


def unregister() -> None:
    """Take out everything `register` added."""
    from . import addon

    addon.unregister()
