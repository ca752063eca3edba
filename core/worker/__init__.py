# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures drawn by another process: Blender's Python asks, the core environment draws.

`protocol` says what they tell each other, `frames` how pixels cross over; with `process` and `client` they need
numpy alone. `server` and `picture` are the other end.
"""
