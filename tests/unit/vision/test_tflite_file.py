import numpy as np
import pytest

from gonio.errors import InputError
from gonio.vision.weights.tflite_file import densify, read_tflite


def test_densify_a_csr_matrix() -> None:
    dense = densify(np.array([1.0, 2, 3]), (3, 4), [0, 1], [3, (np.array([0, 1, 1, 3]), np.array([2, 0, 3]))])
    np.testing.assert_array_equal(dense, [[0, 0, 1, 0], [0, 0, 0, 0], [2, 0, 0, 3]])


def test_densify_a_csc_matrix() -> None:
    """Columns are walked first: the same matrix, stored the other way round."""
    levels = [4, (np.array([0, 1, 1, 2, 3]), np.array([2, 0, 2]))]
    dense = densify(np.array([2.0, 1, 3]), (3, 4), [1, 0], levels)
    np.testing.assert_array_equal(dense, [[0, 0, 1, 0], [0, 0, 0, 0], [2, 0, 0, 3]])


def test_densify_convolution_weights() -> None:
    """As the detector stores them: three dense levels, then compressed input channels."""
    dense = np.where(np.random.default_rng(1).random((5, 1, 2, 7)) < 0.3, 1.5, 0.0)
    rows = dense.reshape(-1, 7)
    segments = np.concatenate([[0], np.cumsum((rows != 0).sum(axis=1))])
    levels = [5, 1, 2, (segments, np.nonzero(rows)[1])]
    np.testing.assert_array_equal(densify(rows[rows != 0], dense.shape, [0, 1, 2, 3], levels), dense)


def test_read_a_network(tiny_tflite: bytes) -> None:
    graph = read_tflite(tiny_tflite)
    assert [graph.tensors[i].name for i in graph.inputs + graph.outputs] == ["image", "Identity"]
    assert [operator.kind for operator in graph.operators] == ["DEQUANTIZE", "CONV_2D"]
    assert graph.operators[1].options["FusedActivationFunction"] == 3
    weights = graph.tensors[1].value
    assert weights is not None
    assert weights.dtype == np.float16
    np.testing.assert_array_equal(weights[:, 0, 0], [[1, 0, 0], [0, 8, 0]])


@pytest.mark.parametrize("data", [b"", b"PK\x03\x04 a zip file", b"<html>"])
def test_another_file_is_refused(data: bytes) -> None:
    with pytest.raises(InputError, match="TFLite") as caught:
        read_tflite(data)
    assert caught.value.code == "weights-invalid"
