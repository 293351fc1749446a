"""OpenSim models (.osim): read into a :class:`gonio.records.BodyModel`.

Document versions 10901 to 40600 (OpenSim 1.x to 4.6) are read: bodies, joints, couplers, markers and gravity. Muscles,
geometry, contact and controllers don't take part in kinematics or in inverse dynamics and stay in the file.
"""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from gonio.errors import InputError
from gonio.formats.osim_functions import inner_function, read_function
from gonio.formats.osim_joints import GROUND_NAME, FrameTable, Joint, Node, Place, read_joints
from gonio.formats.osim_xml import (
    Element,
    children,
    describe,
    flag,
    name_of,
    number,
    objects,
    open_document,
    text,
    vector,
    words,
)
from gonio.kernel.body.functions import Pieces, scaled, stack
from gonio.records import (
    GROUND,
    REVOLUTE,
    Bodies,
    BodyModel,
    Coordinates,
    JointTree,
    Markers,
)

_GRAVITY_M_S2 = (0.0, -9.80665, 0.0)
_RANGE = (-10.0, 10.0)  # OpenSim's own default
INERTIA_TAGS = ("inertia_xx", "inertia_yy", "inertia_zz", "inertia_xy", "inertia_xz", "inertia_yz")


def read_osim(path: Path) -> BodyModel:
    """Read an OpenSim model.

    A file that has not changed since it was read last is not parsed again: a lab's trials share a handful of models, and
    parsing one takes as long as the inverse dynamics of a minute.

    Args:
        path: A ``.osim`` file of OpenSim 1.x to 4.6.

    Returns:
        The model; its bodies, coordinates and markers are in the file's order.

    Raises:
        InputError: the file can't be read, is no model, or holds something that gonio can't honour (a joint, a function or a
            constraint of an unknown kind, a loop). The message names the file and the element.
    """
    try:
        state = path.stat() if path.is_file() else None
        return _read_version(path.absolute(), state.st_mtime_ns, state.st_size) if state else _read(path)
    except InputError as error:
        if path.name in error.message:
            raise
        raise InputError(f"{path.name}: {error.message}", hint=error.hint, code=error.code, **error.details) from error


@lru_cache(maxsize=8)
def _read_version(path: Path, _changed_ns: int, _size: int) -> BodyModel:
    """Read one version of a file; a model is immutable, so all may share it."""
    return _read(path)


def _read(path: Path) -> BodyModel:
    model, version = open_document(path, "Model")
    body_elements = [body for body in objects(model, "BodySet") if name_of(body) != GROUND_NAME]
    body_names = [name_of(body) for body in body_elements]
    _refuse_duplicates(body_names, "body")
    joints = read_joints(model, version)
    functions: list[Pieces] = []
    coordinates = _read_coordinates(model, joints, functions)
    joints = _sorted_joints(joints, body_names)
    tree, nodes_of = _plant(joints, coordinates.names, body_names, functions)
    return BodyModel(
        name=name_of(model),
        source=path.name,
        joints=tree,
        functions=stack(functions),
        coordinates=coordinates,
        bodies=_read_bodies(body_elements, joints, nodes_of),
        markers=_read_markers(objects(model, "MarkerSet"), body_names, FrameTable(model)),
        gravity_m_s2=vector(model, "gravity", _GRAVITY_M_S2),
    )


def _sorted_joints(joints: list[Joint], body_names: list[str]) -> list[Joint]:
    """Order the joints so that each hangs on a body that is already placed; refuse what is no tree."""
    waiting, placed, ordered = list(joints), {GROUND_NAME}, []
    known = {GROUND_NAME, *body_names}
    for joint in joints:
        for place in (joint.parent, joint.child):
            if place.body not in known:
                raise InputError(
                    f"{describe(joint.element)} connects the body {place.body!r}, which does not exist.",
                    hint=f"The bodies are: {', '.join(sorted(known))}.",
                )
    children = [joint.child.body for joint in joints]
    for joint in joints:
        if children.count(joint.child.body) > 1 or joint.child.body == GROUND_NAME:
            raise InputError(
                f"{describe(joint.element)} closes a loop: {joint.child.body} hangs on more than one joint.",
                hint="gonio's bodies form a tree from ground outwards; remove a joint or swap its parent and child.",
            )
    while waiting:
        ready = [joint for joint in waiting if joint.parent.body in placed]
        if not ready:
            raise InputError(
                f"The joints {', '.join(joint.name for joint in waiting)} form a cycle that never reaches ground.",
                hint="Connect one of their bodies to ground.",
            )
        ordered.extend(ready)
        placed.update(joint.child.body for joint in ready)
        waiting = [joint for joint in waiting if joint not in ready]
    loose = [name for name in body_names if name not in placed]
    if loose:
        raise InputError(
            f"The bodies {', '.join(loose)} have no joint.", hint="Connect each body to ground or to another body."
        )
    return ordered


def _plant(
    joints: list[Joint], coordinate_names: tuple[str, ...], body_names: list[str], functions: list[Pieces]
) -> tuple[JointTree, dict[str, int]]:
    """Number the nodes of all joints, adding their functions; give each body's last node too."""
    last_node, T_last_body = {GROUND_NAME: GROUND}, {GROUND_NAME: np.eye(4)}
    nodes: list[Node] = []
    parents, placements, function_numbers, parent_bodies = [], [], [], []
    for joint in joints:
        parent, placement = last_node[joint.parent.body], T_last_body[joint.parent.body] @ joint.parent.T_body_frame
        for node in joint.nodes:
            parents.append(parent)
            placements.append(placement)
            function_numbers.append(-1 if node.function is None else len(functions))
            parent_bodies.append(GROUND if joint.parent.body == GROUND_NAME else body_names.index(joint.parent.body))
            if node.function is not None:
                functions.append(node.function)
            parent, placement = len(nodes), np.eye(4)
            nodes.append(node)
        last_node[joint.child.body] = parent
        T_last_body[joint.child.body] = np.linalg.inv(joint.child.T_body_frame)
    tree = JointTree(
        names=tuple(node.name for node in nodes),
        parent=np.array(parents, dtype=int),
        kind=np.array([node.kind for node in nodes], dtype=int),
        axis=np.array([node.axis for node in nodes]).reshape(-1, 3),
        T_parent_node=np.array(placements).reshape(-1, 4, 4),
        function=np.array(function_numbers, dtype=int),
        coordinate=np.array(
            [coordinate_names.index(node.coordinate) if node.coordinate else -1 for node in nodes], dtype=int
        ),
        parent_body=np.array(parent_bodies, dtype=int),
    )
    return tree, last_node


def _read_bodies(elements: list[Element], joints: list[Joint], node_of: dict[str, int]) -> Bodies:
    T_node_body = {joint.child.body: np.linalg.inv(joint.child.T_body_frame) for joint in joints}
    names = [name_of(element) for element in elements]
    return Bodies(
        names=tuple(names),
        node=np.array([node_of[name] for name in names], dtype=int),
        T_node_body=np.array([T_node_body[name] for name in names]).reshape(-1, 4, 4),
        mass_kg=np.array([_mass_kg(element) for element in elements]),
        com_body_m=np.array([vector(element, "mass_center", (0, 0, 0)) for element in elements]).reshape(-1, 3),
        inertia_body_kgm2=np.array([_inertia_kgm2(element) for element in elements]).reshape(-1, 3, 3),
    )


def _mass_kg(element: Element) -> float:
    mass_kg = number(element, "mass", 0.0)
    if mass_kg < 0:
        raise InputError(f"{describe(element)} has the mass {mass_kg} kg.", hint="A mass is not negative.")
    return mass_kg


def _inertia_kgm2(element: Element) -> np.ndarray:
    """Read the tensor about the centre of mass: one tag of six numbers since 4.0, six tags before."""
    if element.find("inertia") is not None:
        xx, yy, zz, xy, xz, yz = vector(element, "inertia", (0,) * 6)
    else:
        xx, yy, zz, xy, xz, yz = (number(element, tag, 0.0) for tag in INERTIA_TAGS)
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _read_coordinates(model: Element, joints: list[Joint], functions: list[Pieces]) -> Coordinates:
    """Read all coordinates and the couplers between them; the couplers' functions are added to ``functions``."""
    elements = [coordinate for joint in joints for coordinate in joint.coordinates]
    names = [name_of(element) for element in elements]
    _refuse_duplicates(names, "coordinate")
    for element in elements:
        if flag(element, "prescribed", default=False) and children(element.find("prescribed_function")):
            raise InputError(
                f"{describe(element)} is prescribed over time.", hint="Set <prescribed> to false, or lock it."
            )
    nodes = [node for joint in joints for node in joint.nodes]
    coupled_to, coupling = np.full(len(names), -1), np.full(len(names), -1)
    for constraint in objects(model, "ConstraintSet"):
        enforced = flag(constraint, "isEnforced", default=True) and not flag(constraint, "isDisabled", default=False)
        if enforced:
            dependent, source, pieces = _read_coupler(constraint, names)
            coupled_to[dependent], coupling[dependent] = source, len(functions)
            functions.append(pieces)
    _refuse_circular_couplers(coupled_to, names)
    return Coordinates(
        names=tuple(names),
        rotational=np.array([_is_angle(name, nodes) for name in names], dtype=bool),
        default=np.array([number(element, "default_value", 0.0) for element in elements]),
        range=np.array([vector(element, "range", _RANGE) for element in elements]).reshape(-1, 2),
        clamped=np.array([flag(element, "clamped", default=False) for element in elements], dtype=bool),
        locked=np.array([flag(element, "locked", default=False) for element in elements], dtype=bool),
        coupled_to=coupled_to,
        coupling_function=coupling,
    )


def _is_angle(name: str, nodes: list[Node]) -> bool:
    """Tell whether a coordinate is an angle: whether some node turns by it itself, forwards or backwards.

    What drives turns by other functions only is neither angle nor length, and OpenSim ("coupled") never converts it.
    """
    turns = [node.function for node in nodes if node.kind == REVOLUTE and node.coordinate == name]
    return any(
        function is not None
        and function.coefficients.shape == (1, 2)  # one piece, a straight line
        and abs(function.coefficients[0, 1]) == 1.0
        for function in turns
    )


def _read_coupler(element: Element, names: list[str]) -> tuple[int, int, Pieces]:
    """Read one enforced constraint; only a coupler of one coordinate to another can be honoured exactly."""
    if element.tag != "CoordinateCouplerConstraint":
        raise InputError(
            f"{describe(element)} is a kind of constraint that gonio does not know.",
            hint="Switch it off in the model (isEnforced false), or express it by a CoordinateCouplerConstraint.",
        )
    dependent, sources = text(element, "dependent_coordinate_name"), words(element, "independent_coordinate_names")
    if len(sources) != 1 or dependent not in names or sources[0] not in names:
        raise InputError(
            f"{describe(element)} couples {dependent!r} to {' '.join(sources)!r}.",
            hint="A coupler needs one dependent and one independent coordinate, both of the model.",
        )
    named = [child for child in children(element) if child.get("name") == "coupled_coordinates_function"]
    found = children(element.find("coupled_coordinates_function")) or named
    function = found[0] if found else inner_function(element)
    pieces = scaled(read_function(function), number(element, "scale_factor", 1.0))
    return names.index(dependent), names.index(sources[0]), pieces


def _refuse_circular_couplers(coupled_to: np.ndarray, names: list[str]) -> None:
    for start in range(len(names)):
        step, steps = start, 0
        while coupled_to[step] >= 0:
            step, steps = coupled_to[step], steps + 1
            if steps > len(names):
                raise InputError(f"The coupler of {names[start]} leads back to itself.", hint="Break the circle.")


@dataclass(frozen=True)
class ModelForce:
    """A force that a model's file makes act on it: a muscle, a spring, a contact; ``kind`` is OpenSim's class."""

    kind: str
    name: str


def read_osim_forces(path: Path) -> tuple[ModelForce, ...]:
    """List the forces in a model's file that are switched on; gonio computes none of them.

    Raises:
        InputError: the file can't be read.
    """
    model, _ = open_document(path, "Model")
    return tuple(
        ModelForce(element.tag, name_of(element))
        for element in objects(model, "ForceSet")
        if flag(element, "appliesForce", default=True) and not flag(element, "isDisabled", default=False)
    )


def read_osim_markers(path: Path, model: BodyModel) -> Markers:
    """Read a marker set file (``<MarkerSet>``) for a model that it fits; markers on bodies that it lacks are refused.

    Raises:
        InputError: the file can't be read, or a marker is on no body of the model.
    """
    markerset, _ = open_document(path, "MarkerSet")
    frames = FrameTable(markerset, model.bodies.names)
    return _read_markers(children(markerset.find("objects")), list(model.bodies.names), frames)


def _read_markers(elements: list[Element], body_names: list[str], frames: FrameTable) -> Markers:
    names = [name_of(element) for element in elements]
    _refuse_duplicates(names, "marker")
    bodies, locations = [], []
    for element in elements:
        place = _marker_place(element, frames)
        if place.body not in body_names and place.body != GROUND_NAME:
            raise InputError(
                f"{describe(element)} is on the body {place.body!r}, which does not exist.",
                hint=f"The bodies are: {', '.join(body_names)}.",
            )
        bodies.append(GROUND if place.body == GROUND_NAME else body_names.index(place.body))
        location = vector(element, "location", (0, 0, 0))
        locations.append(place.T_body_frame[:3, :3] @ location + place.T_body_frame[:3, 3])
    return Markers(
        names=tuple(names),
        body=np.array(bodies, dtype=int),
        location_body_m=np.array(locations).reshape(-1, 3),
        fixed=np.array([flag(element, "fixed", default=False) for element in elements], dtype=bool),
    )


def _marker_place(element: Element, frames: FrameTable) -> Place:
    if element.find("body") is not None:  # OpenSim 1.x to 3.x
        return Place(text(element, "body"), np.eye(4))
    return frames.resolve(element, "parent_frame")


def _refuse_duplicates(names: list[str], what: str) -> None:
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"Two {what} elements have the name {name}.", hint="Give each a name of its own.")
