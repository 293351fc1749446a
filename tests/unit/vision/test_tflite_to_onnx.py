"""Each operator against the same arithmetic in numpy, in TFLite's layout (batch, height, width, channel)."""

from collections.abc import Sequence

import numpy as np
import onnx
import onnxruntime as ort
import pytest

from gonio.errors import InputError
from gonio.vision.weights.tflite_file import Graph, Operator, Tensor
from gonio.vision.weights.tflite_to_onnx import convert_graph, convert_tflite

RELU, RELU6 = 1, 3
SAME, VALID = 0, 1
CONV = {"StrideH": 1, "StrideW": 1, "DilationHFactor": 1, "DilationWFactor": 1, "FusedActivationFunction": 0}


def graph_of(
    kind: str, image: np.ndarray, constants: Sequence[np.ndarray], output_shape: Sequence[int], options: dict[str, int]
) -> Graph:
    """One operator on the image, with constants as its further inputs."""
    tensors = [Tensor("image", (1, *image.shape[1:]))]
    tensors += [Tensor(f"constant_{i}", value.shape, value) for i, value in enumerate(constants)]
    tensors.append(Tensor("result", (1, *output_shape)))
    last = len(tensors) - 1
    return Graph(tuple(tensors), (Operator(kind, tuple(range(last)), (last,), options),), (0,), (last,))


def run(model: bytes, image: np.ndarray) -> dict[str, np.ndarray]:
    session = ort.InferenceSession(model)
    names = [output.name for output in session.get_outputs()]
    return dict(zip(names, session.run(names, {"image": image}), strict=True))


def apply(
    kind: str, image: np.ndarray, constants: Sequence[np.ndarray], output_shape: Sequence[int], **options: int
) -> np.ndarray:
    graph = graph_of(kind, image, constants, output_shape, options)
    return run(convert_graph(graph, {"result": "result"}), image)["result"]


@pytest.fixture
def image() -> np.ndarray:
    return np.random.default_rng(7).normal(size=(2, 5, 6, 4)).astype(np.float32)


def convolve(image: np.ndarray, kernel: np.ndarray, stride: int, pads: Sequence[tuple[int, int]]) -> np.ndarray:
    """Convolve, the slow and plain way; kernel (out, height, width, in)."""
    padded = np.pad(image, [(0, 0), *pads, (0, 0)])
    windows = np.lib.stride_tricks.sliding_window_view(padded, kernel.shape[1:3], axis=(1, 2))[:, ::stride, ::stride]
    return np.einsum("nijchw,ohwc->nijo", windows, kernel)


@pytest.mark.parametrize(
    ("stride", "padding", "pads"),
    # SAME: ceil(5 / 2) = 3 rows need (3 - 1) 2 + 3 = 7, so one before and one behind; 3 columns need 7 of 6: one behind.
    [
        (1, VALID, [(0, 0), (0, 0)]),
        (1, SAME, [(1, 1), (1, 1)]),
        (2, SAME, [(1, 1), (0, 1)]),
        (2, VALID, [(0, 0), (0, 0)]),
    ],
)
def test_convolution(image: np.ndarray, stride: int, padding: int, pads: list[tuple[int, int]]) -> None:
    rng = np.random.default_rng(8)
    kernel, bias = rng.normal(size=(3, 3, 3, 4)).astype(np.float32), rng.normal(size=3).astype(np.float32)
    expected = convolve(image, kernel, stride, pads) + bias
    options = CONV | {"StrideH": stride, "StrideW": stride, "Padding": padding}
    actual = apply("CONV_2D", image, [kernel, bias], expected.shape[1:], **options)
    np.testing.assert_allclose(actual, expected, atol=1e-5)


def test_depthwise_convolution_with_relu6(image: np.ndarray) -> None:
    kernel = np.random.default_rng(9).normal(scale=4, size=(1, 3, 3, 4)).astype(np.float32)
    each = [convolve(image[..., [c]], kernel[..., [c]], 1, [(1, 1), (1, 1)]) for c in range(4)]
    expected = np.clip(np.concatenate(each, axis=-1), 0, 6)
    assert (expected == 6).any()
    options = CONV | {"Padding": SAME, "FusedActivationFunction": RELU6}
    actual = apply("DEPTHWISE_CONV_2D", image, [kernel, np.zeros(4, np.float32)], (5, 6, 4), **options)
    np.testing.assert_allclose(actual, expected, atol=1e-5)


def test_max_pool(image: np.ndarray) -> None:
    expected = image[:, :4].reshape(2, 2, 2, 3, 2, 4).max(axis=(2, 4))
    options = {"FilterHeight": 2, "FilterWidth": 2, "StrideH": 2, "StrideW": 2, "Padding": VALID}
    np.testing.assert_array_equal(apply("MAX_POOL_2D", image, [], (2, 3, 4), **options), expected)


def test_pad_space_and_channels(image: np.ndarray) -> None:
    amounts = np.array([[0, 0], [1, 2], [0, 1], [0, 3]], np.int32)
    np.testing.assert_array_equal(apply("PAD", image, [amounts], (8, 7, 7)), np.pad(image, amounts))


def test_resize_by_half_pixel_centres() -> None:
    ramp = np.arange(4, dtype=np.float32).reshape(1, 1, 4, 1).repeat(2, axis=1)
    actual = apply("RESIZE_BILINEAR", ramp, [], (4, 8, 1), AlignCorners=0, HalfPixelCenters=1)
    # Output pixel j lies at (j + 0.5) / 2 - 0.5 of the input, held at the borders.
    expected = np.clip((np.arange(8) + 0.5) / 2 - 0.5, 0, 3)
    np.testing.assert_allclose(actual[0, :, :, 0], np.tile(expected, (4, 1)), atol=1e-6)


def test_depth_to_space(image: np.ndarray) -> None:
    expected = image.reshape(2, 5, 6, 2, 2, 1).transpose(0, 1, 3, 2, 4, 5).reshape(2, 10, 12, 1)
    np.testing.assert_array_equal(apply("DEPTH_TO_SPACE", image, [], (10, 12, 1), BlockSize=2), expected)


def test_reshape_keeps_the_channels_last_and_the_batch_free(image: np.ndarray) -> None:
    np.testing.assert_array_equal(apply("RESHAPE", image, [], (60, 2)), image.reshape(2, 60, 2))


def test_sigmoid(image: np.ndarray) -> None:
    np.testing.assert_allclose(apply("LOGISTIC", image, [], image.shape[1:]), 1 / (1 + np.exp(-image)), atol=1e-6)


@pytest.mark.parametrize("axis", [1, 3, -1])
def test_add_with_relu_then_concatenate(image: np.ndarray, axis: int) -> None:
    shape = list(image.shape)
    shape[axis] *= 2
    graph = Graph(
        (Tensor("image", (1, *image.shape[1:])), Tensor("sum", (1, *image.shape[1:])), Tensor("both", (1, *shape[1:]))),
        (
            Operator("ADD", (0, 0), (1,), {"FusedActivationFunction": RELU}),
            Operator("CONCATENATION", (0, 1), (2,), {"Axis": axis, "FusedActivationFunction": 0}),
        ),
        (0,),
        (2,),
    )
    expected = np.concatenate([image, np.maximum(2 * image, 0)], axis=axis)
    np.testing.assert_array_equal(run(convert_graph(graph, {"both": "both"}), image)["both"], expected)


def test_a_whole_file_with_two_pictures_at_once(tiny_tflite: bytes) -> None:
    image = np.random.default_rng(3).random((2, 4, 4, 3)).astype(np.float32)
    output = run(convert_tflite(tiny_tflite, {"Identity": "colours"}, "made for a test"), image)["colours"]
    np.testing.assert_allclose(output, np.stack([image[..., 0], np.clip(8 * image[..., 1] - 1, 0, 6)], -1), atol=1e-6)


def test_weights_are_stored_as_float16_only_where_that_is_exact(tiny_tflite: bytes) -> None:
    model = onnx.load_from_string(convert_tflite(tiny_tflite, {"Identity": "colours"}))
    kinds = {tuple(constant.dims): constant.data_type for constant in model.graph.initializer}
    assert kinds[2, 3, 1, 1] == onnx.TensorProto.FLOAT16
    image = np.zeros((1, 4, 4, 3), np.float32)
    inexact = graph_of("CONV_2D", image, [np.full((2, 1, 1, 3), 0.1, np.float32), np.zeros(2, np.float32)], (4, 4, 2),
                       CONV | {"Padding": VALID})  # fmt: skip
    model = onnx.load_from_string(convert_graph(inexact, {"result": "result"}))
    kinds = {tuple(constant.dims): constant.data_type for constant in model.graph.initializer}
    assert kinds[2, 3, 1, 1] == onnx.TensorProto.FLOAT


def test_what_the_outputs_do_not_need_is_left_out(image: np.ndarray) -> None:
    shape = (1, *image.shape[1:])
    graph = Graph(
        tuple(Tensor(name, shape) for name in ("image", "wanted", "unwanted")),
        (Operator("LOGISTIC", (0,), (1,)), Operator("UNHEARD_OF", (0,), (2,))),
        (0,),
        (1, 2),
    )
    model = onnx.load_from_string(convert_graph(graph, {"wanted": "result"}))
    assert [output.name for output in model.graph.output] == ["result"]
    with pytest.raises(InputError, match="UNHEARD_OF") as caught:
        convert_graph(graph, {"unwanted": "result"})
    assert caught.value.code == "weights-invalid"
    with pytest.raises(InputError, match="no output missing; their outputs are wanted, unwanted"):
        convert_graph(graph, {"missing": "result"})
