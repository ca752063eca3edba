# SPDX-License-Identifier: GPL-3.0-or-later
"""What the cameras of a capture see of its subject: the rays to train on, and the box that holds it.

A pixel shows the subject where its alpha exceeds `ALPHA_MIN`; masks of videos are never quite black beside it.
"""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..capture import Capture
from ..errors import HoloreelError
from .hull import SeenMask, carve
from .occupancy import Lattice

ALPHA_MIN = 8  # of 255
BOUNDS_EDGE = 96  # vertices along the longest side, where masks are carved for their bounds
BORDER = 5  # pixels around the subject that are trained on: they are what clears the space beside it

Box = tuple[NDArray[np.float64], NDArray[np.float64]]  # lowest and highest corner


class RayBatch(NamedTuple):
    """Rays to train on: `origins` and unit `directions` (N, 3) in the world, `rgba` (N, 4) in 0..1, straight alpha."""

    origins: Tensor
    directions: Tensor
    rgba: Tensor


class FrameViews:
    """One frame of a capture as training takes it: all rays near the subject, and the masks.

    `origins` and `directions` (P, 3; float32) and `rgba` (P, 4; uint8, straight alpha) are the pixels of all cameras of
    `split` within `border` pixels of the subject, camera by camera, row by row; pixels through which a lens sees
    nothing are left out. `masks` says where each camera sees the subject. The pictures are read once.

    Raises `HoloreelError` where a picture has no alpha and no mask, or no camera sees the subject.
    """

    def __init__(self, capture: Capture, frame: int, split: str | None = "train", border: int = BORDER) -> None:
        if border < 0:
            raise ValueError("border must be 0 or more")
        names = [name for name in capture.camera_names(split) if (name, frame) in capture.images]
        self.frame = frame
        self.number = capture.frame_start + frame  # on the timeline, for messages
        self.masks: dict[str, SeenMask] = {}
        parts = []
        for name in names:
            rgba = capture.rgba(name, frame)
            self.masks[name] = SeenMask(capture.cameras[name], rgba[..., 3] > ALPHA_MIN)
            parts.append(_rays_near(self.masks[name], rgba, border))
        if not any(len(part.rgba) for part in parts):
            raise HoloreelError(
                f"{capture.source}: no camera's mask shows anything in frame {self.number}: give masks that are white "
                "where the subject is, or leave the frame out."
            )
        self.centers = torch.stack([part.origins for part in parts])
        self.camera_of = torch.repeat_interleave(torch.tensor([len(part.rgba) for part in parts]))
        self.directions = torch.cat([part.directions for part in parts])
        self.rgba = torch.cat([part.rgba for part in parts])

    def __len__(self) -> int:
        return len(self.rgba)

    @property
    def origins(self) -> Tensor:
        """Where each ray starts (P, 3): its camera's center."""
        return self.centers[self.camera_of]

    def sample(self, count: int, generator: torch.Generator | None = None) -> RayBatch:
        """Return `count` rays drawn with replacement."""
        return self.rays(torch.randint(len(self), (count,), generator=generator))

    def rays(self, chosen: Tensor | slice) -> RayBatch:
        """Return the rays of the pool at the places `chosen`."""
        rgba = self.rgba[chosen].float().div_(255)
        return RayBatch(self.centers[self.camera_of[chosen]], self.directions[chosen], rgba)


def _rays_near(seen: SeenMask, rgba: NDArray[np.uint8], border: int) -> RayBatch:
    """Return the rays within `border` pixels of a mask; `origins` is one point, `rgba` bytes."""
    pixels = np.flatnonzero(grow(seen.mask, border))
    column, row = pixels % seen.mask.shape[1], pixels // seen.mask.shape[1]
    _, directions = seen.camera.rays(np.stack((column + 0.5, row + 0.5), 1))
    visible = np.isfinite(directions).all(1)
    return RayBatch(
        torch.from_numpy(seen.camera.center.astype(np.float32)),
        torch.from_numpy(directions[visible].astype(np.float32)),
        torch.from_numpy(rgba.reshape(-1, 4)[pixels[visible]]),
    )


def grow(mask: NDArray[np.bool_], border: int) -> NDArray[np.bool_]:
    """Return the mask and all pixels within `border` columns and rows of it."""
    from scipy.ndimage import maximum_filter

    return maximum_filter(mask, 2 * border + 1, mode="constant") if border else mask


def subject_bounds(capture: Capture) -> Box:
    """Return the lowest and the highest corner of a box that holds the subject in all frames.

    That is the capture's own box where it has one. Otherwise the masks of all frames are laid over each other, camera
    by camera. Their bounding rectangles leave a pyramid each, the part of the world inside all pyramids has a box (six
    linear programs), and the box around what the masks then leave of it, carved, is the answer.
    Raises `HoloreelError` where no such part exists, or it has no end.
    """
    if capture.bounds is not None:
        low, high = capture.bounds
        return np.asarray(low, np.float64), np.asarray(high, np.float64)
    seen = [_united(capture, name) for name in capture.camera_names("train")]
    seen = [one for one in seen if one.mask.any()]
    sides = [planes for planes in map(_pyramid, seen) if planes is not None]
    box = _box_inside(np.concatenate(sides)) if sides else None
    if box is None or not (box[1] > box[0]).all():
        raise _unbounded(capture)
    lattice = Lattice.around(*box, BOUNDS_EDGE)
    found = np.argwhere(carve(seen, lattice))
    if not len(found):
        raise _unbounded(capture)
    return np.maximum(lattice.positions(found.min(0)), box[0]), np.minimum(lattice.positions(found.max(0)), box[1])


def _unbounded(capture: Capture) -> HoloreelError:
    return HoloreelError(
        f"{capture.source}: the masks do not enclose a subject that all cameras see (masks that miss it, a wrong "
        "calibration, or too few cameras): mend them, or give the subject's bounds."
    )


def _united(capture: Capture, name: str) -> SeenMask:
    """Return what a camera's masks of all frames show, together."""
    camera = capture.cameras[name]
    mask = np.zeros((camera.height, camera.width), bool)
    for frame in range(capture.frame_count):
        if (name, frame) in capture.images:
            mask |= capture.rgba(name, frame)[..., 3] > ALPHA_MIN
    return SeenMask(camera, mask)


def _pyramid(seen: SeenMask) -> NDArray[np.float64] | None:
    """Return four planes (4, 4), n · x <= d, around all that a mask shows; None where they do not bound it."""
    camera = seen.camera
    row, column = np.nonzero(grow(seen.mask, 1))  # the far side of the pixels at the rim
    _, directions = camera.rays(np.stack((column + 0.5, row + 0.5), 1))
    local = directions @ camera.world_to_camera[:3, :3].T
    if not (local[:, 2] > 1e-3).all():
        return None  # the subject surrounds the camera, or the lens sees nothing there
    slopes = local[:, :2] / local[:, 2:]
    low, high = slopes.min(0), slopes.max(0)
    normals = np.array([[1, 0, -high[0]], [-1, 0, low[0]], [0, 1, -high[1]], [0, -1, low[1]]])
    normals = normals @ camera.world_to_camera[:3, :3]
    return np.concatenate((normals, (normals @ camera.center)[:, None]), 1)


def _box_inside(planes: NDArray[np.float64]) -> Box | None:
    """Return the box around the points that lie inside all planes (N, 4); None where there is none, or no end to it."""
    from scipy.optimize import linprog

    ends = []
    for goal in (*np.eye(3), *-np.eye(3)):
        found = linprog(goal, planes[:, :3], planes[:, 3], bounds=(None, None))
        if found.status != 0:
            return None
        ends.append(float(found.x @ goal))
    return np.array(ends[:3]), -np.array(ends[3:])
