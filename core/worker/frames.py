# SPDX-License-Identifier: GPL-3.0-or-later
"""Pixels that cross from one process to the other: a file in memory that both map. Needs numpy only.

It has no name for longer than it takes the other end to map it (where the system lets open files be deleted), so that
nothing stays behind whoever dies. `multiprocessing.shared_memory` would not do: its tracker, a process of its own,
deletes what a client has merely attached.
"""

import mmap
import os
import secrets
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import HoloreelError

Array = NDArray[np.float32]

FAR = 1e10  # the depth where nothing is, as Blender has it
CHANNELS = 6
_PREFIX = "holoreel-"
_FOLDERS = ("/dev/shm",)  # memory, where there is such a thing; else a file of the system's folder for temporary ones


class Pixels(NamedTuple):
    """A picture as Blender's render results hold it: rows from the bottom up, float32.

    `rgba` (H, W, 4) is premultiplied; `depth` (H, W) is `FAR` where nothing is; `alpha` (H, W) is what the reels cover,
    whatever lies behind them.
    """

    rgba: Array
    depth: Array
    alpha: Array


def bytes_of(width: int, height: int) -> int:
    """Return how many bytes the pixels of a picture take."""
    return 4 * CHANNELS * width * height


class Buffer:
    """A mapped file: `create` it at one end, `attach` to it at the other."""

    def __init__(self, path: Path, size: int, memory: mmap.mmap):
        self.path, self.size, self._memory = path, size, memory

    @classmethod
    def create(cls, size: int) -> "Buffer":
        """Make a buffer; raises `HoloreelError` where there is no room for it.

        Its pages are allotted here: writing to one that the memory has no room for would end the process.
        """
        for folder in (*filter(os.path.isdir, _FOLDERS), tempfile.gettempdir()):
            path = Path(folder, f"{_PREFIX}{os.getpid()}-{secrets.token_hex(8)}")
            try:
                return cls(path, size, _create(path, size))
            except OSError as error:
                reason = error
                with suppress(OSError):
                    path.unlink()
        raise HoloreelError(
            f"{path} cannot take the {size >> 20} MiB of a picture ({reason.strerror or reason}): make room there, or "
            "render a smaller picture."
        ) from reason

    @classmethod
    def attach(cls, path: Path, size: int) -> "Buffer":
        """Map what the other end has made, and take its name away."""
        with open(path, "r+b") as file:
            if os.fstat(file.fileno()).st_size != size:
                raise HoloreelError(f"{path} does not have the {size} bytes it was announced with.")
            attached = cls(path, size, mmap.mmap(file.fileno(), size))
        attached.unlink()
        return attached

    def pixels(self, width: int, height: int) -> Pixels:
        """Return the views of a picture; ValueError where the buffer is too small."""
        count = width * height
        if bytes_of(width, height) > self.size:
            raise ValueError(f"a buffer of {self.size} bytes holds no {width} x {height} pixels")
        values = np.frombuffer(self._memory, np.float32, CHANNELS * count)
        rgba, depth, alpha = np.split(values, (4 * count, 5 * count))
        return Pixels(rgba.reshape(height, width, 4), depth.reshape(height, width), alpha.reshape(height, width))

    def unlink(self) -> None:
        """Delete the file; its memory stays as long as somebody maps it."""
        with suppress(OSError):  # gone already, or held open by the other end where that matters
            self.path.unlink()

    def close(self) -> None:
        """Delete the file, and give the memory back once no view of it is left."""
        with suppress(BufferError):
            self._memory.close()
        self.unlink()


def _create(path: Path, size: int) -> mmap.mmap:
    with os.fdopen(
        os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o600), "r+b"
    ) as file:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, size)
        else:
            file.truncate(size)
        return mmap.mmap(file.fileno(), size)
