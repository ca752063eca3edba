# SPDX-License-Identifier: GPL-3.0-or-later
"""What a user does, one file per deed."""


def register() -> None:
    """Register all operators and their menu entries."""
    from . import import_reel, setup_exact_render

    import_reel.register()
    setup_exact_render.register()


def unregister() -> None:
    """Take them out again, in reverse."""
    from . import import_reel, setup_exact_render

    setup_exact_render.unregister()
    import_reel.unregister()
