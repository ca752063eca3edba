# SPDX-License-Identifier: GPL-3.0-or-later
"""ActorsHQ (Işık et al., 2023; https://github.com/synthesiaresearch/humanrf): people cut out, 160 cameras around them.

A sequence's folder has a folder for each size, 1x, 2x and 4x, which holds calibration.csv, rgbs/CAM/CAM_rgbFFFFFF.jpg
and masks/CAM/CAM_maskFFFFFF.png. calibration.csv has a row per camera: name, size w h in pixels, camera-to-world
rotation vector rx ry rz, center tx ty tz in meters (axes are OpenCV's), then focal lengths fx fy and principal point
px py as shares of width and height; pixel centers lie at +0.5. Beside the sizes, aabbs.csv has the subject's box in
each frame. What else lies there (light_annotations.csv, scene.json, occupancy_grids, meshes) is not read.

JPEGs have no transparency: theirs lie over black. HumanRF's loader multiplies pictures by their masks, its drawings
are black where nothing is, and its evaluation compares them with the JPEGs as they are.
"""

import re
from functools import partial
from pathlib import Path

import numpy as np

from ..camera import MAX_COORDINATE, Camera, invert_rigid
from ..errors import HoloreelError
from ..files import write_json
from .capture import MAX_FRAMES, Capture, Triple, View
from .export import (
    Export,
    check_complete,
    numbered,
    pinhole,
    subject_alpha,
    subject_over,
    write_pictures,
    write_text,
)  # fmt: skip
from .media import Media
from .options import CaptureOptions
from .picture_set import check_pictures
from .rotations import matrix_from_vector, vector_from_matrix
from .tables import numbers_of, read_table

CALIBRATION = "calibration.csv"
BOXES = "aabbs.csv"
BLACK = (0.0, 0.0, 0.0)
FPS = 25.0  # no file says so; the paper does
_HERO = "Cam127"  # the one portrait that HumanRF's evaluation looks at, every third frame
_TURNS = tuple(f"Cam{i:03d}" for i in (1, 64, 98, 31, 14, 71, 115, 25, 85, 44, 65, 104, 58))  # by turns, every fifth
HELD_OUT = tuple(sorted((*_TURNS, _HERO)))
_NUMBERS = ("w", "h", "rx", "ry", "rz", "tx", "ty", "tz", "fx", "fy", "px", "py")
_BOX = ("frame_number", "aabb_min_x", "aabb_min_y", "aabb_min_z", "aabb_max_x", "aabb_max_y", "aabb_max_z")
_NAME = re.compile(r"[\w-]{1,64}")
_OWN_NAME = re.compile(r"Cam\d{3}")
_ACTOR = re.compile(r"Actor\d+")
_SIZE = re.compile(r"(\d{1,2})x")
_MAX_CAMERAS = 10_000


def matches(path: Path) -> bool:
    """Whether the folder is a sequence's, or that of one of its sizes."""
    return _is_size(path) or bool(_sizes(path))


def _is_size(folder: Path) -> bool:
    return (folder / CALIBRATION).is_file() or (folder / "rgbs").is_dir()


def _sizes(path: Path) -> list[Path]:
    """The folders 1x, 2x, … of a sequence, the finest first."""
    named = [(int(match[1]), folder) for folder in path.glob("*x") if (match := _SIZE.fullmatch(folder.name))]
    return [folder for _, folder in sorted(named) if _is_size(folder)]


def read(path: Path, options: CaptureOptions) -> Capture:
    """Read one size of a sequence: `path` itself, else the finest one in it that has pictures."""
    notes, folder = [], path
    if not _is_size(path):
        sizes = _sizes(path)
        folder = next((size for size in sizes if any(size.glob("rgbs/*/*.jpg"))), sizes[0])
        if len(sizes) > 1:
            listed = ", ".join(size.name for size in sizes)
            notes.append(
                f"{path} has the sizes {listed}; {folder.name} is read: name one of these folders for another."
            )
    file = folder / CALIBRATION
    known, pictures = _cameras(file), _pictures(folder / "rgbs")
    if extra := [name for name in pictures if name not in known]:
        raise HoloreelError(
            f"{folder / 'rgbs' / extra[0]} has pictures of a camera without a row in {CALIBRATION}: fetch the files of "
            "one sequence."
        )
    cameras = {name: camera for name, camera in known.items() if name in pictures}
    if absent := [name for name in known if name not in pictures]:
        more = f" and {len(absent) - 5} more" if len(absent) > 5 else ""
        notes.append(f"{folder}: no pictures of {', '.join(absent[:5])}{more}; these cameras are left out.")
    every = {number for frames in pictures.values() for number in frames}
    chosen = options.choose_frames(folder, range(min(every), max(every) + 1))
    if len(chosen) > MAX_FRAMES:
        raise HoloreelError(f"{folder}: {len(chosen)} frames are more than {MAX_FRAMES}; take a part by --frames.")
    wanted = [(name, j, number) for j, number in enumerate(chosen) for name in cameras]
    if missing := [(name, number) for name, _, number in wanted if number not in pictures[name]]:
        more = f" and {len(missing) - 1} more pictures are" if len(missing) > 1 else " is"
        raise HoloreelError(
            f"{_place(folder, 'rgb', *missing[0])}{more} missing; fetch what is missing, or choose other --frames."
        )
    sequence = folder.absolute().parent
    images: dict[View, Media] = {(name, j): pictures[name][number] for name, j, number in wanted}
    masks: dict[View, Media] = {(name, j): _place(folder, "mask", name, number) for name, j, number in wanted}
    capture = Capture(
        cameras=cameras,
        images=images,
        frame_count=len(chosen),
        fps=options.fps or FPS,
        frame_start=chosen.start,
        masks=masks,
        matte=BLACK,
        bounds=_bounds(sequence / BOXES, chosen),
        source=file,
        title=f"{sequence.parent.name}_{sequence.name}" if _ACTOR.fullmatch(sequence.parent.name) else sequence.name,
        notes=tuple(notes),
    )
    check_pictures(capture)
    return capture


def _place(folder: Path, kind: str, name: str, number: int) -> Path:
    """Where the picture ("rgb") or the mask ("mask") of a camera lies in the folder of a size."""
    return folder / f"{kind}s" / name / f"{name}_{kind}{number:06d}.{'jpg' if kind == 'rgb' else 'png'}"


def _pictures(folder: Path) -> dict[str, dict[int, Path]]:
    """The pictures by camera and frame number; cameras whose folders are empty are left out."""
    if not folder.is_dir():
        raise HoloreelError(
            f"{folder} is missing: pictures lie there as CAM/CAM_rgbFFFFFF.jpg; fetch the missing files."
        )
    found: dict[str, dict[int, Path]] = {}
    for inside in sorted(folder.iterdir()):
        picture = re.compile(re.escape(inside.name) + r"_rgb(\d{6,7})\.jpg")
        files = inside.iterdir() if inside.is_dir() else ()
        if numbers := {int(match[1]): file for file in files if (match := picture.fullmatch(file.name))}:
            found[inside.name] = numbers
    if not found:
        raise HoloreelError(f"{folder} holds no pictures CAM/CAM_rgbFFFFFF.jpg: fetch the missing files.")
    return found


def _cameras(file: Path) -> dict[str, Camera]:
    """The cameras by name, in the order of the file."""
    rows = read_table(file, ("name", *_NUMBERS))
    if not 1 <= len(rows) <= _MAX_CAMERAS:
        raise HoloreelError(f"{file} must have a row for each camera, up to {_MAX_CAMERAS}: fetch it again.")
    cameras: dict[str, Camera] = {}
    for line, row in enumerate(rows, start=2):
        where, name = f"{file}: line {line}", row["name"]
        if not _NAME.fullmatch(name):
            raise HoloreelError(f"{where}: the name {name[:64]!r} is no camera's, such as Cam001: fetch it again.")
        if name in cameras:
            raise HoloreelError(f"{where} is a second one of {name}: fetch it again.")
        cameras[name] = _camera(where, name, numbers_of(file, line, row, _NUMBERS))
    return cameras


def _camera(where: str, name: str, numbers: list[float]) -> Camera:
    width, height, rx, ry, rz, tx, ty, tz, fx, fy, px, py = numbers
    if not (0 < px < 1 and 0 < py < 1):
        raise HoloreelError(
            f"{where}: the principal point ({px:g}, {py:g}) must lie within 0 and 1, as shares of width and height: "
            "fetch it again."
        )
    pose = np.eye(4)
    try:
        pose[:3, :3] = matrix_from_vector((rx, ry, rz))
        pose[:3, 3] = tx, ty, tz
        return Camera(
            width,  # type: ignore[arg-type]  # checked to be whole by Camera
            height,  # type: ignore[arg-type]
            fx * width,
            fy * height,
            px * width,
            py * height,
            invert_rigid(pose),
            name=name,
        )
    except (HoloreelError, ValueError) as error:
        raise HoloreelError(f"{where}: {str(error).rstrip('.')}: fetch it again.") from error


def _bounds(file: Path, chosen: range) -> tuple[Triple, Triple] | None:
    """The box around all boxes of the chosen frames; None where the file is not there."""
    if not file.is_file():
        return None
    boxes: dict[float, list[float]] = {}
    for line, row in enumerate(read_table(file, _BOX), start=2):
        number, *box = numbers_of(file, line, row, _BOX)
        if (
            not all(low < high for low, high in zip(box[:3], box[3:], strict=True))
            or max(map(abs, box)) > MAX_COORDINATE
        ):
            raise HoloreelError(f"{file}: line {line}: aabb_min must be smaller than aabb_max: fetch it again.")
        boxes[number] = box
    if lacking := [number for number in chosen if number not in boxes]:
        raise HoloreelError(f"{file} has no row for frame {lacking[0]}: fetch it again, or take it away.")
    every = np.array([boxes[number] for number in chosen])
    low_x, low_y, low_z = every[:, :3].min(axis=0).tolist()
    high_x, high_y, high_z = every[:, 3:].max(axis=0).tolist()
    return (low_x, low_y, low_z), (high_x, high_y, high_z)


def protocol_views(capture: Capture) -> list[View]:
    """Return what HumanRF's evaluation looks at of a capture that holds out its cameras, frame by frame.

    That is every third frame of the portrait Cam127, and every fifth of one landscape camera each, by turns.
    """
    portrait = [(_HERO, frame) for frame in range(0, capture.frame_count, 3)]
    turns = [(_TURNS[i % len(_TURNS)], frame) for i, frame in enumerate(range(0, capture.frame_count, 5))]
    return sorted((*portrait, *turns), key=lambda view: (view[1], view[0]))


def names(capture: Capture) -> dict[str, str]:
    """Return what each camera is called: its own name where all are called CamNNN, else such a one."""
    if all(_OWN_NAME.fullmatch(name) for name in capture.cameras):
        return {name: name for name in capture.cameras}
    return numbered(capture, [f"Cam{i:03d}" for i in range(1, len(capture.cameras) + 1)], HELD_OUT)


def write(capture: Capture, path: Path, export: Export) -> None:
    """Write a sequence of one size, 1x: the subject alone over black, masks, pinhole cameras, and boxes if known."""
    files = names(capture)
    check_complete(capture, files, "this layout")
    if capture.frame_start < 0:
        raise HoloreelError(f"{capture.source}: this layout numbers frames from 0: give --frame-start 0.")
    lenses = export.lenses(capture)
    targets = {name: pinhole(lenses[name]) for name in files}
    folder = path / "1x"

    def place(kind: str, name: str, frame: int) -> Path:
        return _place(folder, kind, files[name], capture.frame_start + frame)

    parts = [("rgb", subject_over(BLACK)), ("mask", subject_alpha)]
    for index, (kind, content) in enumerate(parts):
        write_pictures(capture, targets, partial(place, kind), export.part(index, len(parts)), content)
    rows = [",".join((files[name], *map(repr, _row(camera)))) for name, camera in targets.items()]
    write_text(folder / CALIBRATION, "\n".join((",".join(("name", *_NUMBERS)), *rows)) + "\n")
    stop = capture.frame_start + capture.frame_count
    if capture.bounds is not None:
        box = ",".join(repr(float(number)) for corner in capture.bounds for number in corner)
        boxes = (f"{number},{box}" for number in range(capture.frame_start, stop))
        write_text(path / BOXES, "\n".join((",".join(_BOX), *boxes)) + "\n")
    else:
        export.notes.append(f"There is no box around the subject, and so no {BOXES}, which HumanRF's own code needs.")
    write_json(path / "scene.json", {"num_frames": stop})
    if capture.fps != FPS:
        export.notes.append(f"This layout knows no frame rate: read it with --fps {capture.fps:g}.")


def _row(camera: Camera) -> list[float]:
    """What calibration.csv says of a camera after its name."""
    pose, width, height = camera.camera_to_world, camera.width, camera.height
    vector, center = vector_from_matrix(pose[:3, :3]).tolist(), pose[:3, 3].tolist()
    shares = [camera.fx / width, camera.fy / height, camera.cx / width, camera.cy / height]
    return [width, height, *vector, *center, *shares]
