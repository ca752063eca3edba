# SPDX-License-Identifier: GPL-3.0-or-later
"""What a figure was measured on."""

import platform
from importlib.metadata import version
from pathlib import Path

from .render.native import available_cores


def machine() -> dict[str, object]:
    """Return the processor's name, the cores this process may use, and the version of torch."""
    name = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        names = [
            line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")
        ]
        name = names[0] if names else name
    return {"processor": name, "cores": available_cores(), "torch": version("torch")}
