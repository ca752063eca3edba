# SPDX-License-Identifier: GPL-3.0-or-later
"""The point attributes of a reel: one table, from Spacetime Gaussians to Blender's types.

Attributes with the prefix `stg_` are what the node group "Holoreel Evaluate" consumes; the others are there after it.
Quaternions travel as FLOAT_COLOR, because nodes can calculate with a color's four numbers but not with a rotation's.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.gaussians.model import SpacetimeGaussians, sigmoid

PREFIX = "stg_"
INVERSE_WIDTH_MAX = 1e18  # its square still fits into float32


class Kind(Enum):
    """A type of attribute: Blender's name, the property that `foreach_set` writes, numbers per point."""

    FLOAT = ("FLOAT", "value", 1)
    VECTOR = ("FLOAT_VECTOR", "vector", 3)
    COLOR = ("FLOAT_COLOR", "color", 4)

    @property
    def type_name(self) -> str:
        """Blender's name of the type."""
        return self.value[0]

    @property
    def property_name(self) -> str:
        """The property of one element that holds its numbers."""
        return self.value[1]

    @property
    def width(self) -> int:
        """Numbers per point."""
        return self.value[2]


@dataclass(frozen=True)
class Attribute:
    """One row of the table: `read` returns (N,) or (N, width) from the model."""

    name: str
    kind: Kind
    read: Callable[[SpacetimeGaussians], NDArray[np.float32]]


def _opacity(gaussians: SpacetimeGaussians) -> NDArray[np.float32]:
    return sigmoid(gaussians.opacity_logits.astype(np.float64)).astype(np.float32)


def _inverse_width(gaussians: SpacetimeGaussians) -> NDArray[np.float32]:
    with np.errstate(over="ignore"):
        return np.minimum(np.exp(-gaussians.trbf_log_scales.astype(np.float64)), INVERSE_WIDTH_MAX).astype(np.float32)


def _color(gaussians: SpacetimeGaussians) -> NDArray[np.float32]:
    color = np.ones((len(gaussians), 4), np.float32)
    color[:, :3] = gaussians.features[:, :3]
    return color


TABLE = (
    Attribute("position", Kind.VECTOR, lambda g: g.means),
    Attribute("stg_motion_1", Kind.VECTOR, lambda g: g.motions[:, 0]),
    Attribute("stg_motion_2", Kind.VECTOR, lambda g: g.motions[:, 1]),
    Attribute("stg_motion_3", Kind.VECTOR, lambda g: g.motions[:, 2]),
    Attribute("stg_quat", Kind.COLOR, lambda g: g.quats),
    Attribute("stg_omega", Kind.COLOR, lambda g: g.omegas),
    Attribute("stg_opacity", Kind.FLOAT, _opacity),
    Attribute("stg_center", Kind.FLOAT, lambda g: g.trbf_centers),
    Attribute("stg_inverse_width", Kind.FLOAT, _inverse_width),
    Attribute("scale", Kind.VECTOR, lambda g: np.exp(g.log_scales)),
    Attribute("rgb", Kind.COLOR, _color),
)


# What points of several segments have besides, in reel frames counted from 0: see the node group "Holoreel Segment".
SEGMENT_NAMES = ("stg_first", "stg_frames", "stg_until")


def write(
    cloud: bpy.types.PointCloud,
    gaussians: SpacetimeGaussians,
    order: NDArray[np.int64] | None = None,
    segments: Mapping[str, NDArray[np.float32]] | None = None,
) -> None:
    """Write the rows of a model that `order` selects, or all, into a point cloud of as many points.

    `segments` has a column for each of `SEGMENT_NAMES`, with the model's rows; without it all belong to one segment.
    """
    columns = {name: (Kind.FLOAT, lambda values=values: values) for name, values in (segments or {}).items()}
    columns |= {row.name: (row.kind, lambda row=row: row.read(gaussians)) for row in TABLE}
    # All are created before any is filled: creating one may move the others.
    for name, (kind, _) in columns.items():
        if name not in cloud.attributes:
            cloud.attributes.new(name, kind.type_name, "POINT")
    rows = slice(None) if order is None else order
    for name, (kind, values_of) in columns.items():
        values = np.ascontiguousarray(values_of()[rows], dtype=np.float32)
        cloud.attributes[name].data.foreach_set(kind.property_name, values.ravel())


def read(attributes: bpy.types.AttributeGroupPointCloud, name: str) -> NDArray[np.float32]:
    """Return a float attribute as (N,) or (N, width); quaternions come as w x y z."""
    widths = {kind.type_name: (kind.property_name, kind.width) for kind in Kind} | {"QUATERNION": ("value", 4)}
    attribute = attributes[name]
    property_name, width = widths[attribute.data_type]
    values = np.empty(len(attribute.data) * width, np.float32)
    attribute.data.foreach_get(property_name, values)
    return values if width == 1 else values.reshape(-1, width)
