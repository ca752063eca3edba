# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's end of the worker: starts it, asks it, and outlives whatever happens to it. Needs numpy only."""

import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from .frames import Pixels, bytes_of
from .process import REMEDY, Limits, Pending, Process, Progress
from .protocol import MODULE, PROTOCOL, CancelledError, Message, Shot

Stop = Callable[[], bool]

_POLL_SECONDS = 0.05  # how often a waiting caller looks whether it shall stop


class Drawing:
    """A picture that was asked for; close it to give its memory to the next one."""

    def __init__(self, process: Process, shot: Shot, on_progress: Progress | None):
        self._process, self._size = process, shot.size
        self._buffer = process.take_buffer(bytes_of(*shot.size))
        params = {"shot": shot.to_json(), "buffer": str(self._buffer.path), "bytes": self._buffer.size}
        self._pending = process.ask("draw", params, on_progress)
        self._closed = False

    @property
    def done(self) -> bool:
        """Whether `wait` would return or raise at once."""
        self._process.check()
        return self._pending.answered.is_set()

    @property
    def pixels(self) -> Pixels:
        """The picture, once it is done; good until `close`."""
        return self._buffer.pixels(*self._size)

    @property
    def seconds(self) -> dict[str, float]:
        """What it took the worker: `draw`, the player's own part, and `finish`."""
        return dict(self._pending.result.get("seconds", {}))

    def wait(self, stop: Stop | None = None) -> None:
        """Wait until the picture is done.

        Raises `HoloreelError` where there will be none, `CancelledError` where `stop` said to stop.
        """
        limit = self._process.limits.draw
        while not self._pending.answered.wait(_POLL_SECONDS):
            self._process.check()
            if stop is not None and stop():
                self.cancel()
                raise CancelledError
            if time.monotonic() - self._pending.began > limit:
                self._process.fail(f"The worker gave no picture within {limit:g} s, and was ended; {REMEDY}")
        if self._pending.error is not None:
            raise self._pending.error

    def cancel(self) -> None:
        """Say that the picture is not wanted any more."""
        if not self._pending.answered.is_set() and self._pending.cancelled_at is None:
            self._pending.cancelled_at = time.monotonic()
            self._process.tell("cancel", {"id": self._pending.number})

    def close(self) -> None:
        """Give the memory back; what is still being drawn is cancelled."""
        if self._closed:
            return
        self._closed = True
        if self._pending.answered.is_set():
            self._process.give_buffer(self._buffer)
        else:
            self.cancel()
            self._process.drop_buffer(self._buffer)

    def __enter__(self) -> "Drawing":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Client:
    """Asks one worker at a time, which is started when it is first needed and again after it has ended.

    `python` is the interpreter of an environment in which Holoreel is installed; `command` replaces what is run. What
    the worker prints goes to the file `log`, what it has to say of a reel to `notes`. Use it from any thread.
    """

    def __init__(
        self,
        python: Path,
        *,
        log: Path,
        backend: str = "auto",
        cache_mb: int = 2048,
        command: Sequence[str] | None = None,
        limits: Limits | None = None,
    ):
        self.command = tuple(command or (str(python), "-I", "-m", MODULE))
        self.log, self.limits = log, limits or Limits()
        self.notes: list[str] = []
        self._hello: Message = {"protocol": PROTOCOL, "backend": backend, "cache_mb": cache_mb}
        self._process: Process | None = None
        self._lock = threading.Lock()

    @property
    def pid(self) -> int | None:
        """The number of the running worker's process, None where there is none."""
        process = self._process
        return None if process is None or process.dead is not None else process.pid

    def hello(self, stop: Stop | None = None) -> Message:
        """Return what the worker says of itself: `protocol`, `version`, `python`."""
        process = self._running()
        self._wait(process.greeting, process, process.limits.hello, stop)
        return process.facts

    def open(self, path: Path, rung: str | None = None, stop: Stop | None = None) -> Message:
        """Let the worker open a file; return `frame_start`, `frame_count`, `background` and `report`."""
        process = self._running()
        pending = process.ask("open", {"path": str(path), "rung": rung})
        return self._wait(pending, process, process.limits.draw, stop)

    def forget(self, path: Path) -> None:
        """Let the worker close a file, if it runs."""
        if self.pid is not None and self._process is not None:
            self._process.ask("close", {"path": str(path)})

    def begin(self, shot: Shot, on_progress: Progress | None = None) -> Drawing:
        """Ask for a picture and return at once; `on_progress` is called in another thread."""
        return Drawing(self._running(), shot, on_progress)

    def draw(self, shot: Shot, *, stop: Stop | None = None, on_progress: Progress | None = None) -> Drawing:
        """Return a picture that is done. Raises `HoloreelError`, or `CancelledError` where `stop` said to stop."""
        drawing = self.begin(shot, on_progress)
        try:
            drawing.wait(stop)
        except BaseException:
            drawing.close()
            raise
        return drawing

    def close(self) -> None:
        """End the worker, if one runs; the next request starts another."""
        with self._lock:
            process, self._process = self._process, None
        if process is not None:
            process.leave()

    def _running(self) -> Process:
        with self._lock:
            if self._process is not None:
                self._process.check()
            if self._process is None or self._process.dead is not None:
                self._process = Process(self.command, self.log, self._hello, self.limits, self.notes)
            return self._process

    def _wait(self, pending: Pending, process: Process, limit: float, stop: Stop | None) -> Message:
        while not pending.answered.wait(_POLL_SECONDS):
            process.check()
            if stop is not None and stop():
                raise CancelledError
            if time.monotonic() - pending.began > limit:
                process.fail(f"The worker gave no answer within {limit:g} s, and was ended; {REMEDY}")
        if pending.error is not None:
            raise pending.error
        return pending.result
