# SPDX-License-Identifier: GPL-3.0-or-later
"""The child process that runs COLMAP: `python -m holoreel.core.sfm.child JOB.json`.

pycolmap stays out of every other process: imported before Pillow, it makes Pillow's PNG writer crash. The job's `task`
is a function of `colmap`; how it went is told in `core.child`'s lines.
"""

import json
import os
import sys
import traceback
from pathlib import Path
from typing import NoReturn

from ..child import emit, end_with_parent
from ..errors import HoloreelError

TASKS = ("triangulate", "reconstruct")


def main() -> NoReturn:
    """Do the job that the file named on the command line describes, and end the process."""
    end_with_parent()
    try:
        job = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
        if job["task"] not in TASKS:
            raise HoloreelError(f"{sys.argv[1]}: task must be one of {', '.join(TASKS)}.")
        from . import colmap

        emit({"event": "done", "result": getattr(colmap, job["task"])(job, emit)})
    except HoloreelError as error:
        emit({"event": "error", "message": str(error), "mendable": True})
    except ImportError as error:
        emit({"event": "error", "message": f"pycolmap cannot be imported ({error}): install it.", "mendable": True})
    except Exception as error:  # noqa: BLE001 - everything is reported, nothing is swallowed
        traceback.print_exc()
        text = f"structure from motion failed with {type(error).__name__}: {error}"
        emit({"event": "error", "message": text, "mendable": False})
    sys.stderr.flush()
    os._exit(0)


if __name__ == "__main__":
    main()
