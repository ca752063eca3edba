# SPDX-License-Identifier: GPL-3.0-or-later
"""The worker: answers one request after the other, and listens meanwhile whether one is cancelled."""

import os
import platform
import queue
import sys
import threading
import traceback
import warnings
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import IO, Any

from ..errors import HoloreelError
from .frames import Buffer
from .protocol import (
    BAD_PARAMETERS,
    CANCELLED,
    FAILED,
    MENDABLE,
    NO_METHOD,
    NO_REQUEST,
    PARSE_ERROR,
    PROTOCOL,
    CancelledError,
    Message,
    Shot,
    decode,
    encode,
)

_BACKENDS = ("auto", "cpu", "reference", "cuda")


class RequestError(Exception):
    """A request that cannot be answered: what goes wrong between the two programs, no matter of the user's."""

    def __init__(self, code: int, message: str):
        super().__init__(message)
        self.code = code


class Server:
    """Answers the lines of `source` on `sink`."""

    def __init__(self, source: IO[bytes], sink: IO[bytes]):
        self._source, self._sink = source, sink
        self._writing = threading.Lock()
        self._requests: queue.SimpleQueue[Message | None] = queue.SimpleQueue()
        self._unwanted: set[Any] = set()
        self._buffers: dict[str, Buffer] = {}
        self._players: Any = None  # picture.Players, from `hello` on
        self._said: set[str] = set()
        self._methods: dict[str, Callable[[Any, Message], Message]] = {
            "hello": self._hello,
            "open": self._open,
            "draw": self._draw,
            "close": self._close,
            "release": self._release,
            "shutdown": lambda _id, _params: {},
        }

    def run(self) -> None:
        """Answer until `shutdown`. The process ends at once where the other end goes away."""
        threading.Thread(target=self._listen, daemon=True).start()
        while (request := self._requests.get()) is not None:
            answer = self._answer(request)
            if "id" in request or "error" in answer:
                self._send(answer)
            if request.get("method") == "shutdown":
                return

    def _listen(self) -> None:
        announced = None
        while line := self._source.readline():
            try:
                message = decode(line)
            except ValueError as error:
                self._send(_error(None, PARSE_ERROR, str(error)))
                continue
            if message.get("method") == "cancel":
                self._unwanted.add(_parameters(message).get("id"))
            else:
                announced = _parameters(message).get("buffer", announced)
                self._requests.put(message)
        if isinstance(announced, str):  # it may not have been mapped yet
            with suppress(OSError):
                Path(announced).unlink()
        os._exit(0)  # the client is gone, and nobody waits for what is being drawn

    def _answer(self, request: Message) -> Message:
        number = request.get("id")
        try:
            method = self._methods.get(str(request.get("method")))
            if not isinstance(request.get("method"), str):
                raise RequestError(NO_REQUEST, "'method' is missing")
            if method is None:
                raise RequestError(NO_METHOD, f"there is no method '{request['method']}'")
            self._check(number)
            return {"id": number, "result": method(number, _parameters(request))}
        except HoloreelError as error:
            return _error(number, MENDABLE, str(error))
        except CancelledError:
            return _error(number, CANCELLED, "cancelled")
        except RequestError as error:
            return _error(number, error.code, str(error))
        except MemoryError:
            return _error(number, MENDABLE, "There is not enough memory for this picture: render a smaller one.")
        except Exception as error:  # noqa: BLE001 - everything is reported, nothing is swallowed
            traceback.print_exc()
            return _error(number, FAILED, f"{type(error).__name__}: {error}")
        finally:
            self._unwanted.discard(number)

    def _hello(self, _id: Any, params: Message) -> Message:
        from .picture import Players

        backend, cache = params.get("backend", "auto"), params.get("cache_mb", 2048)
        if backend not in _BACKENDS or not isinstance(cache, int):
            raise RequestError(BAD_PARAMETERS, f"'backend' {backend!r} or 'cache_mb' {cache!r} is unknown")
        self._players = Players(backend, cache)
        return {"protocol": PROTOCOL, "version": _version(), "python": platform.python_version()}

    def _open(self, _id: Any, params: Message) -> Message:
        player = self._ready().get(Path(_text(params, "path")), params.get("rung"))
        return {
            "frame_start": player.frame_start,
            "frame_count": player.frame_count,
            "background": player.background,
            "report": player.report,
        }

    def _close(self, _id: Any, params: Message) -> Message:
        self._ready().close(Path(_text(params, "path")))
        return {}

    def _draw(self, number: Any, params: Message) -> Message:
        from .picture import draw_shot, each_note

        if not isinstance(params.get("shot"), dict):
            raise RequestError(BAD_PARAMETERS, "'shot' must be an object")
        players, shot = self._ready(), Shot.from_json(params["shot"])
        pixels = self._buffer(_text(params, "buffer"), params.get("bytes")).pixels(*shot.size)

        def step(done: int, of: int) -> None:
            self._check(number)
            self._notify("progress", {"id": number, "done": done, "of": of})

        seconds = draw_shot(players, shot, pixels, step)
        for sentence in each_note(players, shot):
            self.log(sentence)
        return {"seconds": seconds}

    def _buffer(self, path: str, size: Any) -> Buffer:
        if path not in self._buffers:
            if not isinstance(size, int) or size <= 0:
                raise RequestError(BAD_PARAMETERS, "'bytes' must be a positive number")
            try:
                self._buffers[path] = Buffer.attach(Path(path), size)
            except OSError as error:
                raise RequestError(BAD_PARAMETERS, f"the buffer {path} cannot be mapped ({error})") from error
        return self._buffers[path]

    def _release(self, _id: Any, params: Message) -> Message:
        buffer = self._buffers.pop(_text(params, "buffer"), None)
        if buffer is not None:
            buffer.close()
        return {}

    def _ready(self) -> Any:
        if self._players is None:
            raise RequestError(NO_REQUEST, "say 'hello' first")
        return self._players

    def _check(self, number: Any) -> None:
        if number in self._unwanted:
            raise CancelledError

    def log(self, text: str) -> None:
        """Tell the client a sentence, once."""
        if text not in self._said:
            self._said.add(text)
            self._notify("log", {"text": text})

    def _notify(self, method: str, params: Message) -> None:
        self._send({"method": method, "params": params})

    def _send(self, message: Message) -> None:
        with self._writing:
            try:
                self._sink.write(encode(message))
                self._sink.flush()
            except (OSError, ValueError):  # nobody listens any more
                os._exit(0)


def serve() -> None:
    """Serve standard input and output. What anything else prints goes to standard error."""
    sink = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    sys.stdout = sys.stderr
    server = Server(sys.stdin.buffer, sink)
    warnings.showwarning = lambda message, *_args, **_keys: server.log(str(message))
    server.run()


def _parameters(message: Message) -> Message:
    params = message.get("params", {})
    return params if isinstance(params, dict) else {}


def _text(params: Message, key: str) -> str:
    if not isinstance(params.get(key), str):
        raise RequestError(BAD_PARAMETERS, f"'{key}' must be text")
    return str(params[key])


def _error(number: Any, code: int, message: str) -> Message:
    return {"id": number, "error": {"code": code, "message": message}}


def _version() -> str:
    try:
        return version("holoreel")
    except PackageNotFoundError:
        return "unknown"
