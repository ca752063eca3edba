# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures and plots for reports. Pictures are (H, W, 3) float in [0, 1]; plots are written as SVG."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..files import atomic_path

Picture = NDArray[np.float32]
INK, ACCENT, COOL, WARM = "#3a3f4b", "#b4561f", "#2b6f8f", "#d9a441"


def difference(a: Picture, b: Picture, gain: float = 8.0) -> Picture:
    """Return the largest channel's absolute difference times `gain`, as a heat map (black is equal)."""
    from matplotlib import colormaps

    error = np.abs(a - b).max(axis=-1) * gain
    return colormaps["inferno"](np.clip(error, 0.0, 1.0))[..., :3].astype(np.float32)


def height_time_slice(pictures: Sequence[Picture], column: int, width: int) -> Picture:
    """Return one pixel column over time, time running to the right, `width` pixels per picture (the paper's Fig. 6)."""
    return np.repeat(np.stack([picture[:, column] for picture in pictures], axis=1), width, axis=1)


def contact_sheet(pictures: Sequence[Picture], columns: int, gap: int = 2) -> Picture:
    """Lay pictures of one size out in rows on white."""
    height, width = pictures[0].shape[:2]
    rows = -(-len(pictures) // columns)
    sheet = np.ones((rows * (height + gap) - gap, columns * (width + gap) - gap, 3), np.float32)
    for index, picture in enumerate(pictures):
        top, left = index // columns * (height + gap), index % columns * (width + gap)
        sheet[top : top + height, left : left + width] = picture
    return sheet


def write_animation(path: Path, pictures: Sequence[Picture], fps: float) -> None:
    """Write an endless animated WebP."""
    from PIL import Image

    frames = [Image.fromarray(np.rint(np.clip(picture, 0, 1) * 255).astype(np.uint8)) for picture in pictures]
    with atomic_path(path) as temporary:
        frames[0].save(
            temporary,
            format="WEBP",
            save_all=True,
            append_images=frames[1:],
            duration=round(1000 / fps),
            loop=0,
            quality=90,
            method=4,
        )


def plot_training(path: Path, history: Sequence[dict[str, Any]]) -> None:
    """Plot PSNR on the training views and the number of Gaussians over the iterations."""
    figure, (left, right) = _figure(2)
    iterations = [row["iteration"] for row in history]
    left.plot(iterations, [row["psnr"] for row in history], color=ACCENT, linewidth=0.8)
    left.set(xlabel="iteration", ylabel="PSNR of training views, dB")
    right.plot(iterations, [row["gaussians"] / 1000 for row in history], color=COOL)
    right.set(xlabel="iteration", ylabel="thousand Gaussians", ylim=(0, None))
    _save(figure, path)


def plot_frames(path: Path, frames: Sequence[int], psnr: Sequence[float], ssim: Sequence[float]) -> None:
    """Plot PSNR and SSIM of the held-out view over its frames."""
    figure, (left, right) = _figure(2)
    for axes, values, label, color in ((left, psnr, "PSNR, dB", ACCENT), (right, ssim, "SSIM", COOL)):
        axes.plot(frames, values, color=color, marker="o", markersize=4)
        axes.set(xlabel="frame", ylabel=f"held-out {label}")
    _save(figure, path)


def plot_curves(path: Path, curves: dict[str, list[list[Any]]], labels: Sequence[str], xlabel: str) -> None:
    """Plot curves by title, each a list of points (x, y) per label, over a logarithmic x. The first one stands out."""
    from matplotlib import colormaps
    from matplotlib.ticker import LogLocator, NullFormatter

    figure, plots = _figure(len(labels), height=4.2)
    palette = colormaps["tab20"].colors  # type: ignore[attr-defined]
    for index, (axes, label) in enumerate(zip(np.atleast_1d(plots), labels, strict=True)):
        for number, (title, parts) in enumerate(curves.items()):
            x, y = zip(*sorted(tuple(point) for point in parts[index]), strict=True)
            color, width = (INK, 2.2) if number == 0 else (palette[(number - 1) % len(palette)], 0.9)
            axes.plot(x, y, color=color, linewidth=width, marker=".", label=title if index == 0 else None)
        axes.set(xlabel=xlabel, ylabel=label, xscale="log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter(NullFormatter())
    figure.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    _save(figure, path)


def plot_rig(path: Path, cameras: Sequence[Camera], held_out: set[str], points: NDArray[np.float32]) -> None:
    """Draw the cameras and the seed points from above and from the side (x, y and x, z of the world)."""
    figure, plots = _figure(2, height=3.6)
    size = 0.35 * max(np.ptp([camera.center for camera in cameras], axis=0).max(), 1e-6) / 4
    for axes, (i, j) in zip(plots, ((0, 1), (0, 2)), strict=True):
        axes.scatter(points[:, i], points[:, j], s=0.3, color=WARM, alpha=0.5, linewidths=0)
        for camera in cameras:
            color = ACCENT if camera.name in held_out else COOL
            corners = np.array([[0, 0], [camera.width, 0], [camera.width, camera.height], [0, camera.height]], float)
            tips = camera.unproject(corners, np.full(4, size * 2))
            for tip in tips:
                axes.plot(*np.stack([camera.center, tip])[:, [i, j]].T, color=color, linewidth=0.7)
            axes.plot(*np.concatenate([tips, tips[:1]])[:, [i, j]].T, color=color, linewidth=0.7)
        axes.set(xlabel="xyz"[i], ylabel="xyz"[j], aspect="equal")
    _save(figure, path)


def _figure(columns: int, height: float = 2.8) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.2 * columns, height), layout="constrained")
    plots = figure.subplots(1, columns)
    for axes in plots:
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.25, linewidth=0.6)
        axes.tick_params(colors=INK)
    return figure, plots


def _save(figure: Any, path: Path) -> None:
    with atomic_path(path) as temporary:
        figure.savefig(temporary)
