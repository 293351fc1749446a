"""Make ``all_joints.osim``, one body for each kind of joint and function, and what OpenSim 4.6 says of it.

python tests/golden/make_all_joints.py              writes all_joints.osim (needs nothing)
python tests/golden/make_all_joints.py reference    writes all_joints.json (needs the opensim wheel)
"""

import json
import sys
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
LINEAR = '<LinearFunction name="function"><coefficients>1 0</coefficients></LinearFunction>'
SPLINE = (
    '<SimmSpline name="function"><x>-2 -1.2 -0.3 0.4 1.1 2.2</x><y>0.01 -0.02 0.005 0.03 0.01 -0.04</y></SimmSpline>'
)
POLYNOMIAL = (
    '<PolynomialFunction name="function"><coefficients>0.05 -0.1 0.02 0.4 0.01</coefficients></PolynomialFunction>'
)
BROKEN = '<PiecewiseLinearFunction name="function"><x>-1 0 1 2</x><y>0 0.02 -0.01 0.03</y></PiecewiseLinearFunction>'
MULTIPLIED = (
    '<MultiplierFunction name="function"><function><SimmSpline><x>-1 0 1</x><y>0.02 0.01 0.05</y></SimmSpline>'
    "</function><scale>1.3</scale></MultiplierFunction>"
)
TWO = '<LinearFunction name="function"><coefficients>0.5 -0.25 0.1</coefficients></LinearFunction>'
CONSTANT = '<Constant name="function"><value>0.2</value></Constant>'


def axis(name: str, coordinates: str, direction: str, function: str) -> str:
    return (
        f'<TransformAxis name="{name}"><coordinates>{coordinates}</coordinates><axis>{direction}</axis>{function}'
        "</TransformAxis>"
    )


JOINTS = {
    # joint: its coordinates, and for a CustomJoint its transform
    "FreeJoint": (["f1", "f2", "f3", "f4", "f5", "f6"], ""),
    "PinJoint": (["pin"], ""),
    "SliderJoint": (["slide"], ""),
    "UniversalJoint": (["u1", "u2"], ""),
    "BallJoint": (["b1", "b2", "b3"], ""),
    "GimbalJoint": (["g1", "g2", "g3"], ""),
    "PlanarJoint": (["p1", "p2", "p3"], ""),
    "WeldJoint": ([], ""),
    "CustomJoint": (
        ["c1", "c2"],
        axis("rotation1", "c1", "0.6 0 0.8", LINEAR)
        + axis("rotation2", "c1", "0 1 0", POLYNOMIAL)
        + axis("rotation3", "c1 c2", "1 0 0", TWO)
        + axis("translation1", "c1", "1 0 0", SPLINE)
        + axis("translation2", "c2", "0 1 0", BROKEN)
        + axis("translation3", "c1", "0 0 1", MULTIPLIED),
    ),
    "CustomJoint2": (
        ["d1", "d2"],
        axis("rotation1", "d1", "0 0 1", LINEAR)
        + axis("rotation2", "", "1 0 0", CONSTANT)
        + axis("rotation3", "d2", "0 1 0", SPLINE)
        + axis("translation1", "", "1 0 0", CONSTANT)
        + axis("translation2", "d2", "0 1 0", LINEAR)
        + axis("translation3", "", "0 0 1", '<Constant name="function"><value>0</value></Constant>'),
    ),
}


def build() -> str:
    """Chain one joint of each kind, with offset and turned frames on both sides of every joint."""
    random = np.random.default_rng(7)
    bodies, joints, markers, parent = [], [], [], "/ground"
    for number, (kind, (coordinates, transform)) in enumerate(JOINTS.items()):
        body, inertia = f"body{number}", "0.1 0.2 0.15 0.01 -0.02 0.005"
        bodies.append(
            f'<Body name="{body}"><mass>{1 + number}</mass><mass_center>0.1 -0.2 0.05</mass_center>'
            f"<inertia>{inertia}</inertia></Body>"
        )
        listed = "".join(
            f'<Coordinate name="{name}"><default_value>0.1</default_value><range>-2 2</range></Coordinate>'
            for name in coordinates
        )
        frames = "".join(
            f'<PhysicalOffsetFrame name="{name}"><socket_parent>{on}</socket_parent>'
            f"<translation>{numbers(random.normal(size=3) / 5)}</translation>"
            f"<orientation>{numbers(random.normal(size=3))}</orientation></PhysicalOffsetFrame>"
            for name, on in (("outer", parent), ("before", "outer"), ("after", f"/bodyset/{body}"))
        )
        spatial = f"<SpatialTransform>{transform}</SpatialTransform>" if transform else ""
        joints.append(
            f'<{kind.rstrip("2")} name="j{number}"><socket_parent_frame>before</socket_parent_frame>'
            f"<socket_child_frame>after</socket_child_frame><coordinates>{listed}</coordinates>"
            f"<frames>{frames.replace('<socket_parent>outer', '<socket_parent>../outer')}</frames>{spatial}"
            f"</{kind.rstrip('2')}>"
        )
        for corner in range(2):
            markers.append(
                f'<Marker name="m{number}{corner}"><socket_parent_frame>/bodyset/{body}</socket_parent_frame>'
                f"<location>{numbers(random.normal(size=3))}</location></Marker>"
            )
        parent = f"/bodyset/{body}"
    markers.append(
        '<Marker name="on_offset"><socket_parent_frame>/jointset/j3/after</socket_parent_frame>'
        "<location>0.1 0.2 0.3</location></Marker>"
    )
    markers.append(
        '<Marker name="in_lab"><socket_parent_frame>/ground</socket_parent_frame><location>1 2 3</location></Marker>'
    )
    coupler = (
        '<CoordinateCouplerConstraint name="coupler"><isEnforced>true</isEnforced>'
        "<coupled_coordinates_function><SimmSpline><x>-2 -1 0 1 2</x><y>0.5 0.1 0 0.3 0.2</y></SimmSpline>"
        "</coupled_coordinates_function>"
        "<independent_coordinate_names>c1</independent_coordinate_names>"
        "<dependent_coordinate_name>d1</dependent_coordinate_name><scale_factor>1.5</scale_factor>"
        "</CoordinateCouplerConstraint>"
    )
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<OpenSimDocument Version="40000"><Model name="all_joints">'
        '<Ground name="ground"/><gravity>0 -9.80665 0</gravity>'
        + f'<BodySet name="bodyset"><objects>{"".join(bodies)}</objects></BodySet>\n'
        + f'<JointSet name="jointset"><objects>{"".join(joints)}</objects></JointSet>\n'
        + f'<ConstraintSet name="constraintset"><objects>{coupler}</objects></ConstraintSet>\n'
        + f'<MarkerSet name="markerset"><objects>{"".join(markers)}</objects></MarkerSet>'
        + "</Model></OpenSimDocument>\n"
    )


def numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.6g}" for value in values)


def reference() -> dict:
    """Ask OpenSim for the markers' places at random poses, some of them outside the splines' knots."""
    import opensim

    opensim.Logger.setLevelString("off")
    model = opensim.Model(str(HERE / "all_joints.osim"))
    state = model.initSystem()
    coordinates = model.updCoordinateSet()
    names = [coordinates.get(i).getName() for i in range(coordinates.getSize())]
    kinds = [coordinates.get(i).getMotionType() for i in range(coordinates.getSize())]
    random, poses = np.random.default_rng(1), []
    for scale in (0.1, 0.5, 1.0, 1.0, 2.0, 3.0):
        q = np.round(random.normal(size=len(names)) * scale, 3)
        for index, name in enumerate(names):
            if not coordinates.get(name).isDependent(state):
                coordinates.get(name).setValue(state, float(q[index]), False)
        model.setUseVisualizer(False)
        model.assemble(state)
        model.realizePosition(state)
        points = [model.getMarkerSet().get(i) for i in range(model.getMarkerSet().getSize())]
        places = [[point.getLocationInGround(state).get(k) for k in range(3)] for point in points]
        values = [coordinates.get(name).getValue(state) for name in names]
        poses.append({"q": values, "markers_m": places})
    return {
        "opensim": opensim.GetVersionAndDate(),
        "coordinates": names,
        "rotational": [kind == 1 for kind in kinds],
        "mass_kg": model.getTotalMass(state),
        "poses": poses,
    }


if __name__ == "__main__":
    if sys.argv[1:] == ["reference"]:
        (HERE / "all_joints.json").write_text(json.dumps(reference(), indent=1) + "\n")
    else:
        (HERE / "all_joints.osim").write_text(build())
