"""What a file's owner is told when it is uploaded, and how its role is guessed."""

import numpy as np
import pytest

from gonio.errors import InputError
from gonio.formats.pressure_csv import write_pressure
from gonio.jobs.filenames import guess_role
from gonio.jobs.probe import probe_file
from gonio.records import FootPressure

CARD = """
kind = "forces"
[time]
column = "t"
unit = "s"
[force]
unit = "N"
[cop]
unit = "m"
[right]
force = "R"
cop = ["x", "y"]
[left]
force = "L"
cop = ["x", "y"]
"""


@pytest.fixture
def soles(tmp_path):
    force = 350 + 300 * np.sin(np.arange(50) / 4)
    pressure = FootPressure(
        times_s=np.arange(50) / 20,
        vertical_n=np.stack([force, 700 - force], axis=1),
        cop_foot_m=np.full((50, 2, 2), 0.05),
    )
    write_pressure(tmp_path / "soles.csv", pressure)
    return tmp_path / "soles.csv"


def test_a_table_without_a_card_is_read_at_once(soles):
    assert probe_file(soles, "pressure") == {"samples": 50, "duration_s": 2.45, "rate_hz": 20.0, "lost": 0.0}
    soles.write_text(soles.read_text().replace("\n0.1", "\n-0.1"))
    with pytest.raises(InputError, match="go back"):
        probe_file(soles, "pressure")


def test_a_table_with_a_card_waits_for_it_but_must_be_a_table(soles, tmp_path):
    soles.write_text(soles.read_text().replace("right_force_n", "F"))
    assert "card" in probe_file(soles, "pressure")["columns"]
    soles.write_bytes(b"\x00\x01\x02\n")
    with pytest.raises(InputError, match="is no table"):
        probe_file(soles, "pressure")
    (tmp_path / "a.pressure.toml").write_text(CARD)
    assert probe_file(tmp_path / "a.pressure.toml", "pressure_card") == {"kind": "forces", "time_column": "t"}


def test_force_plates(tmp_path, vicon_pig):
    facts = probe_file(vicon_pig / "PiG_Motion3_FF.c3d", "force_plates")
    assert facts == {"plates": 3, "samples": 2930}
    with pytest.raises(InputError, match="holds no force plates"):
        probe_file(vicon_pig / "PiG_Calibration3_FF.c3d", "force_plates")


@pytest.mark.parametrize(
    ("name", "role"),
    [
        ("soles.csv", "pressure"),
        ("my.pressure.toml", "pressure_card"),
        ("Calib.toml", "calibration"),
        ("walk1.C3D", "force_plates"),
        ("grf.mot", "force_plates"),
        ("body.osim", "body_model"),
        ("cam1.mp4", "video"),
    ],
)
def test_names_tell_roles(name, role):
    assert guess_role(name, "human_multicamera") == role
