# SPDX-License-Identifier: GPL-3.0-or-later
"""`holoreel info FILE`: what a reel, PLY, .splatv or capture holds, and what is wrong with it."""

import json
from pathlib import Path
from typing import Annotated, Any

import tyro

from ..capture import Capture, CaptureOptions, read_capture
from ..capture.layouts import find_layout
from ..capture.media import media_path
from ..gaussians.decoder import Activation, decoder_path
from ..reel import VIDEORF, Loaded, load_gaussians, reel_kind
from ..videorf.inspect import describe_model, describe_video_reel
from ..videorf.model import is_model


def run(
    file: tyro.conf.Positional[Path],
    /,
    decoder_output: Activation | None = None,
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
    options: Annotated[CaptureOptions, tyro.conf.arg(name="")] = CaptureOptions(),  # noqa: B008
) -> None:
    """Say what a file holds, and what is unusual or wrong.

    Args:
        file: a .reel, .ply, .stgc or .splatv, the NAME.model of a VideoRF, or a capture (a folder in any layout, or a
            transforms.json).
        decoder_output: what the decoder of a bare full model (.ply with a .pt beside it) ends in; sigmoid without it.
        as_json: print JSON for programs to read.
        options: how a capture is read.
    """
    facts = describe(file, options, decoder_output)
    print(json.dumps(facts, indent=1, allow_nan=False) if as_json else table(facts))


def describe(path: Path, options: CaptureOptions, decoder_output: Activation | None = None) -> dict[str, Any]:
    """Return the facts about one file, ready for JSON; `problems` lists sentences."""
    if reel_kind(path) == VIDEORF:
        return describe_video_reel(path)
    if is_model(path):
        return describe_model(path)
    if path.is_dir() or path.suffix.lower() == ".json":
        return describe_capture(path, options)
    loaded = load_gaussians(path, decoder_output=decoder_output)
    return describe_reel(loaded) if loaded.reel else describe_gaussians(loaded)


def describe_gaussians(loaded: Loaded) -> dict[str, Any]:
    """Return the facts about one payload of Gaussians, and its decoder."""
    gaussians, files = loaded.gaussians, _files(loaded)
    box = gaussians.bounds()
    lives = gaussians.lifetimes()
    visible = [len(gaussians.evaluate(time).alive) for time in (0.0, 0.5, 0.98)]
    return {
        "file": str(loaded.path),
        "what": f"{gaussians.variant} Spacetime Gaussians in a {loaded.kind} file",
        "gaussians": len(gaussians),
        "visible at 0, 0.5, 0.98": visible,
        "visible throughout": int(((lives[:, 0] <= 0.0) & (lives[:, 1] >= 1.0)).sum()),
        "frames": f"{loaded.frame_count} from frame {loaded.frame_start} at {loaded.fps:g} fps",
        "temporal centers": [float(gaussians.trbf_centers.min()), float(gaussians.trbf_centers.max())],
        "bounds": None if box is None else box.tolist(),
        "up": loaded.up,
        "decoder": _decoder(loaded),
        "bytes in memory": sum(array.nbytes for array in vars(gaussians).values()),
        "bytes on disk": sum(path.stat().st_size for path in files),
        "problems": [*loaded.report, *gaussians.problems()],
    }


def _decoder(loaded: Loaded) -> str:
    if loaded.gaussians.variant == "lite":
        return "none, a lite model has its colors"
    if loaded.decoder is None:
        return "none, the base color stands for the color"
    return f"per pixel, output activation {loaded.decoder.activation}"


def _files(loaded: Loaded) -> list[Path]:
    """The payload that was loaded, and its decoder if it has one."""
    reel = loaded.reel
    payload = reel.payload(reel.locate(loaded.frame_start)[0]) if reel else loaded.path
    if loaded.decoder is None:
        return [payload]
    return [payload, next(path for path in (decoder_path(payload), payload.with_suffix(".pt")) if path.is_file())]


def describe_reel(first: Loaded) -> dict[str, Any]:
    """Return the facts about a reel: its first segment's, with the numbers of all segments."""
    reel = first.reel
    assert reel is not None
    parts = [describe_gaussians(first)]
    parts += [describe_gaussians(load_gaussians(reel.path, index)) for index in range(1, len(reel.segments))]
    problems = [(part.pop("problems"), segment.file) for part, segment in zip(parts, reel.segments, strict=True)]
    return parts[0] | {
        "what": f"a reel of {reel.variant} Spacetime Gaussians",
        "segments": [
            f"{segment.file}: {segment.frame_count} frames from {segment.frame_start}, "
            f"{part['gaussians']:,} Gaussians, {part['bytes on disk']:,} bytes"
            for segment, part in zip(reel.segments, parts, strict=True)
        ],
        "gaussians": sum(part["gaussians"] for part in parts),
        "frames": f"{reel.frame_count} from frame {reel.frame_start} at {reel.fps:g} fps",
        "bounds": reel.bounds,
        "color space": reel.color_space,
        "background": reel.background,
        "files": reel.files,
        "bytes in memory": sum(part["bytes in memory"] for part in parts),
        "bytes on disk": reel.path.stat().st_size + sum(part["bytes on disk"] for part in parts),
        "problems": [f"{file}: {sentence}" for sentences, file in problems for sentence in sentences],
    }


def describe_capture(path: Path, options: CaptureOptions) -> dict[str, Any]:
    """Return the facts about a capture in any layout; that all its files exist was checked on reading."""
    capture = read_capture(path, options)
    missing = len(capture.cameras) * capture.frame_count - len(capture.images)
    problems = []
    if missing:
        problems.append(f"{missing} pictures of camera and frame do not exist.")
    if not capture.camera_names("test"):
        problems.append("No camera is held out for testing: eval needs --split train.")
    if not capture.seeds:
        problems.append("There are no seed points: training of Gaussians has nothing to start from.")
    return {
        "file": str(capture.source),
        "what": "a multi-view capture",
        "layout": find_layout(path, options),
        "cameras": {
            name: f"{camera.width}x{camera.height} {camera.model}, {capture.split(name)}"
            for name, camera in capture.cameras.items()
        },
        "frames": f"{capture.frame_count} from frame {capture.frame_start} at {capture.fps:g} fps",
        "pictures": len(capture.images),
        "masks": len(capture.masks),
        "subject": _subject(capture),
        "subject bounds": capture.bounds,
        "depth maps": len(capture.depths),
        "frames with seed points": len(capture.seeds),
        "bytes on disk": sum(file.stat().st_size for file in set(map(media_path, capture.images.values()))),
        "notes": list(capture.notes),
        "problems": problems,
    }


def _subject(capture: Capture) -> str:
    if capture.masked:
        return "cut out of every picture"
    return "not told apart in every picture: a VideoRF needs masks or transparent pictures"


def table(facts: dict[str, Any]) -> str:
    """Return facts as lines of text."""
    width = max(map(len, facts))
    lines = []
    for name, value in facts.items():
        for index, text in enumerate(_lines(name, value)):
            lines.append(f"{name if index == 0 else '':{width}}  {text}")
    return "\n".join(lines)


def _lines(name: str, value: Any) -> list[str]:
    if isinstance(value, dict):
        return [f"{key}: {text}" for key, text in value.items()] or ["none"]
    if isinstance(value, list) and value and isinstance(value[0], str):
        return value
    if isinstance(value, list | tuple):
        return ["  ".join(_text(part) for part in value)] if value else ["none found"]
    if name.startswith("bytes"):
        return [f"{value:,} ({value / 2**20:.1f} MiB)"]
    return [_text(value)]


def _text(value: Any) -> str:
    if value is None:
        return "unknown"
    if isinstance(value, list | tuple):
        return f"({', '.join(_text(part) for part in value)})"
    if isinstance(value, float):
        return f"{value:.4g}"
    return f"{value:,}" if isinstance(value, int) else str(value)
