# SPDX-License-Identifier: GPL-3.0-or-later
"""The vertex table of a PLY file as a numpy structured array. Needs numpy only.

What is read: `format` binary_little_endian, binary_big_endian or ascii 1.0, scalar vertex properties of any type, other
elements after the vertices (skipped). Lists among the vertices, and elements before them, are refused. What is written:
binary_little_endian with vertices alone, e.g. (https://paulbourke.net/dataformats/ply/)

    ply
    format binary_little_endian 1.0
    element vertex 2
    property float x
    ...
    end_header
"""

from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from .errors import HoloreelError
from .files import atomic_path

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
_NAMES = {kind: name for name, kind in reversed(_TYPES.items())}  # the first, classic spelling wins
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
_MAX_HEADER_BYTES = 1 << 16


@dataclass(frozen=True)
class PlyHeader:
    """What a PLY header says; `dtype` is one vertex, `size` the header's length in bytes."""

    format: str
    dtype: np.dtype
    count: int
    comments: tuple[str, ...]
    size: int
    vertices_only: bool


def read_header(path: str | Path) -> PlyHeader:
    """Read a PLY header and check it against the file's size; raises `HoloreelError` for a file that is not whole."""
    path = Path(path)
    with _open(path) as file:
        return _read_header(path, file)


def read_vertices(path: str | Path) -> NDArray[np.void]:
    """Read the vertices as an (N,) structured array with native byte order: `table["x"]`, `table.dtype.names`.

    Raises `HoloreelError` for anything that is not a whole PLY file. Values are not judged: check finiteness yourself.
    """
    path = Path(path)
    with _open(path) as file:
        header = _read_header(path, file)
        if header.format == "ascii":
            return _read_ascii(path, file, header)
        table = np.fromfile(file, header.dtype, header.count)
    return table.astype(header.dtype.newbyteorder("="), copy=False)


def write_vertices(path: str | Path, table: NDArray[np.void], comments: tuple[str, ...] = ()) -> None:
    """Write a 1-D structured array of scalar columns as a binary little-endian PLY, atomically."""
    if table.ndim != 1 or not table.dtype.names:
        raise ValueError(f"a 1-D structured array is wanted, not {table.dtype} {table.shape}")
    packed = np.dtype([(name, table.dtype[name].newbyteorder("<")) for name in table.dtype.names])
    properties = [f"property {_NAMES[packed[name].str[1:]]} {name}" for name in table.dtype.names]
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {text}" for text in comments)]
    lines += [f"element vertex {len(table)}", *properties, "end_header\n"]
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write("\n".join(lines).encode("ascii"))
        np.ascontiguousarray(table, dtype=packed).tofile(file)


def _open(path: Path) -> BinaryIO:
    try:
        return open(path, "rb")
    except OSError as error:
        raise HoloreelError(f"{path} cannot be read ({error.strerror or error}): check the path.") from error


def _read_header(path: Path, file: BinaryIO) -> PlyHeader:
    lines = _header_lines(path, file)
    header = _parse_header(path, lines, file.tell())
    left = path.stat().st_size - header.size
    # An ASCII number takes a character and a separator at least; the last separator may be missing.
    least = header.count * (header.dtype.itemsize if header.format != "ascii" else 2 * len(header.dtype.names or ()))
    if left < least - (header.format == "ascii"):
        raise HoloreelError(
            f"{path} is cut short: 'element vertex' promises {header.count} vertices ({least} bytes), "
            f"the file holds {left}; fetch or export it again."
        )
    if header.format != "ascii" and header.vertices_only and left > least:
        raise HoloreelError(
            f"{path} has {left - least} bytes more than 'element vertex {header.count}' and its properties say: "
            "its header is wrong; export it again."
        )
    return header


def _header_lines(path: Path, file: BinaryIO) -> list[list[str]]:
    """Return the header's lines as words, `ply` first and without `end_header`; the file stands at the data."""
    lines: list[list[str]] = []
    while file.tell() <= _MAX_HEADER_BYTES:
        raw = file.readline(1024)
        try:
            words = raw.decode("utf-8").split()
        except UnicodeDecodeError:
            break
        if not raw.endswith(b"\n") or (not lines and words != ["ply"]):
            break
        if words == ["end_header"]:
            return lines
        if words:
            lines.append(words)
    raise HoloreelError(f"{path} is not a PLY file (no header from 'ply' to 'end_header'): give the right file.")


def _parse_header(path: Path, lines: list[list[str]], size: int) -> PlyHeader:
    format_name, comments = "", []
    count: int | None = None
    vertices_only = True
    columns: list[tuple[str, str]] = []
    element = ""
    for words in lines[1:]:
        match words:
            case ["comment" | "obj_info", *rest]:
                comments.append(" ".join(rest))
            case ["format", name, "1.0"] if name in _ORDERS and not format_name:
                format_name = name
            case ["element", "vertex", number] if count is None and not element and number.isdecimal():
                element, count = "vertex", int(number[:19])
            case ["element", name, number] if count is not None and number.isdecimal():
                element, vertices_only = name, False
            case ["property", kind, name] if element == "vertex" and kind in _TYPES:
                columns.append((name, _TYPES[kind]))
            case ["property", *_] if element and element != "vertex":
                pass
            case _:
                raise HoloreelError(f"{path}: the header line '{' '.join(words)}' is not understood; export it again.")
    if not format_name or count is None or not columns:
        raise HoloreelError(f"{path}: the header lacks a format, vertices or their properties; export it again.")
    names = [name for name, _ in columns]
    if len(set(names)) != len(names):
        double = next(name for name in names if names.count(name) > 1)
        raise HoloreelError(f"{path}: the property '{double}' is there twice; export it again.")
    dtype = np.dtype([(name, _ORDERS[format_name] + kind) for name, kind in columns])
    return PlyHeader(format_name, dtype, count, tuple(comments), size, vertices_only)


def _read_ascii(path: Path, file: BinaryIO, header: PlyHeader) -> NDArray[np.void]:
    if header.count == 0:
        return np.empty(0, header.dtype)
    try:
        rows = (line.decode("ascii", "replace") for line in file if line.strip())
        table = np.loadtxt(rows, header.dtype, comments=None, max_rows=header.count, ndmin=1)
    except (ValueError, OverflowError) as error:
        raise HoloreelError(f"{path}: a vertex is not what the header says ({error}); export it again.") from error
    if len(table) != header.count:
        raise HoloreelError(
            f"{path} is cut short: 'element vertex' promises {header.count} vertices, the file holds {len(table)}; "
            "export it again."
        )
    return table
