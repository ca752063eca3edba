# SPDX-License-Identifier: GPL-3.0-or-later
"""Node groups, built from code.

"Holoreel Reel" (reel.py), which a reel's modifier holds, chains "Holoreel Time" and "Holoreel Evaluate"
(evaluation.py), a color conversion, and the looks (looks.py).
"""
