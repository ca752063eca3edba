# SPDX-License-Identifier: GPL-3.0-or-later
"""Rectified copies of a capture's pictures, for what knows pinholes alone."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..camera import Camera
from ..errors import HoloreelError
from ..images import picture_path, write_png
from .capture import Capture, View
from .media import Media
from .resample import lens_map

MAX_FIELD_DEGREES = 170.0  # to either side together; a wider pinhole is mostly stretched border


def pinhole_of(camera: Camera, focal: float = 1.0) -> Camera:
    """The PINHOLE at a camera's place, of its size and principal point, with `focal` times its focal lengths.

    A `focal` under 1 takes in more of a wide lens (the paper's data: 0.36 for a fisheye, in twice the size).
    """
    pinhole = replace(camera, model="PINHOLE", distortion=(), fx=camera.fx * focal, fy=camera.fy * focal)
    if focal <= 0 or 2 * np.degrees(np.arctan(camera.width / 2 / pinhole.fx)) > MAX_FIELD_DEGREES:
        raise HoloreelError(
            f"camera {camera.name!r}: a pinhole of {focal:g} times its focal length is wider than "
            f"{MAX_FIELD_DEGREES:g} degrees; give a larger focal length."
        )
    return pinhole


def undistort_capture(
    capture: Capture,
    out: str | Path,
    focal: float = 1.0,
    on_progress: Callable[[int, int], None] | None = None,
) -> Capture:
    """Write pictures of cameras with distortion as their `pinhole_of` sees them, and return the capture of those.

    PNGs go to OUT/CAMERA/FRAME.png, black where the lens saw nothing; those that are there already are kept. Pictures
    of PINHOLE cameras stay where they are. Depth maps and masks of rectified cameras are left out, as their pixels lie
    elsewhere; seed points hold as before.
    """
    distorted = {name: camera for name, camera in capture.cameras.items() if camera.model != "PINHOLE"}
    cameras = capture.cameras | {name: pinhole_of(camera, focal) for name, camera in distorted.items()}
    images: dict[View, Media] = dict(capture.images)
    views = sorted((view for view in images if view[0] in distorted), key=lambda view: (view[0], view[1]))
    lens = None
    for done, (name, frame) in enumerate(views):
        if on_progress:
            on_progress(done, len(views))
        path = picture_path(Path(out), name, capture.frame_start + frame)
        if not path.is_file():
            if lens is None or lens[0] != name:  # views come camera by camera: one map at a time
                lens = name, lens_map(distorted[name], cameras[name])
            write_png(path, lens[1].apply(capture.image(name, frame)).astype(np.float32) / 255)
        images[name, frame] = path
    depths = {view: path for view, path in capture.depths.items() if view[0] not in distorted}
    masks = {view: media for view, media in capture.masks.items() if view[0] not in distorted}
    return replace(capture, cameras=cameras, images=images, depths=depths, masks=masks)
