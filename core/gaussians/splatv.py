# SPDX-License-Identifier: GPL-3.0-or-later
"""`.splatv`, the files of the splaTV web viewer (github.com/antimatter15/splaTV, hybrid.js). Needs numpy only.

Little-endian: u32 magic 0x674B, u32 length of a JSON text, the text (a list of chunks `{type, size, texwidth,
texheight, ...}`), then the chunks' payloads in order. The payload of a chunk "splat" is a texture 4096 texels wide;
64 bytes make one lite Spacetime Gaussian (`_RECORD`). Writers in use leave out the padding that fills the last row of
the texture; this one does not.
"""

import json
import struct
from pathlib import Path
from typing import Any, BinaryIO, TypeGuard

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..errors import HoloreelError
from ..files import atomic_path
from .model import ALWAYS_LOG_SCALE, SpacetimeGaussians, logit, recentered, rows, sigmoid, unit_rotations
from .ply import usable_rows

MAGIC = 0x674B
_HEADER_LIMIT = 64 * 2**20  # the text lists one camera per picture at most: a few MB
_TEXTURE_WIDTH = 4096
_ROW_BYTES = _TEXTURE_WIDTH * 16
_RECORD = np.dtype(
    [
        ("position", "<f4", 3),
        ("rotation", "<f2", 4),
        ("scale", "<f2", 4),  # linear; the fourth is unused
        ("rgba", "u1", 4),  # color and opacity, 255 is 1
        ("motion", "<f2", 10),  # order-major; the tenth is unused
        ("omega", "<f2", 4),
        ("temporal", "<f2", 2),  # center, linear width
    ]
)
# What a zero stands for: half of the smallest positive half-precision number, and a quarter of a color step. Finite in
# the logarithm, and as invisible as a zero.
_LEAST_HALF = 2.0**-25
_LEAST_OPACITY = 0.25 / 255.0
_MOST_HALF = 65504.0  # the largest finite half-precision number
_SMALLEST_HALF = 2.0**-14  # the smallest that every graphics card keeps


def read_splatv(path: str | Path) -> tuple[SpacetimeGaussians, list[str]]:
    """Read a `.splatv`; return a lite model with finite parameters and sentences about what is unusual.

    Infinite widths (always visible) become large ones, zero scales the smallest, empty padding records vanish, and
    records whose position is not finite are left out and reported. Raises `HoloreelError` for a file that is not a
    whole `.splatv` or has no usable record.
    """
    path = Path(path)
    try:
        with open(path, "rb") as file:
            records, report = _read_records(path, file)
    except OSError as error:
        raise HoloreelError(f"{path} cannot be read ({error.strerror or error}): check the path.") from error
    words = records.view("<u4").reshape(-1, _RECORD.itemsize // 4)
    padding = ~words.any(axis=1)
    if padding.any():
        report.append(f"{rows(int(padding.sum()))} of padding left out.")
        records = records[~padding]
    return usable_rows(path, _decode(records, report), report), report


def write_splatv(path: str | Path, gaussians: SpacetimeGaussians, camera: Camera) -> None:
    """Write a lite model for splaTV, atomically; `camera` is where its viewer begins.

    The most important Gaussians (volume times opacity) come first, because the viewer shows what has arrived. Half
    precision rounds most parameters, colors and opacities have 8 bits. All values are finite and quaternions of length
    1 at the temporal center. Rows that cannot be drawn are left out; a full model is a ValueError: flatten it first.
    """
    if gaussians.variant != "lite":
        raise ValueError("a .splatv holds lite models")
    records = _encode(gaussians.without_bad_rows())
    height = max(1, -(-records.nbytes // _ROW_BYTES))
    pose = camera.camera_to_world
    view = {
        "id": 0,
        "img_name": camera.name or "view",
        "width": camera.width,
        "height": camera.height,
        "position": pose[:3, 3].tolist(),
        "rotation": pose[:3, :3].tolist(),
        "fy": camera.fy,
        "fx": camera.fx,
    }
    size = height * _ROW_BYTES
    chunk = {"type": "splat", "size": size, "texwidth": _TEXTURE_WIDTH, "texheight": height, "cameras": [view]}
    text = json.dumps([chunk], allow_nan=False).encode()
    with atomic_path(path) as temporary:
        head = struct.pack("<II", MAGIC, len(text)) + text
        temporary.write_bytes(head + records.tobytes() + bytes(size - records.nbytes))


def _encode(model: SpacetimeGaussians) -> NDArray[np.void]:
    """Return the records of a model, most important first."""
    model = recentered(model, _half(model.trbf_centers).astype(np.float64))
    quats, omegas = unit_rotations(model)
    quats[~quats.any(axis=1)] = (1.0, 0.0, 0.0, 0.0)  # the viewer divides by their length
    with np.errstate(over="ignore"):
        scales = np.exp(model.log_scales.astype(np.float64))
        widths = np.exp(model.trbf_log_scales.astype(np.float64))
    opacities = sigmoid(model.opacity_logits.astype(np.float64))
    records = np.zeros(len(model), _RECORD)
    records["position"] = model.means
    records["rotation"], records["omega"] = _half(quats), _half(omegas)
    records["scale"][:, :3] = _half(scales.clip(_SMALLEST_HALF))
    records["rgba"] = np.round(255.0 * np.column_stack([model.features, opacities]).clip(0.0, 1.0))
    records["motion"][:, :9] = _half(model.columns("motions"))
    records["temporal"] = _half(np.column_stack([model.trbf_centers, widths.clip(_SMALLEST_HALF)]))
    importance = model.log_scales.astype(np.float64).sum(axis=1) + np.log(opacities.clip(1e-30))
    return records[np.argsort(-importance, kind="stable")]


def _half(values: NDArray[Any]) -> NDArray[np.float16]:
    return values.clip(-_MOST_HALF, _MOST_HALF).astype(np.float16)


def _decode(records: NDArray[np.void], report: list[str]) -> SpacetimeGaussians:
    widths = records["temporal"][:, 1].astype(np.float64)
    endless = np.isposinf(widths)
    if endless.any():
        report.append(f"{rows(int(endless.sum()))} with an infinite temporal width: always visible.")
    with np.errstate(invalid="ignore"):  # a negative width has no logarithm: NaN, and the row is left out
        log_widths = np.where(endless, ALWAYS_LOG_SCALE, np.log(np.where(widths == 0.0, _LEAST_HALF, widths)))
        scales = records["scale"][:, :3].astype(np.float64)
        log_scales = np.log(np.where(scales == 0.0, _LEAST_HALF, scales))
    rgba = records["rgba"] / 255.0
    return SpacetimeGaussians(
        means=records["position"],
        motions=records["motion"][:, :9].reshape(-1, 3, 3),
        quats=records["rotation"],
        omegas=records["omega"],
        log_scales=log_scales,
        opacity_logits=logit(np.clip(rgba[:, 3], _LEAST_OPACITY, 1.0 - _LEAST_OPACITY)),
        features=rgba[:, :3].astype(np.float32),
        trbf_centers=records["temporal"][:, 0],
        trbf_log_scales=log_widths,
    )


def _read_records(path: Path, file: BinaryIO) -> tuple[NDArray[np.void], list[str]]:
    size = path.stat().st_size
    chunk, offset = _find_splats(path, _read_header(path, file, size))
    promised, present = chunk["size"], min(chunk["size"], size - offset)
    missing = promised - present
    # Only the padding of the last row of the texture may be missing, in whole records.
    if missing >= _ROW_BYTES or present <= 0 or present % _RECORD.itemsize:
        raise HoloreelError(
            f"{path} is cut short: its header's 'size' promises {promised} bytes of Gaussians, the file holds "
            f"{max(present, 0)}; fetch it again."
        )
    file.seek(offset)
    report = [f"{missing} bytes of padding are missing at the end (harmless)."] if missing else []
    return np.fromfile(file, _RECORD, present // _RECORD.itemsize), report


def _read_header(path: Path, file: BinaryIO, size: int) -> tuple[list[Any], int]:
    """Return the list of chunks and where the first payload starts."""
    start = file.read(8)
    if len(start) < 8 or struct.unpack("<I", start[:4])[0] != MAGIC:
        raise HoloreelError(f"{path} is not a .splatv file (its first bytes are not 4B 67 00 00): give the right file.")
    length = struct.unpack("<I", start[4:])[0]
    if length > min(size - 8, _HEADER_LIMIT):
        raise HoloreelError(f"{path}: its header claims {length} bytes, more than the file can hold; fetch it again.")
    try:
        chunks = json.loads(file.read(length))
    except (ValueError, RecursionError) as error:
        raise HoloreelError(f"{path}: its header is not valid JSON ({error}); fetch it again.") from error
    if not isinstance(chunks, list):
        raise HoloreelError(f"{path}: its header is not a list of chunks; fetch it again.")
    return chunks, 8 + length


def _find_splats(path: Path, header: tuple[list[Any], int]) -> tuple[dict[str, Any], int]:
    """Return the chunk of Gaussians, checked, and where its payload starts."""
    chunks, offset = header
    for chunk in chunks:
        if not isinstance(chunk, dict) or not _is_count(chunk.get("size")):
            raise HoloreelError(f"{path}: a chunk in its header has no valid 'size'; fetch it again.")
        if chunk.get("type") == "splat":
            width, height = chunk.get("texwidth"), chunk.get("texheight")
            if width != _TEXTURE_WIDTH or not _is_count(height) or chunk["size"] != height * _ROW_BYTES:
                raise HoloreelError(
                    f"{path}: 'texwidth' {width!r}, 'texheight' {height!r} and 'size' {chunk['size']} in its header "
                    f"do not agree (size = {_TEXTURE_WIDTH} × texheight × 16); fetch it again."
                )
            return chunk, offset
        offset += chunk["size"]
    raise HoloreelError(f"{path} has no chunk of type 'splat': give a .splatv that holds Gaussians.")


def _is_count(value: Any) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool) and 0 < value < 2**48
