"""OpenSim models (.osim): a scaled model written into a copy of the file that it came from.

Only what scaling changes is written: masses, centres of mass, inertias, where joints sit, the factors of the joints'
coupled slides, and the markers. Everything else (muscles, geometry, contact, comments, and the document's version)
stays as it was. OpenSim 4.6 loads the result whatever its version (it rounds the joints' places in files older than 4.0
to six digits); muscle paths and pictures keep the generic model's size.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] - no types
from scipy.spatial.transform import Rotation

from gonio.errors import InputError
from gonio.formats.osim import INERTIA_TAGS, read_osim
from gonio.formats.osim_joints import GROUND_NAME, FrameTable, find_function, joint_elements
from gonio.formats.osim_xml import Element, children, describe, name_of, number, objects, open_document, text
from gonio.records import GROUND, PRISMATIC, BodyModel


def write_osim(path: Path, model: BodyModel, template: Path) -> None:
    """Write a model into a copy of the file that it was scaled from.

    Args:
        path: The file to write.
        model: The scaled model, of the same bodies, joints and coordinates as the template's; markers may be others.
        template: The generic model's file.

    Raises:
        InputError: the template can't be read, or is another model.
    """
    generic = read_osim(template)
    if (generic.bodies.names, generic.joints.names) != (model.bodies.names, model.joints.names):
        raise InputError(
            f"{template.name} is not the model that {model.name} was scaled from.",
            hint="Give the generic model's file.",
        )
    root, version = open_document(template, "Model", keep_comments=True)
    root.set("name", model.name)
    for element in objects(root, "BodySet"):
        if name_of(element) != GROUND_NAME:
            _write_body(element, model, model.bodies.index(name_of(element)))
    frames = FrameTable(root)
    for element, child in joint_elements(root, version):
        _write_joint(element, child, model, generic, frames)
    _write_markers(root, model, version)
    document = root.getroottree()
    path.write_bytes(etree.tostring(document, xml_declaration=True, encoding="UTF-8"))


def _write_body(element: Element, model: BodyModel, body: int) -> None:
    _put(element, "mass", [model.bodies.mass_kg[body]])
    _put(element, "mass_center", model.bodies.com_body_m[body])
    tensor = model.bodies.inertia_body_kgm2[body]
    values = (*np.diag(tensor), tensor[0, 1], tensor[0, 2], tensor[1, 2])
    if element.find(INERTIA_TAGS[0]) is not None:
        for tag, value in zip(INERTIA_TAGS, values, strict=True):
            _put(element, tag, [value])
    else:
        _put(element, "inertia", values)


def _write_joint(element: Element, child: str, model: BodyModel, generic: BodyModel, frames: FrameTable) -> None:
    """Write where a joint sits in its two bodies, and the factors of its slides."""
    first, last = _nodes_of(element, child, model)
    parent_body = model.joints.parent_body[first]
    T_node_parent = np.eye(4) if parent_body == GROUND else model.bodies.T_node_body[parent_body]
    T_parent_joint = np.linalg.inv(T_node_parent) @ model.joints.T_parent_node[first]
    T_child_joint = np.linalg.inv(model.bodies.T_node_body[model.bodies.index(child)])
    if element.find("socket_parent_frame") is None and element.find("parent_body") is not None:
        _put_offset(element, "location_in_parent", "orientation_in_parent", T_parent_joint)
        _put_offset(element, "location", "orientation", T_child_joint)
    else:
        _write_frame(element, "parent_frame", T_parent_joint, frames)
        _write_frame(element, "child_frame", T_child_joint, frames)
    for node in range(first, last + 1):
        if model.joints.kind[node] == PRISMATIC:
            factor = _function_factor(model, generic, node)
            if factor != 1.0:
                label = model.joints.names[node].rpartition("/")[2]
                _multiply(next(axis for axis in element.iter("TransformAxis") if name_of(axis) == label), factor)


def _nodes_of(element: Element, child: str, model: BodyModel) -> tuple[int, int]:
    """Find the first and the last node of the joint that moves a body."""
    last = int(model.bodies.node[model.bodies.index(child)])
    first, name = last, name_of(element)
    while (
        first > 0 and model.joints.parent[first] == first - 1 and model.joints.names[first - 1].startswith(f"{name}/")
    ):
        first -= 1
    return first, last


def _write_frame(joint: Element, socket: str, T_body_joint: Float[np.ndarray, "4 4"], frames: FrameTable) -> None:
    """Move the offset frame that a joint's socket names so that the joint comes to lie where it should."""
    frame = frames.offset_frame(joint, socket)
    if frame is None:  # the joint sits in the body's own frame
        if not np.allclose(T_body_joint, np.eye(4), atol=1e-12):
            raise InputError(f"{describe(joint)} has no offset frame to be moved.", hint="Give it one in the template.")
        return
    T_body_outer = frames.resolve(frame, "parent").T_body_frame
    _put_offset(frame, "translation", "orientation", np.linalg.inv(T_body_outer) @ T_body_joint)


def _function_factor(model: BodyModel, generic: BodyModel, node: int) -> float:
    """Give the factor by which a node's function was scaled."""
    ours, theirs = (m.functions.coefficients[m.functions.pieces_of(m.joints.function[node])] for m in (model, generic))
    largest = np.unravel_index(np.argmax(np.abs(theirs)), theirs.shape)
    return float(ours[largest] / theirs[largest])


def _multiply(axis: Element, factor: float) -> None:
    """Scale a TransformAxis' function: through its MultiplierFunction, or by a new one around it."""
    function = find_function(axis)
    if function is None:
        raise InputError(f"{describe(axis)} has no function that could be scaled.", hint="Give it one in the template.")
    if function.tag == "MultiplierFunction":
        _put(function, "scale", [factor * number(function, "scale", 1.0)])
        return
    multiplier = etree.Element("MultiplierFunction")
    if function.get("name"):
        multiplier.set("name", function.attrib.pop("name"))
    function.getparent().replace(function, multiplier)
    etree.SubElement(multiplier, "function").append(function)
    _put(multiplier, "scale", [factor])


def _write_markers(root: Element, model: BodyModel, version: int) -> None:
    """Write all markers of the model; those of the template that it lacks are removed."""
    markerset = root.find("MarkerSet")
    if markerset is None:
        markerset = etree.SubElement(root, "MarkerSet", name="markerset")
    holder = markerset.find("objects")
    if holder is None:
        holder = etree.SubElement(markerset, "objects")
    known = {name_of(marker): marker for marker in children(holder)}
    holder[:] = []
    for index, name in enumerate(model.markers.names):
        body = model.markers.body[index]
        body_name = GROUND_NAME if body == GROUND else model.bodies.names[body]
        marker = known.get(name)
        if marker is None:
            marker = etree.Element("Marker", name=name)
        if version < 30500:
            _put_text(marker, "body", body_name)
        else:
            _put_text(marker, "socket_parent_frame", f"/{GROUND_NAME}" if body == GROUND else f"/bodyset/{body_name}")
        _put(marker, "location", model.markers.location_body_m[index])
        _put_text(marker, "fixed", "true" if model.markers.fixed[index] else "false")
        holder.append(marker)


def _put_offset(element: Element, location: str, orientation: str, T: Float[np.ndarray, "4 4"]) -> None:
    """Write a fixed offset; an orientation that has not changed keeps its own digits."""
    _put(element, location, T[:3, 3])
    given = Rotation.from_euler("XYZ", [float(word) for word in text(element, orientation, "0 0 0").split()])
    if np.abs(given.as_matrix() - T[:3, :3]).max() > 1e-9:
        _put(element, orientation, Rotation.from_matrix(T[:3, :3]).as_euler("XYZ"))


def _put(element: Element, tag: str, values: "list[float] | tuple[float, ...] | np.ndarray") -> None:
    """Write numbers as a property, so that reading them gives the same numbers."""
    _put_text(element, tag, " ".join(repr(float(value)) for value in values))


def _put_text(element: Element, tag: str, value: str) -> None:
    found = element.find(tag)
    if found is None:
        found = etree.SubElement(element, tag)
    found.text = value
