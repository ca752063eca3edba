# SPDX-License-Identifier: GPL-3.0-or-later
"""Instances of reels as objects of their own, so that the splats of each can face the camera."""

from collections.abc import Collection

import bpy
from mathutils import Matrix

from .reels import modifier_of


def make_real(context: bpy.types.Context, instancers: Collection[bpy.types.Object]) -> list[bpy.types.Object]:
    """Return a new object for every reel that `instancers` instance; these instance nothing any more.

    The new objects share the points of the reel that was instanced, have its settings and drivers, and are children of
    their instancer, which places them exactly (an object's own channels know no shear). Blender's own operator would
    make two of each and drop the drivers.
    """
    found: dict[tuple[str, str, tuple[float, ...]], Matrix] = {}
    for instance in context.evaluated_depsgraph_get().object_instances:
        if not instance.is_instance or instance.parent.original not in instancers:
            continue
        # A reel can be there twice, once for each component of what it evaluates to.
        source, matrix = instance.instance_object.original, instance.matrix_world.copy()
        if modifier_of(source) is not None:
            found[instance.parent.original.name, source.name, tuple(x for row in matrix for x in row)] = matrix
    created = []
    for (instancer_name, source_name, _), matrix in found.items():
        instancer, source = bpy.data.objects[instancer_name], bpy.data.objects[source_name]
        real = source.copy()
        for collection in instancer.users_collection:
            collection.objects.link(real)
        real.parent, real.parent_type = instancer, "OBJECT"
        real.matrix_parent_inverse = instancer.matrix_world.inverted() @ matrix
        real.matrix_basis = Matrix.Identity(4)
        created.append(real)
    for instancer_name, _, _ in found:
        bpy.data.objects[instancer_name].instance_type = "NONE"
    return created


def instancers_of(context: bpy.types.Context) -> list[bpy.types.Object]:
    """Return the selected objects that instance something."""
    return [chosen for chosen in context.selected_objects if chosen.instance_type != "NONE"]
