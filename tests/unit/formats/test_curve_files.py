"""What marker laboratories and statistics programs get: C3D and tables, read back."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from gonio.formats.c3d import Event, read_c3d
from gonio.formats.c3d_writer import write_c3d
from gonio.formats.curve_tables import write_cycle_parquet, write_cycle_table, write_time_table
from gonio.formats.trc import Trajectories
from gonio.records import CycleCurves, EventTrain, GaitAnalysis, GaitCycle, GaitEvents, Timebase, TimeCurve


def test_a_c3d_file_comes_back_as_it_was_written(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    xyz_m = rng.normal(0.0, 1.0, (30, 3, 3))
    xyz_m[4, 1] = np.nan
    markers = Trajectories(names=("a", "b", "c"), times_s=np.arange(30) / 60.0, xyz_m=xyz_m, rate_hz=60.0)
    angle = rng.normal(20.0, 10.0, 30)
    angle[7] = np.nan
    events = [Event("Foot Strike", "right", 0.1), Event("Foot Off", "left", 0.3)]
    write_c3d(tmp_path / "trial.c3d", markers, {"right_knee_flexion": angle}, events)
    read = read_c3d(tmp_path / "trial.c3d")
    assert read.markers.names == markers.names
    assert read.markers.rate_hz == 60.0
    # The file holds 32-bit millimetres: 24 bits of 4 m are 0.3 µm.
    np.testing.assert_allclose(read.markers.xyz_m, xyz_m, atol=1e-6)
    np.testing.assert_allclose(read.outputs.of("right_knee_flexion")[:, 0], angle, atol=1e-4)
    assert [(e.label, e.side) for e in read.events] == [(e.label, e.side) for e in events]
    np.testing.assert_allclose([e.time_s for e in read.events], [0.1, 0.3], atol=1e-6)


def test_tables_name_side_quantity_and_unit(tmp_path: Path) -> None:
    values = np.array([1.5, np.nan, 2.5])
    curve = TimeCurve(quantity="knee_extension_moment", side="left", unit="Nm/kg", values=values, sd=np.full(3, 0.25))
    write_time_table(tmp_path / "angles.csv", np.arange(3) / 50.0, [curve])
    table = pd.read_csv(tmp_path / "angles.csv")
    assert list(table) == ["time_s", "left_knee_extension_moment_Nm_per_kg", "left_knee_extension_moment_sd_Nm_per_kg"]
    np.testing.assert_allclose(table.iloc[:, 1], values)


def test_all_cycles_stand_in_the_long_table_and_odd_ones_are_marked(tmp_path: Path) -> None:
    none = EventTrain(frames=np.zeros(0), sd_s=np.zeros(0), from_force=np.zeros(0, dtype=bool))
    cycles = tuple(
        GaitCycle(
            foot=1,
            start_frame=60.0 * i,
            other_lift_frame=np.nan,
            heel_off_frame=np.nan,
            other_strike_frame=np.nan,
            lift_frame=np.nan,
            end_frame=60.0 * (i + 1),
            left_out="odd" if i else "",
        )
        for i in range(2)
    )
    values = np.stack([np.arange(101.0), np.full(101, np.nan)])
    gait = GaitAnalysis(
        events=GaitEvents(strikes=(none, none), lifts=(none, none)),
        cycles=cycles,
        measures=(),
        curves=(CycleCurves(quantity="knee_flexion", side="left", unit="deg", values=values, sd=values),),
        timebase=Timebase(rate_hz=60.0, start_s=0.5),
        belt_m_s=0.0,
        leg_length_m=0.9,
    )
    write_cycle_table(tmp_path / "cycles.csv", gait)
    table = pd.read_csv(tmp_path / "cycles.csv")
    assert len(table) == 202
    first, second = table[table["cycle"] == 1], table[table["cycle"] == 2]
    np.testing.assert_allclose(first["value"], np.arange(101.0))
    assert first["counts"].all()
    assert not second["counts"].any()
    assert second["value"].isna().all()
    assert first["start_s"].iloc[0] == 0.5
    arrow = pytest.importorskip("pyarrow.parquet", reason="Apache Arrow is an extra: gonio[parquet]")
    write_cycle_parquet(tmp_path / "cycles.parquet", gait)
    columns = arrow.read_table(tmp_path / "cycles.parquet").to_pydict()
    assert list(columns) == list(table.columns)
    assert columns["value"][:101] == list(range(101))
    assert columns["value"][101:] == [None] * 101
    assert columns["counts"] == table["counts"].tolist()
