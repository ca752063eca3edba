# SPDX-License-Identifier: GPL-3.0-or-later
"""Where a user looks, one file per place."""


def register() -> None:
    """Register all panels."""
    from . import reel

    reel.register()


def unregister() -> None:
    """Take them out again."""
    from . import reel

    reel.unregister()
