# SPDX-License-Identifier: GPL-3.0-or-later
"""The VideoRF that Blender's tests play (`tests/data/field`) holds what core's player makes of it."""

from pathlib import Path

import numpy as np
from holoreel.core.videorf.decode import DecodedVideo
from holoreel.core.videorf.package import read_video_reel

DATA = Path(__file__).parents[1] / "data" / "field"


def test_codes_are_those_that_the_player_decodes():
    reel = read_video_reel(DATA / "ball.reel")
    first, second = DecodedVideo(reel, 0), DecodedVideo(reel, 1)
    with np.load(DATA / "codes.npz") as codes:
        assert len(codes) == reel.frame_count + 1
        for t in range(reel.frame_count):
            np.testing.assert_array_equal(codes[f"t{t}"], first.codes(t))
        np.testing.assert_array_equal(codes["last"], second.codes(reel.frame_count - 1))
