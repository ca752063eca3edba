# SPDX-License-Identifier: GPL-3.0-or-later
"""Run a program as a child that speaks in lines: events are JSON behind a marker, all else it prints goes to a log.

The child has its own process group, which ends with the call whatever ends it. Its standard input stays open as long as
this process lives: a child that watches it (`end_with_parent`) never outlives us. The last event is `done` (with
`result`) or `error` (with `message` and `mendable`). Needs the standard library alone.
"""

import json
import os
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any

from .errors import HoloreelError

MARKER = "@holoreel "  # begins a line of the child that is an event, as JSON

_LOG_TAIL = 50
_PATIENCE_SECONDS = 5


@dataclass(frozen=True)
class Ending:
    """How a child ended: its last word, None where it died without one, and its exit status."""

    outcome: dict[str, Any] | None
    status: int
    log: Path

    def result(self, name: str) -> Any:
        """What the child returned; raises `HoloreelError` with its own sentence, or with the last thing it said.

        `name` is what the child is called in a sentence.
        """
        if self.outcome is None:
            raise HoloreelError(self._obituary(name))
        if self.outcome["event"] == "error":
            where = "" if self.outcome.get("mendable") else f"; all it said is in {self.log}"
            raise HoloreelError(f"{self.outcome['message']}{where}")
        return self.outcome.get("result")

    def _obituary(self, name: str) -> str:
        with open(self.log, encoding="utf-8") as file:
            lines = deque((line.strip() for line in file if line.strip()), maxlen=_LOG_TAIL)
        last = next(
            (line for line in reversed(lines) if "Error" in line or "error" in line), lines[-1] if lines else ""
        )
        killed = self.status < 0
        how = f"was ended by {signal.Signals(-self.status).name}" if killed else f"stopped with status {self.status}"
        return f"{name} {how}, last saying '{last[:200]}'; all it said is in {self.log}."


def run_child(
    command: list[str],
    *,
    log: str | Path,
    request: dict[str, Any] | None = None,
    on_event: Callable[[dict[str, Any]], None] | None = None,
    on_start: Callable[[Callable[[], None]], None] | None = None,
    inherit: Iterable[int] = (),
) -> Ending:
    """Run `command`, hand it `request` as one line of JSON, and listen until it is done.

    `on_event` gets each event, in this thread; an exception of it ends the child. `on_start` gets a function that ends
    the child from any thread. File descriptors in `inherit` stay open in the child. Raises OSError where the command
    cannot be run or the log not be written.
    """
    log = Path(log)
    log.parent.mkdir(parents=True, exist_ok=True)
    with open(log, "w", encoding="utf-8") as log_file, _start(command, inherit) as child:
        try:
            if on_start:
                on_start(partial(_kill_group, child))
            outcome = _converse(child, request, log_file, on_event)
            with suppress(subprocess.TimeoutExpired):  # it said all it had to say, and hangs at exit
                child.wait(_PATIENCE_SECONDS)
        finally:
            _kill(child)
    return Ending(outcome, child.returncode, log)


def emit(event: dict[str, Any]) -> None:
    """Send one event, in the child; it has a line of its own whatever was printed before it."""
    sys.stdout.write(f"\n{MARKER}{json.dumps(event)}\n")
    sys.stdout.flush()


def end_with_parent() -> None:
    """End this process, a child, when its standard input closes: whoever asked is gone."""

    def watch() -> None:
        sys.stdin.read()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _start(command: list[str], inherit: Iterable[int]) -> subprocess.Popen[str]:
    environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "PYTHONHOME")}
    return subprocess.Popen(
        command,
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
    request: dict[str, Any] | None,
    log: IO[str],
    on_event: Callable[[dict[str, Any]], None] | None,
) -> dict[str, Any] | None:
    """Send the request, pass events on until the child is done; return its last word, if it had one."""
    assert child.stdin is not None
    assert child.stdout is not None
    try:
        if request is not None:
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
    _kill_group(child)
    child.wait()


def _kill_group(child: subprocess.Popen[str]) -> None:
    """End the child and all it started."""
    if hasattr(os, "killpg"):
        with suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)
    else:
        child.kill()
