# SPDX-License-Identifier: GPL-3.0-or-later
"""Find Blender, and run a function of the add-on in it as a child process.

`run_in_blender(find_blender(), "holoreel.addon.module:function", job)` calls `function(job, emit)` inside Blender, with
`job` a JSON-able dictionary and `emit(event: dict)` sending events back, and returns what the function returns. The
child has its own process group and ends when this process does; what it prints goes to a log file.
"""

import importlib.util
import os
import shutil
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .child import run_child
from .errors import HoloreelError

ENVIRONMENT_VARIABLE = "HOLOREEL_BLENDER"

_ROOT = Path(__file__).resolve().parents[1]  # the folder that is the package `holoreel`
_CHECKOUT_ENVIRONMENTS = (".venv-bpy52", ".venv-bpy45")

# The package is loaded from its folder under its own name, whatever that folder is called, and whether or not Blender's
# Python knows it.
_BOOTSTRAP = """
import importlib, importlib.util, sys
root = {root!r}
spec = importlib.util.spec_from_file_location("holoreel", root + "/__init__.py", submodule_search_locations=[root])
sys.modules["holoreel"] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(sys.modules["holoreel"])
importlib.import_module("holoreel.core.blender_child").serve()
"""


@dataclass(frozen=True)
class Blender:
    """A Blender to run: the `blender` executable, or a Python interpreter whose `bpy` module is Blender."""

    path: Path
    is_python: bool

    def command(self, code: str) -> list[str]:
        """The command line that runs Python `code` in a Blender that loads no user settings."""
        if self.is_python:
            return [str(self.path), "-P", "-c", code]
        return [str(self.path), "--background", "--factory-startup", "--python-exit-code", "1", "--python-expr", code]


def find_blender(path: str | Path | None = None) -> Blender:
    """Return the Blender at `path`, or the first one there is.

    `path` may be a `blender` executable, a Python interpreter with the module bpy, or a virtual environment of one.
    Without it: $HOLOREEL_BLENDER, this interpreter where it has bpy, `blender` on the PATH, and a checkout's own
    environments. Raises `HoloreelError` where there is none.
    """
    path = path or os.environ.get(ENVIRONMENT_VARIABLE)
    if path:
        return _blender_at(Path(path).expanduser())
    if importlib.util.find_spec("bpy") is not None:
        return Blender(Path(sys.executable), is_python=True)
    if found := shutil.which("blender"):
        return Blender(Path(found), is_python=False)
    for name in _CHECKOUT_ENVIRONMENTS:
        python = _python_of(_ROOT / name)
        if python.is_file():
            return Blender(python, is_python=True)
    raise HoloreelError(
        "no Blender was found: install Blender or `pip install bpy`, and say where it is with --blender PATH or "
        f"${ENVIRONMENT_VARIABLE}."
    )


def _blender_at(path: Path) -> Blender:
    if path.is_dir():
        path = _python_of(path)
    if not path.is_file() or not os.access(path, os.X_OK):
        raise HoloreelError(f"no Blender at {path}: give the `blender` executable or a Python that has bpy.")
    return Blender(path.absolute(), is_python=path.name.lower().startswith("python"))


def _python_of(environment: Path) -> Path:
    return environment / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def run_in_blender(
    blender: Blender,
    function: str,
    job: dict[str, Any],
    *,
    log: str | Path,
    on_event: Callable[[dict[str, Any]], None] | None = None,
    inherit: Iterable[int] = (),
) -> Any:
    """Call `function` ("holoreel.addon.module:name") with `job` inside Blender and return its result.

    `on_event` gets each event the function emits, in this thread. The child's output goes to the file `log`. File
    descriptors in `inherit` stay open in the child (a lock, for one). Whatever ends this call (an exception of
    `on_event`, Ctrl-C) ends the child. Raises `HoloreelError` with the child's own sentence, or, where it crashed, with
    the last thing it said.
    """
    log = Path(log)
    try:
        ending = run_child(
            blender.command(_BOOTSTRAP.format(root=str(_ROOT))),
            log=log,
            request={"function": function, "job": job},
            on_event=on_event,
            inherit=inherit,
        )
    except OSError as error:
        raise HoloreelError(
            f"Blender at {blender.path} cannot be run, or {log} not be written ({error.strerror or error})."
        ) from error
    return ending.result(f"Blender at {blender.path}")
