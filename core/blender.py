# SPDX-License-Identifier: GPL-3.0-or-later
"""Find Blender, and run a function of the add-on in it as a child process.

`run_in_blender(find_blender(), "holoreel.addon.module:function", job)` calls `function(job, emit)` inside Blender, with
`job` a JSON-able dictionary and `emit(event: dict)` sending events back, and returns what the function returns. The
child has its own process group and ends when this process does; what it prints goes to a log file.
"""

import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from .errors import HoloreelError

ENVIRONMENT_VARIABLE = "HOLOREEL_BLENDER"
MARKER = "@holoreel "  # begins a line of the child that is an event, as JSON

_ROOT = Path(__file__).resolve().parents[1]  # the folder that is the package `holoreel`
_CHECKOUT_ENVIRONMENTS = (".venv-bpy52", ".venv-bpy45")
_LOG_TAIL = 50
_PATIENCE_SECONDS = 5

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
        log.parent.mkdir(parents=True, exist_ok=True)
        with open(log, "w", encoding="utf-8") as log_file, _start(blender, inherit) as child:
            try:
                outcome = _converse(child, {"function": function, "job": job}, log_file, on_event)
                with suppress(subprocess.TimeoutExpired):  # it said all it had to say, and hangs at exit
                    child.wait(_PATIENCE_SECONDS)
            finally:
                _kill(child)
    except OSError as error:
        raise HoloreelError(
            f"Blender at {blender.path} cannot be run, or {log} not be written ({error.strerror or error})."
        ) from error
    if outcome is None:
        raise HoloreelError(_obituary(blender, child.returncode, log))
    if outcome["event"] == "error":
        where = "" if outcome.get("mendable") else f"; all it said is in {log}"
        raise HoloreelError(f"{outcome['message']}{where}")
    return outcome.get("result")


def _start(blender: Blender, inherit: Iterable[int]) -> subprocess.Popen[str]:
    environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "PYTHONHOME")}
    return subprocess.Popen(
        blender.command(_BOOTSTRAP.format(root=str(_ROOT))),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        encoding="utf-8",
        errors="replace",
        env=environment | {"PYTHONIOENCODING": "utf-8", "PYTHONUNBUFFERED": "1"},
        start_new_session=True,
        pass_fds=tuple(inherit) if os.name != "nt" else (),
    )


def _converse(
    child: subprocess.Popen[str],
    request: dict[str, Any],
    log: IO[str],
    on_event: Callable[[dict[str, Any]], None] | None,
) -> dict[str, Any] | None:
    """Send the request, pass events on until the child is done; return its last word, None where it died without one.

    The child's standard input stays open: its end tells the child that this process is gone.
    """
    assert child.stdin is not None
    assert child.stdout is not None
    try:
        child.stdin.write(json.dumps(request) + "\n")
        child.stdin.flush()
    except BrokenPipeError:  # it died at once; what it printed says why
        with suppress(BrokenPipeError):
            child.stdin.close()
    for line in child.stdout:
        event = _event(line)
        if event is None:
            if line.strip():
                log.write(line)
                log.flush()
        elif event["event"] in ("done", "error"):
            return event
        elif on_event:
            on_event(event)
    return None


def _event(line: str) -> dict[str, Any] | None:
    """The event in a line of the child; None where it is talk for the log."""
    if not line.startswith(MARKER):
        return None
    try:
        event = json.loads(line.removeprefix(MARKER))
    except ValueError:  # somebody else's words ran into ours
        return None
    return event if isinstance(event, dict) and "event" in event else None


def _kill(child: subprocess.Popen[str]) -> None:
    """End the child and all it started."""
    if hasattr(os, "killpg"):
        with suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)
    else:
        child.kill()
    child.wait()


def _obituary(blender: Blender, status: int, log: Path) -> str:
    with open(log, encoding="utf-8") as file:
        lines = deque((line.strip() for line in file if line.strip()), maxlen=_LOG_TAIL)
    last = next((line for line in reversed(lines) if "Error" in line or "error" in line), lines[-1] if lines else "")
    how = f"was ended by {signal.Signals(-status).name}" if status < 0 else f"stopped with status {status}"
    return f"Blender at {blender.path} {how}, last saying '{last[:200]}'; all it said is in {log}."
