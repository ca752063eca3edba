# SPDX-License-Identifier: GPL-3.0-or-later
"""The whole loop on one scene: rig → capture → training → Blender's timeline → a report a person can look at."""

from .loop import DemoSettings, Steps, run_demo

__all__ = ["DemoSettings", "Steps", "run_demo"]
