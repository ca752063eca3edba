# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures on disk: 8-bit PNG (and whatever else Pillow reads) and float OpenEXR. Arrays are (H, W, C).

The libraries are imported where they are used, so that importing this module needs numpy alone.
"""

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .errors import HoloreelError
from .files import atomic_path

Image = NDArray[np.float32]


def read_image(path: str | Path) -> Image:
    """Read a picture as (H, W, C) float32 with C of 3 or 4: 8 and 16-bit files in [0, 1], EXR as it is.

    Gray pictures are repeated to RGB. Raises `HoloreelError` where the file is missing or is no picture.
    """
    path = Path(path)
    if path.suffix.lower() == ".exr":
        return read_exr(path)[0]
    pixels = read_pixels(path)
    return pixels.astype(np.float32) / np.float32(np.iinfo(pixels.dtype).max)


def read_pixels(path: str | Path) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Read an 8 or 16-bit picture as the integers it holds, (H, W, 3 or 4); otherwise as `read_image`."""
    import imageio.v3 as iio

    try:
        pixels = iio.imread(path, plugin="pillow")
    except Exception as error:  # Pillow raises what it likes
        raise HoloreelError(f"{path} cannot be read as a picture ({_first_line(error)}): fetch it again.") from error
    if pixels.dtype == np.bool_:  # one bit a pixel, as masks are at times
        pixels = pixels.astype(np.uint8) * 255
    if pixels.dtype not in (np.uint8, np.uint16) or pixels.ndim not in (2, 3):
        raise HoloreelError(f"{path} has pixels of {pixels.dtype} {pixels.shape}: save it as an 8 or 16-bit picture.")
    pixels = np.atleast_3d(pixels)
    if pixels.shape[2] <= 2:  # gray, or gray and alpha
        pixels = np.concatenate([pixels[:, :, :1]] * 3 + [pixels[:, :, 1:]], axis=2)
    return pixels


def write_png(path: str | Path, image: NDArray[np.floating]) -> None:
    """Write (H, W, 3 or 4) values as an 8-bit PNG, atomically; values are clipped to [0, 1] and rounded."""
    import imageio.v3 as iio

    pixels = np.rint(np.clip(np.nan_to_num(image), 0.0, 1.0) * 255.0).astype(np.uint8)
    with atomic_path(path) as temporary:
        iio.imwrite(temporary, pixels, plugin="pillow", extension=".png")


def read_exr(path: str | Path) -> tuple[Image, NDArray[np.float32] | None]:
    """Read an EXR: its RGB or RGBA pixels (H, W, 3 or 4), and its channel Z (H, W) or None.

    Raises `HoloreelError` where the file is missing, damaged, or has no such channels.
    """
    import OpenEXR

    path = Path(path)
    if not path.is_file():
        raise HoloreelError(f"{path} cannot be read (no such file): check the path.")
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.asarray(channel.pixels, np.float32) for name, channel in file.channels().items()}
    except Exception as error:  # the binding raises exceptions of many kinds
        raise HoloreelError(f"{path} cannot be read as OpenEXR ({_first_line(error)}): render it again.") from error
    if not {"R", "G", "B"} <= channels.keys():
        raise HoloreelError(f"{path} has the channels {', '.join(channels)}, but not R, G and B: render it again.")
    names = "RGBA" if "A" in channels else "RGB"
    return np.stack([channels[name] for name in names], axis=2), channels.get("Z")


def write_exr(path: str | Path, image: NDArray[np.floating], depth: NDArray[np.floating] | None = None) -> None:
    """Write (H, W, 3 or 4) values and, if given, depth (H, W) as channel Z; 32-bit float, ZIP, atomically."""
    import OpenEXR

    channels = {name: _plane(image[:, :, index]) for index, name in enumerate("RGBA"[: image.shape[2]])}
    if depth is not None:
        channels["Z"] = _plane(depth)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with atomic_path(path) as temporary, OpenEXR.File(header, channels) as file:
        file.write(str(temporary))


def picture_path(folder: Path, camera: str, frame: str | int, suffix: str = ".png") -> Path:
    """Return FOLDER/CAMERA/FRAME.png: whatever a file calls its cameras, the path stays inside the folder."""
    name = re.sub(r"[^\w.-]", "_", camera).lstrip(".") or "camera"
    return folder / name / (f"{frame:04d}{suffix}" if isinstance(frame, int) else f"{frame}{suffix}")


def write_image(path: str | Path, image: NDArray[np.floating], depth: NDArray[np.floating] | None = None) -> None:
    """Write a PNG or an EXR, as the ending of `path` says; depth goes into an EXR only."""
    match Path(path).suffix.lower():
        case ".png":
            write_png(path, image)
        case ".exr":
            write_exr(path, image, depth)
        case _:
            raise HoloreelError(f"{path}: pictures are written as .png or .exr; choose one of these endings.")


def _plane(values: NDArray[np.floating]) -> NDArray[np.float32]:
    return np.ascontiguousarray(values, dtype=np.float32)


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
