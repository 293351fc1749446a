"""Marker and motion files: round trips, what missing values become, and what is refused."""

import numpy as np
import pytest

from gonio.errors import InputError
from gonio.formats.mot import Table, read_mot, write_mot
from gonio.formats.trc import Trajectories, read_trc, write_trc


def trajectories(frames=7):
    xyz_m = np.random.default_rng(0).normal(size=(frames, 3, 3)).round(7)
    xyz_m[2, 1] = np.nan
    xyz_m[-1, 2] = np.nan
    return Trajectories(
        names=("nose", "left_knee", "heel"), times_s=1.0 + np.arange(frames) / 60, xyz_m=xyz_m, rate_hz=60.0
    )


def test_trc_round_trip_keeps_points_and_gaps(tmp_path):
    given = trajectories()
    write_trc(tmp_path / "a.trc", given)
    read = read_trc(tmp_path / "a.trc")
    assert read.names == given.names
    assert read.rate_hz == 60.0
    np.testing.assert_allclose(read.times_s, given.times_s, atol=1e-6)
    np.testing.assert_allclose(read.xyz_m, given.xyz_m, atol=1e-8)  # NaN where NaN


def test_trc_in_metres_with_padded_header_and_lost_trailing_blanks(tmp_path):
    path = tmp_path / "b.trc"
    path.write_text(
        "PathFileType\t4\t(X/Y/Z)\tb.trc\n"
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames\n"
        "100\t100\t2\t2\tm\t100\t1\t2\n"
        "Frame#\tTime\t  A \t\t\t B\t\t\n\t\tX1\tY1\tZ1\tX2\tY2\tZ2\n\n"
        "1\t0.00\t1.0\t2.0\t3.0\t4.0\t5.0\t6.0\n2\t0.01\t1.1\t2.1\t3.1\n"
    )
    read = read_trc(path)
    assert read.names == ("A", "B")
    np.testing.assert_allclose(read.xyz_m[0], [[1, 2, 3], [4, 5, 6]])
    assert np.isnan(read.xyz_m[1, 1]).all()


def broken_trc(tmp_path, old, new):
    write_trc(tmp_path / "c.trc", trajectories())
    text = (tmp_path / "c.trc").read_text()
    assert old in text
    (tmp_path / "c.trc").write_text(text.replace(old, new, 1))
    return tmp_path / "c.trc"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("PathFileType", "Path", "no .trc file"),
        ("\tmm\t", "\tinch\t", "unit as 'inch'"),
        ("left_knee", "nose", "names 3 markers, 2 of them different"),
        ("\t1.016667", "\t0.5", "times don't ascend"),
        ("\t1.016667", "\tx", "does not fit"),
        ("\t1.016667", "\t", "without a time"),
    ],
)
def test_broken_trc_files_are_refused_by_name(tmp_path, old, new, message):
    with pytest.raises(InputError, match=message) as raised:
        read_trc(broken_trc(tmp_path, old, new))
    assert "c.trc" in raised.value.message
    assert raised.value.hint


def test_missing_files_are_named(tmp_path):
    for read in (read_trc, read_mot):
        with pytest.raises(InputError, match=r"nothing.trc can't be read"):
            read(tmp_path / "nothing.trc")


def table():
    values = np.random.default_rng(1).normal(size=(5, 2)).round(8)
    return Table(
        name="Coordinates", labels=("knee", "pelvis_tx"), times_s=np.arange(5) / 50, values=values, in_degrees=True
    )


def test_mot_round_trip(tmp_path):
    write_mot(tmp_path / "a.mot", table())
    read = read_mot(tmp_path / "a.mot")
    assert read.labels == ("knee", "pelvis_tx")
    assert read.in_degrees
    np.testing.assert_allclose(read.values, table().values, atol=1e-9)
    np.testing.assert_allclose(read.of("knee"), table().values[:, 0], atol=1e-9)
    with pytest.raises(InputError, match="no column hip"):
        read.of("hip")


def test_simm_header(tmp_path):
    path = tmp_path / "s.mot"
    path.write_text(
        "/some/name.mot\ndatacolumns 2\ndatarows 2\nrange 0 1\nendheader\n time \t ty\n0.0  1.5\n1.0\t2.5\n"
    )
    read = read_mot(path)
    assert not read.in_degrees
    assert read.of("ty").tolist() == [1.5, 2.5]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("endheader", "the end", "no line 'endheader'"),
        ("time\tknee", "t\tknee", "no column 'time' first"),
        ("\n0.0200000000", "\n-1", "times don't ascend"),
        ("\n0.0200000000", "\nabc", "does not fit"),
        ("\n0.0200000000", "\n0.02\t1.0", "does not fit"),
    ],
)
def test_broken_mot_files_are_refused_by_name(tmp_path, old, new, message):
    path = tmp_path / "b.mot"
    write_mot(path, table())
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=message) as raised:
        read_mot(path)
    assert "b.mot" in raised.value.message
