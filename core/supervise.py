# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs the commands of a job one after the other, and writes down how it ended: `python supervise.py FOLDER`.

Whoever started it may go, and somebody else may look in: all that is known of a job lies in its folder (`core.jobs`).
It is run as a file of its own by whatever Python there is, so it needs the standard library alone.

A file `cancel` in the folder asks to stop: the command gets what Ctrl-C would send, and as long as it wants; when the
file says `now`, the command and all it started are ended at once.
"""

import json
import os
import shlex
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

LOCK, LOG, CANCEL, END, STATUS, RECORD = "lock", "log.txt", "cancel", "end.json", "status.json", "job.json"
NOW = "now"
TAKEN = 3  # exit status where another supervisor runs this job already

_POLL_SECONDS = 0.1
_LOCK_TRIES = 10


def take_lock(path: Path) -> int | None:
    """Open and lock a file; return its descriptor, which is the lock, or None where somebody holds it.

    The lock ends with the last process that has the descriptor, however that ends.
    """
    handle = os.open(path, os.O_CREAT | os.O_RDWR, 0o644)
    try:
        if os.name == "nt":
            import msvcrt

            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
        else:
            import fcntl

            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(handle)
        return None
    return handle


def main(folder: Path) -> int:
    """Run the job in a folder; return the exit status of its last command."""
    for _ in range(_LOCK_TRIES):  # somebody may just be looking whether we are alive
        lock = take_lock(folder / LOCK)
        if lock is not None:
            break
        time.sleep(_POLL_SECONDS)
    else:
        return TAKEN
    signal.signal(signal.SIGINT, lambda *_: None)  # not ignored: the command would inherit that
    commands = json.loads((folder / RECORD).read_text(encoding="utf-8"))["commands"]
    end: dict[str, Any] = {"status": 0}
    for index, command in enumerate(commands):
        if command["title"]:  # others tell their own progress
            _write(folder / STATUS, _status(command["title"], index, len(commands)))
        end = _run(folder, command, lock)
        if end["status"] or end["cancelled"]:
            break
    _write(folder / END, end)
    return int(end["status"])


def _run(folder: Path, command: dict[str, Any], lock: int) -> dict[str, Any]:
    """Run one command to its end, or until somebody asks to stop."""
    argv = command["argv"]
    with open(folder / LOG, "a", encoding="utf-8", errors="replace") as log:
        log.write(f"$ {shlex.join(argv)}\n")
        log.flush()
        try:
            child = subprocess.Popen(
                argv,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, "PYTHONUNBUFFERED": "1", "PYTHONIOENCODING": "utf-8"},
                **_own_group(lock),
            )
        except OSError as error:
            log.write(f"{argv[0]} cannot be run ({error.strerror or error}).\n")
            return {"status": 127, "cancelled": False}
        asked = ""
        while child.poll() is None:
            wanted = _cancel(folder)
            if wanted != asked:
                _end(child, at_once=wanted == NOW)
                asked = wanted
            time.sleep(_POLL_SECONDS)
    return {"status": child.returncode, "cancelled": bool(asked)}


def _own_group(lock: int) -> dict[str, Any]:
    if os.name == "nt":
        return {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}  # type: ignore[attr-defined]
    return {"start_new_session": True, "pass_fds": (lock,)}


def _cancel(folder: Path) -> str:
    """Return what the file `cancel` says, empty where there is none."""
    try:
        return (folder / CANCEL).read_text(encoding="utf-8") or "soon"
    except OSError:
        return ""


def _end(child: subprocess.Popen[bytes], at_once: bool) -> None:
    """Ask the command to stop, or end it with all it started."""
    if os.name == "nt":
        if at_once:
            child.kill()
        else:
            child.send_signal(signal.CTRL_BREAK_EVENT)  # type: ignore[attr-defined]
        return
    with suppress(ProcessLookupError):
        os.killpg(child.pid, signal.SIGKILL if at_once else signal.SIGINT)


def _status(title: str, done: int, total: int) -> dict[str, Any]:
    step = {"step": f"{done + 1} of {total}"}
    return {"stage": title, "done": done, "total": total, "seconds_left": None, "figures": step, "previews": 0}


def _write(path: Path, value: dict[str, Any]) -> None:
    temporary = path.with_name(f".{path.name}")
    temporary.write_text(json.dumps(value), encoding="utf-8")
    os.replace(temporary, path)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
