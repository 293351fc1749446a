"""Which foot stood on which plate: on a walker whose forces are known, and in a real trial."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from gonio.errors import InputError
from gonio.formats.c3d import read_c3d
from gonio.formats.force_plates import read_force_plates
from gonio.formats.osim import read_osim
from gonio.kernel.body.forward import marker_positions
from gonio.kernel.body.soles import mark_soles
from gonio.kernel.forces.plates import assign_plates
from gonio.kernel.virtual_lab import grow, truth_at, walk
from gonio.records import ForcePlates
from gonio.resources import models_dir

RATE_HZ = 100.0


@pytest.fixture(scope="module")
def walking():
    """Two seconds of a walk: the truth, the heels and the tips of the toes."""
    walker = walk(grow(read_osim(models_dir() / "bodies" / "fullbody_male.osim"), 1.75, 70.0), 1.25)
    truth = truth_at(walker, np.arange(0, 2.0, 1 / RATE_HZ))
    soles = marker_positions(mark_soles(walker.body), truth.q)
    return truth, soles[:, [0, 4]], soles[:, [3, 7]]


def lay_plates(truth, edges_x_m):
    """Plates across the walkway between these edges, that measure whatever stands on them."""
    count = len(edges_x_m) - 1
    force = np.zeros((len(truth.times_s), count, 3))
    moment = np.zeros_like(force)
    for plate in range(count):
        for foot in range(2):
            x_m = truth.cop_lab_m[:, foot, 0]
            on = (x_m >= edges_x_m[plate]) & (x_m < edges_x_m[plate + 1])
            force[on, plate] += truth.wrench[on, foot, :3]
            moment[on, plate] += truth.wrench[on, foot, 3:]
    vertical = force[..., 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        cop = np.stack([moment[..., 2] / vertical, 0 * vertical, -moment[..., 0] / vertical], axis=-1)
    loaded = vertical > 10.0
    cop = np.where(loaded[..., None], cop, np.nan)
    free = np.where(loaded, moment[..., 1] - np.cross(np.nan_to_num(cop), force)[..., 1], 0.0)
    corners = [[[high, 0, 1], [low, 0, 1], [low, 0, -1], [high, 0, -1]] for low, high in pairwise(edges_x_m)]
    return ForcePlates(
        source="virtual",
        times_s=truth.times_s,
        force_lab_n=force,
        cop_lab_m=cop,
        free_moment_nm=free,
        corners_lab_m=np.array(corners, dtype=float),
    )


def between_steps(truth):
    """Edges between the places where the feet stand: one foot a plate."""
    low, high = [], []
    for foot in range(2):
        loaded = np.isfinite(truth.cop_lab_m[:, foot, 0])
        runs = np.flatnonzero(np.diff(np.r_[False, loaded, False].astype(int))).reshape(-1, 2)
        for begin, end in runs:
            low.append(np.nanmin(truth.cop_lab_m[begin:end, foot, 0]))
            high.append(np.nanmax(truth.cop_lab_m[begin:end, foot, 0]))
    low, high = np.sort(low), np.sort(high)
    return np.r_[low[0] - 0.2, (low[1:] + high[:-1]) / 2, high[-1] + 0.2]


def test_each_foot_gets_its_own_plates(walking):
    truth, heel, tip = walking
    found = assign_plates(lay_plates(truth, between_steps(truth)), truth.times_s, heel, tip)
    known = np.isfinite(found.wrench[..., 0])
    assert known.mean() > 0.9
    # Averaging over a frame of 10 ms flattens a force of curvature 800 N · (2π · 5 Hz)² by 800 · 987 · 0.01² / 24 = 3.3 N.
    difference = (found.wrench - truth.wrench)[known]
    assert np.sqrt(np.mean(difference[:, :3] ** 2)) < 3.3
    assert not found.shared.any()


def test_a_foot_beside_the_plates_is_unknown_and_not_without_force(walking):
    truth, heel, tip = walking
    edges = between_steps(truth)
    found = assign_plates(lay_plates(truth, edges[1:3]), truth.times_s, heel, tip)
    for foot in range(2):
        mid_stance = truth.wrench[:, foot, 1] > 400.0
        measured = np.isfinite(found.wrench[:, foot, 1])
        inside = (truth.cop_lab_m[:, foot, 0] > edges[1]) & (truth.cop_lab_m[:, foot, 0] < edges[2])
        assert measured[mid_stance & inside].all()
        assert not measured[mid_stance & ~inside].any()


def test_a_plate_under_both_feet_tells_of_neither(walking):
    truth, heel, tip = walking
    edges = between_steps(truth)
    found = assign_plates(lay_plates(truth, edges[[0, -1]]), truth.times_s, heel, tip)
    assert found.shared.mean() > 0.9
    assert np.isnan(found.wrench[found.shared]).all()


def test_somebody_else_on_a_plate_is_nobodys_force(walking):
    truth, heel, tip = walking
    plates = lay_plates(truth, between_steps(truth))
    aside = np.array([0.0, 0.0, 1.5])
    found = assign_plates(plates, truth.times_s, heel + aside, tip + aside)
    assert np.nansum(np.abs(found.wrench)) == 0.0


def test_a_real_trial_gives_each_plate_to_the_foot_that_its_events_name(vicon_pig):
    read = read_c3d(vicon_pig / "PiG_Motion3_FF.c3d")
    heel, toe = (
        np.stack([read.markers.xyz_m[:, read.markers.names.index(side + point)] for side in "RL"], axis=1)
        for point in ("HEE", "TOE")
    )
    found = assign_plates(read.plates, read.markers.times_s, heel, toe)
    for side, foot in (("right", 0), ("left", 1)):
        strikes = [event.time_s for event in read.events if event.side == side and event.label == "Foot Strike"]
        lifts = [event.time_s for event in read.events if event.side == side and event.label == "Foot Off"]
        loaded = np.nan_to_num(found.wrench[:, foot, 1]) > 100.0
        assert loaded.any()
        for time_s in read.markers.times_s[loaded]:
            last_strike = max(s for s in strikes if s <= time_s + 0.03)
            assert time_s <= min(lift for lift in lifts if lift > last_strike) + 0.03
    assert np.nanmax(found.wrench[..., 1]) == pytest.approx(1.1 * 74 * 9.81, rel=0.1)


def test_opensim_tables(opensim_gait2354):
    plates = read_force_plates(opensim_gait2354 / "subject01_walk1_grf.mot")
    assert plates.force_lab_n.shape == (1501, 2, 3)
    np.testing.assert_allclose(plates.force_lab_n[0, 0], [101.5119767, 745.4661142, -47.44870554])
    np.testing.assert_allclose(plates.cop_lab_m[0, 1], [0.81009656, -0.0075, -0.05354309])
    np.testing.assert_allclose(plates.free_moment_nm[0], [13.53783445, -0.75741936])


def test_a_table_without_forces_is_refused(tmp_path: Path):
    (tmp_path / "a.mot").write_text("a\nendheader\ntime\tknee\n0\t1\n1\t2\n")
    with pytest.raises(InputError) as raised:
        read_force_plates(tmp_path / "a.mot")
    assert raised.value.code == "plates-missing"
