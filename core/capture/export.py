# SPDX-License-Identifier: GPL-3.0-or-later
"""What the writers of all layouts share: pictures and videos of any capture, written one by one and never twice.

A file that exists already is taken for written (each appears only when it is whole), so that a stopped export goes on.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..errors import HoloreelError
from ..files import atomic_path
from .capture import Capture, Triple
from .images import composite
from .resample import LensMap, lens_map, same_lens

Picture = NDArray[np.uint8]
Content = Callable[[Capture, str, int], Picture]  # what is written of a view (camera, frame), before any lens
_QUALITY = "10"  # x264's constant rate factor: the difference to the source is under the pictures' own noise
_FORMATS: dict[str, dict[str, Any]] = {
    ".png": {"compress_level": 3},  # zlib's: twice as fast as the usual 6, a few percent larger
    ".jpg": {"quality": 98, "subsampling": 0},  # colors at full resolution
}


@dataclass
class Export:
    """How an export is done, and what it has to tell."""

    background: Triple = (0.0, 0.0, 0.0)  # behind transparent pictures, where a layout has no alpha
    on_progress: Callable[[int, int], None] | None = None  # pictures done, and all
    rectify: float | None = None  # make pinholes of lenses with distortion, with this share of their focal length
    notes: list[str] = field(default_factory=list)  # sentences about what the layout could not hold

    def lenses(self, capture: Capture) -> dict[str, Camera]:
        """Return the cameras to write, by name: those of `capture`, rectified where that is asked for."""
        return {
            name: camera if self.rectify is None or camera.model == "PINHOLE" else pinhole(camera, self.rectify)
            for name, camera in capture.cameras.items()
        }

    def part(self, index: int, count: int) -> "Export":
        """The same export for one of `count` equal parts of the work, counted from 0; notes go to the same list."""
        return replace(self, on_progress=lambda done, total: self.show(index * total + done, count * total))

    def show(self, done: int, total: int) -> None:
        """Report progress to whoever listens."""
        if self.on_progress:
            self.on_progress(done, total)


def pinhole(camera: Camera, share: float = 1.0) -> Camera:
    """The camera without distortion, otherwise the same, with `share` of the focal length."""
    return replace(camera, model="PINHOLE", distortion=(), fx=camera.fx * share, fy=camera.fy * share)


def write_text(path: Path, text: str) -> None:
    """Write a text file, atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def file_names(capture: Capture) -> dict[str, str]:
    """Return a file name (without ending) for each camera: its own name, without what no file may have."""
    names = {name: re.sub(r"[^\w.-]", "_", name).lstrip(".") or "camera" for name in capture.cameras}
    if len(set(names.values())) < len(names):
        names = {name: f"cam{index:02d}" for index, name in enumerate(capture.cameras)}
    return names


def numbered(capture: Capture, names: Sequence[str], held_out: Sequence[str]) -> dict[str, str]:
    """Return which of `names`, one for each camera, each camera gets, in the order of `names`.

    Held-out cameras get the names in `held_out`, as far as both go, or the first one where it has none of `names`: what
    readers of a layout hold out by default. All others get the remaining names in order.
    """
    places = [name for name in held_out if name in names] or names[:1]
    test = capture.camera_names("test")
    given = dict(zip(places, test, strict=False))
    others = iter([*test[len(given) :], *capture.camera_names("train")])
    return {given[name] if name in given else next(others): name for name in names}


def over(background: Triple) -> Content:
    """The pictures, over a color where they are transparent."""
    return lambda capture, name, frame: capture.image(name, frame, background)


def with_alpha(capture: Capture, name: str, frame: int) -> Picture:
    """The picture with straight alpha, from its mask where it has one; without alpha where it has neither."""
    masked = (name, frame) in capture.masks
    return capture.rgba(name, frame) if masked else capture.image(name, frame)


def subject_over(background: Triple) -> Content:
    """The subject alone over a color, from masks or transparency."""
    return lambda capture, name, frame: composite(capture.rgba(name, frame), background)


def subject_alpha(capture: Capture, name: str, frame: int) -> Picture:
    """How much of each pixel the subject covers, (H, W, 1)."""
    return capture.rgba(name, frame)[..., 3:]


def subject_mask(capture: Capture, name: str, frame: int) -> Picture:
    """How much of each pixel the subject covers, as gray (H, W, 3)."""
    return np.repeat(subject_alpha(capture, name, frame), 3, axis=2)


def check_complete(capture: Capture, cameras: Iterable[str], what: str) -> None:
    """Raise `HoloreelError` naming the first picture that is not there of these cameras, for `what` needs all."""
    lacking = [(name, j) for j in range(capture.frame_count) for name in cameras if (name, j) not in capture.images]
    if lacking:
        name, frame = lacking[0]
        raise HoloreelError(
            f"{capture.source}: camera {name!r} has no picture of frame {capture.frame_start + frame}, and {what} "
            "needs all of them; take the frames that all cameras have by --frames."
        )


def write_pictures(
    capture: Capture,
    targets: Mapping[str, Camera],
    place: Callable[[str, int], Path],
    export: Export,
    content: Content | None = None,
) -> None:
    """Write every view as the PNG or JPEG `place(camera, frame)`, seen through the lens of its camera in `targets`.

    `content` is what is shown, without it the pictures over the export's background.
    """
    _note_lenses(capture, targets, export)
    views = [(name, j) for name in targets for j in range(capture.frame_count) if (name, j) in capture.images]
    lens = _Lenses(capture, targets)
    for done, (name, frame) in enumerate(views):
        export.show(done, len(views))
        path = place(name, frame)
        if not path.is_file():
            _write_picture(path, lens.picture(name, frame, content or over(export.background)))
    export.show(len(views), len(views))


def write_videos(
    capture: Capture,
    targets: Mapping[str, Camera],
    places: Mapping[str, Path],
    export: Export,
    content: Content | None = None,
    unseen: int = 0,
) -> None:
    """Write one H.264 video per camera, seen through its lens in `targets`; every camera must have all frames.

    `content` is what is shown, without it the pictures over the export's background; what a lens did not see becomes
    the gray `unseen`.
    """
    _note_lenses(capture, targets, export)
    check_complete(capture, targets, "a video")
    total = len(targets) * capture.frame_count
    lens = _Lenses(capture, targets)

    def pictures(start: int, name: str) -> Iterator[Picture]:
        for frame in range(capture.frame_count):
            export.show(start + frame, total)
            yield lens.picture(name, frame, content or over(export.background), unseen)

    for index, name in enumerate(targets):
        if not places[name].is_file():
            size = targets[name].width, targets[name].height
            encode_video(places[name], size, capture.fps, pictures(index * capture.frame_count, name))
        export.show((index + 1) * capture.frame_count, total)


def encode_video(path: Path, size: tuple[int, int], fps: float, pictures: Iterable[Picture]) -> None:
    """Write (H, W, 3) pictures of `size` (width, height) as H.264 in MP4, atomically.

    Colors are kept at full resolution (4:4:4), in BT.709, and the file says so.
    """
    import av

    rate = Fraction(fps).limit_denominator(1001)
    with atomic_path(path) as temporary, av.open(str(temporary), "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=rate, options={"crf": _QUALITY, "preset": "medium"})
        stream.pix_fmt = "yuv444p"
        stream.width, stream.height = size
        context = stream.codec_context
        context.color_range, context.colorspace, context.color_primaries, context.color_trc = 1, 1, 1, 1
        for picture in pictures:
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            for packet in stream.encode(
                frame.reformat(format="yuv444p", dst_colorspace="ITU709", dst_color_range="MPEG")
            ):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)


class _Lenses:
    """Reads pictures of a capture and shows them through other lenses; keeps the map of the camera at work."""

    def __init__(self, capture: Capture, targets: Mapping[str, Camera]) -> None:
        self._capture, self._targets = capture, targets
        self._name = ""
        self._map: LensMap | None = None

    def picture(self, name: str, frame: int, content: Content, unseen: int = 0) -> Picture:
        picture = content(self._capture, name, frame)
        if self._name != name:
            source, target = self._capture.cameras[name], self._targets[name]
            self._name, self._map = name, None if same_lens(source, target) else lens_map(source, target)
        return picture if self._map is None else self._map.apply(picture, unseen)


def _note_lenses(capture: Capture, targets: Mapping[str, Camera], export: Export) -> None:
    changed = [name for name in targets if not same_lens(capture.cameras[name], targets[name])]
    note = (
        f"Pictures of {len(changed)} of {len(targets)} cameras are resampled: the layout cannot describe their lenses."
    )
    if changed and export.rectify is None and note not in export.notes:
        export.notes.append(note)


def _write_picture(path: Path, picture: Picture) -> None:
    """Write (H, W, 1, 3 or 4) in the format that the path's suffix says."""
    import imageio.v3 as iio

    pixels = picture[..., 0] if picture.shape[2] == 1 else picture
    with atomic_path(path) as temporary:
        iio.imwrite(temporary, pixels, plugin="pillow", extension=path.suffix, **_FORMATS[path.suffix])
