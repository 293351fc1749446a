from pathlib import Path

import numpy as np
import pytest

from gonio.errors import ResourceError
from gonio.vision.sessions import available_cores, open_session
from gonio.vision.weights.tflite_to_onnx import convert_tflite


def test_run_by_name(tiny_tflite: bytes, tmp_path: Path) -> None:
    path = tmp_path / "tiny.onnx"
    path.write_bytes(convert_tflite(tiny_tflite, {"Identity": "colours"}))
    output = open_session(path, threads=2).run({"image": np.ones((1, 4, 4, 3), np.float32)})
    assert list(output) == ["colours"]
    np.testing.assert_array_equal(output["colours"], np.broadcast_to(np.float32([1, 6]), (1, 4, 4, 2)))


def test_a_file_that_is_no_network(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "bad.onnx"
    for content in (None, b"", b"half a network"):
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(ResourceError, match=r"bad\.onnx") as caught:
            open_session(path)
        assert caught.value.code == "weights-invalid"
        assert "gonio models fetch" in caught.value.hint
    assert capfd.readouterr() == ("", "")


def test_at_least_one_core() -> None:
    assert available_cores() >= 1
