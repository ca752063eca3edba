# SPDX-License-Identifier: GPL-3.0-or-later
"""Where a user looks, one file per place."""

from types import ModuleType


def _modules() -> tuple[ModuleType, ...]:
    from . import engine, field, jobs, look, reel, synth, train

    return reel, field, look, engine, synth, train, jobs


def register() -> None:
    """Register all panels."""
    for module in _modules():
        module.register()


def unregister() -> None:
    """Take them out again, in reverse."""
    for module in reversed(_modules()):
        module.unregister()
