# SPDX-License-Identifier: GPL-3.0-or-later
"""Frames of videos, read exactly and by number. PyAV is imported when the first video is opened.

Frame i of a video is the i-th in the order of presentation, which is the order a player shows and a decoder returns
them in. The timestamps of all frames are read once per file without decoding anything; a frame is found by its
timestamp after a jump to the keyframe before it, and an unexpected timestamp is an error, never another frame.

Colors become 8-bit RGB with the range and the matrix that the file names; where it names no matrix, BT.601, as FFmpeg
and OpenCV do. Pictures are turned the way the file's display matrix says (phones held upright), as players do.
"""

import os
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import HoloreelError

if TYPE_CHECKING:
    import av

MAX_PIXELS = 1 << 27  # of one frame
MAX_FRAMES = 1_000_000
OPEN_VIDEOS = 4  # decoders kept ready for random access; one of 1352x1014 takes about 30 MB

_AHEAD = 4  # frames that are decoded and dropped rather than jumped over
_OPTIONS = {
    "protocol_whitelist": "file",  # no list of other files, no address
    "format_whitelist": "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg,h264,hevc,ivf,obu,flv,asf,ogg,mxf,nut",
}
_MATRICES = {1: 1, 4: 4, 5: 5, 6: 5, 7: 7, 9: 9, 10: 9}  # FFmpeg's AVCOL_SPC to swscale's numbers
_BT601 = 5
_FULL_RANGE = 2


class VideoFrame(NamedTuple):
    """One frame of a video file, numbered from 0."""

    path: Path
    index: int  # type: ignore[assignment]  # hides tuple.index, which nobody needs here

    def __str__(self) -> str:
        return f"{self.path} (frame {self.index})"


Media = Path | VideoFrame  # a picture's file, or a frame of a video


def media_path(media: Media) -> Path:
    """The file that holds a picture."""
    return media.path if isinstance(media, VideoFrame) else media


@dataclass(frozen=True, eq=False)
class VideoFacts:
    """What is known of a video without decoding all of it. Width and height are those of the pictures as shown."""

    width: int
    height: int
    frames: int
    fps: float
    times: NDArray[np.float64]  # (frames,) seconds, as the file says, increasing


@dataclass(frozen=True)
class _Index:
    """Where the frames of a file lie."""

    path: Path
    pts: tuple[int, ...] | None  # of every frame, increasing; None where the file has none: frames are counted then
    keys: tuple[int, ...]  # numbers of the frames that can be jumped to, increasing
    facts: VideoFacts


def probe(path: str | Path) -> VideoFacts:
    """Look into a video: its size, frames and rate. Raises `HoloreelError` for files that are none or too large."""
    return _index_of(Path(path)).facts


def keyframes(path: str | Path) -> tuple[int, ...]:
    """The numbers of the frames that reading can start at without decoding others; none where nobody knows."""
    return _index_of(Path(path)).keys


def read_frame(frame: VideoFrame) -> NDArray[np.uint8]:
    """Read one frame as (H, W, 3); nearby and following frames of a few videos are quick to read next."""
    with _pool_lock:
        decoder = _pool.pop(frame.path, None)
        index = _index_of(frame.path)
        if decoder is None or decoder.index is not index:
            decoder = _Decoder(index)
        picture = decoder.read(frame.index)  # a decoder that fails is not kept
        _pool[frame.path] = decoder
        while len(_pool) > OPEN_VIDEOS:
            _pool.popitem(last=False)[1].close()
    return picture


def iterate(path: str | Path, start: int = 0, count: int | None = None) -> Iterator[NDArray[np.uint8]]:
    """Yield `count` frames (default: all that are left) from frame `start` on, each (H, W, 3), decoded once."""
    index = _index_of(Path(path))
    stop = index.facts.frames if count is None else start + count
    decoder = _Decoder(index)
    try:
        for number in range(start, stop):
            yield decoder.read(number)
    finally:
        decoder.close()


_pool: "OrderedDict[Path, _Decoder]" = OrderedDict()  # least recently used first
_pool_lock = Lock()


class _Decoder:
    """An open video that remembers where it is."""

    def __init__(self, index: _Index):
        from av.video.reformatter import VideoReformatter

        self.index, self.next = index, 0  # the number of the frame that decoding on would return
        self._reformatter = VideoReformatter()
        self._open()

    def _open(self) -> None:
        self._container, self._stream = _open(self.index.path)
        self._frames = self._container.decode(self._stream)
        self.next = 0

    def close(self) -> None:
        """Give the file back."""
        self._container.close()

    def read(self, number: int) -> NDArray[np.uint8]:
        """Return one frame, decoding on where that is near, jumping where it is not."""
        import av

        facts = self.index.facts
        if not 0 <= number < facts.frames:
            raise HoloreelError(f"{self.index.path} has {facts.frames} frames, and no frame {number} (from 0).")
        try:
            frame = self._counted(number) if self.index.pts is None else self._timed(number, self.index.pts)
            picture = _to_rgb(frame, self._reformatter)
        except (av.FFmpegError, OSError, ValueError, EOFError) as error:
            self.close()
            raise _damaged(self.index.path, number, str(error)) from error
        if picture.shape != (facts.height, facts.width, 3):
            self.close()
            raise _damaged(
                self.index.path, number, f"it is {picture.shape[1]}x{picture.shape[0]} in a video of {facts.width}x"
                f"{facts.height}"
            )  # fmt: skip
        return picture

    def _counted(self, number: int) -> "av.VideoFrame":
        if number < self.next:
            self.close()
            self._open()
        for frame in self._frames:
            self.next += 1
            if self.next > number:
                return frame
        raise EOFError("the video ends before it")

    def _timed(self, number: int, pts: tuple[int, ...]) -> "av.VideoFrame":
        import av

        at = bisect_right(self.index.keys, number) - 1
        near = self.next <= number and (at < 0 or self.index.keys[at] <= self.next + _AHEAD)
        while True:
            try:
                if not near:
                    self._jump(pts[self.index.keys[at]] if at >= 0 else None)
                for frame in self._frames:
                    if frame.pts == pts[number]:
                        self.next = number + 1
                        return frame
                    if frame.pts is None or frame.pts > pts[number]:
                        break  # the jump went too far
            except av.FFmpegError:
                if not near:  # on the way from another frame, the damage may lie before this one
                    raise
            if not near and at < 0:
                raise ValueError("there is no frame at its timestamp")
            at, near = at if near else at - 1, False

    def _jump(self, pts: int | None) -> None:
        """Go to the keyframe at a timestamp, or back to the beginning."""
        if pts is None:
            self.close()
            self._open()
        else:
            self._container.seek(pts, stream=self._stream)
            self._frames = self._container.decode(self._stream)


def _open(path: Path) -> tuple["av.container.InputContainer", "av.VideoStream"]:
    """Open a video for reading on one thread: others have work for the rest of the cores."""
    import av

    container = av.open(f"file:{os.path.abspath(path)}", options=_OPTIONS)
    if not container.streams.video:
        container.close()
        raise ValueError("there is no video in it")
    stream = container.streams.video[0]
    stream.codec_context.thread_count = 1
    width, height = stream.codec_context.width, stream.codec_context.height
    if not (width > 0 and height > 0 and width * height <= MAX_PIXELS):
        container.close()
        raise ValueError(f"its frames are {width}x{height}")
    return container, stream


def _index_of(path: Path) -> _Index:
    try:
        found = os.stat(path)
    except (OSError, ValueError) as error:
        raise HoloreelError(f"{path} cannot be read (no such file): check the path.") from error
    return _indexed(path, found.st_mtime_ns, found.st_size)


@lru_cache(maxsize=1024)
def _indexed(path: Path, _modified: int, _size: int) -> _Index:
    import av

    try:
        return _scan(path)
    except (av.FFmpegError, OSError, ValueError, EOFError) as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise HoloreelError(f"{path} cannot be read as a video ({reason}): fetch or encode it again.") from error


def _scan(path: Path) -> _Index:
    """Decode one frame for its true size, and read the timestamps of all others."""
    container, stream = _open(path)
    with container:
        first = next(container.decode(stream), None)
        if first is None:
            raise ValueError("no frame can be decoded")
        rate, unit = stream.average_rate or stream.guessed_rate, stream.time_base
    sideways = first.rotation % 180 != 0
    width, height = (first.height, first.width) if sideways else (first.width, first.height)
    shown: list[tuple[int | None, bool]] = []
    container, stream = _open(path)
    with container:
        for packet in container.demux(stream):
            if packet.size and not packet.is_discard:
                shown.append((packet.pts, packet.is_keyframe))
            if len(shown) > MAX_FRAMES:
                raise ValueError(f"it has more than {MAX_FRAMES} frames")
    timed = sorted((pts, key) for pts, key in shown if pts is not None)
    pts = [pts for pts, _ in timed]
    keys = tuple(number for number, (_, key) in enumerate(timed) if key)
    fps = float(rate) if rate else 0.0
    if unit is not None and len(pts) > 1 and not fps:
        fps = (len(pts) - 1) / max(float((pts[-1] - pts[0]) * unit), 1e-9)
    if not 0 < fps < 1e6:
        raise ValueError("it does not say how many frames a second has")
    if unit is None or first.pts is None or not len(set(pts)) == len(pts) == len(shown):
        return _Index(path, None, (), VideoFacts(width, height, len(shown), fps, np.arange(len(shown)) / fps))
    times = np.array(pts, np.float64) * float(unit)
    return _Index(path, tuple(pts), keys, VideoFacts(width, height, len(shown), fps, times))


def _to_rgb(frame: "av.VideoFrame", reformatter: Any) -> NDArray[np.uint8]:
    from av.video.reformatter import Interpolation

    flags = Interpolation.BILINEAR | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT
    color = {} if frame.format.is_rgb else {"src_colorspace": _MATRICES.get(frame.colorspace, _BT601)}
    rgb = reformatter.reformat(
        frame, format="rgb24", interpolation=int(flags), dst_color_range=_FULL_RANGE, threads=1, **color
    )
    picture = rgb.to_ndarray()
    turns = round(frame.rotation / 90) % 4
    return np.ascontiguousarray(np.rot90(picture, turns)) if turns else picture


def _damaged(path: Path, number: int, reason: str) -> HoloreelError:
    reason = (reason.strip().splitlines() or ["it is damaged"])[0]
    return HoloreelError(f"{path}: frame {number} cannot be read ({reason}): fetch or encode the video again.")
