# SPDX-License-Identifier: GPL-3.0-or-later
"""Feature videos: lumas through a video codec, one fragment of an MP4 file per group of frames (Sec. 4.3).

Pictures are yuv420p with all data in the luma and neutral chroma, 0 ... 255 throughout (full range). Each group starts
with an IDR frame and refers to nothing before it, and frames come in the order they are shown: any group decodes from
the file's head and its own fragment alone. Rungs of one training differ in the constant QP only. PyAV is imported when
it is needed.
"""

import hashlib
import io
import os
import zlib
from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import HoloreelError
from ..files import atomic_path
from .mp4 import Span, boxes, fragments

RUNGS = (16, 20, 24, 28, 32, 36)  # QP
NEUTRAL = 128
THREADS = "4"  # x264 decides by it where motion may point: fixed, so that every machine writes the same file
# All frames of a rung have the same QP (`ipratio`), and nothing is smoothed across blocks that hold unrelated vertices:
# with a slower preset these take 11 to 17 % off the bytes at equal quality. Vertices keep their pixels, so nothing
# moves, and the shortest search (`me`) will do.
_H264 = "keyint=infinite:scenecut=0:open-gop=0:ref=3:bframes=0:weightp=0:ipratio=1.0:no-deblock=1:me=dia:fullrange=on"
# x265 is tuned for the eye: without these it spends half as much again as x264, with them 4 to 7 % less.
_HEVC = (
    "keyint=-1:scenecut=0:open-gop=0:bframes=0:range=full:aq-mode=0:ipratio=1.0:no-deblock=1:no-sao=1:cutree=0"
    ":psy-rd=0:psy-rdoq=0:rd=6:tskip=1:ctu=32:max-tu-size=8:log-level=error"
)
# Feature images are more like a screen (`scm`) than a photograph. Even so, AV1 spends a third more than x264.
_AV1 = "rc=0:keyint=-1:scd=0:pred-struct=1:aq-mode=0:color-range=1:scm=1:enable-cdef=0:enable-restoration=0:lp=2"
FULL_RANGE = 2  # AVCOL_RANGE_JPEG


class Codec(NamedTuple):
    """An encoder of FFmpeg and its options, where `{qp}` stands for the rung; the tag in the file, the largest QP."""

    encoder: str
    options: dict[str, str]
    tag: str
    qp_max: int


CODECS = {
    "h264": Codec(
        "libx264",
        {"preset": "slower", "qp": "{qp}", "tune": "psnr", "aq-mode": "0", "forced-idr": "1", "x264-params": _H264},
        "avc1",
        51,
    ),
    "hevc": Codec("libx265", {"preset": "slow", "forced-idr": "1", "x265-params": _HEVC + ":qp={qp}"}, "hvc1", 51),
    "av1": Codec("libsvtav1", {"preset": "2", "svtav1-params": _AV1 + ":qp={qp}"}, "av01", 63),
}


class CodedGroup(NamedTuple):
    """A group's fragment: `frames` frames from `first` on, its bytes, and what tells whether they are the right
    ones.

    `sha256` is of the fragment's bytes; `luma_crc32` of the first frame's decoded luma, row by row, which also tells a
    player whether its own decoder leaves the values alone.
    """

    first: int
    frames: int
    offset: int
    size: int
    sha256: str
    luma_crc32: int


class CodedVideo(NamedTuple):
    """A video file: its size, its head, a fragment per group."""

    size: int
    head: Span
    groups: tuple[CodedGroup, ...]


def check_rung(qp: int, codec: str) -> None:
    """Raise `HoloreelError` where a codec is unknown or has no such QP, or this machine has no encoder for it."""
    import av

    if codec not in CODECS:
        raise HoloreelError(f"The codec '{codec}' is unknown: take one of {', '.join(CODECS)}.")
    if not 0 <= qp <= CODECS[codec].qp_max:
        raise HoloreelError(f"A QP of {qp} is out of range: take 0 to {CODECS[codec].qp_max} for {codec}.")
    encoder = CODECS[codec].encoder
    try:
        av.codec.Codec(encoder, "w")
    except av.codec.codec.UnknownCodecError as error:
        raise HoloreelError(
            f"PyAV has no {encoder} here, so no {codec} can be encoded: take another codec, or the PyAV of PyPI."
        ) from error


def code_lumas(lumas: Sequence[NDArray[np.uint8]], qp: int, codec: str = "h264") -> tuple[list[NDArray[np.uint8]], int]:
    """Encode the lumas (H, W) of one group in memory; return them decoded, and the bytes of the fragment."""
    check_rung(qp, codec)
    if not lumas:
        raise ValueError("a group has at least one frame")
    file = io.BytesIO()
    _write(file, lumas, {0}, 30.0, qp, CODECS[codec])
    data = file.getvalue()
    head = next(span.offset for kind, span in boxes(file, len(data)) if kind == b"moof")
    return list(_decode(data, lumas[0].shape)), len(data) - head


def encode_video(
    path: Path,
    lumas: Iterable[NDArray[np.uint8]],
    counts: Sequence[int],
    *,
    fps: float,
    qp: int,
    codec: str = "h264",
    meaning: str = "",
) -> CodedVideo:
    """Write the lumas (H, W) of groups with `counts` frames each to `path`, atomically, and return where they lie.

    `meaning` is the digest of what a reel makes of the pictures: the video's head carries it as its comment.
    Raises `HoloreelError` for an unknown codec, a QP out of range, or more or fewer lumas than the groups have.
    """
    check_rung(qp, codec)
    if not counts or min(counts) < 1:
        raise ValueError("every group has at least one frame")
    firsts = np.concatenate(([0], np.cumsum(counts)[:-1])).tolist()
    with atomic_path(path) as temporary:
        frames = _write(temporary, lumas, set(firsts), fps, qp, CODECS[codec], meaning)
        if frames != sum(counts):
            raise HoloreelError(f"{path}: {frames} frames came for groups of {sum(counts)}; encode all of them.")
        head, spans = fragments(temporary)
        if len(spans) != len(counts):
            raise HoloreelError(f"{path}: the encoder cut {len(spans)} groups, not {len(counts)}; try another codec.")
        groups = []
        with temporary.open("rb") as file:
            start = file.read(head.size)
            for first, count, span in zip(firsts, counts, spans, strict=True):
                part = file.read(span.size)
                crc = zlib.crc32(next(_decode(start + part, None)).tobytes())
                groups.append(CodedGroup(first, count, *span, hashlib.sha256(part).hexdigest(), crc))
            if file.read(1):
                raise HoloreelError(f"{path}: the encoder wrote more than its groups; try another codec.")
    return CodedVideo(spans[-1].offset + spans[-1].size, head, tuple(groups))


def _write(
    file: Path | io.BytesIO,
    lumas: Iterable[NDArray[np.uint8]],
    heads: set[int],
    fps: float,
    qp: int,
    codec: Codec,
    meaning: str = "",
) -> int:
    import av

    os.environ.setdefault("SVT_LOG", "1")  # SVT-AV1 has no other way to be told to report errors alone
    rate = Fraction(fps).limit_denominator(1001)
    options = {name: value.format(qp=qp) for name, value in codec.options.items()} | {"threads": THREADS}
    # Frame by frame into the file: `frag_keyframe` cuts a fragment before every key frame, and only heads are key
    # frames.
    flags = {"movflags": "frag_keyframe+empty_moov+default_base_moof+skip_trailer"}
    target = str(file) if isinstance(file, Path) else file
    with av.open(target, "w", format="mp4", container_options=flags) as container:
        container.metadata["comment"] = meaning
        stream: Any = None
        index = -1
        for index, luma in enumerate(lumas):
            if stream is None:
                stream = container.add_stream(codec.encoder, rate=rate, options=options)
                stream.height, stream.width = luma.shape
                stream.pix_fmt = "yuv420p"
                stream.codec_context.color_range = FULL_RANGE
                stream.codec_context.codec_tag = codec.tag
            frame = _frame(luma)
            frame.pts, frame.time_base = index, 1 / rate
            if index in heads:
                frame.pict_type = av.video.frame.PictureType.I
            container.mux(stream.encode(frame))
        if stream is not None:
            container.mux(stream.encode(None))
    return index + 1


def _frame(luma: NDArray[np.uint8]) -> Any:
    import av

    height, width = luma.shape
    frame = av.VideoFrame(width, height, "yuv420p")
    frame.color_range = FULL_RANGE
    plane = frame.planes[0]
    padded = np.zeros((height, plane.line_size), np.uint8)
    padded[:, :width] = luma
    plane.update(padded.tobytes())
    for chroma in frame.planes[1:]:
        chroma.update(bytes([NEUTRAL]) * (chroma.line_size * chroma.height))
    return frame


def _decode(data: bytes, picture: tuple[int, int] | None) -> Iterator[NDArray[np.uint8]]:
    """Yield the lumas of an MP4 file; ValueError where it is no full-range picture of the size (height, width)."""
    import av

    try:
        with av.open(io.BytesIO(data), "r", format="mp4") as container:
            stream = container.streams.video[0]
            size = stream.codec_context.height, stream.codec_context.width
            if picture is not None and size != picture:
                raise ValueError(f"its pictures are {size[1]} x {size[0]}, not {picture[1]} x {picture[0]}")
            stream.thread_type = "AUTO"
            for frame in container.decode(stream):
                if frame.format.name not in ("yuv420p", "yuvj420p"):
                    raise ValueError(f"its pixels are {frame.format.name}, not yuv420p")
                if frame.color_range != FULL_RANGE:
                    raise ValueError("its luma is of limited range, not 0 to 255")
                if (frame.height, frame.width) != size:
                    raise ValueError("its pictures change their size")
                plane = frame.planes[0]
                rows = np.frombuffer(memoryview(plane), np.uint8).reshape(-1, plane.line_size)
                yield rows[: frame.height, : frame.width].copy()
    except (av.error.FFmpegError, IndexError) as error:
        raise ValueError(f"it does not decode ({error})") from error


class FeatureVideo:
    """Any luma of a feature video, in any order; frames in order cost one decode each, the same one again none."""

    def __init__(self, path: Path, video: CodedVideo, picture: tuple[int, int], meaning: str = "") -> None:
        """Open a video whose lumas are `picture` (height, width), and whose head should carry `meaning`.

        Raises `HoloreelError` where the file is missing.
        """
        self.path, self.video, self.picture, self.meaning = path, video, picture, meaning
        try:
            self.size = path.stat().st_size
        except OSError as error:
            raise HoloreelError(f"{path} cannot be read ({error.strerror}): put it beside its reel.") from error
        self._group: CodedGroup | None = None
        self._frames: Iterator[NDArray[np.uint8]] = iter(())
        self._next = 0
        self._latest: NDArray[np.uint8] | None = None

    def missing(self) -> list[CodedGroup]:
        """Return the groups that a file cut off does not hold in full; the others can be played."""
        return [group for group in self.video.groups if group.offset + group.size > self.size]

    def luma(self, frame: int) -> NDArray[np.uint8]:
        """Return the decoded luma (H, W) of a frame, counted from 0.

        Raises `HoloreelError` where the file is cut off before the frame, was encoded again or to a limited range, or
        does not hold what its reel says.
        """
        group = next((group for group in self.video.groups if 0 <= frame - group.first < group.frames), None)
        if group is None:
            raise HoloreelError(f"{self.path} has no frame {frame}: take 0 to {self._count() - 1}.")
        if group is self._group and frame == self._next - 1 and self._latest is not None:
            return self._latest
        if group is not self._group or frame < self._next:
            self._start(group)
        try:
            while True:
                luma = next(self._frames, None)
                if luma is None:
                    raise ValueError(f"the group from frame {group.first} on has {self._next - group.first} frames")
                self._next += 1
                if self._next == group.first + 1 and zlib.crc32(luma.tobytes()) != group.luma_crc32:
                    raise ValueError("its decoded luma is not the one that was encoded")
                if self._next > frame:
                    self._latest = luma
                    return luma
        except ValueError as error:
            self._group = None
            raise HoloreelError(f"{self.path} is not as its reel says ({error}): fetch the original file.") from error

    def _count(self) -> int:
        return sum(group.frames for group in self.video.groups)

    def _start(self, group: CodedGroup) -> None:
        self._group, self._next, self._latest = group, group.first, None
        self._frames = _decode(self._head() + self._fragment(group), self.picture)

    def check(self, group: CodedGroup) -> None:
        """Raise `HoloreelError` where a group's bytes are not those that were encoded; decodes nothing."""
        self._head()
        self._fragment(group)

    def _head(self) -> bytes:
        head = self._read(self.video.head)
        if self.meaning.encode() not in head:
            raise HoloreelError(
                f"{self.path} was not encoded for the lattice, ranges, tiles and shading network that its reel says: "
                "fetch both again."
            )
        return head

    def _fragment(self, group: CodedGroup) -> bytes:
        if group.offset + group.size > self.size:
            last = group.first + group.frames - 1
            raise HoloreelError(
                f"{self.path} is cut off: frames {group.first} to {last} are not whole; fetch the rest of it."
            )
        part = self._read(Span(group.offset, group.size))
        if hashlib.sha256(part).hexdigest() != group.sha256:
            raise HoloreelError(
                f"{self.path} is not the file that was encoded{self._suspicion()}: fetch the original file."
            )
        return part

    def _read(self, span: Span) -> bytes:
        try:
            with self.path.open("rb") as file:
                file.seek(span.offset)
                return file.read(span.size)
        except OSError as error:
            raise HoloreelError(f"{self.path} cannot be read ({error.strerror}): put it beside its reel.") from error

    def _suspicion(self) -> str:
        """Say what became of a file whose bytes are not the right ones, as far as that can be told."""
        try:
            import av
        except ImportError:  # Blender's Python has no PyAV
            return ": it was damaged, cut, or encoded again"
        try:
            with av.open(str(self.path)) as container:
                frame = next(container.decode(video=0))
                limited = frame.color_range != FULL_RANGE
        except (av.error.FFmpegError, StopIteration, IndexError):
            return ", and does not decode"
        return ": it was encoded again to a limited range" if limited else ": it was damaged, cut, or encoded again"
