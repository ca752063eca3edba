# SPDX-License-Identifier: GPL-3.0-or-later
"""The dataset of ReRF (Wang et al., 2023; https://github.com/aoliao12138/ReRF_Dataset): a subject, cameras all around.

As released, image/CCC.mp4 shows the subject over white and mask/CCC.mp4 what of it is the subject, for cameras counted
from 000. Poses and lenses are written as in NHR (https://github.com/wuminye/NHR): CamPose.inf has a row of 12 numbers
per camera, the camera-to-world axes z, x, y (OpenCV's) and the center; Intrinsic.inf has a line with the camera's
number and K in 3 lines. bbox.json has the corners `xyz_min` and `xyz_max` of the subject's box, in the space in which
the mean of all centers is the origin and their largest coordinate 2 (or -2).

The authors' tools turn that into image/FRAME/img_CCCC.png, mask/FRAME/img_CCCC.png and cams_FRAME.json, where centers
lie in the box's space too: `frames` is a list of objects with `file`, `mask`, `extrinsic` (camera-to-world, 4 x 4) and
`intrinsic` (3 x 3). Both forms are read, in the units of their own cameras; the first one is written.

Those who use the set hold 006 and 039 out.
"""

import re
from collections.abc import Container
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import MAX_COORDINATE, Camera, invert_rigid, rigid
from ..errors import HoloreelError
from ..files import finite, read_json, write_json
from .capture import MAX_FRAMES, Capture, Triple, View
from .export import Export, numbered, pinhole, subject_mask, subject_over, write_text, write_videos
from .images import picture_size
from .media import Media
from .options import CaptureOptions
from .picture_set import check_pictures
from .tables import read_rows
from .video_set import find_videos, probe_all, video_capture

POSES = "CamPose.inf"
LENSES = "Intrinsic.inf"
BOX = "bbox.json"
HELD_OUT = ("006", "039")
WHITE = (1.0, 1.0, 1.0)
_SPREAD = 2.0  # the largest coordinate of a center in the box's space
_FRAME_FILE = re.compile(r"cams_(\d{1,7})\.json")
_PICTURE = re.compile(r"img_(\d{1,6})\.png$")
_MAX_CAMERAS = 10_000
_MAX_SKEW = 1e-3  # of the focal length: what is smaller moves no pixel by one

Array = NDArray[np.float64]


def matches(path: Path) -> bool:
    """Whether CamPose.inf or a cams_FRAME.json lies in the folder."""
    return (path / POSES).is_file() or bool(_frame_files(path))


def read(path: Path, options: CaptureOptions) -> Capture:
    """Read the folder of a scene, from its videos where it has any, else from the authors' pictures."""
    files = _frame_files(path)
    released = (path / POSES).is_file() and (path / "image").is_dir() and find_videos(path / "image")
    return _read_pictures(path, files, options) if files and not released else _read_videos(path, options)


def _frame_files(path: Path) -> dict[int, Path]:
    found = {}
    for file in path.glob("cams_*.json"):
        if match := _FRAME_FILE.fullmatch(file.name):
            found[int(match[1])] = file
    return found


def _read_videos(path: Path, options: CaptureOptions) -> Capture:
    file = path / POSES
    poses, lenses = _poses(file), _lenses(path / LENSES)
    if len(poses) != len(lenses):
        raise HoloreelError(
            f"{path / LENSES} has {len(lenses)} cameras, {POSES} has {len(poses)}; fetch the files of one scene."
        )
    named = {f"{index:03d}": index for index in range(len(poses))}
    videos, masks = _videos(path / "image", named), _videos(path / "mask", named)
    for folder, there, other in (("image", videos, masks), ("mask", masks, videos)):
        if missing := [name for name in other if name not in there]:
            more = f" and {len(missing) - 1} more videos are" if len(missing) > 1 else " is"
            raise HoloreelError(f"{path / folder / missing[0]}.mp4{more} not there: fetch the missing files.")
    if not videos:
        raise HoloreelError(f"{path / 'image'} holds no videos: fetch the missing files.")
    facts = probe_all(videos)
    cameras = {
        name: _camera(f"{path / LENSES}: camera {name}", lenses[named[name]], poses[named[name]], size)
        for name, size in ((name, (found.width, found.height)) for name, found in facts.items())
    }
    capture = video_capture(file, cameras, videos, options, facts, masks)
    absent = [name for name in named if name not in videos]
    note = f"{path}: there are no videos of {', '.join(absent)}; these cameras are left out."
    origin, unit = _box_space(poses[:, :3, 3])
    return replace(capture, matte=WHITE, bounds=_read_box(path / BOX, origin, unit), notes=(note,) if absent else ())


def _videos(folder: Path, named: Container[str]) -> dict[str, Path]:
    """The videos of a folder, all of which must belong to cameras."""
    if not folder.is_dir():
        raise HoloreelError(f"{folder} is missing: the videos CCC.mp4 lie in image, those of the masks in mask.")
    videos = find_videos(folder)
    if extra := [file for name, file in videos.items() if name not in named]:
        raise HoloreelError(f"{extra[0]} is of a camera that {POSES} has no row for: fetch the files of one scene.")
    return videos


def _poses(file: Path) -> Array:
    """The camera-to-world matrices, (N, 4, 4)."""
    rows = read_rows(file)
    if not 1 <= len(rows) <= _MAX_CAMERAS:
        raise HoloreelError(f"{file} must have a row for each camera, up to {_MAX_CAMERAS}: fetch it again.")
    poses = []
    for number, row in enumerate(rows):
        if len(row) != 12:
            raise HoloreelError(f"{file}: row {number} has {len(row)} numbers, not 12: fetch it again.")
        z, x, y, center = np.reshape(row, (4, 3))
        poses.append(_pose(f"{file}: row {number}", np.stack([x, y, z, center], axis=1)))
    return np.stack(poses)


def _pose(where: str, matrix: Array) -> Array:
    """A camera-to-world matrix (3 or 4, 4) made exactly rigid, (4, 4)."""
    try:
        return rigid(np.concatenate([matrix[:3], [(0.0, 0.0, 0.0, 1.0)]]))
    except ValueError as error:
        raise HoloreelError(f"{where} {error}: fetch it again.") from error


def _lenses(file: Path) -> list[Array]:
    """The matrices K, one per camera; lines of one number between them are their cameras'."""
    lenses: list[Array] = []
    part: list[list[float]] = []
    for number, row in enumerate(read_rows(file)):
        if len(row) == 1 and not part:
            continue
        if len(row) != 3:
            raise HoloreelError(f"{file}: row {number} has {len(row)} numbers, not the 3 of a matrix: fetch it again.")
        part.append(row)
        if len(part) == 3:
            lenses.append(np.array(part))
            part = []
    if part or not lenses:
        raise HoloreelError(f"{file} must have 3 rows of 3 numbers for each camera: fetch it again.")
    return lenses


def _camera(where: str, lens: Array, pose: Array, size: tuple[int, int]) -> Camera:
    """The camera of K (3, 3), camera-to-world (4, 4), and the size of its pictures."""
    (fx, skew, cx), (corner, fy, cy), last = lens.tolist()
    if corner or last != [0, 0, 1] or abs(skew) > _MAX_SKEW * abs(fx):
        raise HoloreelError(f"{where}: K must be fx 0 cx, 0 fy cy, 0 0 1, without skew: fetch it again.")
    if not (0 < cx < size[0] and 0 < cy < size[1]):
        raise HoloreelError(
            f"{where}: the principal point ({cx:g}, {cy:g}) lies outside of its pictures of {size[0]}x{size[1]}; "
            "fetch the lenses that were measured at this size."
        )
    try:
        return Camera(*size, fx, fy, cx, cy, invert_rigid(pose))
    except HoloreelError as error:
        raise HoloreelError(f"{where}: {str(error).rstrip('.')}: fetch it again.") from error


def _box_space(centers: Array) -> tuple[Array, float]:
    """The origin and the unit, in the units of the centers (N, 3), of the space that bbox.json speaks of."""
    origin = centers.mean(axis=0)
    return origin, float(np.abs(centers - origin).max()) / _SPREAD


def _read_box(file: Path, origin: Array, unit: float) -> tuple[Triple, Triple] | None:
    """The subject's box in the units of the cameras; None where the file is not there."""
    if not file.is_file():
        return None
    box = read_json(file)
    low, high = (_corner(file, box, key) for key in ("xyz_min", "xyz_max"))
    if not (low < high).all():
        raise HoloreelError(f"{file}: xyz_min must be smaller than xyz_max along every axis: fetch it again.")
    if not unit > 0:
        raise HoloreelError(f"{file} has no unit where all cameras stand in one place: take it away.")
    return _triple(origin + unit * low), _triple(origin + unit * high)


def _corner(file: Path, box: dict[str, Any], key: str) -> Array:
    value = box.get(key)
    numbers = [finite(part) for part in value] if isinstance(value, list) else []
    known = [number for number in numbers if number is not None and abs(number) < MAX_COORDINATE]
    if not len(numbers) == len(known) == 3:
        raise HoloreelError(f"{file}: {key} must be 3 finite numbers, not {str(value)[:60]}: fetch it again.")
    return np.array(known)


def _triple(point: Array) -> Triple:
    x, y, z = map(float, point)
    return x, y, z


def _read_pictures(path: Path, files: dict[int, Path], options: CaptureOptions) -> Capture:
    """Read what the authors' tools made of the videos; cameras of all frames are those of the first chosen one."""
    chosen = options.choose_frames(path, range(min(files), max(files) + 1))
    if len(chosen) > MAX_FRAMES:
        raise HoloreelError(f"{path}: {len(chosen)} frames are more than {MAX_FRAMES}; take a part by --frames.")
    if lacking := [number for number in chosen if number not in files]:
        raise HoloreelError(f"{path}: cams_{lacking[0]}.json is missing; prepare that frame, or choose other --frames.")
    file = files[chosen.start]
    numbers, cameras = [], {}
    for index, (number, lens, pose) in enumerate(_entries(file)):
        where, name = f"{file}: frames[{index}]", f"{number:03d}"
        if name in cameras:
            raise HoloreelError(f"{where} is a second one of camera {name}: prepare the frame again.")
        size = picture_size(_picture(path, "image", chosen.start, number))
        cameras[name] = replace(_camera(where, lens, pose, size), name=name)
        numbers.append(number)
    views = [(name, j, frame, n) for j, frame in enumerate(chosen) for name, n in zip(cameras, numbers, strict=True)]
    images: dict[View, Media] = {(name, j): _picture(path, "image", frame, n) for name, j, frame, n in views}
    masks: dict[View, Media] = {(name, j): _picture(path, "mask", frame, n) for name, j, frame, n in views}
    capture = Capture(
        cameras=cameras,
        images=images,
        frame_count=len(chosen),
        fps=options.fps or 30.0,
        frame_start=chosen.start,
        masks=masks,
        matte=WHITE,
        bounds=_read_box(path / BOX, np.zeros(3), 1.0),
        source=file,
    )
    check_pictures(capture)
    return capture


def _picture(path: Path, folder: str, frame: int, camera: int) -> Path:
    return path / folder / str(frame) / f"img_{camera:04d}.png"


def _entries(file: Path) -> list[tuple[int, Array, Array]]:
    """The number, K and camera-to-world of each camera; where its files lie is known, whatever the file says."""
    frames = read_json(file).get("frames")
    if not isinstance(frames, list) or not 1 <= len(frames) <= _MAX_CAMERAS:
        raise HoloreelError(f"{file}: frames must be a list of 1 to {_MAX_CAMERAS} cameras: prepare the frame again.")
    entries = []
    for index, entry in enumerate(frames):
        where = f"{file}: frames[{index}]"
        listed = entry.get("file") if isinstance(entry, dict) else None
        match = _PICTURE.search(listed) if isinstance(listed, str) else None
        if not match:
            raise HoloreelError(f"{where}.file must end in img_CCCC.png: prepare the frame again.")
        pose = _matrix(f"{where}.extrinsic", entry.get("extrinsic"), 4)
        entries.append((int(match[1]), _matrix(f"{where}.intrinsic", entry.get("intrinsic"), 3), _pose(where, pose)))
    return sorted(entries, key=lambda entry: entry[0])


def _matrix(where: str, value: Any, size: int) -> Array:
    rows = value if isinstance(value, list) else []
    numbers = [finite(number) for row in rows if isinstance(row, list) for number in row]
    known = [number for number in numbers if number is not None]
    if not len(numbers) == len(known) == size * size or {len(row) for row in rows} != {size}:
        raise HoloreelError(f"{where} must be {size} rows of {size} finite numbers: prepare the frame again.")
    return np.reshape(known, (size, size))


def names(capture: Capture) -> dict[str, str]:
    """Return what each camera is called: its own name where all have such, else a number; held-out ones 006 and 039."""
    wanted = [f"{index:03d}" for index in range(len(capture.cameras))]
    if set(wanted) == set(capture.cameras):
        return {name: name for name in wanted}
    return numbered(capture, wanted, HELD_OUT)


def write(capture: Capture, path: Path, export: Export) -> None:
    """Write the subject alone over white, its masks, its box where there is one, and pinhole cameras."""
    files = names(capture)
    lenses = export.lenses(capture)
    targets = {name: pinhole(lenses[name]) for name in files}
    parts = (("image", subject_over(WHITE), 255), ("mask", subject_mask, 0))
    for index, (folder, content, unseen) in enumerate(parts):
        places = {name: path / folder / f"{file}.mp4" for name, file in files.items()}
        write_videos(capture, targets, places, export.part(index, len(parts)), content, unseen)
    poses = np.stack([camera.camera_to_world for camera in targets.values()])
    rows = (" ".join(map(repr, pose[:3, [2, 0, 1, 3]].T.ravel().tolist())) for pose in poses)
    write_text(path / POSES, "".join(f"{row}\n" for row in rows))
    matrices = ("\n".join(" ".join(map(repr, row)) for row in camera.K.tolist()) for camera in targets.values())
    write_text(path / LENSES, "".join(f"{number}\n{matrix}\n\n" for number, matrix in enumerate(matrices)))
    if capture.bounds is not None:
        _write_box(path / BOX, capture.bounds, *_box_space(poses[:, :3, 3]), export)


def _write_box(file: Path, bounds: tuple[Triple, Triple], origin: Array, unit: float, export: Export) -> None:
    if unit > 0:
        low, high = (((np.array(corner) - origin) / unit).tolist() for corner in bounds)
        write_json(file, {"xyz_min": low, "xyz_max": high})
    else:
        export.notes.append("The subject's box is not taken along: with all cameras in one place it has no unit here.")
