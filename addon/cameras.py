# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's camera objects in and out of `Camera`."""

import bpy
import numpy as np
from mathutils import Matrix

from ..core.camera import Camera
from ..core.camera_blender import BlenderCamera
from ..core.camera_fisheye import KINDS as FISHEYES
from ..core.camera_fisheye import Fisheye, fisheye_camera
from ..core.errors import HoloreelError

_KINDS = {"ORTHO": "orthographic", "PANO": "panoramic", "CUSTOM": "custom"}
_DATA = ("lens", "sensor_width", "sensor_height", "sensor_fit", "shift_x", "shift_y")
_FORMAT = ("resolution_x", "resolution_y", "resolution_percentage", "pixel_aspect_x", "pixel_aspect_y")


def camera_settings(
    camera_object: bpy.types.Object, scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph | None = None
) -> BlenderCamera:
    """Read a camera object as it is rendered at the current frame: animation, drivers, constraints, parents included.

    Raises `HoloreelError` for an object that is no perspective camera.
    """
    if camera_object.type != "CAMERA":
        raise HoloreelError(f"object {camera_object.name!r} is no camera; choose a camera.")
    evaluated = camera_object.evaluated_get(depsgraph or bpy.context.evaluated_depsgraph_get())
    if evaluated.data.type != "PERSP":
        kind = _KINDS.get(evaluated.data.type, evaluated.data.type)
        raise HoloreelError(
            f"camera {camera_object.name!r} is {kind}; only perspective cameras are supported, change its type."
        )
    return _settings(evaluated, scene)


def camera_from_object(
    camera_object: bpy.types.Object, scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph | None = None
) -> Camera:
    """Return a camera object, with the format of `scene`, as a `Camera`: a pinhole, or a fisheye for a panoramic one.

    Raises `HoloreelError` for an object that is no camera, and for cameras of other kinds.
    """
    if is_fisheye(camera_object):
        evaluated = camera_object.evaluated_get(depsgraph or bpy.context.evaluated_depsgraph_get())
        data = evaluated.data
        polynomial = tuple(getattr(data, f"fisheye_polynomial_k{power}") for power in range(5))
        lens = Fisheye(data.panorama_type, data.fisheye_fov, data.fisheye_lens, polynomial)
        return fisheye_camera(_settings(evaluated, scene), lens)
    return camera_settings(camera_object, scene, depsgraph).to_camera()


def is_fisheye(candidate: bpy.types.Object) -> bool:
    """Return whether an object is a panoramic camera of one of the kinds that are a `Camera`."""
    return candidate.type == "CAMERA" and candidate.data.type == "PANO" and candidate.data.panorama_type in FISHEYES


def _settings(evaluated: bpy.types.Object, scene: bpy.types.Scene) -> BlenderCamera:
    return BlenderCamera(
        **{key: getattr(evaluated.data, key) for key in _DATA},
        **{key: getattr(scene.render, key) for key in _FORMAT},
        matrix_world=np.array(evaluated.matrix_world, np.float64),
        name=evaluated.name,
    )


def new_camera_object(camera: Camera, collection: bpy.types.Collection) -> bpy.types.Object:
    """Make a camera object that sees what `camera` sees, once the format is set by `set_format`."""
    name = camera.name or "Camera"
    camera_object = bpy.data.objects.new(name, bpy.data.cameras.new(name))
    collection.objects.link(camera_object)
    set_camera_object(camera_object, camera)
    return camera_object


def set_camera_object(camera_object: bpy.types.Object, camera: Camera) -> None:
    """Give a camera object the lens and the place of `camera`; depth of field is switched off."""
    settings = BlenderCamera.from_camera(camera)
    data = camera_object.data
    data.type = "PERSP"
    data.lens_unit = "MILLIMETERS"
    for key in _DATA:
        setattr(data, key, getattr(settings, key))
    data.dof.use_dof = False
    camera_object.rotation_mode = "QUATERNION"  # Euler angles lose digits
    camera_object.matrix_world = Matrix(settings.matrix_world.tolist())


def set_format(scene: bpy.types.Scene, camera: Camera) -> None:
    """Give `scene` the resolution and the pixel aspect that `camera` needs."""
    settings = BlenderCamera.from_camera(camera)
    for key in _FORMAT:
        setattr(scene.render, key, getattr(settings, key))
