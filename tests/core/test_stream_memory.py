# SPDX-License-Identifier: GPL-3.0-or-later
"""What a stream of a real size takes: 20 cameras x 300 frames of 1352x1014, 24.7 GB of pictures, from videos."""

import json
import os
import subprocess
import sys
from pathlib import Path

import av
import numpy as np
import pytest

CAMERAS, FRAMES, WIDTH, HEIGHT, DRAWS = 20, 300, 1352, 1014, 1200

MEASURE = """
import json, resource, sys, time
from pathlib import Path
from holoreel.core.camera import Camera
from holoreel.core.capture import Capture
from holoreel.core.capture.media import VideoFrame
from holoreel.core.capture.stream import PictureStream

cameras, frames, width, height, draws, folder = json.loads(sys.argv[1])
names = [f"cam{index:02d}" for index in range(cameras)]
images = {(name, j): VideoFrame(Path(folder) / f"{name}.mp4", j) for j in range(frames) for name in names}
capture = Capture({name: Camera(width, height, 900, 900, 676, 507, name=name) for name in names}, images, frames)
started, seen = time.process_time(), set()
with PictureStream(capture, capture.views(), limit_bytes=2 << 30) as stream:
    for _ in range(draws):
        view, picture = stream.next()
        assert picture.shape == (height, width, 3)
        seen.add(view)
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
print(json.dumps({"peak": peak, "views": len(seen), "ms": 1e3 * (time.process_time() - started) / draws}))
"""


@pytest.mark.slow
def test_twenty_cameras_of_three_hundred_frames_stay_within_their_memory(tmp_path: Path) -> None:
    """2 GiB of pictures, and less than half a GiB for Python, open videos and what is on its way."""
    first = tmp_path / "cam00.mp4"
    rng = np.random.default_rng(0)
    backdrop = np.kron(rng.integers(0, 255, (HEIGHT // 26, WIDTH // 26, 3)), np.ones((26, 26, 1))).astype(np.uint8)
    with av.open(str(first), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"preset": "ultrafast", "crf": "28"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.codec_context.gop_size = 12
        for frame in range(FRAMES):
            picture = av.VideoFrame.from_ndarray(np.roll(backdrop, 2 * frame, axis=1), format="rgb24")
            container.mux(stream.encode(picture))
        container.mux(stream.encode())
    for index in range(1, CAMERAS):
        os.link(first, tmp_path / f"cam{index:02d}.mp4")
    arguments = json.dumps([CAMERAS, FRAMES, WIDTH, HEIGHT, DRAWS, str(tmp_path)])
    run = subprocess.run([sys.executable, "-c", MEASURE, arguments], capture_output=True, text=True, check=True)
    found = json.loads(run.stdout)
    assert found["views"] == DRAWS  # within one pass, no view comes twice
    assert (2 << 30) * 0.8 < found["peak"] < 2.5 * 2**30
