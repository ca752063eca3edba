# SPDX-License-Identifier: GPL-3.0-or-later
"""Masks: how much of each pixel the subject covers, as gray pictures or videos beside the color."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import HoloreelError
from .images import fit, load_picture
from .media import Media, VideoFrame, read_frame

NOISE = 16  # steps of 255 by which lossy video misses black and white


def read_mask(media: Media, width: int, height: int) -> NDArray[np.uint8]:
    """Read a mask as (height, width), 0 where there is nothing of the subject and 255 where there is nothing else.

    It may be a whole number of times larger. A picture with alpha means its alpha, any other its gray. In videos,
    values within 16 of black and white count as these: compression leaves noise there. Raises `HoloreelError` where
    it cannot be read or has another size.
    """
    if isinstance(media, VideoFrame):
        picture = read_frame(media)
        gray = picture[..., 1].astype(np.int32)
        gray = (gray - NOISE) * 255 // (255 - 2 * NOISE)
        mask = np.clip(gray, 0, 255).astype(np.uint8)
    else:
        picture = load_picture(media)
        mask = picture[..., 3] if picture.shape[2] == 4 else picture[..., 1]
    n = max(mask.shape[0] // height, 1)
    if mask.shape != (n * height, n * width):
        raise HoloreelError(
            f"{media}: the mask is {mask.shape[1]}x{mask.shape[0]}, its picture {width}x{height}; "
            "make the masks from these pictures."
        )
    return fit(np.repeat(mask[..., None], 3, axis=2), width, height, media)[..., 0]


def has_alpha(path: Path) -> bool:
    """Whether a picture's file has an alpha channel; its pixels are not decoded."""
    from PIL import Image

    try:
        with Image.open(path) as picture:
            return "A" in picture.getbands() or "transparency" in picture.info
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise HoloreelError(f"{path} cannot be read as a picture ({error}): fetch it again.") from error


def cut_out(
    picture: NDArray[np.uint8], mask: NDArray[np.uint8], matte: tuple[float, float, float] | None
) -> NDArray[np.uint8]:
    """Return (H, W, 4) with straight alpha of the colors (H, W, 3) and the mask (H, W).

    Where the picture lies over the color `matte` (0 to 1) already, that color is taken out of half-covered pixels, so
    that laying the result over `matte` gives the picture back.
    """
    if matte is None:
        return np.concatenate([picture, mask[..., None]], axis=2)
    alpha = mask[..., None].astype(np.float32) / 255
    below = np.asarray(matte, np.float32) * 255
    color = (picture - below * (1 - alpha)) / np.maximum(alpha, 1 / 255)
    color = np.where(mask[..., None] > 0, np.rint(np.clip(color, 0, 255)), 0).astype(np.uint8)
    return np.concatenate([color, mask[..., None]], axis=2)
