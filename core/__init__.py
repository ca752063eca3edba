# SPDX-License-Identifier: GPL-3.0-or-later
"""Everything of Holoreel that is not Blender. Never imports bpy."""
