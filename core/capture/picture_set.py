# SPDX-License-Identifier: GPL-3.0-or-later
"""What the pictures of a dataset must have in common with its cameras, checked before any is decoded."""

from ..errors import HoloreelError
from .capture import Capture
from .images import picture_size
from .media import VideoFrame


def check_pictures(capture: Capture) -> None:
    """Raise `HoloreelError` naming the first picture or mask that is missing, damaged, or not of its camera's size.

    They may be a whole number of times larger than their camera says, as `Capture.image` has it.
    """
    capture.check_files()
    for (name, _), media in (*capture.images.items(), *capture.masks.items()):
        if isinstance(media, VideoFrame):
            continue
        camera, (width, height) = capture.cameras[name], picture_size(media)
        times = max(width // camera.width, 1)
        if (width, height) != (times * camera.width, times * camera.height):
            raise HoloreelError(
                f"{media} is {width}x{height}, but camera {name!r} is {camera.width}x{camera.height} in "
                f"{capture.source}; fetch the pictures and cameras that belong together."
            )
