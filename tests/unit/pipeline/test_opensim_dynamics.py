"""``gonio id`` on a setup of the built-in body, whose forces are what its motion needs; and all that can be wrong with it."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from gonio.errors import InputError
from gonio.formats.mot import Table, read_mot, write_mot
from gonio.formats.osim import read_osim
from gonio.kernel.dynamics import zero_lag
from gonio.kernel.dynamics.recursive import solve_dynamics
from gonio.pipeline.opensim_dynamics import run_dynamics
from gonio.records import BodyModel
from gonio.resources import models_dir

RATE_HZ, FRAMES = 100.0, 200
TIMES_S = np.arange(FRAMES) / RATE_HZ
SETUP = """<OpenSimDocument Version="40000"><InverseDynamicsTool name="sway"><results_directory>out</results_directory>
<model_file>body.osim</model_file><time_range>0.5 1.5</time_range><forces_to_exclude>Muscles</forces_to_exclude>
<external_loads_file>loads.xml</external_loads_file><coordinates_file>sway.mot</coordinates_file>
<lowpass_cutoff_frequency_for_coordinates>-1</lowpass_cutoff_frequency_for_coordinates>
<output_gen_force_file>torques</output_gen_force_file></InverseDynamicsTool></OpenSimDocument>"""
LOADS = """<OpenSimDocument Version="40000"><ExternalLoads name="loads"><objects><ExternalForce name="plate">
<applied_to_body>calcn_r</applied_to_body><force_expressed_in_body>ground</force_expressed_in_body>
<point_expressed_in_body>ground</point_expressed_in_body><force_identifier>v</force_identifier>
<point_identifier>p</point_identifier><torque_identifier>t</torque_identifier></ExternalForce></objects>
<datafile>forces.mot</datafile></ExternalLoads></OpenSimDocument>"""
COUPLER = """<ConstraintSet><objects><CoordinateCouplerConstraint name="toes"><coupled_coordinates_function>
<LinearFunction><coefficients>0.5 0</coefficients></LinearFunction></coupled_coordinates_function>
<independent_coordinate_names>ankle_angle_r</independent_coordinate_names>
<dependent_coordinate_name>mtp_angle_r</dependent_coordinate_name></CoordinateCouplerConstraint></objects></ConstraintSet>"""
ROOT = ("pelvis_tilt", "pelvis_list", "pelvis_rotation", "pelvis_tx", "pelvis_ty", "pelvis_tz")


def write_coordinates(file: Path, model: BodyModel, q: np.ndarray, *, in_degrees: bool) -> None:
    shown = np.where(model.coordinates.rotational & in_degrees, np.degrees(q), q)
    names = model.coordinates.names
    write_mot(file, Table(name="Coordinates", labels=names, times_s=TIMES_S, values=shown, in_degrees=in_degrees))


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The body sways with half bent knees; the plate under its right foot gives just what that needs."""
    folder = tmp_path_factory.mktemp("example")
    shutil.copy(models_dir() / "bodies" / "fullbody_male.osim", folder / "body.osim")
    model = read_osim(folder / "body.osim")
    q = np.tile(model.coordinates.default, (FRAMES, 1))
    for name, mean, swing in (("hip_flexion_r", 0.3, 0.2), ("knee_angle_r", 0.6, 0.3), ("ankle_angle_r", 0.2, 0.1)):
        q[:, model.coordinates.index(name)] = mean + swing * np.sin(2 * np.pi * TIMES_S)
    q[:, model.coordinates.index("mtp_angle_r")] = 0.5 * q[:, model.coordinates.index("ankle_angle_r")]
    motion = zero_lag.differentiate(TIMES_S, q, None)
    need = solve_dynamics(model, motion.q, motion.velocity, motion.acceleration)
    point = np.tile([0.1, 0.0, 0.05], (FRAMES, 1))
    columns = np.hstack([need.net_force_n, point, need.net_moment_nm - np.cross(point, need.net_force_n)])
    labels = tuple(f"{what}{axis}" for what in "vpt" for axis in "xyz")
    write_mot(folder / "forces.mot", Table(name="f", labels=labels, times_s=TIMES_S, values=columns, in_degrees=False))
    write_coordinates(folder / "sway.mot", model, q, in_degrees=True)
    (folder / "setup.xml").write_text(SETUP)
    (folder / "loads.xml").write_text(LOADS)
    return folder


@pytest.fixture
def folder(example: Path, tmp_path: Path) -> Path:
    return shutil.copytree(example, tmp_path / "example")


def change(file: Path, old: str, new: str) -> None:
    text, count = re.subn(old, new, file.read_text(), count=1)
    assert count
    file.write_text(text)


def test_forces_that_the_motion_needs_leave_no_residual(folder: Path) -> None:
    dynamics, motion, result = run_dynamics(folder / "setup.xml")
    assert result.files == (folder / "out" / "torques.sto",)
    assert result.remarks == ()
    assert motion.times_s[[0, -1]].tolist() == pytest.approx([0.5, 1.5])
    for name in ROOT:
        assert np.abs(dynamics.of(name)).max() < 1e-5  # N and Nm; the file has ten digits behind the point
    written = read_mot(result.files[0])
    assert written.labels[:2] == ("pelvis_tilt_moment", "pelvis_list_moment")
    assert "pelvis_ty_force" in written.labels
    np.testing.assert_allclose(written.of("knee_angle_r_moment"), dynamics.of("knee_angle_r"), atol=1e-9)
    assert np.abs(dynamics.of("knee_angle_r")).max() > 20


def test_forces_may_be_given_in_the_frame_of_a_body_that_stands_still(folder: Path) -> None:
    """The pelvis has the lab's axes here, but not its origin: points move with it, forces don't care."""
    expected = run_dynamics(folder / "setup.xml")[0].forces
    model = read_osim(folder / "body.osim")
    height_m = model.coordinates.default[model.coordinates.index("pelvis_ty")]
    change(folder / "loads.xml", "<force_expressed_in_body>ground", "<force_expressed_in_body>/bodyset/pelvis")
    change(folder / "loads.xml", "<point_expressed_in_body>ground", "<point_expressed_in_body>pelvis")
    table = read_mot(folder / "forces.mot")
    values = table.values - np.where(np.array(table.labels) == "py", height_m, 0.0)
    write_mot(
        folder / "forces.mot",
        Table(name="f", labels=table.labels, times_s=table.times_s, values=values, in_degrees=False),
    )
    np.testing.assert_allclose(run_dynamics(folder / "setup.xml")[0].forces, expected, atol=1e-6)


def test_a_force_on_the_ground_pushes_nobody(folder: Path) -> None:
    change(folder / "loads.xml", "<applied_to_body>calcn_r", "<applied_to_body>ground")
    pushed = run_dynamics(folder / "setup.xml")[0]
    change(folder / "setup.xml", "loads.xml", "")
    np.testing.assert_array_equal(pushed.forces, run_dynamics(folder / "setup.xml")[0].forces)


def test_radians_are_read_as_such(folder: Path) -> None:
    expected = run_dynamics(folder / "setup.xml")[0].forces
    model, table = read_osim(folder / "body.osim"), read_mot(folder / "sway.mot")
    q = np.where(model.coordinates.rotational, np.radians(table.values), table.values)
    write_coordinates(folder / "sway.mot", model, q, in_degrees=False)
    np.testing.assert_allclose(run_dynamics(folder / "setup.xml")[0].forces, expected, atol=1e-4)
    change(folder / "sway.mot", "inDegrees=no", "inDegrees=yes")
    assert "promises degrees, but no angle exceeds 0.9" in run_dynamics(folder / "setup.xml")[2].remarks[0]


def test_opensim_ignores_couplers_and_gonio_does_not(folder: Path) -> None:
    free = run_dynamics(folder / "setup.xml")[0]
    change(folder / "body.osim", "</Model>", f"{COUPLER}</Model>")
    like_opensim, _, result = run_dynamics(folder / "setup.xml")
    np.testing.assert_array_equal(like_opensim.forces, free.forces)
    assert result.remarks[0].startswith("body.osim couples mtp_angle_r: as in OpenSim, the couplers are ignored")
    own, _, result = run_dynamics(folder / "setup.xml", "gonio")
    assert result.remarks == ()
    assert not own.of("mtp_angle_r").any()
    together = free.of("ankle_angle_r") + 0.5 * free.of("mtp_angle_r")
    np.testing.assert_allclose(own.of("ankle_angle_r"), together, atol=1e-9)


def test_what_opensim_would_do_and_gonio_does_not_is_said(folder: Path) -> None:
    spring = "<SpringGeneralizedForce name='{}'><coordinate>knee_angle_r</coordinate></SpringGeneralizedForce>"
    muscle, idle = "<Thelen2003Muscle name='vasti'/>", "<CoordinateActuator name='motor'/>"
    springs = "".join(spring.format(name) for name in ("a", "b", "c", "d"))
    forces = f"<ForceSet><objects>{springs}{muscle}{idle}</objects></ForceSet>"
    change(folder / "body.osim", r"<ForceSet.*?</ForceSet>|</Model>", f"{forces}</Model>")
    change(
        folder / "setup.xml",
        "</InverseDynamicsTool>",
        "<joints_to_report_body_forces>knee_r</joints_to_report_body_forces></InverseDynamicsTool>",
    )
    remarks = run_dynamics(folder / "setup.xml")[2].remarks
    assert remarks[0].startswith("setup.xml leaves forces of the model in, a, b, c and 1 more: OpenSim would subtract")
    assert remarks[1].startswith("The reactions at knee_r are not computed")
    change(folder / "setup.xml", ">Muscles<", "><")
    assert "a, b, c and 2 more" in run_dynamics(folder / "setup.xml")[2].remarks[0]
    change(folder / "setup.xml", "<forces_to_exclude><", "<forces_to_exclude>ALL<")
    assert len(run_dynamics(folder / "setup.xml")[2].remarks) == 1


def spoil(column: str, value: str) -> Callable[[Path], None]:
    """Make one value of a table another one, at 1 s."""

    def edit(file: Path) -> None:
        lines = file.read_text().splitlines()
        labels = next(i for i, line in enumerate(lines) if line.startswith("time\t"))
        row = next(i for i, line in enumerate(lines) if line.startswith("1.0000000000\t"))
        cells = lines[row].split("\t")
        cells[lines[labels].split("\t").index(column)] = value
        lines[row] = "\t".join(cells)
        file.write_text("\n".join(lines) + "\n")

    return edit


def keep_rows(count: int) -> Callable[[Path], None]:
    def edit(file: Path) -> None:
        lines = file.read_text().splitlines()
        labels = next(i for i, line in enumerate(lines) if line.startswith("time\t"))
        kept = [re.sub(r"^nRows=\d+", f"nRows={count}", line) for line in lines[: labels + 1 + count]]
        file.write_text("\n".join(kept) + "\n")

    return edit


def swap(old: str, new: str) -> Callable[[Path], None]:
    return lambda file: change(file, old, new)


@pytest.mark.parametrize(
    ("file", "edit", "message"),
    [
        ("setup.xml", swap("0.5 1.5", "7 9"), "sway.mot runs from 0 to 1.99 s: nothing of it lies between 7 and 9 s"),
        ("setup.xml", swap("0.5 1.5", "1.5 0.5"), "<time_range> of InverseDynamicsTool sway"),
        ("setup.xml", swap(">-1<", ">60<"), "filtered as setup.xml says: A cutoff of 60.0 Hz is impossible"),
        ("setup.xml", swap("body.osim", "nobody.osim"), "nobody.osim can't be read"),
        ("setup.xml", swap("<coordinates_file>sway.mot", "<coordinates_file>"), "setup.xml has no <coordinates_file>"),
        ("setup.xml", swap("out<", "body.osim<"), "torques.sto can't be written into body.osim"),
        ("loads.xml", swap("calcn_r", "hoof_r"), "loads.xml, ExternalForce plate: There is no body named hoof_r"),
        ("loads.xml", swap("in_body>ground", "in_body>hoof"), "ExternalForce plate: There is no body named hoof"),
        ("loads.xml", swap(">v<", ">w<"), "loads.xml, ExternalForce plate: forces.mot has no column wx"),
        ("loads.xml", swap("forces.mot", "farces.mot"), "farces.mot can't be read"),
        ("forces.mot", swap("\tpx", "\tvx"), "ExternalForce plate: forces.mot has 2 columns vx"),
        ("forces.mot", spoil("vy", "nan"), "forces.mot: The forces have a gap or an impossible value at 1.000 s"),
        ("forces.mot", spoil("py", "inf"), "forces.mot: The forces have a gap or an impossible value at 1.000 s"),
        ("forces.mot", spoil("tz", "1e308"), "forces.mot: The forces have a gap or an impossible value at 1.000 s"),
        ("forces.mot", keep_rows(120), "forces.mot: The forces cover 0.000 to 1.190 s, the motion 0.500 to 1.500 s"),
        ("forces.mot", keep_rows(1), "forces.mot: The forces cover 0.000 to 0.000 s"),
        ("sway.mot", swap("inDegrees=yes", "inDegrees=no"), "sway.mot promises radians, but knee_angle_r reaches 52"),
        (
            "sway.mot",
            spoil("knee_angle_r", "nan"),
            "sway.mot, .*The motion has a gap or an impossible value at 1.000 s",
        ),
        ("sway.mot", keep_rows(3), "sway.mot runs from 0 to 0.02 s"),
    ],
)
def test_what_is_wrong_is_named_with_its_file_and_its_remedy(
    folder: Path, file: str, edit: Callable[[Path], None], message: str
) -> None:
    edit(folder / file)
    with pytest.raises(InputError, match=message) as caught:
        run_dynamics(folder / "setup.xml")
    assert caught.value.hint


@pytest.mark.parametrize("file", ["setup.xml", "loads.xml", "sway.mot", "forces.mot", "body.osim"])
def test_a_file_cut_in_half_is_named(folder: Path, file: str) -> None:
    path = folder / file
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError, match=file):
        run_dynamics(folder / "setup.xml")


def test_a_missing_coordinate_keeps_its_default_and_a_column_that_nobody_names_does_not_matter(folder: Path) -> None:
    expected = run_dynamics(folder / "setup.xml")[0].forces
    change(folder / "sway.mot", "mtp_angle_l", "another")
    table = read_mot(folder / "forces.mot")
    values = np.column_stack([table.values, np.full(FRAMES, np.nan)])
    labels = (*table.labels, "emg")
    write_mot(folder / "forces.mot", Table(name="f", labels=labels, times_s=TIMES_S, values=values, in_degrees=False))
    dynamics, _, result = run_dynamics(folder / "setup.xml")
    assert result.remarks == ("sway.mot has no column mtp_angle_l: it keeps its default.",)
    np.testing.assert_array_equal(dynamics.forces, expected)
