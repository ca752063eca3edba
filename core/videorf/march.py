# SPDX-License-Identifier: GPL-3.0-or-later
"""The compiled ray march, forward and backward. float32, on the processor.

While it trains, call `torch.set_num_threads(1)`: torch's own threads spin between calls and take the cores from the
march.
"""

import ctypes
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..errors import HoloreelError
from .field import DEFAULT_RULES, FieldLattice, Marched, MarchRules, Rays, check_march
from .native import CImages, CLattice, CRays, load_kernels

WIDTHS = (4, 8, 16)  # channels the kernels are built for; others are padded with zeros, at the cost of a copy


class Volume:
    """A lattice made ready for the march: bricks of cells, and every occupied cell's eight rows. Keep it for its
    group.
    """

    def __init__(self, field: FieldLattice) -> None:
        """Raise `HoloreelError` where the lookup names a row that the table does not have."""
        lookup = np.ascontiguousarray(field.lookup, np.int32)
        lattice = field.lattice
        c_lattice = CLattice(
            (ctypes.c_int32 * 3)(*lattice.shape),
            field.rows,
            (ctypes.c_double * 3)(*lattice.lowest),
            lattice.spacing,
            lookup.ctypes.data,
        )
        self.field = field
        self.library = load_kernels()
        self.handle = self.library.videorf_volume_new(c_lattice)
        if not self.handle:
            raise HoloreelError(f"The lattice cannot be used: {self.library.videorf_last_error().decode()}.")

    def __del__(self) -> None:
        if getattr(self, "handle", None):
            self.library.videorf_volume_free(self.handle)

    @property
    def cells(self) -> int:
        """How many cells are occupied."""
        return self.library.videorf_volume_cells(self.handle)


def march(volume: Volume, table: Tensor, rays: Rays, rules: MarchRules = DEFAULT_RULES) -> Marched:
    """Sum the field's features along rays, as `field` says. Gradients reach the table; its last row gets none.

    They are the same bits for any number of threads.
    """
    check_march(volume.field, table, rays)
    channels = table.shape[1]
    plain = Rays(*(None if part is None else plain_tensor(part) for part in rays))  # type: ignore[arg-type]
    accumulated, depth = _March.apply(volume, plain, rules, plain_table(table))
    return Marched(accumulated[:, 1:channels], accumulated[:, 0], depth)


def count_samples(volume: Volume, table: Tensor, rays: Rays, rules: MarchRules = DEFAULT_RULES) -> int:
    """Return how many samples the march of these rays takes, all in occupied cells."""
    check_march(volume.field, table, rays)
    plain = Rays(*(None if part is None else plain_tensor(part) for part in rays))  # type: ignore[arg-type]
    return _forward(volume, plain, rules, plain_table(table.detach()))[2]


def plain_tensor(tensor: Tensor) -> Tensor:
    """Return a tensor as the kernels take it: on the processor, float32, without gaps."""
    return tensor.to("cpu", torch.float32).contiguous()


def plain_table(table: Tensor) -> Tensor:
    """Return a table as the march takes it: of a width it is built for, with zeros behind its own channels."""
    width = next(width for width in WIDTHS if width >= table.shape[1])
    return plain_tensor(
        torch.nn.functional.pad(table, (0, width - table.shape[1])) if width > table.shape[1] else table
    )


def _address(tensor: Tensor | None) -> int | None:
    return None if tensor is None else tensor.data_ptr()


def _c_rays(rays: Rays, rules: MarchRules) -> CRays:
    pointers = map(_address, (rays.origins, rays.directions, rays.jitter))
    return CRays(len(rays.origins), *pointers, rules.step, rules.transmittance_min)


class _Tape:
    """What the kernels wrote down on the way forth."""

    def __init__(self, volume: Volume, handle: int) -> None:
        self.volume, self.handle = volume, handle

    def __del__(self) -> None:
        self.volume.library.videorf_tape_free(self.handle)


def _forward(
    volume: Volume, rays: Rays, rules: MarchRules, table: Tensor, with_tape: bool = False
) -> tuple[Tensor, Tensor, int, _Tape | None]:
    accumulated = torch.empty(len(rays.origins), table.shape[1])
    depth = torch.empty(len(rays.origins))
    images = CImages(_address(accumulated), _address(depth))
    samples, tape = ctypes.c_int64(), ctypes.c_void_p()
    status = volume.library.videorf_forward(
        volume.handle,
        _address(table),
        table.shape[1],
        _c_rays(rays, rules),
        images,
        samples,
        tape if with_tape else None,
    )
    if status != 0:
        raise HoloreelError(f"The rays cannot be marched: {volume.library.videorf_last_error().decode()}.")
    return accumulated, depth, samples.value, _Tape(volume, tape.value) if tape.value else None


class _March(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, volume: Volume, rays: Rays, rules: MarchRules, table: Tensor) -> tuple[Tensor, Tensor]:
        accumulated, depth, _, tape = _forward(volume, rays, rules, table, ctx.needs_input_grad[3])
        ctx.tape, ctx.shape = tape, table.shape
        ctx.set_materialize_grads(False)
        return accumulated, depth

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        if ctx.tape is None:
            raise RuntimeError("the gradient of a march can be taken once: march again")
        tape, ctx.tape = ctx.tape, None
        accumulated, depth = (None if gradient is None else plain_tensor(gradient) for gradient in gradients)
        gradient = torch.empty(ctx.shape)
        images = CImages(_address(accumulated), _address(depth))
        library = tape.volume.library
        if library.videorf_backward(tape.handle, images, _address(gradient)) != 0:
            reason = library.videorf_last_error().decode()
            raise HoloreelError(f"The gradient of the rays cannot be computed: {reason}.")
        return None, None, None, gradient
