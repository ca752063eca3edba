# SPDX-License-Identifier: GPL-3.0-or-later
"""The files that hold Gaussians, by their endings, and the decoders that lie beside them. Needs numpy only."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from ..errors import HoloreelError
from .compact import read_compact, write_compact
from .decoder import Activation, Decoder, decoder_path, read_decoder, read_pt
from .model import SpacetimeGaussians
from .ply import read_ply, write_ply
from .splatv import read_splatv


class Payload(NamedTuple):
    """How one kind of file is read (to a model and sentences about it) and written; a reel is not made of all kinds."""

    read: Callable[[Path], tuple[SpacetimeGaussians, list[str]]]
    write: Callable[[Path, SpacetimeGaussians], None] | None


PAYLOADS: dict[str, Payload] = {
    ".ply": Payload(read_ply, write_ply),
    ".stgc": Payload(read_compact, write_compact),
    ".splatv": Payload(read_splatv, None),
}


def read_payload(path: Path) -> tuple[SpacetimeGaussians, list[str]]:
    """Read the Gaussians of one file; `path` has one of the endings of `PAYLOADS`."""
    return PAYLOADS[path.suffix.lower()].read(path)


def write_payload(path: Path, gaussians: SpacetimeGaussians) -> None:
    """Write the Gaussians of one segment, atomically; `path` ends in `.ply` or `.stgc`."""
    write = PAYLOADS[path.suffix.lower()].write
    if write is None:
        raise ValueError(f"{path} is no payload of a reel")
    write(path, gaussians)


def find_decoder(
    path: Path, gaussians: SpacetimeGaussians, output: Activation | None = None
) -> tuple[Decoder | None, list[str]]:
    """Return the decoder of a bare file, from `NAME.decoder.safetensors` or `NAME.pt` beside it, and what to say of it.

    A `.pt` does not say what its network ends in: `output`, or sigmoid where that is None. Raises `HoloreelError` where
    the file beside it is damaged, or `output` has nothing to say here.
    """
    ours, theirs = decoder_path(path), path.with_suffix(".pt")
    full = gaussians.variant == "full"
    if full and ours.is_file():
        found = read_decoder(ours)
        if output not in (None, found.activation):
            raise HoloreelError(f"{ours} says that its output is {found.activation}: leave --decoder-output away.")
        return found, []
    if full and theirs.is_file():
        try:
            decoder = read_pt(theirs, output or "sigmoid")
        except ImportError:
            return None, [
                f"{theirs.name} cannot be read where PyTorch is not installed: the base color stands for the color."
            ]
        return decoder, [] if output else [
            f"{theirs.name} does not say what its decoder ends in: a sigmoid is assumed (Neural 3D Video; "
            "--decoder-output clamp for Technicolor, none for Immersive)."
        ]
    if output is not None:
        raise HoloreelError(f"{path} has no decoder beside it ({theirs.name}): leave --decoder-output away.")
    return None, [
        f"{path.name} is a full model without its decoder ({theirs.name}): the base color stands for the color."
    ] if full else []
