# SPDX-License-Identifier: GPL-3.0-or-later
"""The `.reel` manifest, and one door to everything that holds Spacetime Gaussians. Needs numpy only.

A reel is a JSON file `NAME.reel` that ties together payload files beside it (or in folders below it):

    {"kind": "spacetime_gaussians", "version": 1, "fps": 24.0, "frame_start": 1, "frame_count": 100,
     "bounds": [[x, y, z], [x, y, z]], "up": "Z", "color_space": "display", "background": [0, 0, 0],
     "variant": "full", "decoder": {"output": "sigmoid", "viewpoint": [x, y, z]},
     "segments": [{"file": "NAME.000.ply", "frame_start": 1, "frame_count": 50,
                   "decoder": "NAME.000.decoder.safetensors"}, ...],
     "near": 0.2, "files": {"metrics": "metrics.json"}, "provenance": {...}}

Segments follow each other without gap. Frame j of a segment's F frames has the normalized time j / F, in [0, 1). A lite
reel has `decoder` null, and its segments have none.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, NamedTuple, TypeGuard

import numpy as np

from .errors import HoloreelError
from .files import read_json, write_json
from .gaussians.decoder import ACTIVATIONS, Activation, Decoder, decoder_path, read_decoder, write_decoder
from .gaussians.model import SpacetimeGaussians
from .gaussians.payload import PAYLOADS, find_decoder, read_payload, write_payload

KIND = "spacetime_gaussians"
VIDEORF = "videorf"  # the other kind of reel: `videorf.package`
VERSION = 1
UP_AXES = ("X", "-X", "Y", "-Y", "Z", "-Z")
COLOR_SPACES = ("display",)  # colors are sRGB as displayed: what was seen in the 8-bit pictures, divided by 255
BARE_FRAME_COUNT = 50  # what the authors train on, and assumed where a file does not say
BARE_FPS = 30.0
NEAR = 0.2  # what the authors draw with, and assumed where a manifest does not say

SEGMENT_SUFFIXES = (".ply", ".stgc")  # payloads that a segment may have
_SUFFIX_WORDS = " or ".join(SEGMENT_SUFFIXES)
_ENDINGS = ".reel, .ply, .stgc or .splatv"

Triple = tuple[float, float, float]
Bounds = tuple[Triple, Triple]


@dataclass(frozen=True)
class Segment:
    """A run of frames that one payload file holds, and the file of its decoder if it has one.

    Paths are relative to the manifest, with forward slashes.
    """

    file: str
    frame_start: int
    frame_count: int
    decoder: str | None = None


class SegmentPayload(NamedTuple):
    """What a segment is written from."""

    gaussians: SpacetimeGaussians
    decoder: Decoder | None
    frame_start: int
    frame_count: int


@dataclass(frozen=True)
class Reel:
    """What a `.reel` manifest says.

    `bounds` is the box of the visible Gaussians' centers (lowest, highest corner), `up` the world axis that points up
    (None where unknown), `background` the color the Gaussians were trained over. `decoder_output` is the activation
    that the segments' decoders end in (None where there are none), `viewpoint` the place from which a full model's
    colors are taken where only one for each Gaussian can be shown. Gaussians nearer to the camera than `near` are not
    drawn: it was so in training. `files` names further files by purpose (`config`,
    `metrics`, `log`); `provenance` is free.
    """

    path: Path
    fps: float
    frame_start: int
    frame_count: int
    segments: tuple[Segment, ...]
    variant: str = "lite"
    bounds: Bounds | None = None
    up: str | None = None
    color_space: str = "display"
    background: Triple = (0.0, 0.0, 0.0)
    decoder_output: Activation | None = None
    viewpoint: Triple | None = None
    near: float = NEAR
    files: dict[str, str] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)

    def locate(self, frame: float) -> tuple[int, float]:
        """Return the segment that shows `frame` (sub-frames allowed, held at both ends) and its normalized time."""
        index = 0
        while index + 1 < len(self.segments) and frame >= self.segments[index + 1].frame_start:
            index += 1
        segment = self.segments[index]
        step = min(max(frame - segment.frame_start, 0.0), float(segment.frame_count))
        return index, step / segment.frame_count

    def payload(self, segment: int = 0) -> Path:
        """Return the path of a segment's payload file."""
        return self.path.parent / self.segments[segment].file

    def decoder(self, segment: int = 0) -> Path | None:
        """Return the path of a segment's decoder, None where it has none."""
        file = self.segments[segment].decoder
        return None if file is None else self.path.parent / file


@dataclass(frozen=True)
class Loaded:
    """Spacetime Gaussians with what is needed to play them, whatever file they came from.

    `kind` is `reel`, `ply`, `stgc` or `splatv`; `report` says in sentences what was assumed and what is unusual. Frame
    j of `frame_count`, counted from `frame_start`, has the normalized time j / frame_count. A full model is drawn with
    its `decoder`; where there is none, its base color stands for the color. `viewpoint` is as in `Reel`.
    """

    gaussians: SpacetimeGaussians
    path: Path
    kind: str
    fps: float
    frame_start: int
    frame_count: int
    up: str | None
    color_space: str
    background: Triple
    report: list[str]
    reel: Reel | None = None
    decoder: Decoder | None = None
    viewpoint: Triple | None = None

    def time_of(self, frame: float) -> float:
        """Return the normalized time of a frame (sub-frames allowed)."""
        return (frame - self.frame_start) / self.frame_count


def load_gaussians(path: str | Path, segment: int = 0, decoder_output: Activation | None = None) -> Loaded:
    """Load a `.reel` (its `segment`-th payload), or a bare `.ply`, `.stgc` or `.splatv`.

    `decoder_output` is the activation of a bare full model whose `.pt` beside it does not say it (None: sigmoid).
    Raises `HoloreelError` for a missing, damaged or unknown file.
    """
    path = Path(path)
    if path.is_dir():
        raise HoloreelError(f"{path} is a folder: give the {_ENDINGS} file inside it.")
    if path.suffix.lower() == ".reel":
        if decoder_output is not None:
            raise HoloreelError(f"{path} says itself what its decoder ends in: leave --decoder-output away.")
        return _load_reel(path, segment)
    if path.suffix.lower() not in PAYLOADS:
        raise HoloreelError(f"{path} has the unknown ending '{path.suffix}': give a {_ENDINGS} file.")
    gaussians, report = read_payload(path)
    decoder, notes = find_decoder(path, gaussians, decoder_output)
    assumed = f"{path.name} does not say how long it is: {BARE_FRAME_COUNT} frames at {BARE_FPS:g} fps are assumed."
    return Loaded(
        gaussians,
        path,
        kind=path.suffix.lower()[1:],
        fps=BARE_FPS,
        frame_start=0,
        frame_count=BARE_FRAME_COUNT,
        up=None,
        color_space="display",
        background=(0.0, 0.0, 0.0),
        report=[assumed, *report, *notes],
        decoder=decoder,
    )


def load_segments(path: str | Path) -> list[Loaded]:
    """Load all segments of a `.reel`, or the one that a bare file is. Raises as `load_gaussians` does."""
    first = load_gaussians(path)
    count = 1 if first.reel is None else len(first.reel.segments)
    return [first, *(load_gaussians(path, index) for index in range(1, count))]


def _load_reel(path: Path, index: int) -> Loaded:
    reel = read_reel(path)
    if not 0 <= index < len(reel.segments):
        raise HoloreelError(f"{path} has no segment {index}: take 0 to {len(reel.segments) - 1}.")
    segment, payload = reel.segments[index], reel.payload(index)
    if not payload.is_file():
        raise HoloreelError(f"{path}: its payload '{segment.file}' is missing; put {payload} beside the reel.")
    gaussians, report = read_payload(payload)
    if gaussians.variant != reel.variant:
        raise HoloreelError(
            f"{path} says 'variant' {reel.variant}, but '{segment.file}' is {gaussians.variant}: "
            "correct the variant, or put the right payload beside the reel."
        )
    decoder = _load_decoder(reel, index)
    if decoder is None and gaussians.variant == "full":
        report.append(f"{path.name} is a full model without a decoder: the base color stands for the color.")
    return Loaded(
        gaussians,
        path,
        kind="reel",
        fps=reel.fps,
        frame_start=segment.frame_start,
        frame_count=segment.frame_count,
        up=reel.up,
        color_space=reel.color_space,
        background=reel.background,
        report=report,
        reel=reel,
        decoder=decoder,
        viewpoint=reel.viewpoint,
    )


def _load_decoder(reel: Reel, index: int) -> Decoder | None:
    path, file = reel.decoder(index), reel.segments[index].decoder
    if path is None:
        return None
    if not path.is_file():
        raise HoloreelError(f"{reel.path}: its decoder '{file}' is missing; put {path} beside the reel.")
    decoder = read_decoder(path)
    if decoder.activation != reel.decoder_output:
        raise HoloreelError(
            f"{reel.path} says 'decoder.output' {reel.decoder_output}, but '{file}' says {decoder.activation}: "
            "put the right decoder beside the reel."
        )
    return decoder


def write_segments(
    path: str | Path,
    payloads: Sequence[SegmentPayload],
    *,
    fps: float,
    frame_start: int,
    up: str | None = None,
    background: Triple = (0.0, 0.0, 0.0),
    viewpoint: Triple | None = None,
    near: float = NEAR,
    files: dict[str, str] | None = None,
    provenance: dict[str, Any] | None = None,
    suffix: str = ".ply",
) -> Reel:
    """Write a reel of one or more segments, all lite, or all full with decoders of one activation (or none with any).

    First the payloads, `NAME.ply` or, of several, `NAME.000.ply` and so on, and the decoders beside them; then the
    manifest `NAME.reel` at `path`. `suffix` `.stgc` writes compact payloads. Raises `HoloreelError` naming what does
    not hold together.
    """
    path = Path(path)
    stems = [path.stem] if len(payloads) == 1 else [f"{path.stem}.{index:03d}" for index in range(len(payloads))]
    segments = tuple(
        Segment(
            stem + suffix,
            part.frame_start,
            part.frame_count,
            decoder_path(Path(stem + suffix)).name if part.decoder else None,
        )
        for stem, part in zip(stems, payloads, strict=True)
    )
    boxes = [box for part in payloads if (box := part.gaussians.bounds()) is not None]
    variants = sorted({part.gaussians.variant for part in payloads})
    outputs = sorted({part.decoder.activation for part in payloads if part.decoder})
    if len(variants) > 1 or len(outputs) > 1:
        differences = ", ".join((*variants, *outputs))
        raise HoloreelError(f"{path}: its segments differ ({differences}); train them all alike.")
    reel = Reel(
        path,
        fps=float(fps),
        frame_start=frame_start,
        frame_count=sum(part.frame_count for part in payloads),
        segments=segments,
        variant="".join(variants),
        bounds=_union(boxes),
        up=up,
        background=background,
        decoder_output=outputs[0] if outputs else None,
        viewpoint=viewpoint if outputs else None,
        near=near,
        files=files or {},
        provenance=provenance or {},
    )
    check_reel(reel)
    for index, part in enumerate(payloads):
        write_payload(reel.payload(index), part.gaussians)
        decoder = reel.decoder(index)
        if part.decoder and decoder:
            write_decoder(decoder, part.decoder)
    write_reel(reel)
    return reel


def _union(boxes: list[np.ndarray]) -> Bounds | None:
    if not boxes:
        return None
    low, high = np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)
    return tuple(low.tolist()), tuple(high.tolist())


def save_gaussians(
    path: str | Path,
    gaussians: SpacetimeGaussians,
    *,
    fps: float,
    frame_start: int,
    frame_count: int,
    decoder: Decoder | None = None,
    up: str | None = None,
    background: Triple = (0.0, 0.0, 0.0),
    viewpoint: Triple | None = None,
    files: dict[str, str] | None = None,
    provenance: dict[str, Any] | None = None,
) -> Reel:
    """Write `gaussians` as a reel of one segment: `NAME.ply` (and its decoder), then the manifest `NAME.reel`."""
    return write_segments(
        path,
        [SegmentPayload(gaussians, decoder, frame_start, frame_count)],
        fps=fps,
        frame_start=frame_start,
        up=up,
        background=background,
        viewpoint=viewpoint,
        files=files,
        provenance=provenance,
    )


def write_reel(reel: Reel) -> None:
    """Write the manifest at `reel.path`, atomically; payloads should be there already."""
    check_reel(reel)
    manifest = {
        "kind": KIND,
        "version": VERSION,
        "fps": reel.fps,
        "frame_start": reel.frame_start,
        "frame_count": reel.frame_count,
        "bounds": reel.bounds,
        "up": reel.up,
        "color_space": reel.color_space,
        "background": reel.background,
        "variant": reel.variant,
        "decoder": _decoder_json(reel),
        "near": reel.near,
        "segments": [{k: v for k, v in vars(part).items() if v is not None} for part in reel.segments],
        "files": reel.files,
        "provenance": reel.provenance,
    }
    write_json(reel.path, manifest)


def _decoder_json(reel: Reel) -> dict[str, Any] | None:
    if reel.decoder_output is None:
        return None
    return {"output": reel.decoder_output} | ({"viewpoint": reel.viewpoint} if reel.viewpoint else {})


def reel_kind(path: str | Path) -> str:
    """Return the `kind` of a reel, "" where there is none or the file does not end in .reel. Reads no more than that.

    Raises `HoloreelError` where the file is missing or no JSON.
    """
    path = Path(path)
    if path.suffix.lower() != ".reel" or path.is_dir():
        return ""
    kind = read_json(path).get("kind")
    return kind if isinstance(kind, str) else ""


def read_reel(path: str | Path) -> Reel:
    """Read and check a manifest, not its payloads. Raises `HoloreelError` naming the field that is wrong."""
    path = Path(path)
    manifest = read_json(path)
    if manifest.get("kind") == VIDEORF:
        raise HoloreelError(
            f"{path}: 'kind' is '{VIDEORF}', a video that holds no Gaussians: draw it with `holoreel render`, or make "
            "points of it with `holoreel export --to points`."
        )
    if manifest.get("kind") != KIND:
        raise HoloreelError(f"{path}: 'kind' is {manifest.get('kind')!r}, not '{KIND}'; give a reel of Gaussians.")
    version = manifest.get("version")
    if not _is_int(version) or version < 1:
        raise HoloreelError(f"{path}: 'version' is {version!r}, not a positive whole number; write the reel again.")
    if version > VERSION:
        raise HoloreelError(
            f"{path} is a reel of version {version}, this Holoreel reads up to {VERSION}: update Holoreel."
        )
    decoder = manifest.get("decoder") or {}
    if not isinstance(decoder, dict) or (decoder and decoder.get("output") not in ACTIVATIONS):
        raise HoloreelError(
            f"{path}: 'decoder' is {decoder!r}, not null or an object with 'output' {', '.join(ACTIVATIONS)}; "
            "correct it or write the reel again."
        )
    viewpoint = decoder.get("viewpoint")
    segments = manifest.get("segments")
    if not isinstance(segments, list) or not all(isinstance(segment, dict) for segment in segments):
        raise HoloreelError(f"{path}: 'segments' is not a list of objects; write the reel again.")
    reel = Reel(
        path=path,
        fps=manifest.get("fps"),  # type: ignore[arg-type]  # judged below, with the rest
        frame_start=manifest.get("frame_start"),  # type: ignore[arg-type]
        frame_count=manifest.get("frame_count"),  # type: ignore[arg-type]
        segments=tuple(Segment(*(part.get(key) for key in Segment.__annotations__)) for part in segments),
        variant=manifest.get("variant", ""),
        bounds=_parse_bounds(path, manifest.get("bounds")),
        up=manifest.get("up"),
        color_space=manifest.get("color_space", ""),
        background=_parse_triple(path, "background", manifest.get("background", (0.0, 0.0, 0.0))),
        decoder_output=decoder.get("output"),
        viewpoint=None if viewpoint is None else _parse_triple(path, "decoder.viewpoint", viewpoint),
        near=manifest.get("near", NEAR),
        files=manifest.get("files", {}),
        provenance=manifest.get("provenance", {}),
    )
    check_reel(reel)
    return reel


def check_reel(reel: Reel) -> None:
    """Raise `HoloreelError`, naming the field, where a reel does not hold together."""

    def demand(right: bool, name: str, value: Any, wanted: str) -> None:
        if not right:
            raise HoloreelError(
                f"{reel.path}: '{name}' is {value!r}, not {wanted}; correct it or write the reel again."
            )

    if reel.path.suffix.lower() != ".reel":
        raise HoloreelError(f"{reel.path} does not end in .reel: give it a name like {reel.path.stem or 'name'}.reel.")
    demand(_is_number(reel.fps) and 0 < reel.fps <= 1000, "fps", reel.fps, "a number from above 0 to 1000")
    demand(_is_int(reel.frame_start), "frame_start", reel.frame_start, "a whole number")
    demand(
        _is_int(reel.frame_count) and reel.frame_count > 0, "frame_count", reel.frame_count, "a positive whole number"
    )
    demand(reel.variant in ("lite", "full"), "variant", reel.variant, "'lite' or 'full'")
    demand(reel.variant == "full" or reel.decoder_output is None, "decoder", reel.decoder_output, "null in a lite reel")
    demand(_is_number(reel.near) and reel.near > 0, "near", reel.near, "a positive number")
    demand(reel.up is None or reel.up in UP_AXES, "up", reel.up, f"null or one of {', '.join(UP_AXES)}")
    demand(reel.color_space in COLOR_SPACES, "color_space", reel.color_space, f"one of {', '.join(COLOR_SPACES)}")
    demand(isinstance(reel.provenance, dict), "provenance", reel.provenance, "an object")
    demand(isinstance(reel.files, dict), "files", reel.files, "an object")
    for purpose, file in reel.files.items():
        demand(_is_safe(file), f"files.{purpose}", file, "a relative path below the reel")
    demand(len(reel.segments) > 0, "segments", [], "a list with at least one segment")
    expected = reel.frame_start
    for index, segment in enumerate(reel.segments):
        at = f"segments[{index}]"
        demand(_is_safe(segment.file), f"{at}.file", segment.file, "a relative path below the reel")
        demand(segment.file.endswith(SEGMENT_SUFFIXES), f"{at}.file", segment.file, f"a {_SUFFIX_WORDS} file")
        if reel.decoder_output is None:
            demand(segment.decoder is None, f"{at}.decoder", segment.decoder, "null, as 'decoder' of the reel is")
        else:
            demand(_is_safe(segment.decoder), f"{at}.decoder", segment.decoder, "a relative path below the reel")
            demand(
                str(segment.decoder).endswith(".safetensors"), f"{at}.decoder", segment.decoder, "a .safetensors file"
            )
        count = segment.frame_count
        demand(_is_int(count) and count > 0, f"{at}.frame_count", count, "a positive whole number")
        start = segment.frame_start
        demand(_is_int(start) and start == expected, f"{at}.frame_start", start, f"{expected}, without gap")
        expected += segment.frame_count
    total = expected - reel.frame_start
    demand(reel.frame_count == total, "frame_count", reel.frame_count, f"{total}, the sum of its segments")


def _parse_bounds(path: Path, value: Any) -> Bounds | None:
    if value is None:
        return None
    if not isinstance(value, list | tuple) or len(value) != 2:
        raise HoloreelError(f"{path}: 'bounds' is not [lowest corner, highest corner] or null; write the reel again.")
    low, high = _parse_triple(path, "bounds", value[0]), _parse_triple(path, "bounds", value[1])
    if any(a > b for a, b in zip(low, high, strict=True)):
        raise HoloreelError(f"{path}: 'bounds' does not have its lowest corner first; write the reel again.")
    return low, high


def _parse_triple(path: Path, name: str, value: Any) -> Triple:
    if not isinstance(value, list | tuple) or len(value) != 3 or not all(_is_number(part) for part in value):
        raise HoloreelError(f"{path}: '{name}' has {value!r} where three finite numbers belong; write the reel again.")
    return float(value[0]), float(value[1]), float(value[2])


def _is_int(value: Any) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**31


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300


def _is_safe(value: Any) -> bool:
    """Whether `value` is a path that cannot leave the reel's folder, on any system."""
    if not isinstance(value, str) or not value or "\\" in value or "\0" in value or PureWindowsPath(value).drive:
        return False
    relative = PurePosixPath(value)
    return not relative.is_absolute() and ".." not in relative.parts
