# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's own Gaussian splats (5.3 and later): a moment of a reel as a point cloud of that type.

The attributes are those of Blender's PLY importer: `position`, `scale` (standard deviations, not their logarithms),
`rotation` (w x y z, unit length), and `radiance:base`, whose first three numbers are the coefficients of the constant
harmonic, (color - 0.5) / C0, and whose fourth is the opacity in [0, 1]. There are no higher harmonics.
"""

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import HoloreelError
from ..core.gaussians.model import EvaluatedGaussians
from ..core.gaussians.ply import SH_C0
from .attributes import read
from .compat import get_input, has_native_splats, input_names, new_point_cloud, set_input, set_native
from .nodes.show import DISPLAY, POINTS
from .reels import modifier_of

# Blender's type of each attribute, and the property of its elements that holds the numbers.
TYPES = {
    "position": ("FLOAT_VECTOR", "vector"),
    "scale": ("FLOAT_VECTOR", "vector"),
    "rotation": ("QUATERNION", "value"),
    "radiance:base": ("FLOAT4", "vector"),
}
NOT_ASKED = {"Workbench": False, "Holoreel Engine": False, "Look": POINTS, "Color": DISPLAY, "Hide Fainter Than": 0.0}


def native_arrays(gaussians: EvaluatedGaussians) -> dict[str, NDArray[np.float32]]:
    """Return the attributes, (N, 3) or (N, 4) each, of the Gaussians that can be seen; the others are left out.

    Blender stores each attribute relative to the range over all points: the dead would cost the living precision.
    """
    alive = gaussians.take(gaussians.alive)
    base = np.concatenate([(alive.features[:, :3] - 0.5) / SH_C0, alive.opacities[:, None]], axis=1)
    values = {"position": alive.means, "scale": alive.scales, "rotation": alive.quats, "radiance:base": base}
    return {name: np.ascontiguousarray(array, np.float32) for name, array in values.items()}


def gaussians_shown(played: bpy.types.Object) -> EvaluatedGaussians:
    """Return what a reel shows at the scene's frame, cropped, as display-referred colors, in the object's space."""
    modifier = modifier_of(played)
    if modifier is None:
        raise HoloreelError(f"object {played.name!r} is no reel; select one that was imported by Holoreel.")
    asked = {name: value for name, value in NOT_ASKED.items() if name in input_names(modifier.node_group)}
    before = {name: get_input(modifier, name) for name in asked}
    try:
        for name, value in asked.items():
            set_input(modifier, name, value)
        geometry = played.evaluated_get(bpy.context.evaluated_depsgraph_get()).evaluated_geometry()
        found = geometry.pointcloud
        count = 0 if found is None else len(found.points)
        unturned = np.tile(np.float32([1, 0, 0, 0]), (count, 1))
        if count == 0:
            return EvaluatedGaussians(*(np.zeros((0, *shape), np.float32) for shape in ((3,), (4,), (3,), (), (3,))))
        parts = {name: read(found.attributes, name) for name in ("position", "scale", "opacity", "rgb")}
        turned = read(found.attributes, "rotation") if "rotation" in found.attributes else unturned
        return EvaluatedGaussians(parts["position"], turned, parts["scale"], parts["opacity"], parts["rgb"][:, :3])
    finally:
        for name, value in before.items():
            set_input(modifier, name, value)


def write_native(cloud: bpy.types.PointCloud, arrays: dict[str, NDArray[np.float32]]) -> None:
    """Write the attributes into a point cloud with as many points."""
    for name, (kind, _) in TYPES.items():
        if name not in cloud.attributes:
            cloud.attributes.new(name, kind, "POINT")
    for name, (_, property_name) in TYPES.items():
        cloud.attributes[name].data.foreach_set(property_name, arrays[name].ravel())


def new_native_splats(context: bpy.types.Context, played: bpy.types.Object) -> bpy.types.Object:
    """Return a new object with what a reel shows now, as native splats, in the reel's place.

    Raises `HoloreelError` where Blender has no such splats.
    """
    if not has_native_splats():
        raise HoloreelError("this Blender has no Gaussian splats of its own: use Blender 5.3 or later.")
    arrays = native_arrays(gaussians_shown(played))
    name = f"{played.name} at {context.scene.frame_current_final:g}"
    created = new_point_cloud(context, name, len(arrays["position"]))
    write_native(created.data, arrays)
    set_native(created.data)
    created.matrix_world = played.matrix_world
    return created
