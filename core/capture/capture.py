# SPDX-License-Identifier: GPL-3.0-or-later
"""A multi-view recording in memory: who looked, when, and where the pictures lie. Pictures are read one at a time."""
