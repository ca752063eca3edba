# SPDX-License-Identifier: GPL-3.0-or-later
"""Compact payloads, `.stgc`: Spacetime Gaussians in a quarter to a fifth of a PLY's bytes. Needs numpy only.

Little-endian: `STGC`, u32 length and u32 CRC-32 of a JSON text, the text, then one zlib stream for each of its columns:

    {"version": 1, "variant": "lite", "count": N,
     "columns": [{"name": "means_0", "low": -3.2, "step": 0.001, "planes": 2, "delta": true, "size": 51234}, ...]}

A column is one number of every row. Its stream holds N · planes bytes: the lowest byte of all rows, then the second,
and so on. They make whole numbers k ≥ 0; with `delta` these are differences to the row before (0 before the first), and
0, -1, 1, -2, ... are written as 0, 1, 2, 3, .... The value is low + step · k. A column without planes is constant.
docs/formats.md has the whole description.

What makes it small: rows follow a curve through space (Morton's), so that neighbors are alike; steps are no finer than
a picture shows (`STEPS`); and motion is written around the temporal center as it was rounded, so that rounding the time
moves nothing.
"""

import json
import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, TypeGuard

import numpy as np
from numpy.typing import NDArray

from ..errors import HoloreelError
from ..files import atomic_path, finite
from .model import ALWAYS_LOG_SCALE, FEATURES, ROWS, SpacetimeGaussians, recentered, unit_rotations
from .ply import usable_rows

MAGIC = b"STGC"
VERSION = 1
MAX_PLANES = 6

# How far apart the values are that a parameter may take, chosen by measurement: together they cost about 0.05 dB.
# Positions and motions: in units of the size that all but a tenth of the Gaussians exceed, and motions 1, 2 and 4 times
# that for the linear, quadratic and cubic coefficients, which matter the less the shorter the time.
SIZE_QUANTILE = 0.1
STEPS = {
    "means": 0.04,
    "motions": 0.08,
    "quats": 1 / 512,
    "omegas": 1 / 256,
    "log_scales": 1 / 20,
    "opacity_logits": 1 / 16,
    "features": 1 / 144,
    "trbf_centers": 1 / 512,
    "trbf_log_scales": 1 / 32,
}
# Beyond these nothing changes in a picture.
_LIMITS = {"opacity_logits": (-8.0, 8.0), "trbf_log_scales": (-16.0, ALWAYS_LOG_SCALE), "log_scales": (-30.0, 30.0)}

_HEADER = struct.Struct("<4sII")
_MAX_HEADER = 1 << 16
_DEFLATE_RATIO = 1032  # the most that zlib's format can unpack a byte to
_MORTON_BITS = 21  # for each axis


def write_compact(path: str | Path, gaussians: SpacetimeGaussians) -> None:
    """Write a compact payload, atomically. Rows that cannot be drawn are left out; the others change their order."""
    path = Path(path)
    data = pack(gaussians)
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def pack(gaussians: SpacetimeGaussians, steps: dict[str, float] = STEPS) -> bytes:
    """Return the bytes of a compact payload."""
    model = _prepared(gaussians.without_bad_rows(), steps["trbf_centers"])
    model = model.take(np.argsort(_morton(model.means), kind="stable"))
    columns, streams = [], []
    for name, values, step in _columns(model, steps):
        column, stream = _pack_column(values, step)
        columns.append({"name": name, **column, "size": len(stream)})
        streams.append(stream)
    header = {"version": VERSION, "variant": model.variant, "count": len(model), "columns": columns}
    text = json.dumps(header, separators=(",", ":")).encode()
    return b"".join([_HEADER.pack(MAGIC, len(text), zlib.crc32(text)), text, *streams])


def _prepared(model: SpacetimeGaussians, center_step: float) -> SpacetimeGaussians:
    """Return the same Gaussians around rounded temporal centers, with unit quaternions, all within the limits."""
    model = recentered(model, np.round(model.trbf_centers.astype(np.float64) / center_step) * center_step)
    model.quats, model.omegas = (array.astype(np.float32) for array in unit_rotations(model))
    for name, (low, high) in _LIMITS.items():
        setattr(model, name, getattr(model, name).clip(low, high))
    return model


def _morton(means: NDArray[np.float32]) -> NDArray[np.uint64]:
    """Return keys whose order visits neighbors in space one after another: the coordinates' bits in turn."""
    low, high = means.min(axis=0, initial=np.inf), means.max(axis=0, initial=-np.inf)
    cells = (means.astype(np.float64) - low) / np.maximum((high.astype(np.float64) - low).max(initial=0.0), 1e-30)
    cells = np.minimum(cells * (1 << _MORTON_BITS), (1 << _MORTON_BITS) - 1).astype(np.uint64)
    keys = np.zeros(len(means), np.uint64)
    for bit in range(_MORTON_BITS):
        for axis in range(3):
            keys |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return keys


def _columns(model: SpacetimeGaussians, steps: dict[str, float]) -> Iterator[tuple[str, NDArray[np.float32], float]]:
    """Yield name, values (N,) and step of each column."""
    unit = (
        float(np.quantile(np.exp(model.log_scales.max(axis=1).astype(np.float64)), SIZE_QUANTILE))
        if len(model)
        else 1.0
    )
    for parameter in ROWS:
        for index, values in enumerate(model.columns(parameter).T):
            step = steps[parameter]
            if parameter in ("means", "motions"):
                step *= unit
            if parameter == "motions":
                step *= 2 ** (index // 3)
            yield f"{parameter}_{index}", values, step


def _pack_column(values: NDArray[np.float32], step: float) -> tuple[dict[str, Any], bytes]:
    """Return a column's entry in the header and its stream, with or without differences, whichever is smaller."""
    exact = values.astype(np.float64)
    low, high = (float(exact.min()), float(exact.max())) if len(exact) else (0.0, 0.0)
    step = max(step, (high - low) / 2 ** (8 * MAX_PLANES - 2))
    low = math.floor(low / step) * step  # so that 0 stays 0: what stands still, what is not turned
    whole = np.round((exact - low) / step).astype(np.int64)
    steps = np.diff(whole, prepend=0)
    choices = []
    for delta, numbers in ((False, whole), (True, np.where(steps < 0, -2 * steps - 1, 2 * steps))):
        planes = (int(numbers.max(initial=0)).bit_length() + 7) // 8
        raw = numbers.astype("<u8").view(np.uint8).reshape(-1, 8)[:, :planes].T.tobytes()
        entry = {"low": low, "step": step, "planes": planes, "delta": delta}
        choices.append((entry, zlib.compress(raw, 9) if planes else b""))
    return min(choices, key=lambda choice: len(choice[1]))


def read_compact(path: str | Path) -> tuple[SpacetimeGaussians, list[str]]:
    """Read a compact payload; return the model and sentences about what is unusual.

    Raises `HoloreelError` for a file that is not a whole one, before anything of the size that it claims is allocated.
    """
    path = Path(path)
    report: list[str] = []
    try:
        with open(path, "rb") as file:
            gaussians = _read(path, file, path.stat().st_size)
    except OSError as error:
        raise HoloreelError(f"{path} cannot be read ({error.strerror or error}): check the path.") from error
    return usable_rows(path, gaussians, report), report


def _read(path: Path, file: BinaryIO, size: int) -> SpacetimeGaussians:
    header, start = _read_header(path, file, size)
    variant, count, columns = header.get("variant"), header.get("count"), header.get("columns")
    names = [f"{name}_{index}" for name, width in _widths(path, variant).items() for index in range(width)]
    # Even zeros take a byte for every thousand.
    if not _is_count(count) or count > size * _DEFLATE_RATIO:
        raise HoloreelError(f"{path}: its 'count' is {count!r}, more than {size} bytes can hold; fetch it again.")
    if not isinstance(columns, list) or [part.get("name") for part in columns if isinstance(part, dict)] != names:
        raise HoloreelError(f"{path}: its 'columns' are not those of a {variant} model; write it again.")
    for column in columns:
        _check_column(path, column)
    promised = start + sum(column["size"] for column in columns)
    if promised != size:
        raise HoloreelError(f"{path}: its header promises {promised} bytes, the file has {size}; fetch it again.")
    values = {name: _unpack_column(path, file, column, count) for name, column in zip(names, columns, strict=True)}
    arrays = {
        name: np.stack([values[f"{name}_{index}"] for index in range(width)], axis=1).reshape(
            count, *_shape(name, width)
        )
        for name, width in _widths(path, variant).items()
    }
    return SpacetimeGaussians(**arrays)


def _read_header(path: Path, file: BinaryIO, size: int) -> tuple[dict[str, Any], int]:
    """Return the header and where the first stream starts."""
    start = file.read(_HEADER.size)
    magic, length, check = _HEADER.unpack(start) if len(start) == _HEADER.size else (b"", 0, 0)
    if magic != MAGIC:
        raise HoloreelError(f"{path} is not a compact payload (it does not begin with STGC): give the right file.")
    if length > min(size - _HEADER.size, _MAX_HEADER):
        raise HoloreelError(f"{path}: its header claims {length} bytes, more than it can have; fetch it again.")
    text = file.read(length)
    if zlib.crc32(text) != check:
        raise HoloreelError(f"{path}: its header is damaged (the CRC-32 does not match); fetch it again.")
    try:
        header = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise HoloreelError(f"{path}: its header is not valid JSON ({error}); write it again.") from error
    version = header.get("version") if isinstance(header, dict) else None
    if not _is_count(version) or version != VERSION:
        raise HoloreelError(f"{path}: its 'version' is {version!r}, this Holoreel reads {VERSION}: update Holoreel.")
    return header, _HEADER.size + length


def _widths(path: Path, variant: Any) -> dict[str, int]:
    """Return how many columns each parameter has."""
    features = {name: width for width, name in FEATURES.items()}.get(variant) if isinstance(variant, str) else None
    if features is None:
        raise HoloreelError(f"{path}: its 'variant' is {variant!r}, not lite or full; write it again.")
    return {name: features if name == "features" else math.prod(shape) for name, (shape, _, _) in ROWS.items()}


def _shape(name: str, width: int) -> tuple[int, ...]:
    return (width,) if name == "features" else ROWS[name][0]


def _check_column(path: Path, column: dict[str, Any]) -> None:
    low, step = finite(column.get("low")), finite(column.get("step"))
    planes, size = column.get("planes"), column.get("size")
    wrong = {
        "low": low is None,
        "step": step is None or step <= 0,
        "planes": not _is_count(planes) or planes > MAX_PLANES,
        "delta": not isinstance(column.get("delta"), bool),
        "size": not _is_count(size),
    }
    for name in (name for name, is_wrong in wrong.items() if is_wrong):
        raise HoloreelError(
            f"{path}: '{name}' of its column {column['name']} is {column.get(name)!r}, which cannot be; write it again."
        )


def _unpack_column(path: Path, file: BinaryIO, column: dict[str, Any], count: int) -> NDArray[np.float32]:
    wanted, stream = count * column["planes"], file.read(column["size"])
    unpacker = zlib.decompressobj()
    try:
        raw = unpacker.decompress(stream, wanted + 1) if stream else b""
    except zlib.error as error:
        raise HoloreelError(f"{path}: its column {column['name']} is damaged ({error}); fetch it again.") from error
    if len(raw) != wanted or bool(stream) != unpacker.eof:
        raise HoloreelError(f"{path}: its column {column['name']} does not hold {count} rows; fetch it again.")
    numbers = np.zeros(count, np.int64)
    for plane, part in enumerate(np.frombuffer(raw, np.uint8).reshape(column["planes"], count)):
        numbers |= part.astype(np.int64) << (8 * plane)
    if column["delta"]:
        numbers = np.cumsum(np.where(numbers & 1, -((numbers + 1) >> 1), numbers >> 1))
    with np.errstate(over="ignore"):  # what does not fit a float32 becomes infinite, and its row unusable
        return (column["low"] + column["step"] * numbers.astype(np.float64)).astype(np.float32)


def _is_count(value: Any) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**48
