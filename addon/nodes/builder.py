# SPDX-License-Identifier: GPL-3.0-or-later
"""Node trees written as formulas.

A `Tree` wraps a Blender node tree; the values that its methods return (`Float`, `Vector`, ...) wrap output sockets, and
calculating with them adds nodes: `position + velocity * dt` is two of them. Numbers and tuples stand for constants.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any, Self, TypeAlias

import bpy

COLUMN_WIDTH, ROW_HEIGHT = 200.0, 120.0  # of the arranged nodes, in the node editor's units

SOCKETS = {
    "Geometry": "NodeSocketGeometry",
    "Float": "NodeSocketFloat",
    "Integer": "NodeSocketInt",
    "Menu": "NodeSocketMenu",
    "Boolean": "NodeSocketBool",
    "Object": "NodeSocketObject",
    "Vector": "NodeSocketVector",
    "Image": "NodeSocketImage",
}


class Value:
    """An output socket of a tree."""

    def __init__(self, tree: "Tree", socket: bpy.types.NodeSocket) -> None:
        self.tree = tree
        self.socket = socket


class Geometry(Value):
    """A geometry."""


class Menu(Value):
    """The choice of a menu."""


class Object(Value):
    """One of Blender's objects, or none."""


class Image(Value):
    """An image data-block, which may be a movie."""


class Boolean(Value):
    """True or false."""

    def _logic(self, operation: str, *operands: "Boolean") -> "Boolean":
        node = self.tree.node("FunctionNodeBooleanMath", dict(enumerate(operands)), operation=operation)
        return Boolean(self.tree, node.outputs[0])

    def __and__(self, other: "Boolean") -> "Boolean":
        return self._logic("AND", self, other)

    def __or__(self, other: "Boolean") -> "Boolean":
        return self._logic("OR", self, other)

    def __invert__(self) -> "Boolean":
        return self._logic("NOT", self)


class Rotation(Value):
    """A rotation; `rotate` turns a vector by it."""

    def rotate(self, vector: "VectorLike") -> "Vector":
        """Return the rotated vector."""
        node = self.tree.node("FunctionNodeRotateVector", {"Vector": vector, "Rotation": self})
        return Vector(self.tree, node.outputs[0])

    def inverted(self) -> "Rotation":
        """Return the opposite rotation."""
        return Rotation(self.tree, self.tree.node("FunctionNodeInvertRotation", {0: self}).outputs[0])


class Matrix(Value):
    """Four by four numbers; the first three columns are the images of the axes, the last that of the origin."""

    def columns(self) -> "list[Vector]":
        """Return the first three numbers of each of the four columns."""
        entries = self.tree.node("FunctionNodeSeparateMatrix", {0: self}).outputs
        return [
            self.tree.vector(*(Float(self.tree, entries[f"Column {column} Row {row}"]) for row in (1, 2, 3)))
            for column in (1, 2, 3, 4)
        ]

    def transposed(self) -> "Matrix":
        """Return rows as columns."""
        return Matrix(self.tree, self.tree.node("FunctionNodeTransposeMatrix", {0: self}).outputs[0])

    def inverted(self) -> "Matrix":
        """Return the inverse; the identity if there is none."""
        return Matrix(self.tree, self.tree.node("FunctionNodeInvertMatrix", {0: self}).outputs[0])

    def transform(self, point: "VectorLike") -> "Vector":
        """Return a point transformed by this."""
        node = self.tree.node("FunctionNodeTransformPoint", {"Vector": point, "Transform": self})
        return Vector(self.tree, node.outputs[0])


class Color(Value):
    """Four numbers."""

    def channels(self) -> "tuple[Float, Float, Float, Float]":
        """Return red, green, blue and alpha."""
        red, green, blue, alpha = self.tree.node("FunctionNodeSeparateColor", {0: self}).outputs[:4]
        return tuple(Float(self.tree, socket) for socket in (red, green, blue, alpha))


class Float(Value):
    """A number; also stands for an integer."""

    def _math(self, operation: str, *operands: "FloatLike") -> "Float":
        node = self.tree.node("ShaderNodeMath", dict(enumerate(operands)), operation=operation)
        return Float(self.tree, node.outputs[0])

    def __add__(self, other: "FloatLike") -> "Float":
        return self._math("ADD", self, other)

    def __radd__(self, other: float) -> "Float":
        return self._math("ADD", other, self)

    def __sub__(self, other: "FloatLike") -> "Float":
        return self._math("SUBTRACT", self, other)

    def __rsub__(self, other: float) -> "Float":
        return self._math("SUBTRACT", other, self)

    def __mul__(self, other: "FloatLike") -> "Float":
        return self._math("MULTIPLY", self, other)

    def __rmul__(self, other: float) -> "Float":
        return self._math("MULTIPLY", other, self)

    def __truediv__(self, other: "FloatLike") -> "Float":
        """Division as Blender does it: x / 0 is 0."""
        return self._math("DIVIDE", self, other)

    def __rtruediv__(self, other: float) -> "Float":
        return self._math("DIVIDE", other, self)

    def __neg__(self) -> "Float":
        return self * -1.0

    def exp(self) -> "Float":
        """Return e to this power."""
        return self._math("EXPONENT", self)

    def log(self) -> "Float":
        """Return the natural logarithm."""
        return self._math("LOGARITHM", self, 2.718281828459045)

    def sqrt(self) -> "Float":
        """Return the square root; 0 for negative numbers."""
        return self._math("SQRT", self)

    def power(self, exponent: "FloatLike") -> "Float":
        """Return this to `exponent`."""
        return self._math("POWER", self, exponent)

    def at_most(self, limit: "FloatLike") -> "Float":
        """Return the smaller of the two."""
        return self._math("MINIMUM", self, limit)

    def at_least(self, limit: "FloatLike") -> "Float":
        """Return the larger of the two."""
        return self._math("MAXIMUM", self, limit)

    def modulo(self, period: "FloatLike") -> "Float":
        """Return the remainder with the sign of `period`; 0 where `period` is 0."""
        return self._math("FLOORED_MODULO", self, period)

    def floor(self) -> "Float":
        """Return the largest whole number that is not above this."""
        return self._math("FLOOR", self)

    def absolute(self) -> "Float":
        """Return this without its sign."""
        return self._math("ABSOLUTE", self)

    def is_zero(self) -> "Float":
        """Return 1 where this is exactly 0, else 0."""
        return 1.0 - self.absolute().above(0.0)

    def above(self, limit: "FloatLike") -> "Float":
        """Return 1 where this is above `limit`, else 0 (works in materials too)."""
        return self._math("GREATER_THAN", self, limit)

    def below(self, limit: "FloatLike") -> Boolean:
        """Return whether this is below `limit`."""
        node = self.tree.node("FunctionNodeCompare", {0: self, 1: limit}, data_type="FLOAT", operation="LESS_THAN")
        return Boolean(self.tree, node.outputs[0])


class Vector(Value):
    """Three numbers."""

    def _math(self, operation: str, *operands: "VectorLike") -> bpy.types.Node:
        return self.tree.node("ShaderNodeVectorMath", dict(enumerate(operands)), operation=operation)

    def __add__(self, other: "VectorLike") -> "Vector":
        return Vector(self.tree, self._math("ADD", self, other).outputs[0])

    def __sub__(self, other: "VectorLike") -> "Vector":
        return Vector(self.tree, self._math("SUBTRACT", self, other).outputs[0])

    def __mul__(self, other: "VectorLike | FloatLike") -> "Vector":
        """Scale by a number, or multiply axis by axis."""
        if isinstance(other, (Vector, tuple)):
            return Vector(self.tree, self._math("MULTIPLY", self, other).outputs[0])
        node = self.tree.node("ShaderNodeVectorMath", {0: self, "Scale": other}, operation="SCALE")
        return Vector(self.tree, node.outputs[0])

    def times_plus(self, factor: "VectorLike", addend: "VectorLike") -> "Vector":
        """Return this · factor + addend, axis by axis, in one node."""
        return Vector(self.tree, self._math("MULTIPLY_ADD", self, factor, addend).outputs[0])

    def dot(self, other: "VectorLike") -> Float:
        """Return the scalar product."""
        return Float(self.tree, self._math("DOT_PRODUCT", self, other).outputs["Value"])

    def cross(self, other: "VectorLike") -> "Vector":
        """Return the vector product."""
        return Vector(self.tree, self._math("CROSS_PRODUCT", self, other).outputs[0])

    def length(self) -> Float:
        """Return the length."""
        return Float(self.tree, self._math("LENGTH", self).outputs["Value"])

    def normalized(self) -> "Vector":
        """Return the direction, of length 1; zero stays zero."""
        return Vector(self.tree, self._math("NORMALIZE", self).outputs[0])

    def at_least(self, limit: "VectorLike") -> "Vector":
        """Return the larger of the two, axis by axis."""
        return Vector(self.tree, self._math("MAXIMUM", self, limit).outputs[0])

    def sin(self) -> "Vector":
        """Return the sine of each axis."""
        return Vector(self.tree, self._math("SINE", self).outputs[0])

    def cos(self) -> "Vector":
        """Return the cosine of each axis."""
        return Vector(self.tree, self._math("COSINE", self).outputs[0])

    def axes(self) -> tuple[Float, Float, Float]:
        """Return x, y and z."""
        x, y, z = self.tree.node("ShaderNodeSeparateXYZ", {0: self}).outputs
        return Float(self.tree, x), Float(self.tree, y), Float(self.tree, z)


FloatLike: TypeAlias = Float | float
VectorLike: TypeAlias = Vector | tuple[float, float, float]

ATTRIBUTES: dict[str, type[Value]] = {
    "FLOAT": Float,
    "FLOAT_VECTOR": Vector,
    "FLOAT_COLOR": Color,
    "QUATERNION": Rotation,
    "FLOAT4X4": Matrix,
}


class Tree:
    """A node tree under construction."""

    def __init__(self, tree: bpy.types.NodeTree) -> None:
        self.tree = tree
        self._inputs: bpy.types.Node | None = None
        self._outputs: bpy.types.Node | None = None
        self._panels: dict[str, Any] = {}
        self._attributes: dict[str, Value] = {}

    def node(self, kind: str, inputs: Mapping[int | str, Any] | None = None, **properties: Any) -> bpy.types.Node:
        """Add a node, set its properties, then connect or set its inputs (by name or index)."""
        node = self.tree.nodes.new(kind)
        for name, value in properties.items():
            setattr(node, name, value)
        for key, value in (inputs or {}).items():
            self.connect(node.inputs[key], value)
        return node

    def connect(self, socket: bpy.types.NodeSocket, value: Any) -> None:
        """Link a value to an input socket, or set the socket's constant."""
        if isinstance(value, Value):
            self.tree.links.new(value.socket, socket)
        else:
            socket.default_value = value

    # --- The group's own sockets

    def _socket(self, direction: str, kind: str, name: str, tooltip: str, panel: str | None) -> Any:
        parent = None
        if panel is not None:
            if panel not in self._panels:
                self._panels[panel] = self.tree.interface.new_panel(panel)
            parent = self._panels[panel]
        return self.tree.interface.new_socket(
            name, description=tooltip, in_out=direction, socket_type=SOCKETS[kind], parent=parent
        )

    def _input_socket(self, name: str) -> bpy.types.NodeSocket:
        if self._inputs is None:
            self._inputs = self.tree.nodes.new("NodeGroupInput")
        return self._inputs.outputs[name]

    def geometry_input(self) -> Geometry:
        """Declare the input Geometry."""
        self._socket("INPUT", "Geometry", "Geometry", "Points of a reel", None)
        return Geometry(self, self._input_socket("Geometry"))

    def float_input(
        self,
        name: str,
        tooltip: str,
        default: float = 0.0,
        low: float | None = None,
        high: float | None = None,
        panel: str | None = None,
        kind: str = "Float",
        is_field: bool = False,
    ) -> Float:
        """Declare a number (`kind` "Float" or "Integer") with its tooltip and range.

        It is one number for all points, unless `is_field`; then it may differ from point to point.
        """
        item = self._socket("INPUT", kind, name, tooltip, panel)
        item.default_value = default
        item.force_non_field = not is_field
        if low is not None:
            item.min_value = low
        if high is not None:
            item.max_value = high
        return Float(self, self._input_socket(name))

    def integer_input(self, name: str, tooltip: str, default: int, low: int, panel: str | None = None) -> Float:
        """Declare a whole number."""
        return self.float_input(name, tooltip, default, low, panel=panel, kind="Integer")

    def boolean_input(self, name: str, tooltip: str, default: bool, panel: str | None = None) -> Boolean:
        """Declare a check box."""
        item = self._socket("INPUT", "Boolean", name, tooltip, panel)
        item.default_value = default
        item.force_non_field = True
        return Boolean(self, self._input_socket(name))

    def object_input(self, name: str, tooltip: str, panel: str | None = None) -> Object:
        """Declare an object."""
        self._socket("INPUT", "Object", name, tooltip, panel)
        return Object(self, self._input_socket(name))

    def menu_input(self, name: str, tooltip: str, panel: str | None = None) -> Menu:
        """Declare a menu; its items come from the `switch` that it is linked to. See `set_menu_default`."""
        self._socket("INPUT", "Menu", name, tooltip, panel)
        return Menu(self, self._input_socket(name))

    def set_menu_default(self, name: str, item: str) -> None:
        """Choose the default of a menu input, once it is linked."""
        for socket in self.tree.interface.items_tree:
            if socket.item_type == "SOCKET" and socket.in_out == "INPUT" and socket.name == name:
                socket.default_value = item

    def vector_input(
        self,
        name: str,
        tooltip: str,
        default: tuple[float, float, float] = (0.0, 0.0, 0.0),
        panel: str | None = None,
        is_field: bool = False,
    ) -> Vector:
        """Declare three numbers, the same for all points unless `is_field`."""
        item = self._socket("INPUT", "Vector", name, tooltip, panel)
        item.default_value = default
        item.force_non_field = not is_field
        return Vector(self, self._input_socket(name))

    def image_input(self, name: str, tooltip: str, panel: str | None = None) -> Image:
        """Declare an image."""
        self._socket("INPUT", "Image", name, tooltip, panel)
        return Image(self, self._input_socket(name))

    def output(self, name: str, value: Value, tooltip: str = "") -> None:
        """Declare an output of the group and connect it."""
        self._socket("OUTPUT", type(value).__name__, name, tooltip, None)
        if self._outputs is None:
            self._outputs = self.tree.nodes.new("NodeGroupOutput")
        self.connect(self._outputs.inputs[name], value)

    # --- Fields

    def attribute(self, name: str, kind: str) -> Any:
        """Return the field of a named attribute; `kind` is Blender's data type."""
        if name not in self._attributes:
            node = self.node("GeometryNodeInputNamedAttribute", {"Name": name}, data_type=kind)
            socket = next(socket for socket in node.outputs if socket.enabled and socket.name == "Attribute")
            self._attributes[name] = ATTRIBUTES[kind](self, socket)
        return self._attributes[name]

    def has_attribute(self, name: str, kind: str) -> Boolean:
        """Return the field of whether there is a named attribute."""
        return Boolean(self, self.attribute(name, kind).socket.node.outputs["Exists"])

    def position(self) -> Vector:
        """Return the field of positions."""
        return Vector(self, self.node("GeometryNodeInputPosition").outputs[0])

    def vector(self, x: FloatLike, y: FloatLike, z: FloatLike) -> Vector:
        """Return the vector of three numbers."""
        return Vector(self, self.node("ShaderNodeCombineXYZ", {0: x, 1: y, 2: z}).outputs[0])

    def matrix(self, columns: Sequence[Vector]) -> Matrix:
        """Return the transform with four columns of three numbers; the last is where it moves the origin."""
        node = self.node("FunctionNodeCombineMatrix")
        for column, vector in enumerate(columns, start=1):
            for row, axis in enumerate(vector.axes(), start=1):
                self.connect(node.inputs[f"Column {column} Row {row}"], axis)
        return Matrix(self, node.outputs[0])

    def quaternion(self, w: FloatLike, x: FloatLike, y: FloatLike, z: FloatLike) -> Rotation:
        """Return the rotation of a quaternion, which is normalized first."""
        node = self.node("FunctionNodeQuaternionToRotation", {"W": w, "X": x, "Y": y, "Z": z})
        return Rotation(self, node.outputs[0])

    def color(self, red: FloatLike, green: FloatLike, blue: FloatLike) -> Color:
        """Return a color with alpha 1."""
        node = self.node("FunctionNodeCombineColor", {"Red": red, "Green": green, "Blue": blue, "Alpha": 1.0})
        return Color(self, node.outputs[0])

    def switch(self, menu: Menu, choices: Mapping[str, tuple[str, Value]], kind: str) -> Any:
        """Return the choice that `menu` names; `choices` maps item → (tooltip, value), `kind` is the socket type."""
        node = self.node("GeometryNodeMenuSwitch", data_type=kind)
        node.enum_items.clear()
        for name, (tooltip, _) in choices.items():
            node.enum_items.new(name).description = tooltip
        self.connect(node.inputs["Menu"], menu)
        for name, (_, value) in choices.items():
            self.connect(node.inputs[name], value)
        value_type = type(next(iter(choices.values()))[1])
        return value_type(self, node.outputs[0])

    def choose(self, condition: Boolean, chosen: Value, otherwise: Value, kind: str) -> Any:
        """Return `chosen` where the condition is true, else `otherwise`; `kind` is the socket type."""
        node = self.node("GeometryNodeSwitch", input_type=kind)
        for name, value in (("Switch", condition), ("False", otherwise), ("True", chosen)):
            self.connect(node.inputs[name], value)
        return type(chosen)(self, node.outputs[0])

    # --- Geometry

    def unless(self, condition: Boolean, geometry: Geometry) -> Geometry:
        """Return nothing where the condition is true, else the geometry; what makes it is not computed then."""
        return self.geometry("GeometryNodeSwitch", {"Switch": condition, "False": geometry}, input_type="GEOMETRY")

    def geometry(self, kind: str, inputs: Mapping[int | str, Any], **properties: Any) -> Geometry:
        """Add a node whose first output is a geometry."""
        return Geometry(self, self.node(kind, inputs, **properties).outputs[0])

    def store(self, geometry: Geometry, name: str, value: Value, kind: str, domain: str = "POINT") -> Geometry:
        """Store `value` as a named attribute."""
        inputs = {"Geometry": geometry, "Name": name, "Value": value}
        return self.geometry("GeometryNodeStoreNamedAttribute", inputs, data_type=kind, domain=domain)

    def delete_points(self, geometry: Geometry, selection: Boolean) -> Geometry:
        """Delete the selected points."""
        return self.geometry(
            "GeometryNodeDeleteGeometry", {"Geometry": geometry, "Selection": selection}, domain="POINT"
        )

    def group(self, tree: bpy.types.NodeTree, inputs: Mapping[str, Any]) -> bpy.types.Node:
        """Add another group as a node; the caller wraps its outputs."""
        node = self.node("GeometryNodeGroup", node_tree=tree)
        for name, value in inputs.items():
            self.connect(node.inputs[name], value)
        return node

    def arrange(self) -> Self:
        """Lay the nodes out in columns from inputs to outputs, for people who open the group."""
        depth: dict[str, int] = {}
        sources = defaultdict(set)
        for link in self.tree.links:
            sources[link.to_node.name].add(link.from_node.name)

        def column(name: str) -> int:
            if name not in depth:
                depth[name] = 0
                depth[name] = 1 + max((column(source) for source in sources[name]), default=-1)
            return depth[name]

        rows: dict[int, int] = defaultdict(int)
        places: list[float] = []
        for node in self.tree.nodes:
            x = column(node.name)
            places += x * COLUMN_WIDTH, -rows[x] * ROW_HEIGHT
            rows[x] += 1
        self.tree.nodes.foreach_set("location", places)  # one by one, every node would update the whole tree
        return self
