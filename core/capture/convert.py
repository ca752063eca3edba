# SPDX-License-Identifier: GPL-3.0-or-later
"""Writing a capture in another layout: whole or not at all, and going on where a stopped call left off."""

import os
import shutil
from pathlib import Path
from typing import Any

from ..errors import HoloreelError
from ..files import read_json, write_json
from .capture import Capture
from .export import Export
from .layouts import LAYOUTS, default_held_out
from .video_set import natural

_RECORD = "job.json"


def convert(capture: Capture, to: str, out: Path, job: dict[str, Any], export: Export | None = None) -> list[str]:
    """Write `capture` into the new folder `out` in the layout `to`; return what the layout could not hold.

    Everything is written into .NAME.part beside `out`, which takes its place at the end. `job` (for JSON) says what is
    written there; a folder that another job left is refused.
    """
    export = export or Export()
    out = out.absolute()
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise HoloreelError(f"{out} is there already; choose another --out, or delete it.")
    work = out.with_name(f".{out.name}.part")
    job = {"to": to, **job}
    if (work / _RECORD).is_file():
        if read_json(work / _RECORD) != job:
            raise HoloreelError(
                f"{work} holds an unfinished conversion with other settings; repeat that, or delete it."
            )
    else:
        write_json(work / _RECORD, job)
    _note_losses(capture, to, export)
    LAYOUTS[to].write(capture, work / out.name, export)
    if out.is_dir():
        out.rmdir()
    os.replace(work / out.name, out)
    shutil.rmtree(work)
    return export.notes


def _note_losses(capture: Capture, to: str, export: Export) -> None:
    layout = LAYOUTS[to]
    if capture.seeds and not layout.holds_seeds:
        export.notes.append("Seed points are not taken along: run `holoreel sfm` on the result.")
    held_out = capture.camera_names("test")
    names = layout.names(capture)
    wanted = sorted((names[name] for name in held_out), key=natural)
    default = default_held_out(layout, sorted(names.values(), key=natural))
    if layout.held_out is not None and set(wanted) != set(default):
        export.notes.append(
            f"Held out were {', '.join(held_out) or 'no cameras'}, but what is read in this layout holds "
            f"{', '.join(default) or 'none'} out by default: read it with --test-cameras {' '.join(wanted) or 'none'}."
        )
