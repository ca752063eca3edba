# SPDX-License-Identifier: GPL-3.0-or-later
"""Draw a shot: every reel by its own player, then one over the other, into what Blender takes."""

import time
from collections import OrderedDict
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from ..camera import Camera
from ..draw import Player, open_player
from ..errors import HoloreelError
from ..reel import VIDEORF, Triple, reel_kind
from ..render import Backend
from ..render.native import available_cores
from .frames import FAR, Array, Pixels
from .protocol import Layer, Shot

BLACK: Triple = (0.0, 0.0, 0.0)
ROWS = 32  # finished at once
_TOP = 65535
BAND_SECONDS = 0.5  # drawn at once: how long somebody who cancels waits, where a picture can be drawn in parts

Step = Callable[[int, int], None]  # called with how many of how many parts are done; may raise `CancelledError`


class Part(NamedTuple):
    """What one reel shows, rows from the top: premultiplied color, alpha, depth, and the color behind it."""

    color: Array  # (H, W, 3)
    alpha: Array  # (H, W)
    depth: Array  # (H, W)
    behind: Array  # (H, W, 3) or (1, 1, 3)


class _Opened(NamedTuple):
    player: Player
    size: int
    stamp: tuple[int, int]


class Players:
    """Open files, the longest unused forgotten first where they take more than `cache_mb` on disk.

    A file that has changed since it was opened is opened again.
    """

    def __init__(self, backend: Backend = "auto", cache_mb: int = 2048):
        self.backend, self.cache = backend, cache_mb << 20
        self._open: OrderedDict[tuple[Path, str | None], _Opened] = OrderedDict()
        self._seconds: dict[Player, float] = {}

    def get(self, path: Path, rung: str | None = None) -> Player:
        """Return the player of a file. Raises `HoloreelError` as `core.draw.open_player` does."""
        key, stamp = (path, rung), _stamp(path)
        if key in self._open and self._open[key].stamp != stamp:
            self._forget(key)
        if key not in self._open:
            player = open_player(path, self.backend, rung=rung)
            self._open[key] = _Opened(player, player.size(), stamp)
        self._open.move_to_end(key)
        while len(self._open) > 1 and sum(opened.size for opened in self._open.values()) > self.cache:
            self._forget(next(iter(self._open)))
        return self._open[key].player

    def close(self, path: Path) -> None:
        """Forget all that was opened of a file."""
        for key in [key for key in self._open if key[0] == path]:
            self._forget(key)

    def seconds(self, player: Player) -> float | None:
        """Return how long a pixel of this player took the last time, None before the first."""
        return self._seconds.get(player)

    def took(self, player: Player, seconds: float) -> None:
        """Remember how long a pixel took."""
        self._seconds[player] = seconds

    def _forget(self, key: tuple[Path, str | None]) -> None:
        self._seconds.pop(self._open.pop(key).player, None)


def _stamp(path: Path) -> tuple[int, int]:
    try:
        status = path.stat()
    except OSError as error:
        raise HoloreelError(
            f"{path} cannot be read ({error.strerror or error}): put it back, or find it again with Relink."
        ) from error
    return status.st_mtime_ns, status.st_size


def draw_shot(players: Players, shot: Shot, pixels: Pixels, step: Step) -> dict[str, float]:
    """Draw a shot into `pixels`; return the seconds of `draw`, the players' own, and `finish`, all that is added.

    Where several reels meet in a pixel, the nearer one (by its mean depth there) lies over the farther one, blended as
    the reels themselves are: display-referred.
    """
    began = time.perf_counter()
    parts = [_draw_layer(players, layer, shot, step) for layer in shot.layers]
    drawn = time.perf_counter()
    whole = parts[0] if len(parts) == 1 else _stack(parts)
    _finish(whole, shot, pixels)
    return {"draw": drawn - began, "finish": time.perf_counter() - drawn}


def _draw_layer(players: Players, layer: Layer, shot: Shot, step: Step) -> Part:
    player = players.get(layer.path, layer.rung)
    frame = player.frame_start + layer.step * (player.frame_count / layer.frame_count)
    left, top, right, bottom = shot.window
    if reel_kind(layer.path) == VIDEORF:
        image, alpha, depth = _draw_field(players, player, layer.camera, frame, shot, step)
    else:
        # Drawn whole: what the rasterizer does at the edges depends on where they are.
        step(0, 1)
        image, alpha, depth = (
            drawn[top:bottom, left:right] for drawn in player.draw(layer.camera, frame, _black(player))
        )
    step(1, 1)
    if player.takes_background:
        color, behind = image, _plain(player.background if shot.background is None else shot.background)
    else:  # the decoder has colored every pixel
        color, behind = image * alpha[..., None], image if shot.background is None else _plain(shot.background)
    far = depth if layer.scale == 1.0 else depth * np.float32(layer.scale)
    if shot.along_rays:
        far = far * _stretch(layer.camera, shot.window)
    return Part(color, alpha, far, behind)


def _plain(color: Triple) -> Array:
    return np.array(color, np.float32).reshape(1, 1, 3)


def _black(player: Player) -> Triple | None:
    return BLACK if player.takes_background else None


def _draw_field(
    players: Players, player: Player, camera: Camera, frame: float, shot: Shot, step: Step
) -> tuple[Array, Array, Array]:
    """Draw what is marched ray by ray: only the region, and in bands, so that it can be cancelled between them."""
    from ..videorf.player import FramePlayer, rules_of

    assert isinstance(player, FramePlayer)
    player.rules = rules_of(player.source, shot.quality)
    width, height = shot.size
    each = players.seconds(player)
    rows = height if each is None else max(8, int(BAND_SECONDS / max(each * width, 1e-9)))
    if each is None and height > 64:  # nothing is known yet: a small band tells
        rows = 32
    drawings, done = [], 0
    while done < height:
        step(done, height)
        band = _cut(camera, shot.window, done, min(done + rows, height))
        began = time.perf_counter()
        drawings.append(player.draw(band, frame, BLACK))
        seconds = (time.perf_counter() - began) / (band.width * band.height)
        players.took(player, seconds)
        done += band.height
        rows = max(8, int(BAND_SECONDS / (seconds * width)))
    image, alpha, depth = (np.concatenate(bands) for bands in zip(*drawings, strict=True))
    return image, alpha, depth


def _cut(camera: Camera, window: tuple[int, int, int, int], first: int, last: int) -> Camera:
    """Return a camera that sees rows `first` to `last` of a window of the camera's picture."""
    left, top, right, _ = window
    return replace(camera, width=right - left, height=last - first, cx=camera.cx - left, cy=camera.cy - top - first)


def _stretch(camera: Camera, window: tuple[int, int, int, int]) -> Array:
    """Return how many times longer the way along each pixel's ray is than along the view; 1 from the side on."""
    left, top, right, bottom = window
    part = _cut(camera, window, 0, bottom - top)
    cosine = part.rays()[1] @ camera.world_to_camera[2, :3]
    with np.errstate(invalid="ignore", divide="ignore"):
        stretch = np.where(cosine > 1e-3, 1.0 / cosine, 1.0)
    return stretch.astype(np.float32).reshape(bottom - top, right - left)


def _stack(parts: list[Part]) -> Part:
    """Lay the reels over each other, pixel by pixel, the nearest on top."""
    alphas, colors = (torch.from_numpy(np.stack(arrays)) for arrays in list(zip(*parts, strict=True))[1::-1])
    depths = torch.from_numpy(np.stack([part.depth for part in parts]))
    order = torch.argsort(torch.where(alphas > 0, depths, torch.inf), dim=0, stable=True)
    color, weighted, left = torch.zeros_like(colors[0]), torch.zeros_like(depths[0]), torch.ones_like(depths[0])
    for place in order:
        here = place[None]
        alpha = alphas.gather(0, here)[0]
        color += left[..., None] * colors.gather(0, here[..., None].expand(-1, -1, -1, 3))[0]
        weighted += left * alpha * depths.gather(0, here)[0]
        left = left * (1 - alpha)
    covered = 1 - left
    mean = torch.where(covered > 0, weighted / torch.where(covered > 0, covered, 1.0), 0.0)
    return Part(color.numpy(), covered.numpy(), mean.numpy(), parts[0].behind)


def _finish(part: Part, shot: Shot, pixels: Pixels) -> None:
    """Write what Blender takes: over the background or transparent, scene-linear or not, rows from the bottom up.

    A few rows and one channel at a time, which stay in the processor's cache.
    """
    height = len(part.alpha)
    blocks = [slice(first, min(first + ROWS, height)) for first in range(0, height, ROWS)]
    with ThreadPoolExecutor(available_cores()) as pool:
        for _ in pool.map(lambda rows: _finish_rows(part, rows, shot, pixels), blocks):
            pass


def _finish_rows(part: Part, rows: slice, shot: Shot, pixels: Pixels) -> None:
    height = len(part.alpha)
    rgba, depth, opacity = (array[height - rows.stop : height - rows.start][::-1] for array in pixels)
    alpha = part.alpha[rows]
    left = 1 - alpha
    behind = part.behind[rows] if len(part.behind) > 1 else part.behind
    for channel in range(3):
        color = part.color[rows, :, channel]
        if not shot.transparent:
            color = color + left * behind[..., channel]
            rgba[..., channel] = to_linear(color) if shot.linear else color
        elif shot.linear:  # the colors themselves are converted, not what is left of them by the alpha
            share: Array = np.maximum(alpha, np.float32(1e-8))
            straight: Array = color / share
            rgba[..., channel] = to_linear(straight) * share
        else:
            rgba[..., channel] = color
    rgba[..., 3] = alpha if shot.transparent else 1.0
    opacity[...] = alpha
    depth[...] = np.where(alpha > 0, part.depth[rows], np.float32(FAR))


def to_linear(color: Array) -> Array:
    """Convert sRGB as displayed to linear: from a table where it lies in [0, 1], which is off by less than 2e-5; else
    by the formula, whose curve goes on above 1 and is straight below 0.
    """
    if color.min() >= 0 and color.max() < 1 + 1e-5:  # what rounding leaves of 1 is 1
        return _table()[(np.minimum(color, 1) * np.float32(_TOP) + np.float32(0.5)).astype(np.uint16)]
    return _formula(color)


def _formula(color: Array) -> Array:
    curve = ((np.maximum(color, 0) + np.float32(0.055)) / np.float32(1.055)) ** np.float32(2.4)
    return np.where(color <= np.float32(0.04045), color / np.float32(12.92), curve)


@cache
def _table() -> Array:
    return _formula(np.linspace(0, 1, _TOP + 1, dtype=np.float64)).astype(np.float32)


def each_note(players: Players, shot: Shot) -> Iterator[str]:
    """Yield what the players have to say of the files of a shot."""
    for layer in shot.layers:
        yield from players.get(layer.path, layer.rung).report
