# SPDX-License-Identifier: GPL-3.0-or-later
"""Files that are either whole or absent: what is written appears under its name only once it is complete."""

import json
import math
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from .errors import HoloreelError

MAX_JSON_BYTES = 512 * 2**20


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path` (same suffix); it takes `path`'s place on success and vanishes on failure.

    Missing folders are made. Raises `HoloreelError` where the folder or the file cannot be written.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}-{secrets.token_hex(4)}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise HoloreelError(
            f"{path} cannot be written ({error.strerror or error}): choose a folder you may write to, with room left."
        ) from error
    finally:
        with suppress(OSError):
            temporary.unlink()


def write_json(path: str | Path, value: Any) -> None:
    """Write `value` as indented JSON, atomically; a NaN or infinity is a ValueError."""
    text = json.dumps(value, indent=1, allow_nan=False)
    with atomic_path(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def finite(value: Any) -> float | None:
    """Return `value` as a float if it is a finite number, else None: what JSON holds may be huge, or no number."""
    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def read_json(path: str | Path) -> dict[str, Any]:
    """Read a JSON object; raises `HoloreelError` where the file is missing, too large, no JSON, or no object."""
    path = Path(path)
    try:
        if path.stat().st_size > MAX_JSON_BYTES:
            raise HoloreelError(f"{path} is larger than {MAX_JSON_BYTES >> 20} MiB: this is no file of ours.")
        value = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise HoloreelError(f"{path} cannot be read ({error.strerror or error}): check the path.") from error
    except (ValueError, RecursionError) as error:
        raise HoloreelError(f"{path} is not valid JSON ({error}): write it again or fetch a whole copy.") from error
    if not isinstance(value, dict):
        raise HoloreelError(f"{path} holds a JSON {type(value).__name__}, not an object: give the right file.")
    return value
