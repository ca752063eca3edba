# SPDX-License-Identifier: GPL-3.0-or-later
"""Reading one picture or one depth map of a capture. The libraries are imported when the first one is read."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import HoloreelError
from ..files import atomic_path
from ..images import read_pixels

BACKGROUND_DEPTH = 1e9  # Cycles writes 1e10 where nothing was hit


def read_picture(path: Path, width: int, height: int) -> NDArray[np.uint8]:
    """Read a picture as (height, width, 3), or (height, width, 4) with straight alpha where it has alpha."""
    picture = load_picture(path)
    _check_size(path, picture.shape, width, height)
    return picture


def load_picture(path: Path) -> NDArray[np.uint8]:
    """Read a picture of any size, as `read_picture`."""
    pixels = read_pixels(path)
    if pixels.dtype == np.uint16:
        return ((pixels.astype(np.uint32) * 255 + 32767) // 65535).astype(np.uint8)
    return pixels.astype(np.uint8, copy=False)


def fit(picture: NDArray[np.uint8], width: int, height: int, source: object) -> NDArray[np.uint8]:
    """Bring a picture to its camera's size: the mean of n x n pixels where it is n times as large, for a whole n.

    Straight alpha weighs the colors. Raises `HoloreelError` naming `source` for any other size.
    """
    n = picture.shape[0] // height
    _check_size(source, picture.shape, max(n, 1) * width, max(n, 1) * height, f"{width}x{height}")
    if n == 1:
        return picture
    if picture.shape[2] == 3:
        return _block_means(picture, n)
    alpha = picture[..., 3:].astype(np.float32)
    weight = _block_sums(alpha, n)
    color = _block_sums(picture[..., :3] * alpha, n) / np.maximum(weight, 1)
    return np.rint(np.concatenate([color, weight / (n * n)], axis=2)).astype(np.uint8)


def _block_means(picture: NDArray[np.uint8], n: int) -> NDArray[np.uint8]:
    total = _block_sums(picture.astype(np.uint16 if n <= 16 else np.uint32), n)  # 16 · 16 · 255 < 2¹⁶
    return ((total + n * n // 2) // (n * n)).astype(np.uint8)


def _block_sums(values: NDArray[Any], n: int) -> NDArray[Any]:
    rows = sum(values[i::n] for i in range(1, n)) + values[::n]
    return sum(rows[:, j::n] for j in range(1, n)) + rows[:, ::n]


def picture_size(path: Path) -> tuple[int, int]:
    """Return width and height of a picture without decoding its pixels."""
    from PIL import Image

    try:
        with Image.open(path) as picture:
            return picture.size
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise HoloreelError(f"{path} cannot be read as a picture ({error}): fetch it again.") from error


def composite(picture: NDArray[np.uint8], background: tuple[float, float, float]) -> NDArray[np.uint8]:
    """Lay a picture over a `background` color (0 to 1), in display-referred values; (H, W, 3)."""
    if picture.shape[2] == 3:
        return picture
    alpha = picture[..., 3:].astype(np.float32) / 255
    blend = picture[..., :3] * alpha + np.float32(255) * np.asarray(background, np.float32) * (1 - alpha)
    return np.clip(blend + 0.5, 0, 255).astype(np.uint8)


def read_depth(path: Path, width: int, height: int) -> NDArray[np.float32]:
    """Read the channel Z of an EXR (or its only one) as (height, width) planar z; infinity where nothing was hit.

    Blender's multilayer files call it `ViewLayer.Depth.Z`, in a part of its own or together with the others.
    """
    import OpenEXR

    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: channel.pixels for part in file.parts for name, channel in part.channels.items()}
    except (OSError, RuntimeError, ValueError, TypeError) as error:
        raise HoloreelError(f"{path} cannot be read as an EXR ({error}): render it again.") from error
    found = [pixels for name, pixels in channels.items() if len(channels) == 1 or name.split(".")[-1] == "Z"]
    if len(found) != 1:
        raise HoloreelError(f"{path} has no channel Z (it has {', '.join(channels) or 'none'}): render it again.")
    depth = np.array(found[0], dtype=np.float32)
    _check_size(path, depth.shape, width, height)
    depth[~(depth < BACKGROUND_DEPTH)] = np.inf
    return depth


def write_depth(path: Path, depth: NDArray[np.float32]) -> None:
    """Write a depth map (H, W) as float32 EXR of one channel Z, atomically; infinity becomes 1e10, as in Cycles."""
    import OpenEXR

    pixels = np.where(np.isfinite(depth), depth, 1e10).astype(np.float32)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with atomic_path(path) as temporary:
        OpenEXR.File(header, {"Z": pixels}).write(str(temporary))


def _check_size(source: object, shape: tuple[int, ...], width: int, height: int, wanted: str = "") -> None:
    if shape[:2] != (height, width):
        raise HoloreelError(
            f"{source} is {shape[1]}x{shape[0]}, its camera says {wanted or f'{width}x{height}'}: "
            "correct w and h, or the picture."
        )
