# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender reads the points of a VideoRF: places, colors and densities."""

import bpy
import numpy as np
from holoreel.core.videorf.points import FieldPoints, write_field_points


def test_points_come_in_as_they_were_written(tmp_path):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    random = np.random.default_rng(0)
    xyz = random.normal(size=(20, 3)).astype(np.float32)
    rgb = random.integers(0, 256, (20, 3)).astype(np.uint8)
    density = random.uniform(0, 500, 20).astype(np.float32)
    write_field_points(tmp_path / "points.ply", FieldPoints(xyz, rgb, density))
    bpy.ops.wm.ply_import(filepath=str(tmp_path / "points.ply"), import_colors="SRGB")
    mesh = bpy.context.object.data
    places = np.empty(60, np.float32)
    mesh.vertices.foreach_get("co", places)
    np.testing.assert_allclose(places.reshape(-1, 3), xyz, atol=1e-6)
    values = np.empty(20, np.float32)
    mesh.attributes["density"].data.foreach_get("value", values)
    np.testing.assert_array_equal(values, density)
    colors = np.empty(80, np.float32)
    mesh.color_attributes[0].data.foreach_get("color_srgb", colors)
    np.testing.assert_allclose(colors.reshape(-1, 4)[:, :3] * 255, rgb, atol=0.6)
