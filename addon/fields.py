# SPDX-License-Identifier: GPL-3.0-or-later
"""VideoRF reels as Blender objects: one point cloud with the vertices of all groups, and the movie beside the reel.

The points say where each vertex lies, in the world and in the movie; the modifier reads the movie frame by frame, from
where it lies. The .blend holds the points, never the movie.
"""

import os
import zlib
from contextlib import suppress
from fractions import Fraction
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import HoloreelError
from ..core.videorf.codec import FeatureVideo
from ..core.videorf.decode import find_rung, frames_text, rung_name, rung_order
from ..core.videorf.mapping import MappingTable
from ..core.videorf.package import VideoReel
from ..core.videorf.shading import Shading
from .attributes import Kind
from .compat import get_input, new_point_cloud, set_input
from .nodes.decoder import fits
from .nodes.field import FIRST, LAST, NAME, POINT_SIZE, UV, field_reel, plays
from .nodes.library import is_tagged
from .reels import INFO, MODIFIER, follow_scene, modifier_of, set_timeline
from .timeline import Timeline

NON_COLOR = "Non-Color"
SEEKING_TOLERANCE = 2e-3  # of a frame, at the end of the movie
MAX_POINTS = 100_000_000  # of all groups together: 32 bytes each

Columns = dict[str, tuple[Kind, NDArray[np.float32]]]


def add_field_reel(
    context: bpy.types.Context,
    reel: VideoReel,
    *,
    timeline: Timeline,
    name: str,
    rung: int | str | None = None,
) -> bpy.types.Object:
    """Return a new object that plays a VideoRF by `timeline`, in the context's collection.

    `rung` is as in `find_rung`: None takes the best one that is there. Raises `HoloreelError` where a payload is
    missing, damaged, or of another training, and where Blender decodes the movie to other values; then nothing is
    added.
    """
    shading = reel.shade()
    columns = point_columns(reel)
    chosen, report = _available_rung(reel, rung)
    movie, frames = _load_movie(reel, chosen)
    if frames < reel.frame_count:
        lost = frames_text(list(range(frames, reel.frame_count)))
        report.append(f"{reel.rungs[chosen].file} is cut off: {lost} cannot be shown; fetch the rest of it.")
    created = _create(context, name, columns, reel, shading)
    set_timeline(created, timeline)
    set_input(modifier_of(created), "Point Size", POINT_SIZE)
    _set_movie(created, movie, frames)
    follow_scene(created)
    if not fits(shading.shape):
        report.append(
            f"The network has {shading.shape.hidden} hidden units, too many for nodes: colors are only a hint here, "
            "the Holoreel engine draws the true ones."
        )
    created[INFO] = {
        "source": str(reel.path),
        "kind": "videorf",
        "fps": reel.fps,
        "frame_count": reel.frame_count,
        "points": len(created.data.points),
        "groups": len(reel.groups),
        "rung": rung_name(reel.rungs[chosen]),
        "report": "\n".join(report),
    }
    return created


def set_rung(played: bpy.types.Object, reel: VideoReel, rung: int | str | None = None) -> str:
    """Let an object play another rung of its reel, or the same one of a reel that was moved; returns its name.

    Raises `HoloreelError` where the movie is missing, damaged, or of another training than the object's points.
    """
    modifier = field_modifier(played)
    if modifier is None:
        raise HoloreelError(f"object '{played.name}' plays no VideoRF: choose one that does.")
    if not plays(modifier.node_group, reel):
        raise HoloreelError(f"{reel.path} is of another training than object '{played.name}': import it anew.")
    chosen, _ = _available_rung(reel, rung)
    _set_movie(played, *_load_movie(reel, chosen))
    info = dict(played.get(INFO, {}))
    played[INFO] = {**info, "source": str(reel.path), "rung": rung_name(reel.rungs[chosen])}
    return rung_name(reel.rungs[chosen])


def field_modifier(played: bpy.types.Object | None) -> bpy.types.NodesModifier | None:
    """Return the modifier that plays a VideoRF; None if the object plays none."""
    modifier = modifier_of(played)
    return modifier if modifier is not None and is_tagged(modifier.node_group, NAME) else None


def movie_of(played: bpy.types.Object) -> bpy.types.Image | None:
    """Return the movie that an object plays; None if it has none."""
    modifier = field_modifier(played)
    return None if modifier is None else get_input(modifier, "Movie")


def movie_problem(played: bpy.types.Object) -> str | None:
    """Say in a sentence why an object that plays a VideoRF has nothing to play; None if all is well."""
    modifier = field_modifier(played)
    if modifier is None:
        return None
    movie = get_input(modifier, "Movie")
    if movie is None:
        return "No movie is chosen: take the reel's .mp4"
    path = Path(bpy.path.abspath(movie.filepath, library=movie.library))
    if not path.is_file():
        return f"{path.name} is missing: put it back, or find it"
    return None


def point_columns(reel: VideoReel) -> Columns:
    """Return the attributes of the points: the vertices of all groups, one group after the other.

    `position` is in the reel's world; `field_uv` is the middle of the pixel of channel 0 in the movie's picture, v up;
    `field_first` and `field_last` are the frames of the vertex's group, counted from 0.
    """
    count = sum(group.vertices for group in reel.groups)
    if count > MAX_POINTS:
        raise HoloreelError(f"{reel.path} has {count:,} points in all groups, too many for one object: split the reel.")
    places, uvs = np.empty((count, 3), np.float32), np.zeros((count, 3), np.float32)
    first, last = np.empty(count, np.float32), np.empty(count, np.float32)
    start = 0
    for index, (entry, frame) in enumerate(zip(reel.groups, reel.firsts, strict=True)):
        rows = slice(start, start + entry.vertices)
        table = reel.table(index)
        places[rows] = reel.lattice.positions(table.vertices)
        uvs[rows, :2] = _uv(table, reel.tiling.picture)
        first[rows], last[rows] = frame, frame + entry.frames - 1
        start = rows.stop
    return {
        "position": (Kind.VECTOR, places),
        UV: (Kind.VECTOR, uvs),
        FIRST: (Kind.FLOAT, first),
        LAST: (Kind.FLOAT, last),
    }


def _uv(table: MappingTable, picture: tuple[int, int]) -> NDArray[np.float64]:
    row, column = np.divmod(table.pixels, table.size[1])
    return np.stack(((column + 0.5) / picture[1], 1.0 - (row + 0.5) / picture[0]), 1)


def rungs_of(reel: VideoReel) -> list[tuple[str, str, int]]:
    """Return name, file and size of the rungs that are there, the one that plays by itself first."""
    return [
        (rung_name(rung), rung.file, rung.video.size)
        for rung in (reel.rungs[place] for place in rung_order(reel))
        if (reel.path.parent / rung.file).is_file()
    ]


def _available_rung(reel: VideoReel, wanted: int | str | None) -> tuple[int, list[str]]:
    """Return the rung to play; the best one that is there, and a sentence about it, if it is not the reel's best."""
    best = find_rung(reel, wanted)
    missing = f"{reel.path}: its movie '{reel.rungs[best].file}' is missing"
    if (reel.path.parent / reel.rungs[best].file).is_file():
        return best, []
    there = rungs_of(reel)
    if wanted is not None or not there:
        raise HoloreelError(f"{missing}; put it beside the reel.")
    return find_rung(reel, there[0][0]), [f"{missing}: rung {there[0][0]} is shown instead."]


def _set_movie(played: bpy.types.Object, movie: bpy.types.Image, frames: int) -> None:
    modifier = modifier_of(played)
    set_input(modifier, "Movie", movie)
    set_input(modifier, "Movie Frames", frames)


def _load_movie(reel: VideoReel, rung: int) -> tuple[bpy.types.Image, int]:
    """Return the image data-block of a rung's movie, one for all objects that play it, and how many frames it holds.

    They are fewer than the reel's where it is cut off; all that is there must be what was encoded.
    """
    video = reel.video(rung)
    whole = video.video.groups[: len(video.video.groups) - len(video.missing())]
    for group in whole or video.video.groups:
        video.check(group)
    try:
        fresh = bpy.data.images.load(str(video.path))
    except RuntimeError as error:
        raise HoloreelError(f"{video.path} cannot be opened as a movie ({error}): fetch it again.") from error
    fresh.colorspace_settings.name = NON_COLOR
    fresh.alpha_mode = "NONE"
    problem = _decoding_problem(fresh, reel, video)
    held = next((image for image in bpy.data.images if image != fresh and _is_movie(image, video.path)), None)
    if held is not None or problem is not None:
        bpy.data.images.remove(fresh)
    elif bpy.data.is_saved:
        with suppress(ValueError):  # on another drive
            fresh.filepath = bpy.path.relpath(str(video.path))  # so that folders can be moved with all that is in them
    if problem is not None:
        raise HoloreelError(f"{video.path}: Blender {problem}.")
    if held is not None:
        held.reload()  # the file may have come back, or be another one by now
    return held or fresh, sum(group.frames for group in whole)


def _decoding_problem(movie: bpy.types.Image, reel: VideoReel, video: FeatureVideo) -> str | None:
    """Say what Blender makes of a movie that it does not show as it was encoded; None if all is well."""
    if _first_crc(movie, video.picture) != video.video.groups[0].luma_crc32:
        return "decodes other values than were encoded; take a rung of another codec, or fetch the original file"
    clip = bpy.data.movieclips.load(str(video.path))
    taken = clip.fps
    bpy.data.movieclips.remove(clip)
    # It seeks by time, and takes the rate of some short movies for the nearest usual one.
    rate = Fraction(reel.fps).limit_denominator(1001)
    if abs(taken / rate - 1) * reel.frame_count > SEEKING_TOLERANCE:
        return f"takes it for {taken:g} frames per second, it has {float(rate):g}; give the reel another rate"
    return None


def _is_movie(image: bpy.types.Image, path: Path) -> bool:
    same = os.path.realpath(bpy.path.abspath(image.filepath, library=image.library)) == os.path.realpath(path)
    return same and image.library is None and image.colorspace_settings.name == NON_COLOR


def _first_crc(movie: bpy.types.Image, picture: tuple[int, int]) -> int | None:
    """Return the CRC-32 of the first picture's luma; None where it is not `picture` (height, width) large.

    The data-block must be new: one that was played gives the picture that it showed last.
    """
    width, height = movie.size
    if (height, width) != picture:
        return None
    pixels = np.empty(height * width * 4, np.float32)
    movie.pixels.foreach_get(pixels)
    red = pixels.reshape(height, width, 4)[::-1, :, 0]
    return zlib.crc32(np.rint(red * 255).astype(np.uint8).tobytes())


def _create(
    context: bpy.types.Context, name: str, columns: Columns, reel: VideoReel, shading: Shading
) -> bpy.types.Object:
    group = field_reel(reel, shading)
    created = new_point_cloud(context, name, len(columns["position"][1]))
    attributes = created.data.attributes
    for column, (kind, _) in columns.items():  # all are created before any is filled: creating one may move the others
        if column not in attributes:
            attributes.new(column, kind.type_name, "POINT")
    for column, (kind, values) in columns.items():
        attributes[column].data.foreach_set(kind.property_name, values.ravel())
    modifier = created.modifiers.new(MODIFIER, "NODES")
    modifier.node_group = group
    return created
