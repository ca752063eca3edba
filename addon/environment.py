# SPDX-License-Identifier: GPL-3.0-or-later
"""The core environment: the Python that trains, synthesizes and renders, outside Blender.

Blender's own Python has numpy alone, so what needs torch runs in an environment of its own, as a child process. It is
never searched for on the disk: the preferences name it, or $HOLOREEL_PYTHON does, or it lies where `Create` makes it
(`default_folder`), or in the source checkout that this add-on runs from.
"""

import os
from pathlib import Path

import bpy

from ..core.errors import HoloreelError

ENVIRONMENT_VARIABLE = "HOLOREEL_PYTHON"
PACKAGE = __package__.rpartition(".")[0]  # `holoreel`, or `bl_ext.<repository>.holoreel`
ROOT = Path(__file__).resolve().parents[1]

# What must not leak from Blender's Python into another one.
_FOREIGN = ("PYTHONPATH", "PYTHONHOME", "PYTHONSTARTUP", "LD_LIBRARY_PATH", "DYLD_LIBRARY_PATH")


def user_folder(name: str) -> Path:
    """Return the folder `name` among the user's files of this add-on; it need not exist yet.

    An installed extension has a folder of its own, which goes when the extension goes; a checkout that runs as the
    plain package takes Blender's folder for data files.
    """
    try:
        folder = bpy.utils.extension_path_user(PACKAGE, path=name)
    except ValueError:  # not installed as an extension
        folder = bpy.utils.user_resource("DATAFILES", path=f"holoreel/{name}")
    return Path(folder)


def default_folder() -> Path:
    """Return where `Create` puts the core environment unless told otherwise."""
    return user_folder("environment")


def python_in(environment: Path) -> Path:
    """Return the interpreter of a virtual environment."""
    return environment / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def find_python(chosen: str) -> Path:
    """Return the interpreter of the core environment; `chosen` is what the preferences say, or empty.

    A folder stands for the virtual environment in it. Raises `HoloreelError` where what was chosen is no program, or
    nothing was chosen and there is none.
    """
    for path, source in (
        (chosen, "Preferences > Add-ons > Holoreel"),
        (os.environ.get(ENVIRONMENT_VARIABLE, ""), f"${ENVIRONMENT_VARIABLE}"),
    ):
        if path:
            return _existing(Path(bpy.path.abspath(path)).expanduser(), source)
    for folder in (default_folder(), ROOT / ".venv"):
        if python_in(folder).is_file():
            return python_in(folder)
    raise HoloreelError(
        "the core environment is missing: choose or create one in Preferences > Add-ons > Holoreel, or set "
        f"${ENVIRONMENT_VARIABLE} to its Python."
    )


def _existing(path: Path, source: str) -> Path:
    if path.is_dir():
        path = python_in(path)
    if not (path.is_file() and os.access(path, os.X_OK)):
        raise HoloreelError(f"{path}: there is no Python here; give the core environment's in {source}.")
    return path.absolute()  # not resolved: a virtual environment is known by its own link


def child_environment() -> dict[str, str]:
    """Return the environment variables for a program outside Blender."""
    return {key: value for key, value in os.environ.items() if key not in _FOREIGN}
