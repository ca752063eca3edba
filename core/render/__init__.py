# SPDX-License-Identifier: GPL-3.0-or-later
"""Rasterizers for 3D and Spacetime Gaussians: `contract` says what the backends `cpu`, `reference` and `cuda` do."""

import importlib
import importlib.util
import warnings
from types import ModuleType
from typing import Literal

Backend = Literal["auto", "cpu", "reference", "cuda"]

_warned = False


def get_backend(name: Backend = "auto") -> ModuleType:
    """Return the backend module `name`, with what `contract` describes.

    `auto` takes the GPU if gsplat is installed and torch sees one, else the compiled kernels, or, where they cannot be
    loaded, the plain torch `reference`, and warns about it once. Raises HoloreelError if `cpu` or `cuda` is asked for
    and cannot be loaded.
    """
    if name not in ("auto", "cpu", "reference", "cuda"):
        raise ValueError(f"no rasterizer backend '{name}'; take auto, cpu, reference or cuda")
    if name == "cuda" or (name == "auto" and _gpu_is_wanted()):
        return _load("cuda") if name == "cuda" else _load_or_warn("cuda", "cpu", "Until then the CPU is used.")
    if name == "reference":
        return importlib.import_module(".reference", __name__)
    if name == "cpu":
        return _load("cpu")
    return _load_or_warn("cpu", "reference", "Until then everything runs on plain torch, about 50 times slower.")


def _gpu_is_wanted() -> bool:
    """Whether gsplat is installed and torch sees a GPU; torch is not imported where gsplat is not."""
    if importlib.util.find_spec("gsplat") is None:
        return False
    import torch

    return torch.cuda.is_available()


def _load(name: str) -> ModuleType:
    module = importlib.import_module(f".{name}", __name__)
    module.load_kernels()
    return module


def _load_or_warn(name: str, instead: Backend, consequence: str) -> ModuleType:
    from ..errors import HoloreelError

    global _warned
    try:
        return _load(name)
    except HoloreelError as error:
        if not _warned:
            _warned = True
            warnings.warn(f"{error} {consequence}", stacklevel=3)
    return get_backend(instead)
