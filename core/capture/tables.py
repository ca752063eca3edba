# SPDX-License-Identifier: GPL-3.0-or-later
"""Small text files of numbers in rows, as calibrations often are."""

import math
from pathlib import Path

from ..errors import HoloreelError

_MAX_BYTES = 1 << 22
_MAX_ROWS = 40_000


def read_rows(file: Path, skip: int = 0) -> list[list[float]]:
    """Return the numbers of each line that is not empty, after `skip` lines of headings; rows may differ in length.

    Raises `HoloreelError` where the file is missing, too large, or holds something else than finite numbers.
    """
    try:
        with file.open("rb") as stream:
            text = stream.read(_MAX_BYTES + 1)
    except OSError as error:
        raise HoloreelError(f"{file} cannot be read ({error.strerror or error}): fetch it again.") from error
    lines = [line.split() for line in text.decode("utf-8", "replace").splitlines()[skip:] if line.strip()]
    if len(text) > _MAX_BYTES or len(lines) > _MAX_ROWS:
        raise HoloreelError(f"{file} is larger than any table of cameras: fetch it again.")
    rows = []
    for number, words in enumerate(lines):
        try:
            row = [float(word) for word in words]
        except ValueError as error:
            raise HoloreelError(f"{file}: row {number} is no row of numbers ({error}): fetch it again.") from error
        if not all(map(math.isfinite, row)):
            raise HoloreelError(f"{file}: row {number} holds NaN or infinity: fetch it again.")
        rows.append(row)
    return rows
