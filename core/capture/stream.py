# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures of a capture in an endless random order, within a memory limit, read in the background.

Videos are decoded run by run: a few following frames of one video, from a keyframe on where it has enough of them, in a
random order of runs. A window of pictures lies between reading and training: each draw takes a random one out of it,
and the next one read takes its place. Where all pictures fit into the limit, each is read once and every later pass is
a plain random permutation. What is drawn depends on the seed alone, not on how fast anything is.
"""

import weakref
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain, count
from threading import Condition, Thread, current_thread
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import HoloreelError
from .capture import Capture, View
from .media import VideoFrame, keyframes

Picture = NDArray[np.uint8]

LIMIT_BYTES = 2 << 30
_AHEAD = 8  # pictures read before they are asked for, at most
_FIRST_WINDOW = 32  # pictures to choose from at first; one more is added with every draw
_RUNS = 8  # in a full window, at least
_SHORT_RUN = 4  # frames: shorter runs are not worth opening a video for


class PictureStream:
    """An endless sequence of (view, picture): uint8 (H, W, 3) in the camera's size, laid over the background.

    Every view is drawn equally often over the long run. No more than `limit_bytes` of pictures are held (but always
    four of them); an open video takes some tens of megabytes more. Pictures may be shared: do not write into them.
    Close it, or use it as a context manager; one that is dropped stops its thread too.
    """

    def __init__(
        self,
        capture: Capture,
        views: Sequence[View],
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        seed: int = 0,
        limit_bytes: int = LIMIT_BYTES,
    ):
        if not views:
            raise HoloreelError(f"{capture.source}: there are no pictures to draw from; choose other views.")
        self.views, self.seed = list(views), seed
        sizes = [3 * capture.cameras[name].width * capture.cameras[name].height for name, _ in self.views]
        self._keeps_all = sum(sizes) <= limit_bytes
        self._capacity = len(sizes) if self._keeps_all else max(4, limit_bytes // max(sizes))
        self._window_size = self._capacity if self._keeps_all else max(2, self._capacity - _AHEAD)
        self._runs = _runs(capture, self.views, max(1, self._window_size // _RUNS))
        self._order: tuple[int, list[int]] = (-1, [])  # a pass, and its views in the order of reading
        self._capture, self._background = capture, background
        # What is read has a number: number i is picture i % len(views) of pass i // len(views).
        self._window: list[int] = []
        self._pulled = self._drawn = 0
        self._shelf: _Shelf | None = None
        self._finalizer: weakref.finalize | None = None

    def next(self) -> tuple[View, Picture]:
        """Return the next view and its picture; waits until it is read. Raises `HoloreelError` if it cannot be."""
        shelf = self._started()
        wanted = min(self._window_size, _FIRST_WINDOW + self._drawn)
        while len(self._window) < wanted and not (self._keeps_all and self._pulled == len(self.views)):
            self._window.append(self._pulled)
            self._pulled += 1
        if not self._window:
            self._window = list(range(len(self.views)))
        slot = int(np.random.default_rng([self.seed, 1, self._drawn]).integers(len(self._window)))
        number = self._window[slot]
        self._window[slot] = self._window[-1]
        self._window.pop()
        self._drawn += 1
        picture = shelf.take(number, keep=self._keeps_all)
        return self.views[self._view(number)], picture

    def state(self) -> dict[str, Any]:
        """What `load_state` needs to go on with the same sequence: some numbers, no pictures."""
        return {
            "drawn": self._drawn,
            "pulled": self._pulled,
            "window": list(self._window),
            "capacity": self._capacity,
            "views": len(self.views),
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Go on where `state` was taken from a stream of the same arguments.

        With another limit or other views it goes on at random: still each as often as the others.
        """
        self.close()
        same = state["capacity"] == self._capacity and state["views"] == len(self.views)
        self._drawn = int(state["drawn"])
        self._pulled = int(state["pulled"]) if same else 0
        self._window = [int(number) for number in state["window"]] if same else []

    def close(self) -> None:
        """Stop reading and let go of all pictures. Drawing again starts over with reading, not with the sequence."""
        if self._finalizer:
            self._finalizer()
        self._shelf = self._finalizer = None

    def __enter__(self) -> "PictureStream":
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def _started(self) -> "_Shelf":
        if self._shelf is None:
            # Pictures of a window that was loaded come first, in the order in which they were read before.
            if self._keeps_all:
                numbers: Iterable[int] = range(len(self.views))
            else:
                numbers = chain(sorted(self._window), count(self._pulled))
            self._shelf = _Shelf(self._capacity)
            self._finalizer = weakref.finalize(self, self._shelf.close)
            reader = _reader(self._capture, self._background, self.views, self._runs, self.seed, numbers)
            self._shelf.start(reader)
        return self._shelf

    def _view(self, number: int) -> int:
        turn, place = divmod(number, len(self.views))
        if self._order[0] != turn:
            self._order = turn, _reading_order(self._runs, self.seed, turn)
        return self._order[1][place]


def _reader(
    capture: Capture,
    background: tuple[float, float, float],
    views: Sequence[View],
    runs: Sequence[Sequence[int]],
    seed: int,
    numbers: Iterable[int],
) -> Iterator[tuple[int, Picture]]:
    """Yield the pictures of `numbers`; knows nothing of the stream, so that the thread does not keep that alive."""
    orders: dict[int, list[int]] = {}
    for number in numbers:
        turn, place = divmod(number, len(views))
        if turn not in orders:
            orders = {turn: _reading_order(runs, seed, turn)}
        picture = capture.image(*views[orders[turn][place]], background=background)
        yield number, np.ascontiguousarray(picture)


def _reading_order(runs: Sequence[Sequence[int]], seed: int, turn: int) -> list[int]:
    """All views, once each: the runs in a random order."""
    order = np.random.default_rng([seed, 2, turn]).permutation(len(runs))
    return [view for run in order for view in runs[run]]


def _runs(capture: Capture, views: Sequence[View], longest: int) -> list[list[int]]:
    """Cut the views into runs that are quick to read one after the other: parts of videos, and single files."""
    runs: list[list[int]] = []
    videos: dict[Any, list[tuple[int, int]]] = {}
    for number, view in enumerate(views):
        media = capture.images[view]
        if isinstance(media, VideoFrame):
            videos.setdefault(media.path, []).append((media.index, number))
        else:
            runs.append([number])
    for path, frames in videos.items():
        keys = set(keyframes(path))
        run: list[int] = []
        for index, number in sorted(frames):
            if len(run) >= longest or (index in keys and len(run) >= min(_SHORT_RUN, longest)):
                runs.append(run)
                run = []
            run.append(number)
        runs.append(run)
    return runs


class _Shelf:
    """Pictures that a thread puts down and others take, no more than `capacity` at a time."""

    def __init__(self, capacity: int):
        self._capacity, self._closed = capacity, False
        self._pictures: dict[int, Picture] = {}
        self._error: Exception | None = None
        self._changed = Condition()
        self._thread: Thread | None = None

    def start(self, reader: Iterator[tuple[int, Picture]]) -> None:
        """Begin to fill the shelf."""
        self._thread = Thread(target=self._fill, args=(reader,), name="holoreel pictures", daemon=True)
        self._thread.start()

    def _fill(self, reader: Iterator[tuple[int, Picture]]) -> None:
        try:
            while self._wait_for_room():
                item = next(reader, None)
                if item is None:
                    return
                with self._changed:
                    self._pictures[item[0]] = item[1]
                    self._changed.notify_all()
        except Exception as error:  # noqa: BLE001 - whatever it is, it is raised where the picture is asked for
            with self._changed:
                self._error = error
                self._changed.notify_all()

    def _wait_for_room(self) -> bool:
        with self._changed:
            self._changed.wait_for(lambda: self._closed or len(self._pictures) < self._capacity)
            return not self._closed

    def take(self, number: int, keep: bool) -> Picture:
        """Return a picture once it is there, leaving it there if `keep`."""
        with self._changed:
            self._changed.wait_for(lambda: number in self._pictures or self._error is not None)
            if number not in self._pictures:
                if isinstance(self._error, HoloreelError):
                    raise HoloreelError(str(self._error)) from self._error
                raise HoloreelError(
                    f"a picture cannot be read ({type(self._error).__name__}: {self._error}); check the capture."
                ) from self._error
            if keep:
                return self._pictures[number]
            picture = self._pictures.pop(number)
            self._changed.notify_all()
            return picture

    def close(self) -> None:
        """Stop the thread, after the picture it is at."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if self._thread and self._thread is not current_thread():
            self._thread.join()
        self._pictures.clear()
