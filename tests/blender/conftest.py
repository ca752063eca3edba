# SPDX-License-Identifier: GPL-3.0-or-later
"""Fixtures for tests inside Blender's Python (the `bpy` wheel)."""

import ctypes
from collections.abc import Callable, Iterator
from pathlib import Path

import bpy
import numpy as np
import pytest
from numpy.typing import NDArray

Picture = NDArray[np.float32]


@pytest.fixture(autouse=True)
def _fresh_blender() -> Iterator[None]:
    """Start every test from an empty scene."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    yield
    bpy.ops.wm.read_factory_settings(use_empty=True)


@pytest.fixture(scope="session")
def gpu() -> None:
    """Skip where EEVEE cannot start: without libEGL it aborts the whole process."""
    try:
        ctypes.CDLL("libEGL.so.1")
    except OSError:
        pytest.skip("libEGL.so.1 is absent (Debian package libegl1)")


@pytest.fixture
def render(tmp_path: Path) -> Callable[[], Picture]:
    """`render()` renders the scene and returns premultiplied RGBA (H, W, 4) as floats, top row first."""

    def run() -> Picture:
        scene = bpy.context.scene
        path = tmp_path / "render.exr"
        scene.render.image_settings.file_format = "OPEN_EXR"
        scene.render.image_settings.color_depth = "32"
        scene.render.image_settings.color_mode = "RGBA"
        scene.render.filepath = str(path)
        bpy.ops.render.render(write_still=True)
        image = bpy.data.images.load(str(path))
        image.colorspace_settings.name = "Non-Color"
        width, height = image.size
        pixels = np.empty(width * height * 4, np.float32)
        image.pixels.foreach_get(pixels)
        bpy.data.images.remove(image)
        return pixels.reshape(height, width, 4)[::-1]

    return run
