# SPDX-License-Identifier: GPL-3.0-or-later
"""`holoreel bench`: measure the kernels on this machine."""

import json as json_format
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from ..errors import HoloreelError
from ..machine import machine
from ..render import get_backend
from ..render.native import TIMINGS, set_lanes

if TYPE_CHECKING:  # the measuring itself needs torch, which --help need not wait for
    from ..render.bench import Row


def run(
    what: Annotated[Literal["raster"], tyro.conf.Positional],
    reference: bool = True,
    rounds: int = 7,
    json: Path | None = None,
) -> None:
    """Print how many milliseconds rendering takes, forward and backward, and how that compares with plain torch.

    Args:
        what: What to measure: `raster`, the whole chain from raw parameters to pictures and back.
        reference: Measure plain torch too, at 640 x 360 with 200,000 Gaussians and 3 channels (slow, takes about 4 GB).
        rounds: How often each row is measured; the table shows medians.
        json: Write the figures to this file too.
    """
    if rounds < 1:
        raise HoloreelError("--rounds must be 1 or more.")
    if json is not None and not json.absolute().parent.is_dir():
        raise HoloreelError(f"{json}: the folder does not exist; make it or choose another for --json.")
    get_backend("cpu")
    from ..render import bench

    hardware = {**machine(), "lanes": set_lanes(0)}
    print(
        f"{hardware['processor']}, {hardware['cores']} cores, {hardware['lanes']} lanes; whole chain, milliseconds, "
        f"medians of {rounds}"
    )
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
        _write(json, {"machine": hardware, "rows": [row.as_dict() for row in rows]})


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
    from ..render import bench

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


def _write(path: Path, figures: dict[str, object]) -> None:
    temporary = path.with_name(path.name + ".part")
    temporary.write_text(json_format.dumps(figures, indent=1))
    os.replace(temporary, path)
