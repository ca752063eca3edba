# SPDX-License-Identifier: GPL-3.0-or-later
"""Where the fragments of a fragmented MP4 file lie (ISO/IEC 14496-12). Needs no library."""

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from ..errors import HoloreelError


class Span(NamedTuple):
    """A run of bytes in a file."""

    offset: int
    size: int


def boxes(file: BinaryIO, size: int) -> Iterator[tuple[bytes, Span]]:
    """Yield the kind and place of each top-level box. Raises ValueError where one is cut off or no box."""
    offset = 0
    while offset < size:
        file.seek(offset)
        head = file.read(16)
        length = int.from_bytes(head[:4], "big")
        if length == 1:
            length = int.from_bytes(head[8:16], "big")
        elif length == 0:
            length = size - offset
        if len(head) < 8 or length < 8 or offset + length > size:
            raise ValueError(f"the box at byte {offset} is cut off")
        yield head[4:8], Span(offset, length)
        offset += length


def fragments(path: Path) -> tuple[Span, list[Span]]:
    """Return where the head (ftyp, moov) lies and where each fragment (moof, mdat) does.

    Raises `HoloreelError` where the file is not a whole fragmented MP4.
    """
    head_end = 0
    starts: list[int] = []
    ends: list[int] = []
    try:
        with path.open("rb") as file:
            for kind, span in boxes(file, path.stat().st_size):
                if kind == b"moof":
                    starts.append(span.offset)
                elif kind == b"mdat" and len(starts) == len(ends) + 1:
                    ends.append(span.offset + span.size)
                elif not starts:
                    head_end = span.offset + span.size
    except (OSError, ValueError) as error:
        raise HoloreelError(f"{path} is not a whole MP4 file ({error}): encode it again.") from error
    if not starts or len(starts) != len(ends) or starts[0] != head_end:
        raise HoloreelError(f"{path} is not a fragmented MP4 file: encode it again.")
    return Span(0, head_end), [Span(start, end - start) for start, end in zip(starts, ends, strict=True)]
