# SPDX-License-Identifier: GPL-3.0-or-later
"""Rasterizers for 3D and Spacetime Gaussians. The contract is in `contract`, the backends are `cpu` and `reference`."""

import importlib
import warnings
from types import ModuleType
from typing import Literal

Backend = Literal["auto", "cpu", "reference"]

_warned = False


def get_backend(name: Backend = "auto") -> ModuleType:
    """Return the backend module `name`, with `rasterize` and `rasterize_spacetime` as `contract` describes them.

    `auto` takes the compiled kernels, or, where they cannot be loaded, the plain torch `reference`, and warns about it
    once. Raises HoloreelError if `cpu` is asked for and cannot be loaded.
    """
    global _warned
    if name not in ("auto", "cpu", "reference"):
        raise ValueError(f"no rasterizer backend '{name}'; take auto, cpu or reference")
    if name != "reference":
        from ..errors import HoloreelError

        try:
            cpu = importlib.import_module(".cpu", __name__)
            cpu.load_kernels()
            return cpu
        except HoloreelError as error:
            if name == "cpu":
                raise
            if not _warned:
                _warned = True
                warnings.warn(
                    f"{error} Until then everything runs on plain torch, about 50 times slower.", stacklevel=2
                )
    return importlib.import_module(".reference", __name__)
