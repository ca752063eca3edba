# SPDX-License-Identifier: GPL-3.0-or-later
"""The other end of `core.blender`: what runs inside Blender. Knows the protocol, not Blender."""

import importlib
import json
import os
import sys
import traceback
from typing import NoReturn

from .child import emit, end_with_parent
from .errors import HoloreelError


def serve() -> NoReturn:
    """Read one request from standard input, call its function, say how it went, and end the process.

    The process is ended without Blender's own clean-up, which can hang. It ends early when standard input closes:
    whoever asked is gone.
    """
    request = json.loads(sys.stdin.readline())
    end_with_parent()
    module, _, name = request["function"].partition(":")
    try:
        result = getattr(importlib.import_module(module), name)(request["job"], emit)
        emit({"event": "done", "result": result})
    except HoloreelError as error:
        emit({"event": "error", "message": str(error), "mendable": True})
    except Exception as error:  # noqa: BLE001 - everything is reported, nothing is swallowed
        traceback.print_exc()
        if isinstance(error, ModuleNotFoundError) and error.name == "bpy":
            text = f"{sys.executable} has no bpy: give a Python that has it, or the blender executable, with --blender."
        else:
            text = f"Blender failed with {type(error).__name__}: {error}"
        emit({"event": "error", "message": text, "mendable": False})
    sys.stderr.flush()
    os._exit(0)
