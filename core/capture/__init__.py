# SPDX-License-Identifier: GPL-3.0-or-later
"""Multi-view recordings: `Capture` in memory, several datasets' layouts on disk. Needs numpy only to import."""

from .capture import Capture, View
from .layouts import LAYOUTS, read_capture
from .nerfstudio import write_capture
from .options import CaptureOptions
from .points import Points, read_points, write_points

__all__ = [
    "LAYOUTS",
    "Capture",
    "CaptureOptions",
    "Points",
    "View",
    "read_capture",
    "read_points",
    "write_capture",
    "write_points",
]
