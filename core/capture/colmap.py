# SPDX-License-Identifier: GPL-3.0-or-later
"""Captures as COLMAP leaves them: images/ and sparse/0 for one moment, or the same in folders colmap_FRAME.

The folders colmap_0, colmap_1, … are how the paper's authors prepare every dataset: pictures of one frame each, poses
from the first of them, points from all. They hold out the first camera by name.
"""

import re
from dataclasses import replace
from pathlib import Path

from ..camera import Camera
from ..errors import HoloreelError
from .capture import Capture, View
from .colmap_model import find_model, points_file, read_cameras, write_model
from .export import Export, file_names, with_alpha, write_pictures
from .media import Media
from .options import CaptureOptions
from .picture_set import check_pictures
from .video_set import natural

_FOLDER = re.compile(r"colmap_(\d{1,7})")


def matches(path: Path) -> bool:
    """Whether a model lies in the folder, or in a folder colmap_FRAME below it."""
    return find_model(path) is not None or any(find_model(folder) for folder in _frame_folders(path).values())


def read(path: Path, options: CaptureOptions) -> Capture:
    """Read one moment, or the folders of all frames."""
    folders = _frame_folders(path)
    if find_model(path) is not None:
        match = _FOLDER.fullmatch(path.name)
        folders = {int(match[1]) if match else 0: path}
    numbers = sorted(folders)
    chosen = options.choose_frames(path, range(numbers[0], numbers[-1] + 1))
    lacking = next((number for number in chosen if number not in folders), None)
    if lacking is not None:
        raise HoloreelError(f"{path}: colmap_{lacking} is missing; prepare that frame, or choose other --frames.")
    model = find_model(folders[chosen.start])
    if model is None:
        raise HoloreelError(
            f"{folders[chosen.start]} holds no sparse/0/cameras.bin or .txt; the poses of all frames come from there."
        )
    posed = read_cameras(model)
    names = _camera_names(model, posed)
    images: dict[View, Media] = {}
    seeds: dict[int, Path] = {}
    for j, number in enumerate(chosen):
        for image, name in names.items():
            images[name, j] = folders[number] / "images" / image
        found = find_model(folders[number])
        points = points_file(found) if found else None
        if points:
            seeds[j] = points
    capture = Capture(
        cameras={name: replace(posed[image], name=name) for image, name in names.items()},
        images=images,
        frame_count=len(chosen),
        fps=options.fps or 30.0,
        frame_start=chosen.start,
        seeds=seeds,
        source=model,
    )
    check_pictures(capture)
    return capture


def _frame_folders(path: Path) -> dict[int, Path]:
    found = {}
    for folder in path.glob("colmap_*"):
        match = _FOLDER.fullmatch(folder.name)
        if match and folder.is_dir():
            found[int(match[1])] = folder
    return found


def _camera_names(model: Path, posed: dict[str, Camera]) -> dict[str, str]:
    """Call each camera by its picture's name without the ending, in the order of the names, as the authors sort."""
    names = {image: str(Path(image).with_suffix("")) for image in sorted(posed, key=natural)}
    if len(set(names.values())) < len(names):
        raise HoloreelError(f"{model}: two images differ in their ending only; keep one picture per camera.")
    return names


def write(capture: Capture, path: Path, export: Export) -> None:
    """Write images/CAMERA.png and sparse/0 into `path`, or for several frames into folders colmap_FRAME."""
    single = capture.frame_count == 1
    folders = [path if single else path / f"colmap_{capture.frame_start + j}" for j in range(capture.frame_count)]
    files = {name: f"{file}.png" for name, file in file_names(capture).items()}

    def place(name: str, frame: int) -> Path:
        return folders[frame] / "images" / files[name]

    lenses = export.lenses(capture)
    write_pictures(capture, lenses, place, export, with_alpha)
    cameras = {files[name]: lenses[name] for name in files}
    for j, folder in enumerate(folders):
        write_model(folder / "sparse" / "0", cameras, capture.seed_points(j))
