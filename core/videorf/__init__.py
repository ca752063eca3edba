# SPDX-License-Identifier: GPL-3.0-or-later
"""VideoRF: dynamic radiance fields as streams of feature images (Wang et al., CVPR 2024)."""
