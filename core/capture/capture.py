# SPDX-License-Identifier: GPL-3.0-or-later
"""A multi-view recording in memory: who looked, when, and where the pictures lie. Pictures are read one at a time."""

import math
import os
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..errors import HoloreelError
from .images import composite, fit, load_picture, read_depth
from .masks import cut_out, has_alpha, read_mask
from .media import Media, VideoFrame, media_path, read_frame
from .points import Points, read_points

View = tuple[str, int]  # camera name, frame index from 0
Triple = tuple[float, float, float]

SPLITS = ("train", "test")
MAX_FRAMES = 1_000_000


@dataclass(frozen=True, eq=False)
class Capture:
    """Cameras, frames and the files that belong to each pair of them.

    Frames are counted from 0; frame j of `frame_count` happens at the normalized time j / frame_count and is number
    `frame_start + j` on the timeline. Not every camera needs a picture of every frame. Nothing is read before it is
    asked for. Raises `HoloreelError` where the parts contradict each other.
    """

    cameras: dict[str, Camera]  # by name, in order
    images: dict[View, Media]  # a picture's file, or a frame of a video
    frame_count: int = 1
    splits: dict[str, str] = field(default_factory=dict)  # by camera name; "train" where it says nothing
    fps: float = 30.0
    frame_start: int = 1
    depths: dict[View, Path] = field(default_factory=dict)  # EXR, planar z in scene units
    seeds: dict[int, Path] = field(default_factory=dict)  # PLY of colored points, by frame index
    masks: dict[View, Media] = field(default_factory=dict)  # gray pictures or videos, white where the subject is
    matte: Triple | None = None  # the color (0 to 1) that pictures with masks lie over; None: they show what was there
    bounds: tuple[Triple, Triple] | None = None  # lower and upper corner of a box around the subject, all frames
    source: Path = Path("capture")  # the file it was read from, for messages
    title: str = ""  # what it is called, where that is not the name of the folder of `source`
    notes: tuple[str, ...] = ()  # what its reader measured or assumed, in sentences

    def __post_init__(self) -> None:
        problem = self._problem()
        if problem:
            raise HoloreelError(f"{self.source}: {problem}.")

    def _problem(self) -> str:
        if not self.cameras:
            return "there are no cameras; a capture needs at least one"
        if not 1 <= self.frame_count <= MAX_FRAMES:
            return f"frame_count must be 1 to {MAX_FRAMES}, not {self.frame_count}"
        if not (math.isfinite(self.fps) and self.fps > 0):
            return f"fps must be positive, not {self.fps}"
        for name, split in self.splits.items():
            if name not in self.cameras or split not in SPLITS:
                return f"the split {split!r} of camera {name!r} is not possible; it is one of {', '.join(SPLITS)}"
        for name, frame in (*self.images, *self.depths, *self.masks):
            if name not in self.cameras or not 0 <= frame < self.frame_count:
                return f"there is a picture of camera {name!r} at frame {frame}, which the capture does not have"
        if wrong := [frame for frame in self.seeds if not 0 <= frame < self.frame_count]:
            return f"there are seed points of frame {wrong[0]}, which the capture does not have"
        if self.bounds is not None and not _is_box(*self.bounds):
            return f"bounds must be a lower and an upper corner of finite numbers, not {self.bounds}"
        return ""

    @property
    def name(self) -> str:
        """What the capture is called: in results, and in the titles of pages."""
        return self.title or self.source.resolve().parent.name

    @property
    def times(self) -> NDArray[np.float64]:
        """Normalized times of all frames, (frame_count,), in [0, 1)."""
        return np.arange(self.frame_count) / self.frame_count

    def time(self, frame: int) -> float:
        """The normalized time of one frame."""
        return frame / self.frame_count

    def split(self, name: str) -> str:
        """The split of a camera: "train" or "test"."""
        return self.splits.get(name, "train")

    def camera_names(self, split: str | None = None) -> list[str]:
        """The names of the cameras of a split (of all without one), in order."""
        return [name for name in self.cameras if split in (None, self.split(name))]

    def views(self, split: str | None = None) -> list[View]:
        """All (camera name, frame) that have a picture, frame by frame."""
        names = self.camera_names(split)
        return [(name, frame) for frame in range(self.frame_count) for name in names if (name, frame) in self.images]

    def frames(self, start: int, count: int) -> "Capture":
        """The capture of `count` frames from frame `start` on, counted from 0 again; its times span [0, 1) anew."""
        if not 0 <= start < start + count <= self.frame_count:
            raise HoloreelError(
                f"{self.source}: there are no {count} frames from frame {start} on; it has {self.frame_count}."
            )
        kept = range(start, start + count)
        return replace(
            self,
            images={(name, j - start): media for (name, j), media in self.images.items() if j in kept},
            depths={(name, j - start): path for (name, j), path in self.depths.items() if j in kept},
            masks={(name, j - start): media for (name, j), media in self.masks.items() if j in kept},
            seeds={j - start: path for j, path in self.seeds.items() if j in kept},
            frame_count=count,
            frame_start=self.frame_start + start,
        )

    def image(self, name: str, frame: int, background: Triple | None = None) -> NDArray[np.uint8]:
        """Read one picture in its camera's size: (H, W, 3), or (H, W, 4) with straight alpha where the file has alpha.

        Files may be a whole number of times larger than the camera says; they are averaged down. With a `background`
        color (0 to 1) the picture is laid over it and is always (H, W, 3). Masks have no part in this.
        """
        camera, media = self.cameras[name], self.images[name, frame]
        picture = read_frame(media) if isinstance(media, VideoFrame) else load_picture(media)
        if background is not None:
            picture = composite(picture, background)
        return fit(picture, camera.width, camera.height, media)

    @property
    def masked(self) -> bool:
        """Whether every picture tells the subject from the rest, by a mask or its own alpha.

        Of each camera whose pictures have no masks, one picture is looked at.
        """
        bare = {name: media for (name, frame), media in self.images.items() if (name, frame) not in self.masks}
        return all(not isinstance(media, VideoFrame) and has_alpha(media) for media in bare.values())

    def rgba(self, name: str, frame: int) -> NDArray[np.uint8]:
        """Read one picture of the subject alone: (H, W, 4) with straight alpha, from its mask, else its own alpha.

        Raises `HoloreelError` naming camera and frame where there is neither, or where a mask has another size.
        """
        picture, mask = self.image(name, frame), self.masks.get((name, frame))
        if mask is not None:
            camera = self.cameras[name]
            return cut_out(picture[..., :3], read_mask(mask, camera.width, camera.height), self.matte)
        if picture.shape[2] == 4:
            return picture
        raise HoloreelError(
            f"{self.source}: camera {name!r} has no mask at frame {self.frame_start + frame}, and its picture no "
            "transparency; make masks of the subject, or render it over a transparent film."
        )

    def depth(self, name: str, frame: int) -> NDArray[np.float32]:
        """Read one depth map: (H, W) planar z in scene units, infinity where nothing was hit."""
        camera = self.cameras[name]
        return read_depth(self.depths[name, frame], camera.width, camera.height)

    def seed_points(self, frame: int) -> Points:
        """Read the seed points of one frame; none where the capture has no file for it."""
        if frame in self.seeds:
            return read_points(self.seeds[frame])
        return Points(np.empty((0, 3), np.float32), np.empty((0, 3), np.uint8))

    def check_files(self) -> None:
        """Raise `HoloreelError` naming the first file that is missing, and how many more are."""
        media = (*self.images.values(), *self.masks.values())
        paths = dict.fromkeys((*map(media_path, media), *self.depths.values(), *self.seeds.values()))
        missing = [path for path in paths if not os.path.isfile(path)]  # any name that cannot be is no file
        if missing:
            more = f" and {len(missing) - 1} more files" if len(missing) > 1 else ""
            raise HoloreelError(f"{self.source}: {missing[0]}{more} missing; fetch or render the capture again.")


def _is_box(low: Triple, high: Triple) -> bool:
    return all(math.isfinite(a) and math.isfinite(b) and a < b for a, b in zip(low, high, strict=True))
