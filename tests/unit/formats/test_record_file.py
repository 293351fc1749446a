import io
from enum import Enum, IntEnum
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gonio.errors import GonioError, InputError
from gonio.formats.record_file import read_record, write_record
from gonio.pipeline.run import Outcome, ReportFiles
from gonio.records import Camera, Finding, ImagePoints, Rig, Timebase


class Side(Enum):
    LEFT = "left"
    RIGHT = "right"


class Level(IntEnum):
    LOW = 1


def round_trip(value: object, root: Path | None = None, new_root: Path | None = None) -> Any:
    buffer = io.BytesIO()
    write_record(buffer, value, root)
    buffer.seek(0)
    return read_record(buffer, new_root or root)


@pytest.mark.parametrize(
    "value",
    [
        None,
        True,
        0,
        -(2**70),
        1.5,
        -0.0,
        0.1 + 0.2,
        5e-324,
        float("inf"),
        float("-inf"),
        "",
        "knee ° \x00 \ud800",
        (),
        (1, (2.0, ("three", None)), [True, []]),
        {"a": (1,), 2: {"$": "array"}, (1, 2): None},
        Side.RIGHT,
        Level.LOW,
        Path("/a/b c"),
        Path("relative"),
    ],
    ids=repr,
)
def test_plain_values_come_back_with_their_types(value):
    back = round_trip(value)
    assert back == value
    assert type(back) is type(value)
    assert repr(back) == repr(value)  # tells -0.0 from 0.0, and looks into containers


def test_nan_comes_back():
    assert np.isnan(round_trip(float("nan")))


@pytest.mark.parametrize(
    "array",
    [
        np.array([[1.0, np.nan], [-0.0, np.inf]]),
        np.zeros((0, 3)),
        np.array(2.5),
        np.arange(6, dtype=np.uint8).reshape(2, 3),
        np.array([True, False]),
        np.array(["hip", "knee"]),
        np.array([1 + 2j], dtype=np.complex64),
        np.asfortranarray(np.arange(12.0).reshape(3, 4)),
        np.arange(10.0)[::-2],
    ],
    ids=lambda a: f"{a.dtype}{a.shape}",
)
def test_arrays_come_back_to_the_bit(array):
    back = round_trip((array,))[0]
    assert back.dtype == array.dtype
    assert back.shape == array.shape
    assert back.tobytes() == array.tobytes()


def test_numpy_scalars_keep_their_type():
    for scalar in (np.float64(0.1), np.float32(0.1), np.int16(-3), np.bool_(True)):
        back = round_trip(scalar)
        assert type(back) is type(scalar)
        assert back == scalar


def test_nested_records_come_back():
    camera = Camera(
        name="left",
        image_size_px=(1920, 1080),
        intrinsic_px=np.diag([1000.0, 1000.0, 1.0]),
        distortion=np.zeros(5),
        T_lab_cam=np.eye(4),
    )
    points = ImagePoints(
        camera_names=("left",),
        keypoint_names=("knee",),
        timebase=Timebase(rate_hz=59.94),
        uv_px=np.array([[[[1.0, 2.0]], [[np.nan, np.nan]]]]),
        confidence=np.array([[[0.5], [0.0]]]),
    )
    finding = Finding(code="c", severity="warning", stage="s", message="m", hint="h", value=40.0, unit="%")
    back = round_trip(Outcome((Rig(cameras=(camera,), source="x"), points), (finding,)))
    assert isinstance(back, Outcome)
    rig, back_points = back.value
    assert rig.cameras[0].image_size_px == (1920, 1080)
    np.testing.assert_array_equal(rig.cameras[0].intrinsic_px, camera.intrinsic_px)
    np.testing.assert_array_equal(back_points.uv_px, points.uv_px)
    assert not back_points.uv_px.flags.writeable
    assert back_points.timebase.rate_hz == 59.94
    assert (back.findings[0].value, back.findings[0].severity) == (40.0, "warning")


def test_paths_below_the_root_follow_it():
    files = ReportFiles(document=Path("/old/out/report.json"), page=Path("/elsewhere/report.html"))
    back = round_trip(files, Path("/old"), Path("/new"))
    assert back.document == Path("/new/out/report.json")
    assert back.page == Path("/elsewhere/report.html")


def test_same_value_same_bytes():
    def written() -> bytes:
        buffer = io.BytesIO()
        write_record(buffer, {"a": np.arange(3.0), "b": (1, "x")})
        return buffer.getvalue()

    assert written() == written()


def test_a_file_by_name_keeps_its_name(tmp_path):
    write_record(tmp_path / "stage", (1,))
    assert [path.name for path in tmp_path.iterdir()] == ["stage"]
    assert read_record(tmp_path / "stage") == (1,)


def test_what_it_cannot_hold_is_refused_with_its_place():
    with pytest.raises(TypeError, match=r"value\['points'\]\[1\] is a set"):
        round_trip({"points": [1, {2}]})
    with pytest.raises(TypeError, match="array of Python objects"):
        round_trip(np.array([object()]))


@pytest.mark.parametrize("damage", ["cut", "empty", "text"])
def test_a_damaged_file_is_an_input_error(damage, tmp_path):
    path = tmp_path / "record"
    write_record(path, (np.arange(1000.0), "x"))
    content = path.read_bytes()
    path.write_bytes({"cut": content[:-200], "empty": b"", "text": b"hello"}[damage])
    with pytest.raises(InputError) as caught:
        read_record(path)
    assert caught.value.code == "record-unreadable"


@pytest.mark.parametrize("name", ["os:system", "antigravity:anything", "gonio.errors:GonioError", "builtins:dict"])
def test_only_records_are_constructed(name, tmp_path):
    path = tmp_path / "record"
    document = f'{{"$": "record", "class": "{name}", "fields": {{}}}}'.encode()
    np.savez(path.with_suffix(".npz"), document=np.frombuffer(document, dtype=np.uint8))
    with pytest.raises(GonioError):
        read_record(path.with_suffix(".npz"))
