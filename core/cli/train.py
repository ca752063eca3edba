# SPDX-License-Identifier: GPL-3.0-or-later
"""`holoreel train METHOD CAPTURE --out REEL`: train a reel. Each method is a module with the functions named below."""

import importlib
from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal, Protocol, cast

import tyro

from ..errors import HoloreelError

METHODS = {"stg": "train_stg", "videorf": "train_videorf"}


class Method(Protocol):
    """What the module of a method has: its settings by the name of a preset, and the command they are defaults of."""

    PRESETS: Mapping[str, Any]
    DEFAULT: str

    def command(self, preset: str) -> Callable[..., None]:
        """Return the function whose arguments are the command line, with a preset's settings as defaults."""


def prepare(arguments: list[str]) -> Callable[..., None]:
    """Return the command of the method that the arguments name, with the defaults of the preset that they name."""
    name = next((argument for argument in arguments if not argument.startswith("-")), "")
    if name not in METHODS:
        return run
    method = cast(Method, importlib.import_module(f".{METHODS[name]}", __package__))
    preset = preset_in(arguments) or method.DEFAULT
    if preset not in method.PRESETS:
        raise HoloreelError(f"--preset {preset}: no such preset; take one of {', '.join(method.PRESETS)}.")
    return method.command(preset)


def run(method: Annotated[Literal["stg", "videorf"], tyro.conf.Positional]) -> None:
    """Train a reel from a capture; `holoreel train METHOD --help` explains each method.

    Args:
        method: `stg`, Spacetime Gaussians, for whole scenes; `videorf`, a radiance field as a video of features, for a
            subject with masks.
    """
    raise HoloreelError(f"there is no method {method!r} here.")


def preset_in(arguments: list[str]) -> str | None:
    """Return what the arguments name with --preset, None where they do not."""
    for index, argument in enumerate(arguments):
        if argument == "--preset" and index + 1 < len(arguments):
            return arguments[index + 1]
        if argument.startswith("--preset="):
            return argument.partition("=")[2]
    return None
