# SPDX-License-Identifier: GPL-3.0-or-later
"""The layouts of captures on disk, as a table; reading one, whichever it is."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import HoloreelError
from . import actorshq, colmap, immersive, n3v, nerfstudio, rerf, sfm_result, technicolor, videos
from .capture import Capture, Triple, View
from .export import Export, file_names, with_alpha, write_pictures
from .media import Media
from .options import CaptureOptions
from .points import write_points


class Protocol(NamedTuple):
    """How results on a dataset are measured where its held-out cameras are held out."""

    name: str
    measures: tuple[str, ...]  # of `core.evaluate`
    background: Triple | None = None  # that subject and drawing lie over; None: it does not matter
    views: Callable[[Capture], list[View]] | None = None  # what is looked at; None: all of the held-out cameras


@dataclass(frozen=True)
class Layout:
    """One dataset's way to lay its files out, and its authors' protocol."""

    files: str  # what lies there, for messages
    matches: Callable[[Path], bool]
    read: Callable[[Path, CaptureOptions], Capture]
    write: Callable[[Capture, Path, Export], None]
    scale: int = 1  # by which the protocol divides the size of the pictures
    held_out: tuple[str, ...] | None = ()  # cameras to test on; the first where none has these names; None: files say
    protocol: Protocol | None = None  # that `holoreel eval` names where it was kept
    holds_seeds: bool = False
    names: Callable[[Capture], dict[str, str]] = file_names  # what each camera is called once it is written


def _read_nerfstudio(path: Path, options: CaptureOptions) -> Capture:
    capture = nerfstudio.read_capture(path)
    start = capture.frame_start
    chosen = options.choose_frames(capture.source, range(start, start + capture.frame_count))
    return capture.frames(chosen.start - start, len(chosen))


def _write_nerfstudio(capture: Capture, path: Path, export: Export) -> None:
    """Write images/CAMERA/FRAME.png, points/FRAME.ply and transforms.json into `path`."""
    names = file_names(capture)

    def place(name: str, frame: int) -> Path:
        return path / "images" / names[name] / f"{capture.frame_start + frame:06d}.png"

    lenses = export.lenses(capture)
    write_pictures(capture, lenses, place, export, with_alpha)
    seeds = {j: path / "points" / f"{capture.frame_start + j:06d}.ply" for j in capture.seeds}
    for frame, file in seeds.items():
        write_points(file, capture.seed_points(frame))
    if capture.depths:
        export.notes.append("Depth maps are not taken along.")
    images: dict[View, Media] = {view: place(*view) for view in capture.images}
    written = replace(capture, cameras=lenses, images=images, seeds=seeds, depths={}, masks={})  # these are alpha now
    nerfstudio.write_capture(path, written)


LAYOUTS = {
    "nerfstudio": Layout(
        nerfstudio.FILE_NAME,
        lambda path: (path.suffix.lower() == ".json" and not path.is_dir()) or (path / nerfstudio.FILE_NAME).is_file(),
        _read_nerfstudio,
        _write_nerfstudio,
        held_out=None,
        holds_seeds=True,
    ),
    "n3v": Layout("cam??.mp4 and poses_bounds.npy", n3v.matches, n3v.read, n3v.write, scale=2, names=n3v.names),
    "technicolor": Layout(
        "SCENE_undist_FRAME_CAMERA.png and cameras_parameters.txt",
        technicolor.matches,
        technicolor.read,
        technicolor.write,
        held_out=(technicolor.HELD_OUT,),
        names=technicolor.names,
    ),
    "immersive": Layout(
        "models.json and a video per camera",
        immersive.matches,
        immersive.read,
        immersive.write,
        scale=2,
        held_out=(immersive.HELD_OUT,),
        names=immersive.names,
    ),
    "colmap": Layout(
        "images and sparse/0, or folders colmap_FRAME",
        colmap.matches,
        colmap.read,
        colmap.write,
        holds_seeds=True,
    ),
    "rerf": Layout(
        "image/CCC.mp4, mask/CCC.mp4, CamPose.inf and Intrinsic.inf, or cams_FRAME.json",
        rerf.matches,
        rerf.read,
        rerf.write,
        held_out=rerf.HELD_OUT,
        protocol=Protocol("ReRF", ("psnr", "ssim_gauss"), rerf.WHITE),
        names=rerf.names,
    ),
    "actorshq": Layout(
        "calibration.csv, rgbs and masks, or folders 1x, 2x, 4x with them",
        actorshq.matches,
        actorshq.read,
        actorshq.write,
        held_out=actorshq.HELD_OUT,
        protocol=Protocol("HumanRF", ("psnr_mask", "ssim_crop"), actorshq.BLACK, actorshq.protocol_views),
        names=actorshq.names,
    ),
    "videos": Layout("a video per camera", videos.matches, videos.read, videos.write),
}


def read_capture(path: str | Path, options: CaptureOptions | None = None, **changes: Any) -> Capture:
    """Read the capture that lies at `path`: a folder in any of the `LAYOUTS`, or a transforms.json.

    `changes` are single fields of `CaptureOptions`, as in `read_capture(path, layout="n3v", scale=4)`. What
    `holoreel sfm` left in the folder is attached where the capture has no seed points of its own. Raises
    `HoloreelError` saying what lies there where it is not what was expected.
    """
    path = Path(path)
    options = replace(options or CaptureOptions(), **changes)
    name = find_layout(path, options)
    capture = LAYOUTS[name].read(path, options)
    folder = options.sfm or (path if path.is_dir() else path.parent) / sfm_result.FOLDER
    if options.sfm or (not capture.seeds and sfm_result.has_result(folder)):
        capture = sfm_result.attach(capture, folder)
    return finish(capture, options, LAYOUTS[name])


def find_layout(path: Path, options: CaptureOptions) -> str:
    """Return the name of the layout of what lies at `path`; raises `HoloreelError` where it is none."""
    try:
        return _find_layout(path, options)
    except OSError as error:
        raise HoloreelError(f"{path} cannot be read ({error.strerror or error}): check the path.") from error


def _find_layout(path: Path, options: CaptureOptions) -> str:
    if options.layout != "auto":
        if options.layout not in LAYOUTS:
            raise HoloreelError(f"--layout {options.layout}: no such layout; take one of auto, {', '.join(LAYOUTS)}.")
        if not LAYOUTS[options.layout].matches(path):
            raise HoloreelError(
                f"{path} {_contents(path)}, no {options.layout} capture ({LAYOUTS[options.layout].files}); give the "
                "folder of one, or another --layout."
            )
        return options.layout
    for name, layout in LAYOUTS.items():
        if layout.matches(path):
            return name
    known = "; ".join(layout.files for layout in LAYOUTS.values())
    raise HoloreelError(f"{path} {_contents(path)}, none of the captures that can be read ({known}).")


def _contents(path: Path) -> str:
    """What lies at `path`, in a few words."""
    if not path.is_dir():
        return "is a file" if path.is_file() else "is not there"
    kinds = Counter("folders" if entry.is_dir() else (entry.suffix or "other") for entry in path.iterdir())
    if not kinds:
        return "is an empty folder"
    return "holds " + ", ".join(f"{count} {kind}" for kind, count in kinds.most_common(4))


def finish(capture: Capture, options: CaptureOptions, layout: Layout) -> Capture:
    """Apply what every layout has in common: held-out cameras, size, rate and the place on the timeline."""
    scale = options.scale or layout.scale
    changes: dict[str, Any] = {"splits": _splits(capture, options, layout)}
    if scale > 1:
        changes["cameras"] = {name: _scaled(capture, name, scale) for name in capture.cameras}
        changes["depths"] = {}  # depths of a coarser grid are no means of finer ones
    if options.fps is not None:
        changes["fps"] = options.fps
    if options.frame_start is not None:
        changes["frame_start"] = options.frame_start
    return replace(capture, **changes)


def _splits(capture: Capture, options: CaptureOptions, layout: Layout) -> dict[str, str]:
    if options.test_cameras:
        held_out = [name for name in options.test_cameras if name != "none"]
        if unknown := [name for name in held_out if name not in capture.cameras]:
            raise HoloreelError(
                f"{capture.source}: there is no camera {unknown[0]!r} to hold out; it has "
                f"{', '.join(list(capture.cameras)[:50])}."
            )
    elif layout.held_out is None:
        return capture.splits
    else:
        held_out = default_held_out(layout, list(capture.cameras))
    return {name: "test" if name in held_out else "train" for name in capture.cameras}


def protocol_of(capture: Capture) -> Protocol | None:
    """Return the protocol whose cameras are held out in a capture, whatever its layout; None where there is none."""
    held_out = set(capture.camera_names("test"))
    found = (row.protocol for row in LAYOUTS.values() if row.protocol and held_out == set(row.held_out or ()))
    return next(found, None)


def named_protocol(name: str, capture: Capture) -> Protocol:
    """Return the protocol of a name in lower case; `HoloreelError` where a capture holds out other cameras than it."""
    layout = next(row for row in LAYOUTS.values() if row.protocol and row.protocol.name.lower() == name)
    wanted, held_out = list(layout.held_out or ()), capture.camera_names("test")
    assert layout.protocol is not None
    if set(wanted) != set(held_out):
        lacking = [camera for camera in wanted if camera not in capture.cameras]
        remedy = f"it has no {lacking[0]}" if lacking else f"read it with --test-cameras {' '.join(wanted)}"
        raise HoloreelError(
            f"{capture.source}: --protocol {name} holds {', '.join(wanted)} out, here it is "
            f"{', '.join(held_out) or 'none'}; {remedy}."
        )
    return layout.protocol


def default_held_out(layout: Layout, names: Sequence[str]) -> list[str]:
    """Return which of the cameras `names`, in order, a reader of the layout holds out where nobody says."""
    if len(names) == 1:
        return []
    return [name for name in layout.held_out or () if name in names] or [names[0]]


def _scaled(capture: Capture, name: str, scale: int) -> Any:
    camera = capture.cameras[name]
    if camera.width % scale or camera.height % scale:
        raise HoloreelError(
            f"{capture.source}: {name} is {camera.width}x{camera.height}, which --scale {scale} does not divide; "
            "choose another --scale."
        )
    return camera.scaled(camera.width // scale, camera.height // scale)
