# SPDX-License-Identifier: GPL-3.0-or-later
"""Where panels of the tab "Holoreel" in the sidebar of the 3D viewport stand."""


class Sidebar:
    """A panel of the tab."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Holoreel"
    bl_options = {"DEFAULT_CLOSED"}
