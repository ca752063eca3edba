# SPDX-License-Identifier: GPL-3.0-or-later
"""Captures as nerfstudio's transforms.json, the canonical form on disk.

Format: https://docs.nerf.studio/quickstart/data_conventions.html. Camera-to-world matrices have OpenGL axes (x right,
y up, looking along -z). Every frame entry has a `time` in [0, 1), as D-NeRF's. What nerfstudio has no word for lies in
objects named `holoreel`: at the top (version, fps, frame_start, frame_count, cameras, seeds) and in each entry (camera,
frame). Files without them are read too: entries of one pose and lens are one camera, evenly spaced times are frames.

Lenses are OpenCV's, as nerfstudio's: `camera_model` OPENCV has k1 k2 p1 p2 k3, and OPENCV_FISHEYE k1 k2 k3 k4; those
that are missing are 0. FULL_OPENCV, which nerfstudio does not know, has k4 k5 k6 too. A picture may be a frame of a
video: `file_path` then names the video, and `holoreel.video_frame` the frame, from 0. `mask_path` names a gray picture
that is white where the subject is, or a video, of which `holoreel.mask_frame` is the frame. `holoreel.bounds` is a box
around the subject over all frames ([lower corner, upper corner], in scene units), `holoreel.matte` the color (0 to 1)
that pictures with masks lie over.
"""

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import MODELS, Camera, invert_rigid, rigid
from ..errors import HoloreelError
from ..files import finite, read_json, write_json
from .capture import MAX_FRAMES, Capture, Triple, View
from .media import Media, VideoFrame, media_path

FILE_NAME = "transforms.json"
_VERSION = 1
_MAX_ENTRIES = 2_000_000
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenCV camera axes in OpenGL's, and back
_MODELS = {  # of nerfstudio's and COLMAP's names, those that mean one of ours, and its parameters
    **dict.fromkeys(("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL"), ("k1", "k2", "k3", "p1", "p2")),
    "FULL_OPENCV": MODELS["FULL_OPENCV"].parameters,
    "OPENCV_FISHEYE": MODELS["OPENCV_FISHEYE"].parameters,
}
_DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
_LENS = {"width": "w", "height": "h", "fx": "fl_x", "fy": "fl_y", "cx": "cx", "cy": "cy"}


@dataclass
class _Entry:
    """One element of `frames`, understood."""

    media: Media
    listed: str  # file_path as written
    camera: Camera
    time: float | None
    name: str | None  # camera name, where the file says so
    frame: int | None
    depth: Path | None
    mask: Media | None


def write_capture(path: str | Path, capture: Capture) -> Path:
    """Write `capture` as transforms.json (into `path` where that is a folder), atomically; return the file's path.

    Pictures, depth maps, masks and seed points stay where they are and are named relative to the file.
    """
    path = _file(path)
    lenses = {name: _lens(camera) for name, camera in capture.cameras.items()}
    shared = {key: value for key, value in next(iter(lenses.values())).items() if _same(lenses, key, value)}
    entries = []
    files: dict[str, list[str]] = {"train": [], "test": []}
    for name, frame in capture.views():
        media = capture.images[name, frame]
        entry: dict[str, Any] = {"file_path": _relative(media_path(media), path)}
        entry |= {key: value for key, value in lenses[name].items() if key not in shared}
        entry["transform_matrix"] = (capture.cameras[name].camera_to_world @ _OPENGL).tolist()
        entry["time"] = capture.time(frame)
        if (name, frame) in capture.depths:
            entry["depth_file_path"] = _relative(capture.depths[name, frame], path)
        entry["holoreel"] = {"camera": name, "frame": frame}
        if isinstance(media, VideoFrame):
            entry["holoreel"]["video_frame"] = media.index
        if mask := capture.masks.get((name, frame)):
            entry["mask_path"] = _relative(media_path(mask), path)
            if isinstance(mask, VideoFrame):
                entry["holoreel"]["mask_frame"] = mask.index
        entries.append(entry)
        files[capture.split(name)].append(entry["file_path"])
    value: dict[str, Any] = dict(shared)
    if files["test"]:
        value |= {
            "train_filenames": files["train"],
            "val_filenames": files["test"],
            "test_filenames": files["test"],
        }
    seeds = [_relative(capture.seeds[j], path) if j in capture.seeds else None for j in range(capture.frame_count)]
    if any(seeds):
        value["ply_file_path"] = next(seed for seed in seeds if seed)
    value["holoreel"] = {
        "version": _VERSION,
        "fps": capture.fps,
        "frame_start": capture.frame_start,
        "frame_count": capture.frame_count,
        "cameras": list(capture.cameras),
        "seeds": seeds if any(seeds) else [],
    }
    value["holoreel"] |= {"bounds": capture.bounds} if capture.bounds else {}
    value["holoreel"] |= {"matte": capture.matte} if capture.matte else {}
    write_json(path, value | {"frames": entries})
    return path


def read_capture(path: str | Path) -> Capture:
    """Read a transforms.json (or the one in the folder `path`); raises `HoloreelError` naming file, field and remedy.

    All files it names must exist. Without `time`, every pose is a camera of a capture of one frame.
    """
    path = _file(path)
    meta = read_json(path)
    extra = meta.get("holoreel")
    if extra is not None and (not isinstance(extra, dict) or extra.get("version") != _VERSION):
        raise HoloreelError(f"{path}: holoreel.version must be {_VERSION}; read it with the Holoreel that wrote it.")
    entries = _entries(path, meta)
    cameras, names = _cameras(path, entries, extra)
    frames, frame_count = _frames(path, entries, names, extra)
    images: dict[View, Media] = {}
    depths: dict[View, Path] = {}
    masks: dict[View, Media] = {}
    for entry, name, frame in zip(entries, names, frames, strict=True):
        if (name, frame) in images:
            raise HoloreelError(
                f"{path}: {entry.listed} is the second picture of camera {name!r} at one time; take one out."
            )
        images[name, frame] = entry.media
        if entry.depth:
            depths[name, frame] = entry.depth
        if entry.mask:
            masks[name, frame] = entry.mask
    capture = Capture(
        cameras=cameras,
        images=images,
        frame_count=frame_count,
        splits=_splits(path, meta, entries, names),
        fps=_number(path, "holoreel.fps", extra.get("fps")) if extra else 30.0,
        frame_start=_integer(path, "holoreel.frame_start", extra.get("frame_start")) if extra else 1,
        depths=depths,
        seeds=_seeds(path, meta, extra, frame_count),
        masks=masks,
        matte=_matte(path, extra),
        bounds=_bounds(path, extra),
        source=path,
    )
    capture.check_files()
    return capture


def _file(path: str | Path) -> Path:
    path = Path(path)
    return path if path.suffix == ".json" else path / FILE_NAME


def _relative(file: Path, transforms: Path) -> str:
    return Path(os.path.relpath(file, transforms.parent)).as_posix()


def _lens(camera: Camera) -> dict[str, Any]:
    """What an entry says of a lens. A lens without k4, k5 and k6 is written as OPENCV, which nerfstudio knows."""
    distortion = dict(zip(MODELS[camera.model].parameters, camera.distortion, strict=True))
    model = camera.model
    if model != "OPENCV_FISHEYE" and not any(distortion.get(key) for key in ("k4", "k5", "k6")):
        model = "OPENCV"
        distortion = {key: value for key, value in distortion.items() if key in _MODELS[model]}
    lens = {key: getattr(camera, field) for field, key in _LENS.items()}
    return {"camera_model": model, **lens, **distortion}


def _same(lenses: dict[str, dict[str, Any]], key: str, value: Any) -> bool:
    return all(lens.get(key) == value for lens in lenses.values())


def _entries(path: Path, meta: dict[str, Any]) -> list[_Entry]:
    frames = meta.get("frames")
    if not isinstance(frames, list) or not frames or len(frames) > _MAX_ENTRIES:
        raise HoloreelError(f"{path}: frames must be a list of 1 to {_MAX_ENTRIES} pictures; export it again.")
    world = _applied_transform(path, meta)
    return [_entry(path, meta, index, frame, world) for index, frame in enumerate(frames)]


def _applied_transform(path: Path, meta: dict[str, Any]) -> NDArray[np.float64]:
    """Return what takes the file's poses back to the world that its points are in."""
    if meta.get("applied_scale", 1) != 1:
        raise HoloreelError(f"{path}: applied_scale must be 1; export the capture without scaling its poses.")
    if "applied_transform" not in meta:
        return np.eye(4)
    try:
        return invert_rigid(rigid([*meta["applied_transform"], [0, 0, 0, 1]]))
    except (TypeError, ValueError) as error:
        raise HoloreelError(f"{path}: applied_transform {error}; export the capture without it.") from error


def _entry(path: Path, meta: dict[str, Any], index: int, frame: Any, world: NDArray[np.float64]) -> _Entry:
    where = f"{path}: frames[{index}]"
    if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
        raise HoloreelError(f"{where}.file_path is missing; export the capture again.")
    model, distortion = _distortion(where, meta, frame)
    lens: dict[str, Any] = {field: frame.get(key, meta.get(key)) for field, key in _LENS.items()}
    if missing := [_LENS[field] for field, value in lens.items() if value is None]:
        raise HoloreelError(f"{where}: {missing[0]} is missing, there and at the top; export the capture again.")
    try:
        pose = world @ rigid(frame.get("transform_matrix", [])) @ _OPENGL
    except ValueError as error:
        raise HoloreelError(f"{where}.transform_matrix {error}; export the capture again.") from error
    try:
        camera = Camera(**lens, world_to_camera=invert_rigid(pose), model=model, distortion=distortion)
    except HoloreelError as error:
        raise HoloreelError(f"{where}: {error}") from error
    own = frame.get("holoreel") or {}
    own = own if isinstance(own, dict) else {}
    name, number = own.get("camera"), own.get("frame")
    depth, mask = frame.get("depth_file_path"), frame.get("mask_path")
    time = frame.get("time")
    return _Entry(
        media=_media(path, index, frame["file_path"], own, "video_frame"),
        listed=frame["file_path"],
        camera=camera,
        time=None if time is None else _number(path, f"frames[{index}].time", time),
        name=name if isinstance(name, str) else None,
        frame=None if number is None else _integer(path, f"frames[{index}].holoreel.frame", number),
        depth=_existing(path, depth) if isinstance(depth, str) else None,
        mask=_media(path, index, mask, own, "mask_frame") if isinstance(mask, str) else None,
    )


def _media(path: Path, index: int, name: str, own: dict[str, Any], key: str) -> Media:
    """The picture `name` means, or the frame of a video, where the entry's own words (`own`) have its number."""
    file, number = _existing(path, name), own.get(key)
    return file if number is None else VideoFrame(file, _integer(path, f"frames[{index}].holoreel.{key}", number))


def _distortion(where: str, meta: dict[str, Any], frame: dict[str, Any]) -> tuple[str, tuple[float, ...]]:
    """Return the camera model of an entry and its parameters: the least model that has all that are not 0."""
    model = frame.get("camera_model", meta.get("camera_model", "OPENCV"))
    if not isinstance(model, str) or model not in _MODELS:
        raise HoloreelError(
            f"{where}: camera_model {str(model)[:40]!r} is not supported; undistort the pictures to OPENCV."
        )
    values: dict[str, float] = {}
    for key in _DISTORTION:
        value = finite(frame.get(key, meta.get(key, 0)))
        if value is None:
            raise HoloreelError(f"{where}: {key} must be a finite number; export the capture again.")
        if value != 0 and key not in _MODELS[model]:
            raise HoloreelError(
                f"{where}: {key} is not a parameter of {model}; set it to 0, or say FULL_OPENCV if it is OpenCV's."
            )
        values[key] = value
    names = ("OPENCV_FISHEYE",) if model == "OPENCV_FISHEYE" else ("PINHOLE", "OPENCV", "FULL_OPENCV")
    least = next(name for name in names if {key for key in values if values[key]} <= {*MODELS[name].parameters})
    return least, tuple(values[key] for key in MODELS[least].parameters)


def _existing(path: Path, name: str) -> Path:
    """The file `name` means; NeRF's files leave `.png` out."""
    file = path.parent / name.replace("\\", "/")
    png = file.with_name(file.name + ".png")
    return png if not file.suffix and os.path.isfile(png) else file


def _number(path: Path, field: str, value: Any) -> float:
    number = finite(value)
    if number is None:
        raise HoloreelError(f"{path}: {field} must be a finite number, not {str(value)[:40]}.")
    return number


def _integer(path: Path, field: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or abs(value) > 2**31:
        raise HoloreelError(f"{path}: {field} must be a whole number, not {str(value)[:40]}.")
    return value


def _cameras(path: Path, entries: list[_Entry], extra: dict[str, Any] | None) -> tuple[dict[str, Camera], list[str]]:
    """Return the cameras by name, and the camera's name of each entry."""
    keys = [_pose_key(entry.camera) for entry in entries]
    if all(entry.name for entry in entries):
        names = [str(entry.name) for entry in entries]
    else:
        named = _names(entries, keys)
        names = [named[key] for key in keys]
    first: dict[str, int] = {}
    for index, name in enumerate(names):
        if keys[first.setdefault(name, index)] != keys[index]:
            raise HoloreelError(
                f"{path}: camera {name!r} has another pose or lens in {entries[index].listed}; "
                "cameras stand still, so give every pose a name of its own."
            )
    order = list(first)
    if extra and isinstance(extra.get("cameras"), list):
        rank = {name: index for index, name in enumerate(extra["cameras"]) if isinstance(name, str)}
        order.sort(key=lambda name: rank.get(name, len(rank)))
    return {name: replace(entries[first[name]].camera, name=name) for name in order}, names


def _pose_key(camera: Camera) -> tuple[float, ...]:
    values = [camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion]
    return (float(list(MODELS).index(camera.model)), *values, *np.round(camera.world_to_camera[:3].ravel(), 7).tolist())


def _names(entries: list[_Entry], keys: list[tuple[float, ...]]) -> dict[tuple[float, ...], str]:
    """Name each pose after the folder of its pictures, or after its one picture; else by number."""
    stems: dict[tuple[float, ...], set[str]] = {}
    folders: dict[tuple[float, ...], set[str]] = {}
    for entry, key in zip(entries, keys, strict=True):
        file = media_path(entry.media)
        stems.setdefault(key, set()).add(file.stem)
        folders.setdefault(key, set()).add(file.parent.name)
    for candidates in (folders, stems):
        found = [next(iter(values)) for values in candidates.values() if len(values) == 1]
        if len(set(found)) == len(candidates) and all(found):
            return dict(zip(candidates, found, strict=True))
    digits = len(str(len(stems) - 1))
    return {key: f"cam{index:0{max(digits, 2)}d}" for index, key in enumerate(stems)}


def _frames(path: Path, entries: list[_Entry], names: list[str], extra: dict[str, Any] | None) -> tuple[list[int], int]:
    """Return the frame index of each entry, and the number of frames."""
    if extra is not None and all(entry.frame is not None for entry in entries):
        count = _integer(path, "holoreel.frame_count", extra.get("frame_count"))
        for entry in entries:
            frame = entry.frame or 0
            if not 0 <= frame < count <= MAX_FRAMES:
                raise HoloreelError(f"{path}: frame {frame} of {entry.listed} is outside holoreel.frame_count {count}.")
            if entry.time is None or abs(entry.time - frame / count) > 1e-6:
                raise HoloreelError(
                    f"{path}: time of {entry.listed} must be {frame}/{count}, not {entry.time}; correct one of them."
                )
        return [entry.frame or 0 for entry in entries], count
    untimed = [entry for entry in entries if entry.time is None]
    if len(untimed) == len(entries) == len(set(names)):
        return [0] * len(entries), 1
    if untimed:
        raise HoloreelError(
            f"{path}: time is missing for {untimed[0].listed} and {len(untimed) - 1} more; "
            "give every picture of a moving scene its time, from 0 to 1."
        )
    return _even_frames(path, np.array([entry.time for entry in entries], dtype=np.float64))


def _even_frames(path: Path, times: NDArray[np.float64]) -> tuple[list[int], int]:
    """Number evenly spaced times (some may be left out): those of D-NeRF end at 1, ours before it, both are fine."""
    span = float(np.ptp(times))
    distinct = np.unique(times)
    gaps = np.diff(distinct)
    gaps = gaps[gaps > max(span * 1e-7, 1e-12)]
    if not len(gaps):
        return [0] * len(times), 1
    step = span / max(round(span / float(gaps.min())), 1)
    index = (times - times.min()) / step
    count = round(span / step) + 1
    if count > MAX_FRAMES or np.abs(index - np.round(index)).max() > 0.05:
        raise HoloreelError(f"{path}: the times of the frames are not evenly spaced; resample the recording.")
    return np.round(index).astype(int).tolist(), count


def _splits(path: Path, meta: dict[str, Any], entries: list[_Entry], names: list[str]) -> dict[str, str]:
    """A camera with a picture among val_filenames or test_filenames is held out."""
    held_out: set[str] = set()
    for key in ("val_filenames", "test_filenames"):
        files = meta.get(key, [])
        if not isinstance(files, list) or not all(isinstance(file, str) for file in files):
            raise HoloreelError(f"{path}: {key} must be a list of file names.")
        held_out.update(files)
    test = {name for entry, name in zip(entries, names, strict=True) if entry.listed in held_out}
    return {name: "test" if name in test else "train" for name in names}


def _bounds(path: Path, extra: dict[str, Any] | None) -> tuple[Triple, Triple] | None:
    value = (extra or {}).get("bounds")
    if value is None:
        return None
    if not isinstance(value, list) or len(value) != 2:
        raise HoloreelError(f"{path}: holoreel.bounds must be two corners of three numbers.")
    return _triple(path, "holoreel.bounds[0]", value[0]), _triple(path, "holoreel.bounds[1]", value[1])


def _matte(path: Path, extra: dict[str, Any] | None) -> Triple | None:
    value = (extra or {}).get("matte")
    return None if value is None else _triple(path, "holoreel.matte", value)


def _triple(path: Path, field: str, value: Any) -> Triple:
    if not isinstance(value, list) or len(value) != 3:
        raise HoloreelError(f"{path}: {field} must be three finite numbers, not {str(value)[:60]}.")
    x, y, z = (_number(path, field, part) for part in value)
    return x, y, z


def _seeds(path: Path, meta: dict[str, Any], extra: dict[str, Any] | None, frame_count: int) -> dict[int, Path]:
    """Seed points by frame; a foreign `ply_file_path` holds for every frame."""
    seeds = extra.get("seeds") if extra else None
    if seeds:
        if not isinstance(seeds, list) or len(seeds) != frame_count:
            raise HoloreelError(f"{path}: holoreel.seeds must name one file (or null) per frame.")
        return {index: path.parent / seed for index, seed in enumerate(seeds) if isinstance(seed, str)}
    ply = meta.get("ply_file_path")
    return dict.fromkeys(range(frame_count), path.parent / ply) if isinstance(ply, str) else {}
