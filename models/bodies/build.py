"""Write the built-in bodies, ``fullbody_male.osim`` and ``fullbody_female.osim``, from the numbers in ``segments.py``.

Run ``python models/bodies/build.py`` after a change; a test compares the files with what this makes. They are ours:
only facts (lengths, masses, axes) were taken from the sources that ``segments.py`` names.

Names and signs are those of OpenSim's gait models, with flexion of the knee positive as in Rajagopal et al. 2016.
Frames: X forwards, Y up, Z to the right in the upright default pose, in which every body's axes are parallel to the
ground's.
"""

from pathlib import Path

import numpy as np
import segments as given
from lxml import etree

DEG = np.pi / 180
_X, _Y, _Z = np.eye(3)
_MIRROR = np.array([1.0, 1.0, -1.0])

_RANGES_DEG = {
    # Wide enough for sport, narrow enough to exclude what no joint does. Our choice, near those of the gait models; the
    # knee's goes to −15° because people do hyperextend.
    "hip_flexion": (-40, 140),
    "hip_adduction": (-60, 40),
    "hip_rotation": (-60, 60),
    "knee_angle": (-15, 160),
    "ankle_angle": (-60, 45),
    "subtalar_angle": (-35, 35),
    "mtp_angle": (-40, 70),
    "lumbar_extension": (-90, 45),
    "lumbar_bending": (-50, 50),
    "lumbar_rotation": (-60, 60),
    "neck_extension": (-70, 70),
    "neck_bending": (-60, 60),
    "neck_rotation": (-90, 90),
    "arm_flex": (-90, 180),
    "arm_add": (-180, 90),
    "arm_rot": (-120, 120),
    "elbow_flex": (-10, 160),
    "pro_sup": (-20, 170),
    "wrist_flex": (-80, 80),
    "wrist_dev": (-40, 40),
}


class Builder:
    """Collects bodies, joints and markers of one person and writes them as OpenSim XML."""

    def __init__(self, name: str, person: given.Person) -> None:
        self.name, self.person = name, person
        self.bodies: list[tuple[str, float, np.ndarray, np.ndarray]] = []
        self.joints: list[tuple] = []
        self.markers: list[tuple[str, str, np.ndarray]] = []
        total = sum(s.mass_pct * (1 if n in _ONCE else 2) for n, s in person.segments.items())
        # The published shares are rounded: they add up to 100.2 % (man) and 100.4 % (woman).
        self.kg_per_pct = person.mass_kg / total

    def length(self, segment: str) -> float:
        """Give a segment's length in metres."""
        return self.person.segments[segment].length_mm / 1000

    def inertial(self, segment: str, side: int = 1) -> tuple[float, np.ndarray, np.ndarray]:
        """Give a segment's mass, centre of mass and tensor about it; the left side (−1) mirrors the right one."""
        values, length = self.person.segments[segment], self.length(segment)
        mass = values.mass_pct * self.kg_per_pct
        com = np.array(values.com_pct) / 100 * length
        radii = np.array(values.gyration_pct) / 100 * length
        xx, yy, zz, xy, xz, yz = mass * np.sign(radii) * radii**2
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        mirror = np.diag([1.0, 1.0, side])
        return mass, mirror @ com, mirror @ tensor @ mirror

    def add_body(self, name: str, mass: float, com: np.ndarray, tensor: np.ndarray) -> None:
        """Add a body; refuse a tensor that no mass distribution has."""
        moments = np.linalg.eigvalsh(tensor)
        if mass > 0 and not (moments[0] > 0 and moments[2] <= moments[0] + moments[1]):
            raise ValueError(f"{name}: no body has the principal moments {moments} kg m²")
        self.bodies.append((name, mass, com, tensor))

    def add_joint(self, name: str, parent: str, child: str, place: np.ndarray, motions: dict[str, tuple]) -> None:
        """Add a CustomJoint; ``motions`` maps rotation1 … translation3 to (axis, coordinate or "", function)."""
        self.joints.append((name, parent, child, place, motions))

    def add_marker(self, name: str, body: str, place: np.ndarray) -> None:
        """Add a marker, metres in the body's frame."""
        self.markers.append((name, body, np.asarray(place, dtype=float)))


_ONCE = ("head", "thorax", "abdomen", "pelvis")


def combine(parts: list[tuple[float, np.ndarray, np.ndarray]]) -> tuple[float, np.ndarray, np.ndarray]:
    """Join rigid parts (mass, centre of mass, tensor about it; one frame); a negative mass takes a part away."""
    mass = sum(part[0] for part in parts)
    com = sum(part[0] * part[1] for part in parts) / mass
    tensor = np.zeros((3, 3))
    for part_mass, part_com, part_tensor in parts:
        arm = part_com - com
        tensor += part_tensor + part_mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return mass, com, tensor


def add_trunk(model: Builder) -> None:
    """Add pelvis, torso (thorax and abdomen) and head."""
    person = model.person
    hip, lumbar = np.array(person.hip_per_width), np.array(person.lumbar_per_width)
    width = model.length("pelvis") / np.linalg.norm((lumbar - hip)[:2])  # the pelvis' length runs in the sagittal plane
    hip, lumbar = width * hip, width * lumbar
    mass, com, tensor = model.inertial("pelvis")
    model.add_body("pelvis", mass, lumbar + com, tensor)
    free = {
        "rotation1": (_Z, "pelvis_tilt", "identity"),
        "rotation2": (_X, "pelvis_list", "identity"),
        "rotation3": (_Y, "pelvis_rotation", "identity"),
        "translation1": (_X, "pelvis_tx", "identity"),
        "translation2": (_Y, "pelvis_ty", "identity"),
        "translation3": (_Z, "pelvis_tz", "identity"),
    }
    model.add_joint("ground_pelvis", "ground", "pelvis", np.zeros(3), free)

    neck = np.array([0.0, model.length("thorax") + model.length("abdomen"), 0.0])
    middle = np.array([0.0, model.length("abdomen"), 0.0])
    parts = []
    for segment, origin in (("thorax", neck), ("abdomen", middle)):
        mass, com, tensor = model.inertial(segment)
        parts.append((mass, origin + com, tensor))
    model.add_body("torso", *combine(parts))
    model.add_joint("back", "pelvis", "torso", lumbar, ball("lumbar_extension", "lumbar_bending", "lumbar_rotation"))
    model.add_body("head", *model.inertial("head"))
    model.add_joint("neck", "torso", "head", neck, ball("neck_extension", "neck_bending", "neck_rotation"))

    model.add_marker("pelvis_centre", "pelvis", hip * (1, 1, 0))
    model.add_marker("neck", "torso", neck)
    for letter, side in (("r", 1), ("l", -1)):
        model.add_marker(f"asis_{letter}", "pelvis", np.array([0.0, 0.0, side * width / 2]))
        model.add_marker(f"hip_{letter}", "pelvis", hip * (1, 1, side))
        model.add_marker(f"shoulder_{letter}", "torso", shoulder(model) * (1, 1, side))
    face = model.length("head") * 1000 / given.FACE_HEAD_MM
    for point, place in given.FACE_M.items():
        if place[2] == 0:
            model.add_marker(point, "head", face * np.array(place))
        else:
            model.add_marker(f"{point}_r", "head", face * np.array(place))
            model.add_marker(f"{point}_l", "head", face * np.array(place) * _MIRROR)


def shoulder(model: Builder) -> np.ndarray:
    """Place the right shoulder joint in the torso."""
    torso_mm = 1000 * (model.length("thorax") + model.length("abdomen"))
    return np.array(given.SHOULDER_M) * torso_mm / given.SHOULDER_TORSO_MM


def add_leg(model: Builder, letter: str, side: int) -> None:
    """Add thigh, shank, talus, foot and toes."""
    mirror = np.array([1.0, 1.0, side])
    turn = np.array([side, side, 1.0])  # an axis' mirror image, so that equal values mean equal movements on both sides
    places = {name: place for name, _, place in model.markers}
    thigh, shank = model.length("thigh"), model.length("shank")
    model.add_body(f"femur_{letter}", *model.inertial("thigh", side))
    hip = ball(f"hip_flexion_{letter}", f"hip_adduction_{letter}", f"hip_rotation_{letter}", side)
    model.add_joint(f"hip_{letter}", "pelvis", f"femur_{letter}", places[f"hip_{letter}"], hip)

    model.add_body(f"tibia_{letter}", *model.inertial("shank", side))
    stretched = given.KNEE_UP  # ty at full extension is −395.85 mm in the source's femur
    scale = thigh / 0.39585
    knee = f"knee_angle_{letter}"
    motions = {
        "rotation1": (-_Z, knee, "identity"),
        "translation1": (_X, knee, (given.KNEE_FORWARD[0], scale * np.array(given.KNEE_FORWARD[1]))),
        "translation2": (_Y, knee, (stretched[0], scale * np.array(stretched[1]))),
    }
    model.add_joint(f"knee_{letter}", f"femur_{letter}", f"tibia_{letter}", np.zeros(3), motions)

    ankle = np.array([0.0, -shank, 0.0])
    foot = model.length("foot") / np.linalg.norm(np.add(given.HEEL_FROM_ANKLE_M, given.TOES_FROM_HEEL_M))
    heel, toes = foot * mirror * given.HEEL_FROM_ANKLE_M, foot * mirror * given.TOES_FROM_HEEL_M
    model.add_body(f"talus_{letter}", 0.0, np.zeros(3), np.zeros((3, 3)))
    model.add_joint(f"ankle_{letter}", f"tibia_{letter}", f"talus_{letter}", ankle, hinge("ankle_angle", letter, turn))
    mass, com, tensor = model.inertial("foot", side)
    toe_mass = given.TOES_SHARE * mass
    toe_com = foot * mirror * given.TOES_COM_M
    toe_tensor = np.diag(given.TOES_INERTIA_KGM2) * toe_mass / 0.2166 * foot**2
    whole, front = (mass, com - heel, tensor), (-toe_mass, toes + toe_com, -toe_tensor)
    model.add_body(f"calcn_{letter}", *combine([whole, front]))
    model.add_joint(
        f"subtalar_{letter}", f"talus_{letter}", f"calcn_{letter}", heel, hinge("subtalar_angle", letter, turn)
    )
    model.add_body(f"toes_{letter}", toe_mass, toe_com, toe_tensor)
    model.add_joint(f"mtp_{letter}", f"calcn_{letter}", f"toes_{letter}", toes, hinge("mtp_angle", letter, turn))

    model.add_marker(f"knee_{letter}", f"femur_{letter}", np.array([0.0, -thigh, 0.0]))
    model.add_marker(f"ankle_{letter}", f"tibia_{letter}", ankle)
    model.add_marker(f"heel_{letter}", f"calcn_{letter}", foot * np.array([0.0, 0.010, 0.0]))
    model.add_marker(f"big_toe_{letter}", f"toes_{letter}", foot * mirror * (0.065, 0.005, -0.025))
    model.add_marker(f"small_toe_{letter}", f"toes_{letter}", foot * mirror * (0.010, 0.000, 0.055))


def add_arm(model: Builder, letter: str, side: int) -> None:
    """Add upper arm, forearm and hand."""
    mirror, arm, forearm, hand = np.array([1.0, 1.0, side]), *(model.length(s) for s in ("arm", "forearm", "hand"))
    model.add_body(f"humerus_{letter}", *model.inertial("arm", side))
    motions = ball(f"arm_flex_{letter}", f"arm_add_{letter}", f"arm_rot_{letter}", side)
    model.add_joint(f"shoulder_{letter}", "torso", f"humerus_{letter}", shoulder(model) * mirror, motions)
    model.add_body(f"radius_{letter}", *model.inertial("forearm", side))
    motions = {
        "rotation1": (_Z, f"elbow_flex_{letter}", "identity"),
        "rotation2": (side * _Y, f"pro_sup_{letter}", "identity"),
    }
    elbow, wrist = np.array([0.0, -arm, 0.0]), np.array([0.0, -forearm, 0.0])
    model.add_joint(f"elbow_{letter}", f"humerus_{letter}", f"radius_{letter}", elbow, motions)
    model.add_body(f"hand_{letter}", *model.inertial("hand", side))
    motions = {
        "rotation1": (_Z, f"wrist_flex_{letter}", "identity"),
        "rotation2": (side * _X, f"wrist_dev_{letter}", "identity"),
    }
    model.add_joint(f"wrist_{letter}", f"radius_{letter}", f"hand_{letter}", wrist, motions)

    model.add_marker(f"elbow_{letter}", f"humerus_{letter}", elbow)
    model.add_marker(f"wrist_{letter}", f"radius_{letter}", wrist)
    # Knuckles, palm forwards: the index finger is the outer one. Widths are estimates of ours.
    model.add_marker(f"index_{letter}", f"hand_{letter}", np.array([0.0, -1.05 * hand, side * 0.35 * hand]))
    model.add_marker(f"pinky_{letter}", f"hand_{letter}", np.array([0.0, -0.95 * hand, -side * 0.45 * hand]))
    model.add_marker(f"thumb_{letter}", f"hand_{letter}", np.array([0.2 * hand, -0.75 * hand, side * 0.75 * hand]))


def ball(flexion: str, adduction: str, rotation: str, side: int = 1) -> dict[str, tuple]:
    """Turn about Z, then X, then Y; on the left the last two are mirrored."""
    return {
        "rotation1": (_Z, flexion, "identity"),
        "rotation2": (side * _X, adduction, "identity"),
        "rotation3": (side * _Y, rotation, "identity"),
    }


def hinge(coordinate: str, letter: str, turn: np.ndarray) -> dict[str, tuple]:
    """Turn about one of the foot's published axes."""
    axes = {"ankle_angle": given.ANKLE_AXIS, "subtalar_angle": given.SUBTALAR_AXIS, "mtp_angle": given.TOE_AXIS}
    axis = turn * axes[coordinate]
    return {"rotation1": (axis / np.linalg.norm(axis), f"{coordinate}_{letter}", "identity")}


def to_xml(model: Builder) -> etree._Element:
    """Write the model as an OpenSim 4.0 document."""
    document = etree.Element("OpenSimDocument", Version="40000")
    root = etree.SubElement(document, "Model", name=model.name)
    root.append(
        etree.Comment(" Made by models/bodies/build.py from segments.py, which names the source of every number. ")
    )
    etree.SubElement(root, "Ground", name="ground")
    put(root, "gravity", (0, -9.80665, 0))
    put(root, "credits", "gonio. Licence: Apache-2.0.")
    put(root, "publications", "Masses, inertias and lengths: Dumas et al. 2007, J Biomech 40:543-553; see segments.py.")
    put(root, "length_units", "meters")
    put(root, "force_units", "N")
    for tag, name, elements in (
        ("BodySet", "bodyset", [body_xml(*body) for body in model.bodies]),
        ("JointSet", "jointset", [joint_xml(*joint, height(model)) for joint in model.joints]),
        ("MarkerSet", "markerset", [marker_xml(*marker) for marker in model.markers]),
    ):
        objects = etree.SubElement(etree.SubElement(root, tag, name=name), "objects")
        objects.extend(elements)
    return document


def height(model: Builder) -> float:
    """Give the pelvis' height when the model stands upright with its heels on the floor."""
    place = {name: place for name, _, place in model.markers}
    foot = model.length("foot") / np.linalg.norm(np.add(given.HEEL_FROM_ANKLE_M, given.TOES_FROM_HEEL_M))
    return -(place["hip_r"][1] - model.length("thigh") - model.length("shank") + foot * given.HEEL_FROM_ANKLE_M[1])


def body_xml(name: str, mass: float, com: np.ndarray, tensor: np.ndarray) -> etree._Element:
    """Write one body."""
    body = etree.Element("Body", name=name)
    put(body, "mass", (mass,))
    put(body, "mass_center", com)
    put(body, "inertia", (*np.diag(tensor), tensor[0, 1], tensor[0, 2], tensor[1, 2]))
    return body


def joint_xml(
    name: str, parent: str, child: str, place: np.ndarray, motions: dict[str, tuple], height_m: float
) -> etree._Element:
    """Write one CustomJoint with its coordinates."""
    joint = etree.Element("CustomJoint", name=name)
    put(joint, "socket_parent_frame", f"{parent}_offset")
    put(joint, "socket_child_frame", f"{child}_offset")
    coordinates = etree.SubElement(joint, "coordinates")
    for coordinate in dict.fromkeys(motion[1] for motion in motions.values()):
        coordinates.append(coordinate_xml(coordinate, height_m))
    frames = etree.SubElement(joint, "frames")
    for body, where in ((parent, place), (child, np.zeros(3))):
        frame = etree.SubElement(frames, "PhysicalOffsetFrame", name=f"{body}_offset")
        put(frame, "socket_parent", "/ground" if body == "ground" else f"/bodyset/{body}")
        put(frame, "translation", where)
        put(frame, "orientation", np.zeros(3))
    transform = etree.SubElement(joint, "SpatialTransform")
    for kind in ("rotation", "translation"):
        # OpenSim wants three axes of each kind that are not parallel: unused ones take what is left of x, y, z.
        used = [motions[key][0] for key in motions if key.startswith(kind)]
        spare = [axis for axis in (_Z, _X, _Y) if all(abs(axis @ other) < 0.9 for other in used)]
        for number in (1, 2, 3):
            axis, coordinate, function = motions.get(f"{kind}{number}") or (spare.pop(0), "", "zero")
            transform.append(axis_xml(f"{kind}{number}", axis, coordinate, function))
    return joint


def coordinate_xml(name: str, height_m: float) -> etree._Element:
    """Write one coordinate: translations and the pelvis are free, joints are clamped to their range."""
    element = etree.Element("Coordinate", name=name)
    bounds = _RANGES_DEG.get(name.removesuffix("_r").removesuffix("_l"))
    put(element, "default_value", (height_m if name == "pelvis_ty" else 0.0,))
    if bounds is None:
        put(
            element,
            "range",
            (-100.0, 100.0) if name.startswith("pelvis_t") and name != "pelvis_tilt" else (-10.0, 10.0),
        )
        put(element, "clamped", "false")
    else:
        put(element, "range", np.array(bounds) * DEG)
        put(element, "clamped", "true")
    put(element, "locked", "false")
    return element


def axis_xml(name: str, axis: np.ndarray, coordinate: str, function: object) -> etree._Element:
    """Write one axis of a joint and the function that moves along or about it."""
    element = etree.Element("TransformAxis", name=name)
    put(element, "coordinates", coordinate)
    put(element, "axis", axis)
    if function == "identity":
        put(etree.SubElement(element, "LinearFunction", name="function"), "coefficients", (1, 0))
    elif function == "zero":
        put(etree.SubElement(element, "Constant", name="function"), "value", (0,))
    else:
        spline = etree.SubElement(element, "SimmSpline", name="function")
        put(spline, "x", function[0])
        put(spline, "y", function[1])
    return element


def marker_xml(name: str, body: str, place: np.ndarray) -> etree._Element:
    """Write one marker."""
    marker = etree.Element("Marker", name=name)
    put(marker, "socket_parent_frame", f"/bodyset/{body}")
    put(marker, "location", place)
    put(marker, "fixed", "true")
    return marker


def put(parent: etree._Element, tag: str, value: object) -> None:
    """Write one property; numbers with ten digits, so that the files are the same on every machine."""
    text = value if isinstance(value, str) else " ".join(f"{number + 0.0:.10g}" for number in value)
    etree.SubElement(parent, tag).text = text


def build(name: str, person: given.Person) -> bytes:
    """Make one model's file."""
    model = Builder(name, person)
    add_trunk(model)
    for letter, side in (("r", 1), ("l", -1)):
        add_leg(model, letter, side)
    for letter, side in (("r", 1), ("l", -1)):
        add_arm(model, letter, side)
    document = etree.ElementTree(to_xml(model))
    etree.indent(document, "  ")
    return etree.tostring(document, xml_declaration=True, encoding="UTF-8", pretty_print=True)


if __name__ == "__main__":
    here = Path(__file__).parent
    for label, figures in (("male", given.MAN), ("female", given.WOMAN)):
        (here / f"fullbody_{label}.osim").write_bytes(build(f"fullbody_{label}", figures))
