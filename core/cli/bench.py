# SPDX-License-Identifier: GPL-3.0-or-later
"""`holoreel bench`: measure the kernels, the training, the rendering and the method on this machine."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from ..errors import HoloreelError
from ..files import write_json
from ..machine import machine
from ..render import Backend, get_backend
from ..render.native import TIMINGS, set_lanes

if TYPE_CHECKING:  # the measuring itself needs torch, which --help need not wait for
    from ..bench.raster import Row


def prepare(arguments: list[str]) -> Callable[..., None]:
    """Return the measurement that the arguments name."""
    name = next((argument for argument in arguments if not argument.startswith("-")), "")
    if name == "videorf":  # its defaults hang on the preset, and torch comes with them
        from .bench_videorf import prepare as prepare_videorf

        return prepare_videorf(arguments)
    return MEASUREMENTS.get(name, run)


def run(
    what: Annotated[
        Literal["raster", "march", "train", "render", "ablation", "seams", "videorf"], tyro.conf.Positional
    ],
) -> None:
    """Measure something on this machine; `holoreel bench WHAT --help` explains each.

    Args:
        what: `raster` and `march`, the kernels of Gaussians and of VideoRF; `train`, whole training iterations;
            `render`, frames per second of a reel; `ablation`, what each part of Spacetime Gaussians brings; `seams`,
            the hand-over between a reel's segments; `videorf`, quality over bytes of VideoRF and what its parts bring.
    """
    raise HoloreelError(f"there is nothing to measure called {what!r} here.")


def raster(
    what: Annotated[Literal["raster"], tyro.conf.Positional],
    reference: bool = True,
    rounds: int = 7,
    json: Path | None = None,
) -> None:
    """Print how many milliseconds rendering takes, forward and backward, and how that compares with plain torch.

    Args:
        what: The whole chain from raw parameters to pictures and back.
        reference: Measure plain torch too, at 640 x 360 with 200,000 Gaussians and 3 channels (slow, takes about 4 GB).
        rounds: How often each row is measured; the table shows medians.
        json: Write the figures to this file too.
    """
    _check(rounds, json)
    get_backend("cpu")
    from ..bench import raster as bench

    hardware = _hardware()
    print(f"{_describe(hardware)}; whole chain, milliseconds, medians of {rounds}")
    print(HEADER)
    rows = []
    alone: dict[tuple[int, ...], float] = {}
    for setup in bench.setups():
        row = bench.measure(setup, rounds)
        rows.append(row)
        key = (setup.width, setup.gaussians, setup.channels)
        alone.setdefault(key, row.total)
        print(_line(row, f"{alone[key] / row.total:.2f}x"), flush=True)
    if reference:
        rows += _against_reference(rounds)
    if json is not None:
        write_json(json, {"machine": hardware, "rows": [row.as_dict() for row in rows]})


def march(
    what: Annotated[Literal["march"], tyro.conf.Positional],
    edge: int = 96,
    channels: int = 8,
    repeats: int = 5,
    json: Path | None = None,
) -> None:
    """Print how fast VideoRF's kernels are: the ray march, also against plain torch, a training step, and a picture.

    Args:
        what: The march through a lattice, forward, and forward and backward; the parts of a step of 4096 rays; a
            picture of 320 x 180 pixels that the subject fills.
        edge: Vertices along each side of the lattice.
        channels: Numbers in a row: the density and the features.
        repeats: How often each is measured; the best counts.
        json: Write the figures to this file too.
    """
    _check(repeats, json)
    from ..videorf.bench import bench_drawing, bench_march, bench_step

    speed, step = bench_march(edge, channels, repeats=repeats), bench_step(edge, channels, repeats=repeats)
    pictures = bench_drawing(edge, repeats=repeats)
    hardware = _hardware()
    print(
        f"{_describe(hardware)}; {speed.vertices:,} vertices, {channels} channels, {speed.samples_per_ray:.1f} samples "
        f"per ray, {speed.threads} threads\nmillion samples per second: {speed.forward:.1f} forward, "
        f"{speed.training:.1f} forward and backward, {speed.twin_ratio:.0f} times as many as plain torch\n"
        f"milliseconds of a training step of 4096 rays: {step.total:.1f} = "
        + " + ".join(f"{milliseconds:.1f} {name}" for name, milliseconds in step._asdict().items())
        + "\nmilliseconds of a picture of 320 x 180: "
        + ", ".join(f"{milliseconds:.1f} {quality}" for quality, milliseconds in pictures.items())
    )
    if json is not None:
        figures = {**speed._asdict(), "step": step._asdict(), "pictures": pictures}
        write_json(json, {"machine": hardware, **figures})


def train(
    what: Annotated[Literal["train"], tyro.conf.Positional],
    preset: str = "lite",
    size: str | None = None,
    gaussians: int = 100_000,
    backend: Backend = "auto",
    rounds: int = 30,
    json: Path | None = None,
) -> None:
    """Print how long a whole training iteration takes, where the time goes, and what the raster kernels take of it.

    Args:
        what: The trainer's own steps on a random scene.
        preset: The settings to train with.
        size: Pictures as WIDTHxHEIGHT; without it, 640x360 with 100,000 Gaussians and 269x479 with 11,000.
        gaussians: How many, where a size is given.
        backend: What to render with.
        rounds: How many iterations are measured; the table shows medians.
        json: Write the figures to this file too.
    """
    _check(rounds, json)
    from ..bench import train as bench
    from ..gaussians.config import PRESETS

    if preset not in PRESETS:
        raise HoloreelError(f"--preset {preset}: no such preset; take one of {', '.join(PRESETS)}.")
    setups = (bench.Setup(*parse_size(size), gaussians),) if size else bench.SETUPS
    hardware = _hardware()
    print(f"{_describe(hardware)}; milliseconds per iteration, medians of {rounds}")
    rows = []
    for setup in setups:
        rows.append(bench.measure(setup, preset, rounds, backend))
        print(bench.report(rows[-1:]), flush=True)
    if json is not None:
        write_json(json, {"machine": hardware, "rows": [row.as_dict() for row in rows]})


def render(
    what: Annotated[Literal["render"], tyro.conf.Positional],
    reel: Annotated[Path, tyro.conf.Positional],
    view: Path,
    size: str | None = None,
    rung: str | None = None,
    backend: Backend = "auto",
    json: Path | None = None,
) -> None:
    """Print how many frames of a reel are drawn in a second.

    Of Gaussians with and without temporal culling; of a VideoRF where its time goes, in every quality.

    Args:
        what: All frames of a reel, PLY or .splatv, from one camera. Gaussians in three ways with the same pictures:
            `listed`, what is alive is known beforehand, as when a reel is played; `culled`, the kernels find out; `not
            culled`. A VideoRF by the steps of its march: `full`, `fast`, `draft`.
        reel: The file.
        view: A CAMERA.json, or a capture: its first camera that is held out.
        size: Pictures as WIDTHxHEIGHT instead of the camera's own.
        rung: Of a VideoRF, which rate: its QP as 20, or with its codec as hevc:20; the best without it.
        backend: What to render with.
        json: Write the figures to this file too.
    """
    _check(1, json)
    from ..bench import render as bench
    from ..reel import VIDEORF, reel_kind

    camera = bench.view_camera(view)
    camera = camera.scaled(*parse_size(size)) if size else camera
    figures: dict[str, object]
    if reel_kind(reel) == VIDEORF:
        from ..bench.split import describe, measure_splits

        splits = measure_splits(reel, camera, rung, backend)
        text, figures = describe(splits), {"splits": [split.as_dict() for split in splits]}
    else:
        if rung is not None:
            raise HoloreelError(f"{reel} holds Gaussians, which have no rungs: leave --rung away.")
        result = bench.measure(reel, camera, None, backend)
        text, figures = bench.report(result), result.as_dict()
    hardware = _hardware()
    print(f"{_describe(hardware)}\n{text}")
    if json is not None:
        write_json(json, {"machine": hardware, **figures})


def seams(
    what: Annotated[Literal["seams"], tyro.conf.Positional],
    reel: Annotated[Path, tyro.conf.Positional],
    capture: Annotated[Path, tyro.conf.Positional],
    camera: str | None = None,
    backend: Backend = "auto",
    out: Path | None = None,
) -> None:
    """Print how a reel's segments hand over to each other in a view that was not trained on.

    Args:
        what: The frames around each boundary, and still pixels across it.
        reel: A reel of several segments.
        capture: The capture it was trained on.
        camera: A camera held out; without it, the first of the test split.
        backend: What to render with.
        out: A folder for seams.json and the height-time slice as a picture.
    """
    from ..bench.seams import measure_seams, report_seams, write_seams
    from ..capture import read_capture

    result = measure_seams(reel, read_capture(capture), camera, backend)
    print(report_seams(result))
    if out is not None:
        print(write_seams(result, out))


def ablation(
    what: Annotated[Literal["ablation"], tyro.conf.Positional],
    scenes: tuple[Path, ...],
    out: Path = Path("build/ablation/results"),
    iterations: int = 2000,
    gaussians: int = 40_000,
    parts: tuple[str, ...] = (),
    lpips_weights: Path | None = None,
    lpips_heads: Path | None = None,
    backend: Backend = "auto",
) -> None:
    """Train without single parts of the method and print the paper's Table 4; a call that was stopped goes on.

    Args:
        what: What each part of the method brings, on views that were held out.
        scenes: Folders of captures with a camera held out.
        out: Folder for the reels, ablation.json and index.html; rows that are finished there are kept.
        iterations: Every row's budget.
        gaussians: How many to begin with, at most.
        parts: Rows to train, of temporal_opacity, motion, rotation, features, guided and full; without it, all.
        lpips_weights: As for `holoreel eval`; adds LPIPS to the table.
        lpips_heads: As for `holoreel eval`.
        backend: What to train with.
    """
    from ..bench.ablation import run_ablation
    from ..lpips import load_lpips

    measures = load_lpips(lpips_weights, lpips_heads) if lpips_weights else []
    for text in run_ablation(scenes, out, iterations, gaussians, parts, measures, get_backend(backend)):
        print(text, flush=True)


MEASUREMENTS: dict[str, Callable[..., None]] = {
    "raster": raster,
    "march": march,
    "train": train,
    "render": render,
    "ablation": ablation,
    "seams": seams,
}


def parse_size(text: str) -> tuple[int, int]:
    """Return the width and height of a text like 640x360."""
    found = re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", text)
    if not found:
        raise HoloreelError(f"--size {text}: write it as WIDTHxHEIGHT, like 1352x1014.")
    return int(found[1]), int(found[2])


def _check(rounds: int, json: Path | None) -> None:
    if rounds < 1:
        raise HoloreelError("--rounds must be 1 or more.")
    if json is not None and not json.absolute().parent.is_dir():
        raise HoloreelError(f"{json}: the folder does not exist; make it or choose another for --json.")


def _hardware() -> dict[str, object]:
    return {**machine(), "lanes": set_lanes(0)}


def _describe(hardware: dict[str, object]) -> str:
    return f"{hardware['processor']}, {hardware['cores']} cores, {hardware['lanes']} lanes"


HEADER = (
    "picture    Gaussians  C thr   pairs | project  sort   bin  blend  bwd.blend gather |"
    " raster  forward backward   total (best)   vs 1 thr"
)


def _line(row: "Row", speedup: str) -> str:
    s = row.setup
    parts = [row.parts.get(name, 0.0) for name in TIMINGS]
    return (
        f"{s.width}x{s.height:<5} {s.gaussians:>9} {s.channels:>2} {s.threads:>3} {row.intersections / 1e3:6.0f}k |"
        " {:7.1f} {:5.1f} {:5.1f}  {:5.1f}      {:5.1f}  {:5.1f} |".format(*parts)
        + f" {row.raster:6.1f}   {row.forward:6.1f}   {row.backward:6.1f}  {row.total:6.1f} ({row.best_total:.1f})"
        + f"   {speedup}"
    )


def _against_reference(rounds: int) -> list["Row"]:
    """Measure the kernels before and after plain torch, so that a busy machine is busy for both."""
    from ..bench import raster as bench

    threads = min(2, bench.native.available_cores())
    setup = bench.Setup(640, 360, 200_000, 3, threads)
    before = bench.measure(setup, rounds)
    torch_row = bench.measure_reference(setup)
    after = bench.measure(setup, rounds)
    ours = (before.total + after.total) / 2
    print(
        f"\nplain torch at 640x360, 200000 Gaussians, 3 channels, {threads} threads: forward {torch_row.forward:.0f},"
        f" backward {torch_row.backward:.0f}, together {torch_row.total:.0f} ms;"
        f" the kernels {ours:.1f} ms (measured before and after), {torch_row.total / ours:.0f} times faster"
    )
    return [torch_row, before, after]
