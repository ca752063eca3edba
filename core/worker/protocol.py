# SPDX-License-Identifier: GPL-3.0-or-later
"""What the worker and its client say: JSON-RPC 2.0, one message per line over the worker's standard streams.

Requests of the client:

    hello {protocol, backend, cache_mb}   -> {protocol, version, python}; the first one
    open {path, rung}                     -> {frame_start, frame_count, background, report}
    draw {shot, buffer, bytes}            -> {seconds: {draw, finish}}; pixels are in the file `buffer` (`frames`)
    close {path}                          -> {}; forgets what was opened of a file
    shutdown {}                           -> {}; and ends

and its notifications `cancel {id}`, after which the request with that id fails with CANCELLED as soon as may be, and
`release {buffer}`, after which a buffer is not used again. The worker sends the notifications `progress {id, done, of}`
and `log {text}`. It ends when its standard input does.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..camera import Camera
from ..errors import HoloreelError
from ..files import finite
from ..reel import Triple

PROTOCOL = 1  # to be raised whenever one end would misunderstand the other
MAX_LINE = 1 << 20  # bytes
MODULE = "holoreel.core.worker"

MENDABLE, CANCELLED = -32000, -32001  # a sentence of a `HoloreelError`; what `cancel` asked for
PARSE_ERROR, NO_REQUEST, NO_METHOD, BAD_PARAMETERS, FAILED = -32700, -32600, -32601, -32602, -32603  # the standard's

Message = dict[str, Any]


class CancelledError(Exception):
    """Somebody wanted the picture no longer."""


@dataclass(frozen=True)
class Layer:
    """One reel in a picture.

    `step` frames of `frame_count` have passed since the file's first one (sub-frames count). `camera` looks at it in
    the reel's own space, where `scale` units of the scene are one; depth comes out in the scene's units.
    """

    path: Path
    step: float
    frame_count: int
    camera: Camera
    scale: float = 1.0
    rung: str | None = None

    def to_json(self) -> Message:
        """Return what `from_json` takes."""
        return {
            "path": str(self.path.absolute()),
            "step": self.step,
            "frame_count": self.frame_count,
            "camera": self.camera.to_json(),
            "scale": self.scale,
            "rung": self.rung,
        }

    @classmethod
    def from_json(cls, value: Message) -> "Layer":
        """Read a layer; raises `HoloreelError` for numbers that cannot be."""
        step, scale, count = finite(value.get("step")), finite(value.get("scale")), finite(value.get("frame_count"))
        if step is None or scale is None or scale <= 0 or count is None or count < 1:
            raise HoloreelError("layer: 'step', 'frame_count' and 'scale' must be numbers, the last two positive.")
        rung = value.get("rung")
        if not isinstance(value.get("path"), str) or not isinstance(rung, str | None):
            raise HoloreelError("layer: 'path' must be text, and 'rung' text or null.")
        camera = Camera.from_json(_object(value, "camera"), "layer")
        return cls(Path(value["path"]), step, int(count), camera, scale, rung)


@dataclass(frozen=True)
class Shot:
    """One picture of all layers, whose cameras have the same size and lens.

    `region` is the part (left, top, right, bottom) in pixels from the top left that is wanted, None for all.
    `background` is what lies behind, None for the background of the first layer's file; where `transparent`, nothing
    does. `linear` converts the colors from display-referred to scene-linear. `quality` is of a VideoRF (`core.draw`).
    `along_rays` measures depth along the rays, as Cycles does for panoramic cameras, instead of along the view.
    """

    layers: tuple[Layer, ...]
    region: tuple[int, int, int, int] | None = None
    transparent: bool = False
    background: Triple | None = None
    linear: bool = False
    quality: str = "full"
    along_rays: bool = False

    def __post_init__(self) -> None:
        if not self.layers:
            raise HoloreelError("shot: 'layers' is empty; a picture shows at least one reel.")
        if len({(layer.camera.width, layer.camera.height) for layer in self.layers}) > 1:
            raise HoloreelError("shot: the cameras of its layers differ in size.")
        camera = self.layers[0].camera
        left, top, right, bottom = self.window
        if not (0 <= left < right <= camera.width and 0 <= top < bottom <= camera.height):
            raise HoloreelError(f"shot: 'region' {self.region} is no part of {camera.width} x {camera.height} pixels.")

    @property
    def window(self) -> tuple[int, int, int, int]:
        """What is drawn: `region`, or all."""
        camera = self.layers[0].camera
        return self.region or (0, 0, camera.width, camera.height)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of what is drawn."""
        left, top, right, bottom = self.window
        return right - left, bottom - top

    def to_json(self) -> Message:
        """Return what `from_json` takes."""
        return {
            "layers": [layer.to_json() for layer in self.layers],
            "region": self.region,
            "transparent": self.transparent,
            "background": self.background,
            "linear": self.linear,
            "quality": self.quality,
            "along_rays": self.along_rays,
        }

    @classmethod
    def from_json(cls, value: Message) -> "Shot":
        """Read a shot; raises `HoloreelError` for what cannot be."""
        layers, region, background = value.get("layers"), value.get("region"), value.get("background")
        if not isinstance(layers, list) or not all(isinstance(layer, dict) for layer in layers):
            raise HoloreelError("shot: 'layers' must be a list of objects.")
        if region is not None and not _are_numbers(region, 4):
            raise HoloreelError("shot: 'region' must be 4 numbers or null.")
        if background is not None and not _are_numbers(background, 3):
            raise HoloreelError("shot: 'background' must be 3 numbers or null.")
        left, top, right, bottom = map(int, region or (0, 0, 0, 0))
        return cls(
            tuple(map(Layer.from_json, layers)),
            None if region is None else (left, top, right, bottom),
            bool(value.get("transparent")),
            None if background is None else (float(background[0]), float(background[1]), float(background[2])),
            bool(value.get("linear")),
            str(value.get("quality", "full")),
            bool(value.get("along_rays")),
        )


def encode(message: Message) -> bytes:
    """Return a message as its line."""
    return json.dumps({"jsonrpc": "2.0", **message}, allow_nan=False).encode() + b"\n"


def decode(line: bytes) -> Message:
    """Read a line; a ValueError where it is no message."""
    if len(line) > MAX_LINE or not line.endswith(b"\n"):
        raise ValueError("a message is cut off or too long")
    message = json.loads(line)
    if not isinstance(message, dict) or message.get("jsonrpc") != "2.0":
        raise ValueError("not a JSON-RPC 2.0 message")
    return message


def _object(value: Message, key: str) -> Message:
    if not isinstance(value.get(key), dict):
        raise HoloreelError(f"'{key}' must be an object.")
    return value[key]


def _are_numbers(value: Any, count: int) -> bool:
    return isinstance(value, list) and len(value) == count and all(finite(number) is not None for number in value)
