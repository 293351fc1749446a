"""C3D files: what is read of a real one, force plates of all types, and what is refused."""

import ezc3d
import numpy as np
import pytest

from gonio.errors import InputError
from gonio.formats.c3d import read_c3d
from gonio.formats.c3d_plates import Plate, plate_wrench

CORNERS_MM = np.array([[500.0, 400, 0], [0, 400, 0], [0, 0, 0], [500, 0, 0]])
"""A plate whose x axis is the file's x and whose y axis is the file's y would have z upwards: so its y points to −y."""
TURNED_MM = CORNERS_MM[[3, 2, 1, 0]]
PLACE_MM = np.array([320.0, 150.0, 0.0])
FORCE_N = np.array([-40.0, 25.0, 800.0])
"""On the foot, in the file's axes (Z up)."""
FREE_NMM = 3000.0


def in_plate():
    """The force on the foot, its moment about the middle of the surface, and its place, in the plate's frame, mm."""
    turn = np.diag([1.0, -1.0, -1.0])  # x along the file's x, y against its y, z down
    force = turn @ FORCE_N
    place = turn @ (PLACE_MM - CORNERS_MM.mean(axis=0))
    return force, np.cross(place, force) - [0, 0, FREE_NMM], place


def channels_of(kind, origin_mm):
    force, moment, place = in_plate()
    below = moment + np.cross(origin_mm, force)  # about the transducers
    if kind == 1:
        return [*force, place[0], place[1], -FREE_NMM]
    if kind in (2, 4):
        return [*force, *below]
    a, b, depth = origin_mm[0], origin_mm[1], -abs(origin_mm[2])
    below = moment + np.cross([0, 0, depth], force)
    fz = np.linalg.lstsq(
        np.array([[1, 1, 1, 1], [b, b, -b, -b], [-a, a, a, -a]]), [force[2], below[0], below[1]], rcond=None
    )[0]
    fx34 = force[0] / 2 + below[2] / (4 * b)
    fy14 = force[1] / 2 + below[2] / (4 * a)
    return [force[0] - fx34, fx34, fy14, force[1] - fy14, *fz]


def write(path, kind, *, action=1.0, origin_mm=(120.0, 200.0, -40.0), frames=20, calibration=None, spoil=None):
    """A C3D file with a marker and a plate under a steady load, whose second half is bare."""
    channels = np.array(channels_of(kind, np.array(origin_mm)))
    sign = np.where(np.arange(len(channels)) < 3, action, action)
    if kind == 1:
        sign = np.array([action, action, action, 1, 1, action])
    load = np.zeros((len(channels), 10 * frames))
    load[:, : 5 * frames] = (sign * channels)[:, None]
    if calibration is not None:
        load = np.linalg.solve(calibration, load)
    content = ezc3d.c3d()
    parameters = content["parameters"]
    parameters["POINT"]["RATE"]["value"] = [100.0]
    parameters["POINT"]["LABELS"]["value"] = ["HEEL", "LKneeAngles"]
    parameters["POINT"]["UNITS"]["value"] = ["mm"]
    content.add_parameter("POINT", "ANGLES", ["LKneeAngles"])
    points = np.ones((4, 2, frames))
    points[:3] = np.array([[100.0, 12.0], [200.0, 0.0], [50.0, 0.0]])[..., None]
    points[:3, 0, 3] = np.nan
    content["data"]["points"] = points
    parameters["ANALOG"]["RATE"]["value"] = [1000.0]
    parameters["ANALOG"]["LABELS"]["value"] = [f"c{i}" for i in range(len(load))]
    content["data"]["analogs"] = load[None]
    for entry, value in (
        ("USED", [1]),
        ("TYPE", [kind]),
        ("CORNERS", TURNED_MM.T[:, :, None].copy()),
        ("ORIGIN", np.array(origin_mm, dtype=float)[:, None]),
        ("CHANNEL", 1.0 + np.arange(len(load))[:, None]),
    ):
        content.add_parameter("FORCE_PLATFORM", entry, value)
    if calibration is not None:
        content.add_parameter("FORCE_PLATFORM", "CAL_MATRIX", calibration[:, :, None])
    content.add_parameter("EVENT", "LABELS", ["Foot Off", "Foot Strike"])
    content.add_parameter("EVENT", "CONTEXTS", ["Left", "Right"])
    content.add_parameter("EVENT", "TIMES", np.array([[0.0, 0.0], [0.15, 0.05]]))
    if spoil:
        spoil(content)
    content.write(str(path))
    return path


@pytest.mark.parametrize("action", [1.0, -1.0])
@pytest.mark.parametrize("kind", [1, 2, 3, 4])
def test_each_type_of_plate_gives_the_force_on_the_foot(tmp_path, kind, action):
    calibration = np.diag([2.0, 3, 4, 50, 60, 70]) + 0.1 if kind == 4 else None
    plates = read_c3d(write(tmp_path / "a.c3d", kind, action=action, calibration=calibration)).plates
    # The file's Z is the lab's Y, its X the lab's X: the lab's Z is the file's −Y. C3D keeps 32 bits: 7 digits.
    np.testing.assert_allclose(plates.force_lab_n[5, 0], [-40.0, 800.0, -25.0], rtol=1e-5)
    np.testing.assert_allclose(plates.cop_lab_m[5, 0], [0.320, 0.0, -0.150], atol=1e-5)
    assert plates.free_moment_nm[5, 0] == pytest.approx(3.0, rel=1e-3)
    np.testing.assert_allclose(plates.force_lab_n[-1], 0.0, atol=1e-9)
    assert np.isnan(plates.cop_lab_m[-1]).all()
    np.testing.assert_allclose(plates.corners_lab_m[0].mean(axis=0), [0.25, 0, -0.2], atol=1e-6)


def test_an_origin_given_the_other_way_round_is_turned(tmp_path):
    channels = np.array([channels_of(2, np.array([120.0, 200.0, -40.0]))])
    plates = [Plate(2, TURNED_MM / 1e3, sign * np.array([0.12, 0.2, -0.04]), 1e-3, 1e-3) for sign in (1.0, -1.0)]
    for first, second in zip(*(plate_wrench(plate, channels, 10.0) for plate in plates), strict=True):
        np.testing.assert_allclose(first, second)


def test_markers_outputs_and_events(tmp_path):
    read = read_c3d(write(tmp_path / "a.c3d", 2))
    assert read.markers.names == ("HEEL",)
    np.testing.assert_allclose(read.markers.xyz_m[0, 0], [0.1, 0.05, -0.2], atol=1e-7)
    assert np.isnan(read.markers.xyz_m[3]).all()
    assert read.outputs.of("LKneeAngles")[0].tolist() == [12.0, 0.0, 0.0]
    assert [(event.label, event.side, round(event.time_s, 6)) for event in read.events] == [
        ("Foot Strike", "right", 0.05),
        ("Foot Off", "left", 0.15),
    ]
    assert read.analog.values.shape == (200, 6)
    with pytest.raises(InputError, match="no output RKneeAngles"):
        read.outputs.of("RKneeAngles")


def unknown_unit(content):
    content["parameters"]["POINT"]["UNITS"]["value"] = ["inch"]


def fifth_type(content):
    content["parameters"]["FORCE_PLATFORM"]["TYPE"]["value"] = [5]


def no_corners(content):
    content["parameters"]["FORCE_PLATFORM"]["CORNERS"]["value"] = np.zeros((3, 4, 1))


def lost_channel(content):
    content["parameters"]["FORCE_PLATFORM"]["CHANNEL"]["value"] = np.arange(40.0, 46.0)[:, None]


def uncalibrated(content):
    content["parameters"]["FORCE_PLATFORM"]["TYPE"]["value"] = [4]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (unknown_unit, "POINT:UNITS is 'inch'"),
        (fifth_type, "of type 5"),
        (no_corners, "bound no area"),
        (lost_channel, "a channel that is not there"),
        (uncalibrated, "no calibration"),
    ],
)
def test_what_can_not_be_understood_is_refused(tmp_path, spoil, message):
    with pytest.raises(InputError, match=message) as raised:
        read_c3d(write(tmp_path / "a.c3d", 2, spoil=spoil))
    assert raised.value.code == "capture-file-unreadable"
    assert raised.value.message.startswith("a.c3d")


@pytest.mark.parametrize("content", [b"", b"\x02\x50" + bytes(600), b"no c3d" * 200])
def test_what_is_no_c3d_is_refused(tmp_path, content):
    (tmp_path / "a.c3d").write_bytes(content)
    with pytest.raises(InputError) as raised:
        read_c3d(tmp_path / "a.c3d")
    assert raised.value.code == "capture-file-unreadable"


def test_a_file_cut_short_is_refused(tmp_path):
    whole = write(tmp_path / "a.c3d", 2).read_bytes()
    (tmp_path / "a.c3d").write_bytes(whole[: len(whole) * 2 // 3])
    with pytest.raises(InputError, match="of the 20 frames"):
        read_c3d(tmp_path / "a.c3d")


def test_a_real_trial(vicon_pig):
    """Plug-in Gait's walk: forces as ezc3d computes them, and events where the plates are stepped on."""
    path = vicon_pig / "PiG_Motion3_FF.c3d"
    read = read_c3d(path)
    assert read.mass_kg == 74.0
    assert len(read.markers.times_s) == 293
    assert {"LHEE", "RTOE"} <= set(read.markers.names)
    assert read.outputs.of("LKneeAnglesV").shape == (293, 3)
    theirs = ezc3d.c3d(str(path), extract_forceplat_data=True)["data"]["platform"]
    for index, plate in enumerate(theirs):
        force, cop_mm = plate["force"].T, plate["center_of_pressure"].T
        np.testing.assert_allclose(read.plates.force_lab_n[:, index], force[:, [0, 2, 1]] * [1, 1, -1], atol=1e-4)
        pressed = force[:, 2] > 100.0
        difference_m = read.plates.cop_lab_m[pressed, index] - 1e-3 * cop_mm[pressed][:, [0, 2, 1]] * [1, 1, -1]
        assert np.abs(difference_m).max() < 1e-4
        # Each plate takes one step, beside crosstalk: its longest contact is from a strike to a lift. Those were
        # marked on frames of 10 ms, by another threshold than 20 N: to 30 ms.
        edges = np.flatnonzero(np.diff(np.r_[0, force[:, 2] > 20.0, 0]))
        begin, end = max(edges.reshape(-1, 2), key=lambda run: run[1] - run[0])
        times_s = read.plates.times_s[[begin, end - 1]]
        for time_s, label in ((times_s[0], "Foot Strike"), (times_s[-1], "Foot Off")):
            assert min(abs(e.time_s - time_s) for e in read.events if e.label == label) <= 0.03
