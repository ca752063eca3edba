# SPDX-License-Identifier: GPL-3.0-or-later
"""Multi-view recordings: `Capture` in memory, nerfstudio's transforms.json on disk. Needs numpy only to import."""

from .capture import Capture, View
from .nerfstudio import read_capture, write_capture
from .points import Points, read_points, write_points

__all__ = ["Capture", "Points", "View", "read_capture", "read_points", "write_capture", "write_points"]
