# SPDX-License-Identifier: GPL-3.0-or-later
"""What training runs have in common. Needs numpy only to be imported."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from .camera import Camera
from .capture import Capture
from .errors import HoloreelError

PREVIEW_PIXELS = 256  # along the longer side


def claim_folder(folder: Path) -> None:
    """Make sure that a result can be written before hours are spent on it; raises `HoloreelError`."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".holoreel-write-test"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise HoloreelError(f"{folder}: cannot write here ({error.strerror}); choose another --out.") from error


def claim_run(reel: Path, checkpoint: Path, resume: bool) -> None:
    """Make sure that a run may begin, or go on: the reel's name, its folder, and what a stopped run left behind.

    Raises `HoloreelError`.
    """
    if reel.suffix != ".reel":
        raise HoloreelError(f"{reel}: a reel's name ends in .reel; pass --out {reel}.reel.")
    claim_folder(reel.parent)
    if checkpoint.exists() and not resume:
        raise HoloreelError(
            f"{checkpoint}: a stopped run lies here; pass --resume to go on, or delete it to start anew."
        )
    if resume and not checkpoint.exists():
        raise HoloreelError(f"{checkpoint}: no checkpoint to resume from; leave --resume away to start anew.")


def preview_camera(capture: Capture) -> Camera:
    """Return the camera whose view a run shows while it trains: the first that is held out, else the first; small."""
    camera = capture.cameras[(capture.camera_names("test") or capture.camera_names())[0]]
    shrink = min(1.0, PREVIEW_PIXELS / max(camera.width, camera.height))
    return camera.scaled(max(1, round(camera.width * shrink)), max(1, round(camera.height * shrink)))


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Keep torch's own threads asleep: they spin while they wait, beside the kernels' threads and at their cost."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def differences(old: Mapping, new: Mapping, ignored: tuple[str, ...] = (), prefix: str = "") -> list[str]:
    """Name the settings that two (nested) configurations do not share, but for those `ignored`."""
    names = []
    for key in sorted(old.keys() | new.keys()):
        a, b = old.get(key), new.get(key)
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            names += differences(a, b, ignored, f"{prefix}{key}.")
        elif _plain(a) != _plain(b) and f"{prefix}{key}" not in ignored:
            names.append(f"{prefix}{key}")
    return names


def _plain(value: object) -> object:
    """Return a value as JSON would give it back, where that matters."""
    return list(value) if isinstance(value, tuple | list) else value
