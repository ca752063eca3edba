# SPDX-License-Identifier: GPL-3.0-or-later
"""The presets of training by name, with a title and a sentence for people: what programs without torch show of them.

The settings themselves are `gaussians.config.PRESETS` and `videorf.config.PRESETS`.
"""

STG = (
    ("lite", "Lite", "Each Gaussian has a color: plays exactly in Blender's own engines"),
    ("full", "Full", "Features and a network per pixel: exact in the Holoreel engine alone"),
    ("n3v", "Neural 3D Video", "The published settings for captures like the Neural 3D Video data set"),
    ("technicolor", "Technicolor", "The published settings for captures like the Technicolor data set"),
    ("immersive", "Immersive", "The published settings for fisheye captures like Google's Immersive data set"),
)
VIDEORF = (
    ("standard", "Standard", "Good pictures in few bytes"),
    ("fast", "Fast", "For a first look"),
    ("paper", "Paper", "The published method with nothing added"),
)
