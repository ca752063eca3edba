# SPDX-License-Identifier: GPL-3.0-or-later
"""Text files of rows, as calibrations often are: numbers between spaces, or columns with names (CSV)."""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from ..errors import HoloreelError

_MAX_BYTES = 1 << 22
_MAX_TABLE_BYTES = 1 << 26
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


def read_table(file: Path, columns: Sequence[str], most: int = _MAX_TABLE_BYTES) -> list[dict[str, str]]:
    """Return the given columns of every row of a CSV file of at most `most` bytes, whose first line names its columns.

    Spaces around values are dropped; what a short row lacks is empty. Raises `HoloreelError` where the file is missing,
    too large, damaged, or without one of the columns.
    """
    try:
        if file.stat().st_size > most:
            raise HoloreelError(f"{file} is larger than {most >> 20} MiB: this is no such table; fetch it again.")
        rows = csv.DictReader(
            io.StringIO(file.read_text(encoding="utf-8-sig", errors="replace")), skipinitialspace=True, restval=""
        )
        rows.fieldnames = names = [name.strip() for name in rows.fieldnames or ()]
        table = [{name: row[name].strip() for name in columns if name in names} for row in rows]
    except OSError as error:
        raise HoloreelError(f"{file} cannot be read ({error.strerror or error}): fetch it again.") from error
    except csv.Error as error:
        raise HoloreelError(f"{file} is damaged ({error}): fetch it again.") from error
    if missing := [name for name in columns if name not in names]:
        raise HoloreelError(f"{file} has no column {missing[0]} (it has {', '.join(names)[:60] or 'none'}); add it.")
    return table


def numbers_of(file: Path, line: int, row: Mapping[str, str], columns: Sequence[str]) -> list[float]:
    """Return columns of a row of `read_table` as finite numbers; raises `HoloreelError` naming what is none."""
    numbers = []
    for name in columns:
        try:
            number = float(row[name])
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise HoloreelError(f"{file}: line {line}: {name} is {row[name][:60]!r}, no finite number: fetch it again.")
        numbers.append(number)
    return numbers
