from pathlib import Path

import numpy as np
import pytest

from gonio.errors import InputError
from gonio.formats.calibration import read_calibration
from gonio.formats.qualisys import read_qualisys_calibration

CAMERA = """<camera serial="{name}"><fov_video bottom="1919" left="0" right="1087" top="0"/>
<transform r11="1" r12="0" r13="0" r21="0" r22="0" r23="1" r31="0" r32="-1" r33="0" x="1000" y="-4000" z="1500"/>
<intrinsic centerPointU="34816" centerPointV="61440" focalLengthU="107520" focalLengthV="107584"
 radialDistortion1="-0.046" radialDistortion2="0.14" radialDistortion3="0" skew="0"
 tangentalDistortion1="0.0006" tangentalDistortion2="0.0007"/></camera>"""


def write(path: Path, cameras: str) -> Path:
    path.write_text(f"<?xml version='1.0'?><calibration><cameras>{cameras}</cameras></calibration>")
    return path


def test_units_axes_and_distortion(tmp_path: Path) -> None:
    rig = read_calibration(write(tmp_path / "a.qca.txt", CAMERA.format(name="b") + CAMERA.format(name="a")))
    assert rig.names == ("a", "b")
    camera = rig.cameras[0]
    assert camera.image_size_px == (1088, 1920)
    np.testing.assert_allclose(camera.intrinsic_px, [[1680, 0, 544], [0, 1681, 960], [0, 0, 1]])
    np.testing.assert_allclose(camera.distortion, [-0.046, 0.14, 0.0006, 0.0007, 0])  # not divided by 64
    # Qualisys (1, -4, 1.5) m, Z up -> lab (1, 1.5, 4), Y up. The camera looks along Qualisys' +y, that is the lab's -Z.
    np.testing.assert_allclose(camera.centre_lab_m, [1.0, 1.5, 4.0])
    np.testing.assert_allclose(camera.T_lab_cam[:3, 2], [0, 0, -1])
    np.testing.assert_allclose(camera.T_lab_cam[:3, 1], [0, -1, 0])  # image rows run downwards


@pytest.mark.parametrize(
    ("content", "code"),
    [
        ("", "calibration-format-unknown"),
        ("not xml", "calibration-format-unknown"),
        ("<calibration><cameras>", "calibration-unreadable"),
        ("<calibration/>", "calibration-unreadable"),
        ("<!DOCTYPE x [<!ENTITY e SYSTEM 'file:///etc/passwd'>]><calibration>&e;</calibration>", "calibration-unreadable"),
        (f"<calibration><cameras>{CAMERA.format(name='a').replace('focalLengthU', 'x')}</cameras></calibration>",
         "calibration-incomplete"),
        (f"<calibration><cameras>{CAMERA.format(name='a').replace('107520', 'nan')}</cameras></calibration>",
         "calibration-incomplete"),
        (f"<calibration><cameras>{CAMERA.format(name='')}</cameras></calibration>", "calibration-incomplete"),
        (f"<calibration><cameras>{CAMERA.format(name='a') * 2}</cameras></calibration>", "invalid-input"),
        ("<calibration><cameras>" + CAMERA.format(name="a").replace('r33="0"', 'r33="1"') + "</cameras></calibration>",
         "invalid-input"),
    ],
)  # fmt: skip
def test_a_bad_file_is_named_with_its_remedy(tmp_path: Path, content: str, code: str) -> None:
    path = tmp_path / "lab.qca.txt"
    path.write_text(content)
    with pytest.raises(InputError) as caught:
        read_calibration(path)
    assert caught.value.code == code
    assert caught.value.hint


def test_the_real_calibration(balancing: Path) -> None:
    rig = read_qualisys_calibration(balancing / "calibration" / "Calib.qca.txt")
    assert rig.names == ("cam01", "cam02", "cam03", "cam04")
    assert [round(c.distortion[0], 3) for c in rig.cameras] == [-0.046, -0.048, -0.047, -0.048]
    assert all(1.5 < c.centre_lab_m[1] < 2.5 for c in rig.cameras)  # tripods: Y is up
    assert all(c.T_lab_cam[1, 2] < 0 for c in rig.cameras)  # they look down at the subject
