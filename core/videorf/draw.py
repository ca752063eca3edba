# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures of a field: march, deferred shading and compositing for every pixel of a camera."""

from ctypes import c_float
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..camera import Camera
from . import reference
from .deferred import DeferredShading, composite
from .field import DEFAULT_RULES, FieldLattice, MarchRules, Rays, check_march
from .march import Volume, plain_table
from .native import CNetwork, CPicture, CView, call
from .shading import Shading

Triple = tuple[float, float, float]

QUALITY = {"full": MarchRules(0.5, 1e-4), "fast": MarchRules(1.0, 1e-3), "draft": MarchRules(2.0, 1e-2)}
WHITE: Triple = (1.0, 1.0, 1.0)
CHUNK = 1 << 13  # rays that the torch twin marches at once


class FieldDrawing(NamedTuple):
    """`image` (H, W, 3) over the background, `alpha` (H, W), `depth` (H, W): mean planar z, inf where alpha is 0."""

    image: NDArray[np.float32]
    alpha: NDArray[np.float32]
    depth: NDArray[np.float32]


def draw_field(
    volume: Volume,
    table: Tensor,
    shading: Shading,
    camera: Camera,
    rules: MarchRules = DEFAULT_RULES,
    background: Triple = WHITE,
) -> FieldDrawing:
    """Draw a table (N + 1, C) of a prepared lattice as a camera sees it, through any lens, on the processor.

    Pixels where the lens sees nothing show the background. Raises `HoloreelError` where the network takes other
    features than the table has.
    """
    table = table.detach()
    check_march(volume.field, table, Rays(torch.zeros(0, 3), torch.zeros(0, 3)))
    padded, shape = plain_table(table), shading.shape
    origins, directions = camera_rays(camera)
    weights = np.concatenate([part.ravel() for layer in shading.layers for part in layer]).astype(np.float32)
    size = (camera.height, camera.width)
    drawing = FieldDrawing(np.empty((*size, 3), np.float32), np.empty(size, np.float32), np.empty(size, np.float32))
    forward = camera.world_to_camera[2, :3]
    frequencies = -1 if shape.frequencies is None else shape.frequencies
    call(
        "videorf_draw",
        volume.handle,
        padded.data_ptr(),
        padded.shape[1],
        CNetwork(shape.features, frequencies, shape.hidden, weights.ctypes.data),
        CView(
            camera.width,
            camera.height,
            origins.ctypes.data,
            directions.ctypes.data,
            rules.step,
            rules.transmittance_min,
            (c_float * 3)(*forward),
            (c_float * 3)(*background),
        ),
        CPicture(*(part.ctypes.data for part in drawing)),
    )
    return drawing


@torch.no_grad()
def draw_field_torch(
    field: FieldLattice,
    table: Tensor,
    shading: Shading,
    camera: Camera,
    rules: MarchRules = DEFAULT_RULES,
    background: Triple = WHITE,
    chunk: int = CHUNK,
) -> FieldDrawing:
    """Draw as `draw_field` does, in plain torch on the table's device, `chunk` rays at a time."""
    table, device = table.detach(), table.device
    origins, directions = (torch.from_numpy(part) for part in camera_rays(camera))
    network = DeferredShading.of(shading).to(device)
    color = torch.tensor(background, dtype=torch.float32, device=device)
    forward = torch.tensor(camera.world_to_camera[2, :3], dtype=torch.float32, device=device)
    image, alpha, depth = torch.empty(len(origins), 3), torch.empty(len(origins)), torch.empty(len(origins))
    for first in range(0, len(origins), chunk):
        part = slice(first, first + chunk)
        o, d = origins[part].to(device), directions[part].to(device)
        seen = torch.isfinite(d).all(-1)
        d = torch.where(seen[:, None], d, forward)
        marched = reference.march(field, table, Rays(o, d), rules)
        left = torch.where(seen, marched.transmittance.float(), 1.0)
        image[part] = composite(network(marched.features.float(), d), left, color).cpu()
        alpha[part] = (1 - left).cpu()
        along = (d * forward).sum(-1) * marched.depth.float() / (1 - left)
        depth[part] = torch.where(left < 1, along, torch.inf).cpu()
    size = (camera.height, camera.width)
    return FieldDrawing(image.reshape(*size, 3).numpy(), alpha.reshape(size).numpy(), depth.reshape(size).numpy())


@lru_cache(maxsize=2)
def camera_rays(camera: Camera) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the origins and unit directions (H · W, 3) of a camera's pixels, row by row; NaN where it sees nothing."""
    origins, directions = camera.rays()
    return origins.astype(np.float32), directions.astype(np.float32)
