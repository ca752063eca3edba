# SPDX-License-Identifier: GPL-3.0-or-later
"""A worker as its client sees it: a child process, the requests it has not answered yet, and how it ended."""

import os
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from ..errors import HoloreelError
from .frames import Buffer
from .protocol import CANCELLED, MAX_LINE, MENDABLE, MODULE, PROTOCOL, CancelledError, Message, decode, encode

Progress = Callable[[int, int], None]

REMEDY = "the next picture starts it anew."
_NOTES_KEPT = 20
_BUFFERS_KEPT = 2
_ROOMY = 4  # a buffer this many times too large is given up
_LOG_TAIL_BYTES = 1 << 14
_FOREIGN = ("PYTHONPATH", "PYTHONHOME", "LD_LIBRARY_PATH")  # Blender's own would lead the other Python astray


@dataclass(frozen=True)
class Limits:
    """How many seconds the worker may take: to say `hello`, to draw, and to react to being cancelled."""

    hello: float = 120.0
    draw: float = 900.0
    cancel: float = 30.0
    leave: float = 2.0


class Pending:
    """A request without an answer yet."""

    def __init__(self, number: int, on_progress: Progress | None = None):
        self.number, self.on_progress = number, on_progress
        self.answered = threading.Event()
        self.result: Message = {}
        self.error: Exception | None = None
        self.began = time.monotonic()
        self.cancelled_at: float | None = None

    def settle(self, result: Message | None = None, error: Exception | None = None) -> None:
        """Give the answer; the first one counts."""
        if not self.answered.is_set():
            self.result, self.error = result or {}, error
            self.answered.set()


class Process:
    """One running worker. All that is asked of it is answered: by itself, or by how it ended."""

    def __init__(self, command: Sequence[str], log: Path, hello: Message, limits: Limits, notes: list[str]):
        self.command, self.log, self.limits, self.notes = command, log, limits, notes
        self.dead: str | None = None  # a sentence
        self.facts: Message = {}
        self._buffers: list[Buffer] = []  # free ones
        self._lock = threading.RLock()
        self._pending: dict[int, Pending] = {}
        self._count = 0
        self._child = self._start()
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()
        self.greeting = self.ask("hello", hello)

    def ask(self, method: str, params: Message, on_progress: Progress | None = None) -> Pending:
        """Send a request."""
        with self._lock:
            self._count += 1
            pending = Pending(self._count, on_progress)
            self._pending[pending.number] = pending
            if self.dead is not None:
                pending.settle(error=HoloreelError(self.dead))
            else:
                self._write({"id": pending.number, "method": method, "params": params})
        return pending

    def tell(self, method: str, params: Message) -> None:
        """Send a notification."""
        with self._lock:
            if self.dead is None:
                self._write({"method": method, "params": params})

    def take_buffer(self, size: int) -> Buffer:
        """Return a free buffer that is large enough, or a new one; those that do not fit are given up."""
        with self._lock:
            while self._buffers:
                buffer = self._buffers.pop()
                if size <= buffer.size <= _ROOMY * size:
                    return buffer
                self.drop_buffer(buffer)
        return Buffer.create(size)

    def give_buffer(self, buffer: Buffer) -> None:
        """Keep a buffer for the next picture."""
        with self._lock:
            if self.dead is None and len(self._buffers) < _BUFFERS_KEPT:
                self._buffers.append(buffer)
            else:
                self.drop_buffer(buffer)

    def drop_buffer(self, buffer: Buffer) -> None:
        """Give up a buffer at both ends."""
        self.tell("release", {"buffer": str(buffer.path)})
        buffer.close()

    def check(self) -> None:
        """End the process where it takes longer than it may for its greeting or for a cancelled request."""
        now = time.monotonic()
        if not self.greeting.answered.is_set():
            if now - self.greeting.began > self.limits.hello:
                self.fail(f"The worker did not answer within {self.limits.hello:g} s of its start; {self._told()}")
            return
        with self._lock:
            waiting = [pending.cancelled_at for pending in self._pending.values() if pending.cancelled_at is not None]
        if any(now - since > self.limits.cancel for since in waiting):
            self.fail(f"The worker did not stop drawing when asked to, and was ended; {REMEDY}")

    def fail(self, sentence: str) -> None:
        """End the process for a reason; everything that was asked fails with it."""
        with self._lock:
            if self.dead is None:
                self.dead = sentence
            waiting = list(self._pending.values())
            self._pending.clear()
            for buffer in self._buffers:
                buffer.close()
            self._buffers.clear()
        _kill(self._child)
        for pending in waiting:
            pending.settle(error=HoloreelError(self.dead))

    def leave(self) -> None:
        """Ask the process to end, and see to it."""
        self.tell("shutdown", {})
        with suppress(OSError, ValueError):
            self._child.stdin.close()  # type: ignore[union-attr]
        with suppress(subprocess.TimeoutExpired):
            self._child.wait(self.limits.leave)
        self.fail("The worker was ended.")
        self._listener.join(self.limits.leave)

    @property
    def pid(self) -> int:
        """The process's number."""
        return self._child.pid

    def _start(self) -> subprocess.Popen[bytes]:
        environment = {key: value for key, value in os.environ.items() if key not in _FOREIGN}
        try:
            self.log.parent.mkdir(parents=True, exist_ok=True)
            with open(self.log, "wb") as log:
                return subprocess.Popen(
                    self.command,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    cwd=tempfile.gettempdir(),
                    env=environment | {"PYTHONUNBUFFERED": "1"},
                    start_new_session=True,
                    creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
                )
        except OSError as error:
            raise HoloreelError(
                f"The core environment's {self.command[0]} cannot be run ({error.strerror or error}): name its Python "
                "in the preferences of Holoreel."
            ) from error

    def _write(self, message: Message) -> None:
        assert self._child.stdin is not None
        line = encode(message)
        with suppress(OSError, ValueError):  # it is gone: who listens to it will say so
            self._child.stdin.write(line)
            self._child.stdin.flush()

    def _listen(self) -> None:
        stream: IO[bytes] = self._child.stdout  # type: ignore[assignment]
        with suppress(OSError):
            while self.dead is None and (line := stream.readline(MAX_LINE + 1)):
                try:
                    self._take(decode(line))
                except (ValueError, TypeError, KeyError, AttributeError):
                    self.fail(f"The worker answered with something that is no message; {self._told()}")
        with suppress(subprocess.TimeoutExpired):
            self._child.wait(self.limits.leave)
        self.fail(self._obituary())
        stream.close()

    def _take(self, message: Message) -> None:
        params = message.get("params", {})
        if message.get("method") == "log":
            self.notes.append(str(params["text"]))
            del self.notes[:-_NOTES_KEPT]
        elif message.get("method") == "progress":
            with self._lock:
                pending = self._pending.get(params["id"])
            if pending is not None and pending.on_progress is not None:
                pending.on_progress(int(params["done"]), int(params["of"]))
        elif "error" in message or "result" in message:
            self._settle(message)
        else:
            raise ValueError("neither notification nor answer")

    def _settle(self, message: Message) -> None:
        number = message["id"]
        result = None if "error" in message else dict(message["result"])
        error = self._translated(message["error"]) if "error" in message else None
        if number == self.greeting.number:
            self._greet(result or {})
        with self._lock:
            pending = self._pending.pop(number) if self.dead is None else None
        if pending is not None:
            pending.settle(result, error)

    def _greet(self, facts: Message) -> None:
        self.facts = facts
        spoken = self.facts.get("protocol")
        if spoken != PROTOCOL:
            found = self.facts.get("version", "of unknown version")
            self.fail(
                f"The core environment ({self.command[0]}) has Holoreel {found}, which speaks protocol {spoken} where "
                f"this add-on speaks {PROTOCOL}: install the same version in both."
            )
            return
        with self._lock:  # what was cancelled meanwhile could not be heard before
            for pending in self._pending.values():
                if pending.cancelled_at is not None:
                    pending.cancelled_at = time.monotonic()

    def _translated(self, error: Message) -> Exception:
        if error["code"] == MENDABLE:
            return HoloreelError(str(error["message"]))
        if error["code"] == CANCELLED:
            return CancelledError()
        return HoloreelError(f"The worker failed with '{error['message']}'; all it said is in {self.log}.")

    def _obituary(self) -> str:
        status = self._child.returncode
        if status is not None and status < 0:
            with suppress(ValueError):
                return f"The worker was ended by {signal.Signals(-status).name}; {REMEDY}"
        last = self._last_words()
        if (
            f"No module named '{MODULE.partition('.')[0]}" in last
            or f"No module named {MODULE.partition('.')[0]}" in last
        ):
            return (
                f"The core environment ({self.command[0]}) has no Holoreel, or an older one without a worker: install "
                "Holoreel in it, or name another in the preferences."
            )
        return f"The worker stopped with status {status}, last saying '{last}'; {self._told()}"

    def _told(self) -> str:
        return f"all it said is in {self.log}, and {REMEDY}"

    def _last_words(self) -> str:
        with suppress(OSError), open(self.log, "rb") as log:
            log.seek(max(log.seek(0, os.SEEK_END) - _LOG_TAIL_BYTES, 0))
            lines = [line.strip() for line in log.read().decode("utf-8", "replace").splitlines() if line.strip()]
            return lines[-1][:200] if lines else ""
        return ""


def _kill(child: subprocess.Popen[bytes]) -> None:
    """End the worker and all it started."""
    if child.poll() is not None:
        return
    with suppress(OSError):
        if hasattr(os, "killpg"):
            os.killpg(child.pid, signal.SIGKILL)
        else:
            child.kill()
    with suppress(subprocess.TimeoutExpired):
        child.wait(5)
