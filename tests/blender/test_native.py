# SPDX-License-Identifier: GPL-3.0-or-later
"""Attributes of Blender's own splats: values that say where they belong."""

import bpy
import numpy as np
import pytest
from holoreel.addon import compat, native, reels
from holoreel.addon.attributes import read
from holoreel.addon.nodes.show import HULL, LINEAR
from holoreel.core.errors import HoloreelError
from holoreel.core.gaussians.model import EvaluatedGaussians
from holoreel.tests.blender.test_looks import show, wide_model

C0 = 0.5 / np.sqrt(np.pi)  # the constant harmonic


def telling(count: int = 6) -> EvaluatedGaussians:
    """Return Gaussians whose values are 100 * array + 10 * point + column, scaled to what is allowed; two are dead."""
    point = 10.0 * np.arange(count)[:, None]
    quats = 100 + point + np.arange(4)
    opacities = 0.1 + 0.1 * np.arange(count)
    opacities[[1, 4]] = 0.5 / 255
    return EvaluatedGaussians(
        means=(200 + point + np.arange(3)).astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        scales=(300 + point + np.arange(3)).astype(np.float32),
        opacities=opacities.astype(np.float32),
        features=(400 + point + np.arange(3)).astype(np.float32),
    )


def test_attributes_are_those_of_the_importer() -> None:
    arrays = native.native_arrays(telling())
    assert list(arrays) == list(native.TYPES)
    points = [0, 2, 3, 5]
    for row, point in enumerate(points):
        np.testing.assert_array_equal(arrays["position"][row], 200 + 10 * point + np.arange(3))
        np.testing.assert_array_equal(arrays["scale"][row], 300 + 10 * point + np.arange(3))
        turned = 100.0 + 10 * point + np.arange(4)  # w x y z
        np.testing.assert_allclose(arrays["rotation"][row] / arrays["rotation"][row][0], turned / turned[0], rtol=1e-6)
        color = 0.5 + C0 * arrays["radiance:base"][row, :3]
        np.testing.assert_allclose(color, 400 + 10 * point + np.arange(3), rtol=1e-6)
        assert arrays["radiance:base"][row, 3] == np.float32(0.1 + 0.1 * point)
    assert all(array.dtype == np.float32 and array.flags.c_contiguous for array in arrays.values())


def test_a_moment_is_what_the_model_shows_then() -> None:
    model = wide_model()
    played = show(model, 0.35)
    modifier = reels.modifier_of(played)
    for name, value in (("Look", HULL), ("Color", LINEAR)):
        compat.set_input(modifier, name, value)
    shown, truth = native.gaussians_shown(played), model.evaluate(0.35)
    truth = truth.take(truth.alive)
    order, expected = (np.lexsort(part.means.T) for part in (shown, truth))
    for name in ("means", "quats", "scales", "opacities", "features"):
        found, right = getattr(shown, name)[order], getattr(truth, name)[expected]
        np.testing.assert_allclose(found, right, rtol=1e-5, atol=1e-5)
    assert (compat.get_input(modifier, "Look"), compat.get_input(modifier, "Color")) == (HULL, LINEAR)


def test_written_attributes_can_be_read_back() -> None:
    if "FLOAT4" not in bpy.types.Attribute.bl_rna.properties["data_type"].enum_items:
        pytest.skip("this Blender has no attributes of four floats")
    arrays = native.native_arrays(telling())
    cloud = compat.new_point_cloud(bpy.context, "native", 4).data
    native.write_native(cloud, arrays)
    for name, (kind, property_name) in native.TYPES.items():
        attribute = cloud.attributes[name]
        assert (attribute.data_type, attribute.domain) == (kind, "POINT")
        values = np.empty(arrays[name].size, np.float32)
        attribute.data.foreach_get(property_name, values)
        np.testing.assert_array_equal(values.reshape(arrays[name].shape), arrays[name])
    np.testing.assert_array_equal(read(cloud.attributes, "position"), arrays["position"])


def test_older_blenders_say_what_is_missing() -> None:
    played = show(wide_model(5), 0.5)
    if compat.has_native_splats():
        created = native.new_native_splats(bpy.context, played)
        assert "radiance:base" in created.data.attributes
        return
    with pytest.raises(HoloreelError, match=r"Blender 5\.3"):
        native.new_native_splats(bpy.context, played)
    assert len(bpy.data.pointclouds) == 1
