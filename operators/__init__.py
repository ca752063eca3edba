# SPDX-License-Identifier: GPL-3.0-or-later
"""What a user does, one file per deed."""

from types import ModuleType


def _modules() -> tuple[ModuleType, ...]:
    from . import (
        add_crop_box,
        choose_rung,
        environment,
        import_reel,
        jobs,
        let_rays_through,
        make_native_splats,
        make_reels_real,
        reload_reel,
        retime,
        setup_composite,
        setup_engine,
        setup_exact_render,
        synth,
        train,
    )

    return (
        import_reel,
        reload_reel,
        retime,
        setup_exact_render,
        setup_engine,
        setup_composite,
        add_crop_box,
        choose_rung,
        let_rays_through,
        make_native_splats,
        make_reels_real,
        environment,
        train,
        synth,
        jobs,
    )


def register() -> None:
    """Register all operators and their menu entries."""
    for module in _modules():
        module.register()


def unregister() -> None:
    """Take them out again, in reverse."""
    for module in reversed(_modules()):
        module.unregister()
