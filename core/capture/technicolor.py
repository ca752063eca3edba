# SPDX-License-Identifier: GPL-3.0-or-later
"""Technicolor light fields (Sabater et al., 2017): cameras_parameters.txt and SCENE_undist_FRAME_CAMERA.png.

cameras_parameters.txt has a line of headings, then one row per camera: focal length, principal point (cu, cv), aspect
ratio (fy / fx), skew, world-to-camera quaternion w x y z and translation. Pictures are undistorted; frames have five
digits, cameras two, counted from 0. The authors hold cam10 out.
"""

import re
from pathlib import Path

from ..camera import Camera
from ..errors import HoloreelError
from .capture import MAX_FRAMES, Capture, View
from .export import Export, numbered, pinhole, write_pictures, write_text
from .images import picture_size
from .media import Media
from .options import CaptureOptions
from .picture_set import check_pictures
from .rotations import matrix_from_quaternion, quaternion_from_matrix
from .tables import read_rows

FILE_NAME = "cameras_parameters.txt"
HEADINGS = "f cu cv ar sk qw qx qy qz tx ty tz"
HELD_OUT = "cam10"
_PICTURE = re.compile(r"(?P<scene>.+)_undist_(?P<frame>\d{1,7})_(?P<camera>\d{1,4})\.png")
_MAX_CAMERAS = 10_000
_MAX_SKEW = 1e-3  # of the focal length: what is smaller moves no pixel by one


def matches(path: Path) -> bool:
    """Whether cameras_parameters.txt lies in the folder."""
    return (path / FILE_NAME).is_file()


def read(path: Path, options: CaptureOptions) -> Capture:
    """Read the folder of a scene; only the chosen frames need to be there."""
    file = path / FILE_NAME
    rows = _rows(file)
    scene, pictures = _pictures(path)
    numbers = sorted({frame for _, frame in pictures})
    chosen = options.choose_frames(path, range(numbers[0], numbers[-1] + 1))
    if len(chosen) > MAX_FRAMES:
        raise HoloreelError(f"{path}: {len(chosen)} frames are more than {MAX_FRAMES}; take a part by --frames.")
    if beyond := [camera for camera, _ in pictures if camera >= len(rows)]:
        raise HoloreelError(
            f"{path}: there are pictures of camera {beyond[0]}, but {FILE_NAME} has {len(rows)} rows; "
            "fetch the files of one scene."
        )
    wanted = [(camera, frame) for frame in chosen for camera in range(len(rows))]
    if missing := [view for view in wanted if view not in pictures]:
        camera, frame = missing[0]
        more = f" and {len(missing) - 1} more pictures are" if len(missing) > 1 else " is"
        raise HoloreelError(
            f"{path}: {scene}_undist_{frame:05d}_{camera:02d}.png{more} missing; fetch what is missing, "
            "or choose other --frames."
        )
    cameras = {}
    for index, row in enumerate(rows):
        name = f"cam{index:02d}"
        cameras[name] = _camera(file, index, row, picture_size(pictures[index, chosen.start]), name)
    images: dict[View, Media] = {
        (f"cam{c:02d}", j): pictures[c, n] for j, n in enumerate(chosen) for c in range(len(rows))
    }
    capture = Capture(
        cameras=cameras,
        images=images,
        frame_count=len(chosen),
        fps=options.fps or 30.0,
        frame_start=chosen.start,
        source=file,
    )
    check_pictures(capture)
    return capture


def _rows(file: Path) -> list[list[float]]:
    rows = read_rows(file, skip=1)
    if not 1 <= len(rows) <= _MAX_CAMERAS:
        raise HoloreelError(f"{file} must have a line of headings and a row per camera: fetch it again.")
    if wrong := [(number, len(row)) for number, row in enumerate(rows) if len(row) != 12]:
        number, count = wrong[0]
        raise HoloreelError(f"{file}: row {number} has {count} numbers, not the 12 of {HEADINGS!r}: fetch it again.")
    return rows


def _pictures(path: Path) -> tuple[str, dict[tuple[int, int], Path]]:
    """The scene's name, and the pictures by (camera, frame number)."""
    found: dict[tuple[int, int], Path] = {}
    scenes: set[str] = set()
    for file in path.iterdir():
        if match := _PICTURE.fullmatch(file.name):
            found[int(match["camera"]), int(match["frame"])] = file
            scenes.add(match["scene"])
    if len(scenes) != 1:
        raise HoloreelError(
            f"{path} holds pictures SCENE_undist_FRAME_CAMERA.png of "
            f"{'the scenes ' + ', '.join(sorted(scenes)[:5]) if scenes else 'no scene'}; give the folder of one scene."
        )
    return scenes.pop(), found


def _camera(file: Path, index: int, row: list[float], size: tuple[int, int], name: str) -> Camera:
    focal, cu, cv, aspect, skew, *pose = row
    if abs(skew) > _MAX_SKEW * abs(focal):
        raise HoloreelError(f"{file}: row {index} has a skew of {skew:g}; undistort the pictures to square corners.")
    matrix = [[0.0] * 4 for _ in range(3)] + [[0.0, 0.0, 0.0, 1.0]]
    try:
        rotation = matrix_from_quaternion(pose[:4]).tolist()
        for line in range(3):
            matrix[line] = [*rotation[line], pose[4 + line]]
        return Camera(*size, focal, focal * aspect, cu, cv, matrix, name=name)  # type: ignore[arg-type]
    except (HoloreelError, ValueError) as error:
        raise HoloreelError(f"{file}: row {index}: {str(error).rstrip('.')}; fetch it again.") from error


def names(capture: Capture) -> dict[str, str]:
    """Return what each camera is called: the held-out one is number 10 where there are more than 10, else 0."""
    return numbered(capture, [f"cam{i:02d}" for i in range(len(capture.cameras))], (HELD_OUT,))


def write(capture: Capture, path: Path, export: Export) -> None:
    """Write the files of a scene that is called as `path` is."""
    order = list(names(capture))
    lenses = export.lenses(capture)
    targets = {name: pinhole(lenses[name]) for name in order}
    numbers = {name: number for number, name in enumerate(order)}

    def place(name: str, frame: int) -> Path:
        return path / f"{path.name}_undist_{capture.frame_start + frame:05d}_{numbers[name]:02d}.png"

    write_pictures(capture, targets, place, export)
    lines = [HEADINGS]
    for camera in targets.values():
        quaternion = quaternion_from_matrix(camera.world_to_camera[:3, :3]).tolist()
        translation = camera.world_to_camera[:3, 3].tolist()
        row = [camera.fx, camera.cx, camera.cy, camera.fy / camera.fx, 0.0, *quaternion, *translation]
        lines.append(" ".join(map(repr, row)))
    write_text(path / FILE_NAME, "\n".join(lines) + "\n")
