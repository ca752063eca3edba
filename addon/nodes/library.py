# SPDX-License-Identifier: GPL-3.0-or-later
"""Data-blocks that are built from code once per .blend file and found again afterwards by a tag."""

from collections.abc import Callable

import bpy

from .builder import Tree

TAG = "holoreel"  # custom property that holds "name version"


def find(collection: bpy.types.bpy_prop_collection, name: str, version: int | str) -> bpy.types.ID | None:
    """Return the local data-block tagged `name version`, whatever it is called now."""
    for block in collection:
        if block.library is None and block.get(TAG) == f"{name} {version}":
            return block
    return None


def is_tagged(block: bpy.types.ID, name: str) -> bool:
    """Return whether a data-block was built as `name`, in any version."""
    return str(block.get(TAG, "")).rpartition(" ")[0] == name


def tag(block: bpy.types.ID, name: str, version: int | str) -> None:
    """Mark a data-block so that `find` finds it."""
    block[TAG] = f"{name} {version}"


def node_group(
    name: str, version: int, tooltip: str
) -> Callable[[Callable[[Tree], None]], Callable[[], bpy.types.NodeTree]]:
    """Turn a function that fills a `Tree` into one that returns the group, built at most once per .blend file.

    Raise `version` with every change of a group's nodes or sockets: files made earlier keep their own.
    """

    def decorate(build: Callable[[Tree], None]) -> Callable[[], bpy.types.NodeTree]:
        def ensure() -> bpy.types.NodeTree:
            return ensure_group(name, version, tooltip, build)

        ensure.__name__ = build.__name__
        ensure.__doc__ = build.__doc__
        return ensure

    return decorate


def ensure_group(name: str, version: int | str, tooltip: str, build: Callable[[Tree], None]) -> bpy.types.NodeTree:
    """Return the group `name version`, which `build` fills if it is not there yet.

    A group that differs from reel to reel has a digest of what it was built from in its version.
    """
    group = find(bpy.data.node_groups, name, version)
    if group is None:
        group = bpy.data.node_groups.new(name, "GeometryNodeTree")
        group.description = tooltip
        tree = Tree(group)
        build(tree)
        tree.arrange()
        tag(group, name, version)
    return group
