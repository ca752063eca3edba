# SPDX-License-Identifier: GPL-3.0-or-later
"""What a long command is doing, for programs that look in from outside: `--status FILE`.

FILE is a JSON object that is replaced as a whole, so that it can be read at any moment; the newest preview lies beside
it as a PNG of the same name. Needs numpy only to be imported.

    {"stage": "train", "done": 340, "total": 3500, "seconds_left": 61.5,
     "figures": {"loss": "0.0312", "PSNR": "27.1 dB"}, "previews": 3}
"""

import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .errors import HoloreelError
from .files import finite, read_json, write_json

Preview = Callable[[], NDArray[np.floating]]  # draws (H, W, 3) in 0..1

EVERY_SECONDS = 0.5  # at most so often is the file written
PREVIEW_SECONDS = 5.0
PREVIEW_SHARE = 0.02  # of the time goes into previews at most
MAX_BYTES = 1 << 16
MAX_FIGURES = 16


@dataclass(frozen=True)
class Status:
    """How far a command is: `done` steps of `total` (0: not known yet), and `figures` worth seeing, as text.

    `previews` counts the previews so far: the PNG is a new one when it has grown.
    """

    stage: str = "starting"
    done: int = 0
    total: int = 0
    seconds_left: float | None = None
    figures: dict[str, str] = field(default_factory=dict)
    previews: int = 0

    @property
    def share(self) -> float:
        """How much is done, 0 to 1."""
        return min(max(self.done / self.total, 0.0), 1.0) if self.total > 0 else 0.0


def preview_path(status: Path) -> Path:
    """Return where the preview that belongs to a status file lies."""
    return status.with_suffix(".png")


class StatusWriter:
    """Keeps a status file up to date; without a path it does nothing.

    Raises `HoloreelError` where the file cannot be made. Later troubles (a full disk) are not worth ending a run for:
    then the file stays as it was.
    """

    def __init__(self, path: Path | None, clock: Callable[[], float] = time.monotonic) -> None:
        self.path, self._clock, self._previews = path, clock, 0
        self._next_status = self._next_preview = clock()
        if path is not None:
            write_json(path, asdict(Status()))

    def tell(
        self,
        stage: str,
        done: int,
        total: int,
        seconds_left: float | None = None,
        figures: Mapping[str, str] | None = None,
        preview: Preview | None = None,
    ) -> None:
        """Say how far the command is; most calls return at once. The last step is always written."""
        now = self._clock()
        if self.path is None or (now < self._next_status and done != total):
            return
        with suppress(HoloreelError):
            if preview is not None and (now >= self._next_preview or done == total):
                self._draw(self.path, preview)
            status = Status(stage, done, total, finite(seconds_left), dict(figures or {}), self._previews)
            write_json(self.path, asdict(status))
        self._next_status = self._clock() + EVERY_SECONDS

    def _draw(self, path: Path, preview: Preview) -> None:
        from .images import write_png

        begin = self._clock()
        write_png(preview_path(path), preview())
        end = self._clock()
        self._next_preview = end + max(PREVIEW_SECONDS, (end - begin) / PREVIEW_SHARE)
        self._previews += 1


def read_status(path: Path) -> Status:
    """Read a status file; raises `HoloreelError` where it is missing or no status."""
    try:
        size = path.stat().st_size
    except OSError as error:
        raise HoloreelError(f"{path} cannot be read ({error.strerror or error}): has the job begun?") from error
    value = read_json(path) if size <= MAX_BYTES else {}
    stage, figures = value.get("stage"), value.get("figures")
    counts = [count for name in ("done", "total", "previews") if type(count := value.get(name)) is int]
    if not (isinstance(stage, str) and isinstance(figures, dict) and len(counts) == 3):
        raise HoloreelError(f"{path} is no status of a job: write it with --status.")
    shown = {str(name): str(text) for name, text in list(figures.items())[:MAX_FIGURES]}
    done, total, previews = counts
    return Status(stage, done, total, finite(value.get("seconds_left")), shown, previews)
