"""Tables of foot pressure and their cards: what is read, what is marked as lost, and what is refused."""

import tracemalloc

import numpy as np
import pandas as pd
import pytest

from gonio.errors import InputError
from gonio.formats import pressure_csv
from gonio.formats.pressure_card import DEFAULT_COLUMNS, read_pressure_card
from gonio.formats.pressure_csv import read_pressure
from gonio.formats.pressure_mat import FeetOnMat, split_by_foot

FORCES = """
kind = "forces"
[time]
column = "t"
unit = "ms"
zero = {zero}
[force]
unit = "kgf"
saturation = 100
[cop]
unit = "mm"
along = "backwards"
across = "outwards"
[right]
force = "R"
cop = ["Rx", "Ry"]
heel = [250, 40]
[left]
force = "L"
cop = ["Lx", "Ly"]
heel = [250, 40]
"""


def steps(samples=200, rate_hz=50.0):
    """Two feet that take turns, by the default columns: 700 N, from the heel to 0.2 m."""
    times_s = np.arange(samples) / rate_hz
    share = 0.5 + 0.5 * np.sin(2 * np.pi * times_s)
    along_m = 0.1 + 0.1 * np.sin(2 * np.pi * times_s - 1)
    return pd.DataFrame(
        dict(
            zip(
                DEFAULT_COLUMNS,
                (times_s, 700 * share, along_m, 0.01 + 0 * share, 700 * (1 - share), along_m, -0.01 + 0 * share),
                strict=True,
            )
        )
    )


@pytest.fixture
def write(tmp_path):
    def write(table, card="", name="soles.csv", **options):
        path = tmp_path / name
        table.to_csv(path, index=False, **options)
        if not card:
            return path, None
        (tmp_path / "card.toml").write_text(card)
        return path, read_pressure_card(tmp_path / "card.toml")

    return write


def test_the_default_columns_need_no_card(write):
    table = steps()
    stream = read_pressure(*write(table))
    np.testing.assert_array_equal(stream.pressure.times_s, table["time_s"])
    np.testing.assert_allclose(stream.pressure.vertical_n, table[["right_force_n", "left_force_n"]], atol=1e-9)
    np.testing.assert_allclose(
        stream.pressure.cop_foot_m[1:, 1], table[["left_along_m", "left_across_m"]][1:], atol=1e-9
    )
    assert stream.in_newtons
    assert not stream.saturated.any()


@pytest.mark.parametrize(("separator", "decimal"), [(";", ","), ("\t", "."), (",", ".")])
def test_units_directions_and_clock_are_those_of_the_card(write, separator, decimal):
    rows = [(5000 + 20 * i, 80 if i % 2 else 110, 100, 45, 3.5, 240, 20, "note") for i in range(30)]
    table = pd.DataFrame(rows, columns=["t", "R", "Rx", "Ry", "L", "Lx", "Ly", "what"]).astype({"R": float})
    table.loc[7:9, "L"] = 30.0
    path, card = write(table, f'decimal = "{decimal}"\n' + FORCES.format(zero=4000), sep=separator, decimal=decimal)
    stream = read_pressure(path, card)
    np.testing.assert_allclose(stream.pressure.times_s[:2], [1.0, 1.02])
    np.testing.assert_allclose(stream.pressure.vertical_n[1], [80 * 9.80665, 3.5 * 9.80665])
    # along: 250 - 100 mm before the heel's back; across: 5 mm outwards of it, which is right for the right foot; the
    # left one's is 20 mm inwards, which is right too.
    np.testing.assert_allclose(stream.pressure.cop_foot_m[1], [[0.150, 0.005], [0.010, 0.020]], atol=1e-12)
    assert stream.saturated[:3].tolist() == [[True, False], [False, False], [True, False]]


SENSORS = """
kind = "sensors"
[time]
column = "t"
unit = "s"
[sensor]
unit = "kPa"
area_mm2 = 100
saturation = 300
threshold = 5
[right]
columns = ["r0", "r1"]
positions_mm = [[30, 0], [180, 10]]
[left]
list_column = "left"
grid = { rows = 2, columns = 2, first_mm = [180, -10], pitch_mm = [-150, 20] }
"""


def test_sensors_become_force_and_centre(write):
    table = pd.DataFrame({"t": np.arange(20) / 10, "r0": 300.0, "r1": 100.0, "left": "100,0,4,200"})
    table.loc[3, "r1"] = 299.0
    table.loc[5, "left"] = "100,0,4"  # a sensor short
    table.loc[6, "left"] = ""
    table.loc[7, "r0"] = 0.0
    table.loc[8, "left"] = "[300, 0, 0, 0]"
    stream = read_pressure(*write(table, SENSORS))
    assert stream.pressure.vertical_n[0].tolist() == [
        40.0,
        30.0,
    ]  # 400 kPa and 300 kPa on 100 mm²: 4 below the threshold
    np.testing.assert_allclose(stream.pressure.cop_foot_m[0, 0], [(30 * 3 + 180) / 4e3, 10 / 4e3])
    # The left foot's: 100 at (180, -10), 200 at (30, 10).
    np.testing.assert_allclose(stream.pressure.cop_foot_m[0, 1], [(180 + 60) / 3e3, (-10 + 20) / 3e3])
    assert np.isnan(stream.pressure.vertical_n[5:7, 1]).all()
    assert stream.pressure.vertical_n[5, 0] == 40.0
    assert stream.saturated[:, 0].tolist() == [True] * 7 + [False] + [True] * 12
    assert np.flatnonzero(stream.saturated[:, 1]).tolist() == [8]


def test_what_was_lost_stays_lost(write):
    table = steps()
    table.loc[20:30, "left_force_n"] = np.nan
    table.loc[40, "right_force_n"] = np.inf
    table = table.drop(index=range(100, 120))
    stream = read_pressure(*write(table))
    lost = np.isnan(stream.pressure.vertical_n)
    assert np.flatnonzero(lost[:, 1])[:11].tolist() == list(range(20, 31))
    assert lost[40, 0]
    gap = int(np.flatnonzero(lost.all(axis=1))[0])
    assert stream.pressure.times_s[gap] == pytest.approx((99 + 120) / 2 / 50)
    assert len(stream.pressure.times_s) == 200 - 20 + 1
    assert lost.sum() == 11 + 1 + 2
    assert (np.isnan(stream.pressure.cop_foot_m[..., 0]) >= lost).all()


def test_doubled_time_stamps_and_noise_below_zero_are_counted(write):
    table = steps(samples=400)
    table.loc[50, "time_s"] = table.loc[49, "time_s"]
    table["right_force_n"] -= 3.0
    stream = read_pressure(*write(table))
    assert stream.doubled == 1
    assert len(stream.pressure.times_s) == 399
    assert stream.negative == pytest.approx(float((table["right_force_n"].drop(50) < 0).mean()) / 2)
    assert np.nanmin(stream.pressure.vertical_n) == 0.0
    assert np.isnan(stream.pressure.cop_foot_m[stream.pressure.vertical_n == 0]).all()


def test_a_clock_may_start_anywhere(write):
    table = steps().rename(columns={"time_s": "t", "right_force_n": "R", "left_force_n": "L"})
    table = table.rename(
        columns=dict(zip(DEFAULT_COLUMNS[2:4] + DEFAULT_COLUMNS[5:], ["Rx", "Ry", "Lx", "Ly"], strict=True))
    )
    table["t"] = 1.727036e12 + 1e3 * table["t"]
    table[["R", "L"]] /= 9.80665
    table[["Rx", "Lx"]] = 250 - 1e3 * table[["Rx", "Lx"]]
    table[["Ry", "Ly"]] = 40 + 1e3 * table[["Ry", "Ly"]] * [1, -1]
    with pytest.raises(InputError, match=r"too few samples between -60 and 600 s of the video: 0") as raised:
        read_pressure(*write(table, FORCES.format(zero=0)))
    assert raised.value.code == "pressure-clock"
    stream = read_pressure(*write(table, FORCES.format(zero='"first"')))
    assert stream.pressure.times_s[0] == 0.0


def one_foot(table):
    return table.assign(left_force_n=7.0)


def lost_foot(table):
    return table.assign(right_force_n=np.nan)


def absent_foot(table):
    return table.drop(columns=["left_force_n", "left_along_m", "left_across_m"], errors="ignore")


def negative(table):
    return table.assign(right_force_n=-table["right_force_n"])


def too_light(table):  # newtons declared, but kilogrammes of a body of 71 kg given: 7 kg could be a child, 71 N
    return table.assign(right_force_n=table["right_force_n"] / 23, left_force_n=table["left_force_n"] / 23)


def too_heavy(table):
    return table.assign(right_force_n=table["right_force_n"] * 1e3)


def millimetres(table):
    return table.assign(left_along_m=table["left_along_m"] * 1e3)


def no_centre(table):
    return table.assign(left_along_m=np.nan)


def back(table):
    return table.assign(time_s=np.r_[table["time_s"][:100], table["time_s"][:100] + 0.5])


def still(table):
    return table.assign(time_s=table["time_s"].round(1))


def no_time(table):
    return table.assign(time_s=table["time_s"].where(table.index != 60))


def words(table):
    return table.astype({"left_along_m": object}).assign(left_along_m=["x", *table["left_along_m"][1:]])


def renamed(table):
    return table.rename(columns={"left_along_m": "left_x"})


def untimed(table):
    return table.rename(columns={"time_s": "time"})


@pytest.mark.parametrize(
    ("spoil", "code", "message"),
    [
        (one_foot, "pressure-one-foot", "left foot always shows 7"),
        (lost_foot, "pressure-one-foot", "right foot has no value"),
        (absent_foot, "pressure-one-foot", "no column of the left foot"),
        (negative, "pressure-negative", "are negative, down to -699"),
        (too_light, "pressure-unit", r"that is 3\.1 kg"),
        (too_heavy, "pressure-unit", "at most 6.99e"),
        (millimetres, "pressure-cop", "left foot's centre of pressure"),
        (no_centre, "pressure-cop", "no centre of pressure of the left foot in 100 %"),
        (back, "pressure-clock", "go back in row 102"),
        (still, "pressure-clock", "159 of 200 samples have the time stamp of the one before"),
        (no_time, "pressure-clock", "no time in row 62"),
        (words, "pressure-unreadable", "does not fit"),
        (renamed, "pressure-unreadable", "no column 'left_along_m'"),
        (untimed, "pressure-unreadable", "no column 'time_s' in its first line"),
    ],
)
def test_what_can_not_be_is_refused_by_name(write, spoil, code, message):
    with pytest.raises(InputError, match=message) as raised:
        read_pressure(*write(spoil(steps())))
    assert raised.value.code == code
    assert "soles.csv" in raised.value.message
    assert raised.value.hint


@pytest.mark.parametrize("content", [b"", b"\x00\xff\xfe" * 50, b"time_s\n1\n2\n", b"a" * 100_000])
def test_what_is_no_table_is_refused(tmp_path, content):
    (tmp_path / "soles.csv").write_bytes(content)
    with pytest.raises(InputError) as raised:
        read_pressure(tmp_path / "soles.csv")
    assert raised.value.code == "pressure-unreadable"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"kPa"', '"bar"', "sensor.unit: Input should be 'N'"),
        ("area_mm2 = 100", "", "sensor.area_mm2 is missing"),
        ('["r0", "r1"]', '["r0"]', "right: 1 columns, but 2 positions"),
        ("[180, 10]", "[1800, 10]", "a sensor lies 1800 mm from the heel"),
        ('list_column = "left"', "", "left: give either columns or list_column"),
        ("grid = {", "what = {", "left.what: Unexpected keyword argument"),
        ('kind = "sensors"', "", "kind: "),
        ("[time]", "[time", "no pressure card"),
        ("rows = 2", "rows = 100000", "less than or equal to 16384"),
    ],
)
def test_cards_are_refused_with_the_entry_that_is_wrong(tmp_path, old, new, message):
    assert old in SENSORS
    (tmp_path / "c.toml").write_text(SENSORS.replace(old, new, 1))
    with pytest.raises(InputError, match=message) as raised:
        read_pressure_card(tmp_path / "c.toml")
    assert raised.value.code == "pressure-card-unreadable"


def test_a_card_of_one_foot_is_refused(tmp_path):
    (tmp_path / "c.toml").write_text(SENSORS.partition("[left]")[0])
    with pytest.raises(InputError, match="describes no left foot") as raised:
        read_pressure_card(tmp_path / "c.toml")
    assert raised.value.code == "pressure-one-foot"


def test_memory_does_not_grow_with_the_file(write, monkeypatch):
    """Only the video's time is kept, and a part at a time is parsed: ten times the file takes no more memory."""
    monkeypatch.setattr(pressure_csv, "PART_VALUES", 20_000)

    def peak(samples):
        path, _ = write(steps(samples=samples, rate_hz=200.0))
        tracemalloc.start()
        stream = read_pressure(path, span_s=(samples / 200.0 - 5.0, samples / 200.0))
        highest = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert len(stream.pressure.times_s) == 1000
        return highest

    peak(6_000)  # pandas caches at the first call
    # A part of 20 000 cells is 160 kB, the whole table of 60 000 rows 3.4 MB.
    assert peak(60_000) < peak(6_000) + 300_000


def test_too_many_samples_are_refused_while_they_come(write, monkeypatch):
    monkeypatch.setattr(pressure_csv, "MOST_SAMPLES", 1000)
    monkeypatch.setattr(pressure_csv, "PART_VALUES", 7_000)
    with pytest.raises(InputError, match="more than 1000 samples") as raised:
        read_pressure(*write(steps(samples=5000)))
    assert raised.value.code == "pressure-too-long"


def test_a_foot_beside_the_mat_is_unknown():
    """Two sensors 0.2 m apart under the right foot; the left one is above the mat at first, then steps beside it."""
    times_s = np.arange(4) / 10
    heel = np.tile([[[0.1, 0.05, 0.1], [0.1, 0.05, -0.1]]], (4, 1, 1))
    heel[2:, 1, 2] = -0.5
    places_m = np.array([[0.0, -0.2], [0.5, 0.2], [0.15, 0.1], [0.25, 0.1]])
    forces = np.tile([0.0, 0.0, 300.0, 100.0], (4, 1))
    forces[3, 0] = np.nan
    force, cop_m = split_by_foot(
        times_s, forces, places_m, FeetOnMat(times_s, heel, heel + np.array([0.18, -0.05, 0.0]))
    )
    assert force[:3, 0].tolist() == [400.0] * 3
    assert force[:2, 1].tolist() == [0.0, 0.0]
    assert np.isnan(force[2, 1])
    assert np.isnan(force[3]).all()
    # 175 mm before the lab's origin, 75 mm before the heel's; along a sole that slopes down by 50 mm in 180.
    slope = np.array([0.18, -0.05]) / np.hypot(0.18, 0.05)
    np.testing.assert_allclose(cop_m[0, 0], [slope @ [0.075, -0.05], 0.0], atol=1e-12)


def test_a_mats_card(tmp_path):
    text = SENSORS.partition("[right]")[0].replace('"sensors"', '"mat"')
    (tmp_path / "m.toml").write_text(text + '[mat]\ncolumns = ["a"]\npositions_mm = [[60000, 0]]\n')
    with pytest.raises(InputError, match="60000 mm from the lab's origin"):
        read_pressure_card(tmp_path / "m.toml")
    (tmp_path / "m.toml").write_text(text)
    with pytest.raises(InputError, match="mat: Field required"):
        read_pressure_card(tmp_path / "m.toml")


ISCAS = """
kind = "sensors"
[time]
column = "Timestamp"
unit = "s"
zero = "first"
[sensor]
unit = "counts"
saturation = 4095
[right]
list_column = "Matrix_1"
grid = { rows = 33, columns = 15, first_mm = [256, -49], pitch_mm = [-8, 7] }
[left]
list_column = "Matrix_0"
grid = { rows = 33, columns = 15, first_mm = [256, -49], pitch_mm = [-8, 7] }
"""


def test_a_messy_real_insole_goes_through_and_nothing_is_invented(insole_iscas, tmp_path):
    (tmp_path / "insole.toml").write_text(ISCAS)
    path = insole_iscas / "walking_cjj_neiba.csv"
    stream = read_pressure(path, read_pressure_card(tmp_path / "insole.toml"))
    table = pd.read_csv(path, usecols=["Timestamp", "Matrix_0", "Matrix_1"])
    counts = np.array([[float(cell) for cell in line.split(",")] for line in table["Matrix_1"]])
    assert not stream.in_newtons
    measured = np.isfinite(stream.pressure.vertical_n).all(axis=1)
    assert measured.sum() == len(table) == 367
    gaps_s = np.diff(stream.pressure.times_s[measured])
    assert (~measured).sum() == (gaps_s > 2.5 * np.median(gaps_s)).sum() > 0
    np.testing.assert_allclose(stream.pressure.times_s[measured], table["Timestamp"] - table["Timestamp"][0], atol=1e-6)
    np.testing.assert_allclose(stream.pressure.vertical_n[measured, 0], counts.sum(axis=1))
    # The centre of pressure lies on the sole: 33 rows of 8 mm, 15 columns of 7 mm.
    known = np.isfinite(stream.pressure.cop_foot_m[..., 0])
    assert (known == (np.nan_to_num(stream.pressure.vertical_n) > 0)).all()
    assert (np.abs(stream.pressure.cop_foot_m[known] - [0.128, 0.0]) <= [0.128, 0.049]).all()
