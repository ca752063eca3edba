# SPDX-License-Identifier: GPL-3.0-or-later
"""A whole little recording whose truth is known: a model, its reel, and the capture that cameras made of it."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from holoreel.core.camera import Camera
from holoreel.core.capture import Capture, write_capture
from holoreel.core.gaussians.model import SpacetimeGaussians
from holoreel.core.reel import save_gaussians

FRAMES = range(101, 104)
BACKGROUND = (0.25, 0.5, 0.75)


@dataclass(frozen=True)
class Recording:
    """Files of one recording: three frames, two cameras, `right` held out."""

    folder: Path
    reel: Path
    capture: Path
    camera: Path  # CAMERA.json of `left`
    cameras: dict[str, Camera]
    model: SpacetimeGaussians


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory, random_model: Callable[..., SpacetimeGaussians]) -> Recording:
    """Draw a random model over a background with two cameras; nothing here may be changed."""
    from holoreel.core.camera import write_camera
    from holoreel.core.gaussians.player import draw, to_tensors
    from holoreel.core.images import picture_path, write_png
    from holoreel.core.render import get_backend

    folder = tmp_path_factory.mktemp("recording")
    model = random_model(60)
    poses = {"left": np.eye(4), "right": np.eye(4)}
    poses["right"][0, 3] = -0.5
    cameras = {name: Camera(32, 24, 30.0, 30.0, 16.0, 12.0, pose, name=name) for name, pose in poses.items()}
    images = {}
    for name, camera in cameras.items():
        for index, frame in enumerate(FRAMES):
            drawing = draw(to_tensors(model), index / 3, camera, get_backend("reference"), BACKGROUND)
            images[name, index] = picture_path(folder / "pictures", name, frame)
            write_png(images[name, index], drawing.image)
    capture = Capture(
        cameras, images, len(FRAMES), {"right": "test"}, fps=24.0, frame_start=FRAMES[0], source=folder
    )  # fmt: skip
    reel = folder / "out" / "a.reel"
    save_gaussians(reel, model, fps=24, frame_start=FRAMES[0], frame_count=len(FRAMES), background=BACKGROUND)
    write_camera(folder / "left.json", cameras["left"])
    return Recording(folder, reel, write_capture(folder, capture), folder / "left.json", cameras, model)
