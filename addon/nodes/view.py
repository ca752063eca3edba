# SPDX-License-Identifier: GPL-3.0-or-later
"""Who looks: the active camera, or the 3D viewport's own view, as seen from the object that a modifier belongs to."""

import bpy

from .builder import Boolean, Float, Matrix, Object, Tree, Vector
from .library import node_group

VIEW_GROUP, VIEW_VERSION = "Holoreel View", 2
SWITCH_NODE, SCALE_NODE = "Viewport Camera", "Viewport Camera Scale"  # both take the object that the add-on moves


@node_group(VIEW_GROUP, VIEW_VERSION, "The camera that splats face: the active one, or the viewport's own view")
def view_camera(tree: Tree) -> None:
    """The add-on moves the viewport's camera (`addon.viewport`) and says the rest by its scale, which has no other use.

    x is 2 where the viewport looks through no camera, y is 2 where it is shaded as Solid or Wireframe, else they are 1.
    z is the size of its pixels over those of a render by that camera.
    """
    follow = tree.boolean_input("Follow View", "Face the 3D viewport's own view where it looks through no camera", True)
    workbench = tree.boolean_input("Workbench", "Whether the scene is rendered by Workbench", False)
    switch = tree.node("GeometryNodeSwitch", input_type="OBJECT")
    switch.name = SWITCH_NODE
    stands = tree.node("GeometryNodeObjectInfo", transform_space="ORIGINAL")
    stands.name = SCALE_NODE
    free, plain, pixels = Vector(tree, stands.outputs["Scale"]).axes()
    in_viewport = Boolean(tree, tree.node("GeometryNodeIsViewport").outputs[0])
    follows = in_viewport & follow & ~free.below(1.5)
    tree.connect(switch.inputs["Switch"], follows)
    tree.connect(switch.inputs["False"], Object(tree, tree.node("GeometryNodeInputActiveCamera").outputs[0]))
    camera = Object(tree, switch.outputs[0])
    tree.output("Camera", camera, "The camera to face")
    chosen = tree.node("GeometryNodeObjectInfo", {"Object": camera}, transform_space="ORIGINAL")
    is_there = ~Vector(tree, chosen.outputs["Scale"]).length().below(1e-12)  # an object that is not there has no scale
    tree.output("Is There", is_there, "Whether there is a camera to face")
    tree.output("Pixel Scale", tree.choose(follows, pixels, 1.0, "FLOAT"), "Size of a pixel over that of a render")
    opaque = tree.choose(in_viewport, ~plain.below(1.5), workbench, "BOOLEAN")
    tree.output("Opaque", opaque, "Whether nothing can be drawn but opaque surfaces")


class View:
    """A camera as fields, seen from the object, however either is moved, turned, scaled or sheared.

    Three vectors `right`, `up` and `back` of the object's space are one world unit long along the camera's axes; three
    covectors `across`, `above` and `behind` measure: their scalar products with an offset from `location` are the
    world's lengths along those axes. Where the object is moved and turned alone, vectors and covectors are the same.
    """

    def __init__(self, tree: Tree, follow: Boolean, width_px: Float, height_px: Float) -> None:
        """`follow` and the size of the rendered picture are inputs of a look."""
        self.tree = tree
        chosen = tree.group(view_camera(), {"Follow View": follow}).outputs
        camera, pixel_scale = Object(tree, chosen["Camera"]), Float(tree, chosen["Pixel Scale"])
        self.exists = Boolean(tree, chosen["Is There"])
        from_object = _transform(tree, camera, "RELATIVE")
        # Blender takes a camera's axes for one unit long, whatever the camera is scaled by.
        lengths = [axis.length() for axis in _transform(tree, camera, "ORIGINAL").columns()[:3]]
        *axes, self.location = from_object.columns()
        self.right, self.up, self.back = (axis * (1.0 / length) for axis, length in zip(axes, lengths, strict=True))
        rows = from_object.inverted().transposed().columns()[:3]
        self.across, self.above, self.behind = (row * length for row, length in zip(rows, lengths, strict=True))
        # World units per unit of the object: the geometric mean over the axes.
        self.scale = self.across.dot(self.above.cross(self.behind)).absolute().power(1 / 3)

        info = tree.node("GeometryNodeCameraInfo", {"Camera": camera})
        entries = tree.node("FunctionNodeSeparateMatrix", {0: _matrix(tree, info.outputs["Projection Matrix"])}).outputs
        # Half the extent of what is seen at depth 1 (anywhere, if orthographic), and the middle of it where the lens is
        # shifted; the size of a pixel there.
        self.tangent_x = 1.0 / Float(tree, entries["Column 1 Row 1"])
        self.tangent_y = 1.0 / Float(tree, entries["Column 2 Row 2"])
        self.middle_x = self.tangent_x * Float(tree, entries["Column 3 Row 1"])
        self.middle_y = self.tangent_y * Float(tree, entries["Column 3 Row 2"])
        self.pixel_x = self.tangent_x * 2.0 / width_px * pixel_scale
        self.pixel_y = self.tangent_y * 2.0 / height_px * pixel_scale
        self.orthographic = Float(tree, info.outputs["Is Orthographic"])

    def pixel_at(self, point: Vector, angle: Float | None = None) -> Float:
        """Return the size of a pixel at a point, in the object's units; `angle` is that of a pixel, 0: of the lens."""
        offset = point - self.location
        along = offset.dot(self.across), offset.dot(self.above), offset.dot(self.behind)
        distance = self.tree.vector(*along).length()
        lens = (self.pixel_x * self.pixel_y).sqrt()
        per_distance = lens if angle is None else self.tree.choose(angle.below(1e-12), lens, angle, "FLOAT")
        return (per_distance * (distance * (1.0 - self.orthographic) + self.orthographic)) / self.scale


def _transform(tree: Tree, found: Object, space: str) -> Matrix:
    node = tree.node("GeometryNodeObjectInfo", {"Object": found}, transform_space=space)
    return _matrix(tree, node.outputs["Transform"])


def _matrix(tree: Tree, socket: bpy.types.NodeSocket) -> Matrix:
    return Matrix(tree, socket)
