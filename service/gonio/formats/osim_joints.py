"""OpenSim's joints, whatever their version and kind, as rows of elementary nodes."""

import posixpath
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gonio.errors import InputError
from gonio.formats.osim_functions import inner_function, linear_coefficients, read_function
from gonio.formats.osim_xml import Element, describe, flag, name_of, objects, text, vector, words
from gonio.kernel.body.functions import Pieces, polynomial
from gonio.records import FIXED, PRISMATIC, REVOLUTE

GROUND_NAME = "ground"

_X, _Y, _Z = np.eye(3)
_MOTIONS: dict[str, list[tuple[int, Float[np.ndarray, "3"], int]]] = {
    # What each joint does, outermost first: kind of node, axis, which of its coordinates drives it.
    "WeldJoint": [],
    "PinJoint": [(REVOLUTE, _Z, 0)],
    "SliderJoint": [(PRISMATIC, _X, 0)],
    "UniversalJoint": [(REVOLUTE, _X, 0), (REVOLUTE, _Y, 1)],
    "BallJoint": [(REVOLUTE, _X, 0), (REVOLUTE, _Y, 1), (REVOLUTE, _Z, 2)],
    "GimbalJoint": [(REVOLUTE, _X, 0), (REVOLUTE, _Y, 1), (REVOLUTE, _Z, 2)],
    "PlanarJoint": [(PRISMATIC, _X, 1), (PRISMATIC, _Y, 2), (REVOLUTE, _Z, 0)],
    "FreeJoint": [
        (PRISMATIC, _X, 3),
        (PRISMATIC, _Y, 4),
        (PRISMATIC, _Z, 5),
        (REVOLUTE, _X, 0),
        (REVOLUTE, _Y, 1),
        (REVOLUTE, _Z, 2),
    ],
}
_TRANSFORM_AXES = ("translation1", "translation2", "translation3", "rotation1", "rotation2", "rotation3")
_NOT_FUNCTIONS = ("coordinates", "axis", "components", "is_rotation")


class Place(NamedTuple):
    """A frame that is fixed in a body."""

    body: str
    T_body_frame: Float[np.ndarray, "4 4"]


class Node(NamedTuple):
    """One elementary node before it is numbered; ``coordinate`` is empty for a constant."""

    name: str
    kind: int
    axis: Float[np.ndarray, "3"]
    function: Pieces | None
    coordinate: str


@dataclass(frozen=True)
class Joint:
    """A joint of either file layout: the frames it connects, its coordinates and its nodes, outermost first."""

    element: Element
    name: str
    parent: Place
    child: Place
    coordinates: list[Element]
    nodes: list[Node]


def read_joints(model: Element, version: int) -> list[Joint]:
    """Read all joints of a model, in the file's order.

    Raises:
        InputError: a joint of a kind that gonio can't honour, or one whose frames or coordinates don't exist.
    """
    if version >= 30500 or model.find("JointSet") is not None:
        frames = FrameTable(model)
        return [_read_new(element, frames) for element in objects(model, "JointSet")]
    joints: list[Joint] = []
    for body in objects(model, "BodySet"):
        holder = body.find("Joint")
        if holder is not None and len(holder):
            joints.append(_read_old(holder[0], name_of(body)))
    return joints


def _read_old(element: Element, child: str) -> Joint:
    """Read a joint that stands in the body it moves (OpenSim 1.x to 3.x)."""
    if flag(element, "reverse", default=False):
        raise InputError(
            f"{describe(element)} is reversed (it moves the parent against the child).",
            hint="Open the model in OpenSim 4 and save it again.",
        )
    parent = Place(text(element, "parent_body"), _offset(element, "location_in_parent", "orientation_in_parent"))
    coordinates = objects(element, "CoordinateSet")
    return Joint(
        element=element,
        name=name_of(element),
        parent=parent,
        child=Place(child, _offset(element, "location", "orientation")),
        coordinates=coordinates,
        nodes=_nodes(element, coordinates),
    )


def _read_new(element: Element, frames: "FrameTable") -> Joint:
    """Read a joint of a JointSet (OpenSim 4.x)."""
    coordinates = list(element.findall("coordinates/*"))
    return Joint(
        element=element,
        name=name_of(element),
        parent=frames.resolve(element, "parent_frame"),
        child=frames.resolve(element, "child_frame"),
        coordinates=coordinates,
        nodes=_nodes(element, coordinates),
    )


def _offset(element: Element, location: str, orientation: str) -> Float[np.ndarray, "4 4"]:
    """Read a fixed offset: metres, and body-fixed x-y-z angles in rad."""
    offset = np.eye(4)
    offset[:3, :3] = Rotation.from_euler("XYZ", vector(element, orientation, (0, 0, 0))).as_matrix()
    offset[:3, 3] = vector(element, location, (0, 0, 0))
    return offset


def _nodes(element: Element, coordinates: list[Element]) -> list[Node]:
    names = [name_of(coordinate) for coordinate in coordinates]
    joint = name_of(element)
    if element.tag == "CustomJoint":
        return _custom_nodes(element, names) or [Node(joint, FIXED, _X, None, "")]
    if element.tag not in _MOTIONS:
        raise InputError(
            f"{describe(element)} is a kind of joint that gonio does not know.",
            hint=f"Model it as a CustomJoint, or as one of {', '.join(_MOTIONS)}.",
        )
    motions = _MOTIONS[str(element.tag)]
    if len(names) != len(motions):
        raise InputError(
            f"{describe(element)} has {len(names)} coordinates.", hint=f"A {element.tag} has {len(motions)}."
        )
    identity = polynomial(np.array([0.0, 1.0]))
    nodes = [Node(f"{joint}/{names[which]}", kind, axis, identity, names[which]) for kind, axis, which in motions]
    return nodes or [Node(joint, FIXED, _X, None, "")]


def _custom_nodes(element: Element, names: list[str]) -> list[Node]:
    """Take a CustomJoint apart: three slides along axes of the parent's frame, then three turns, one after another."""
    transform = element.find("SpatialTransform")
    axes = {} if transform is None else {name_of(axis): axis for axis in transform}
    unknown = set(axes) - {*_TRANSFORM_AXES, "components"}
    if unknown:
        raise InputError(
            f"{describe(element)} has the transform axes {', '.join(sorted(unknown))}.",
            hint=f"OpenSim names them {', '.join(_TRANSFORM_AXES)}.",
        )
    nodes: list[Node] = []
    for which, label in enumerate(_TRANSFORM_AXES):
        if label in axes:
            nodes.extend(_axis_nodes(axes[label], PRISMATIC if which < 3 else REVOLUTE, which % 3, names))
    return nodes


def _axis_nodes(axis: Element, kind: int, which: int, names: list[str]) -> list[Node]:
    """Read one TransformAxis; a linear function of several coordinates is as many nodes about the same axis."""
    drivers, function = words(axis, "coordinates"), _find_function(axis)
    where = f"{name_of(axis)} of {describe(_joint_of(axis))}"
    for driver in drivers:
        if driver not in names:
            raise InputError(
                f"{where} depends on {driver}, which is no coordinate of that joint.",
                hint=f"Its coordinates are {', '.join(names) or 'none'}.",
            )
    direction = vector(axis, "axis", tuple(np.eye(3)[which]))
    length = float(np.linalg.norm(direction))
    if length < 1e-9:
        raise InputError(f"{where} has an axis of length 0.", hint="Give a direction such as 0 0 1.")
    direction = direction / length
    label = f"{name_of(_joint_of(axis))}/{name_of(axis)}"
    if len(drivers) > 1:
        if function is None or function.tag != "LinearFunction":
            raise InputError(
                f"{where} is a function of several coordinates.", hint="gonio honours that for a LinearFunction only."
            )
        *slopes, intercept = linear_coefficients(function, len(drivers))
        intercepts = [float(intercept)] + [0.0] * (len(drivers) - 1)
        rows = [polynomial(np.array(pair)) for pair in zip(intercepts, slopes, strict=True)]
        return [Node(label, kind, direction, row, driver) for row, driver in zip(rows, drivers, strict=True)]
    if function is None:  # older files leave out the identity, and the constant 0
        return [Node(label, kind, direction, polynomial(np.array([0.0, 1.0])), drivers[0])] if drivers else []
    pieces = read_function(function)
    if not drivers and pieces.coefficients.size > 1:
        raise InputError(f"{where} is a function of no coordinate.", hint="Name its coordinate, or make it a Constant.")
    if not np.any(pieces.coefficients):
        return []
    return [Node(label, kind, direction, pieces, drivers[0] if drivers else "")]


def _find_function(axis: Element) -> Element | None:
    """Find a TransformAxis' function: its own child in new files, inside ``<function>`` in old ones."""
    holder = axis.find("function")
    if holder is not None:
        return inner_function(axis) if len(holder) else None
    found = [child for child in axis if child.tag not in _NOT_FUNCTIONS]
    return found[0] if found else None


def _joint_of(axis: Element) -> Element:
    return next(axis.iterancestors("CustomJoint"))


class FrameTable:
    """The named frames of a 4.x model: sockets refer to them by absolute or relative path, or by name."""

    def __init__(self, model: Element) -> None:
        self._model = model
        self._bodies = {GROUND_NAME, *(name_of(body) for body in objects(model, "BodySet"))}
        self._offsets = {_path_of(frame, model): frame for frame in model.iter("PhysicalOffsetFrame")}

    def resolve(self, owner: Element, socket: str) -> Place:
        """Find the body, and the place in it, that a component's socket names.

        Raises:
            InputError: the socket is empty, names nothing, or leads round in a circle.
        """
        T_frame = np.eye(4)
        for _ in range(len(self._offsets) + 1):
            target = self._connectee(owner, socket)
            if isinstance(target, str):
                return Place(target, T_frame)
            T_frame = _offset(target, "translation", "orientation") @ T_frame
            owner, socket = target, "parent"
        raise InputError(f"The offset frames around {describe(owner)} hang on each other.", hint="Break the circle.")

    def _connectee(self, owner: Element, socket: str) -> str | Element:
        given = text(owner, f"socket_{socket}") or text(owner, f"socket_{socket}_connectee_name")
        path = posixpath.normpath(posixpath.join(_path_of(owner, self._model), given))
        if path in self._offsets:
            return self._offsets[path]
        name = given.rpartition("/")[2]
        if name in self._bodies:
            return name
        found = [frame for frame in self._offsets.values() if name_of(frame) == name]
        if len(found) != 1:
            raise InputError(
                f"<socket_{socket}> of {describe(owner)} names {given!r}, which is not one frame of the model.",
                hint="Give the path of a body (/bodyset/pelvis), of ground (/ground) or of an offset frame.",
            )
        return found[0]


def _path_of(element: Element, model: Element) -> str:
    """Write OpenSim's path of a component: /jointset/knee_r/femur_r_offset."""
    parts: list[str] = []
    step: Element | None = element
    while step is not None and step is not model:
        if step.tag not in ("objects", "frames", "components"):
            parts.append(str(step.tag).lower() if str(step.tag).endswith("Set") else name_of(step))
        step = step.getparent()
    return "/" + "/".join(reversed(parts))
