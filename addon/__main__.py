# SPDX-License-Identifier: GPL-3.0-or-later
"""`python -m holoreel.addon COMMAND ...`: what `blender --command holoreel` does, where Blender is the module bpy."""

import os
import sys

from .commands import run

if __name__ == "__main__":
    status = run(sys.argv[1:])
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)  # without Blender's own clean-up, which can hang
