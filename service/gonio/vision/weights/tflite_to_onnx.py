# ruff: noqa: ANN401
# pyright: standard
# (`onnx.helper` returns protobuf messages, whose fields have no types: they are Any here.)
"""Convert a TFLite network to ONNX: just the operators that BlazePose needs, one short function each.

TFLite keeps pictures as (batch, height, width, channel), ONNX as (batch, channel, height, width). The converted network
keeps TFLite's layout at its inputs and outputs; inside, every four-dimensional tensor is transposed once, at the input,
and back where its order matters (before a reshape and at an output).
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from gonio.errors import InputError, ResourceError
from gonio.vision.weights.tflite_file import Graph, Operator, read_tflite

CONVERTER_VERSION = 1
"""Part of the cache key: raise it whenever the same file converts to another network."""

OPSET, IR_VERSION = 17, 8
NCHW, NHWC = (0, 3, 1, 2), (0, 2, 3, 1)
PADDING_SAME = 0
ACTIVATIONS = {0: None, 1: (0.0, None), 3: (0.0, 6.0)}
"""The schema's fused activations as limits: none, Relu, Relu6."""


def convert_tflite(data: bytes, outputs: Mapping[str, str], description: str = "") -> bytes:
    """Convert a TFLite file to an ONNX file.

    Args:
        data: The TFLite file.
        outputs: The wanted outputs: TFLite's tensor name to ONNX's output name. What they don't need is left out.
        description: Goes into the ONNX file's metadata.

    Returns:
        The ONNX file. Its input is called ``image``; the batch dimension is free. Weights that float16 holds exactly
        are stored so, which halves the file and changes no result.

    Raises:
        InputError: The file is no TFLite file, or has other operators or outputs (``weights-invalid``).
        ResourceError: The packages ``tflite`` and ``onnx`` are not installed (``package-missing``).
    """
    return convert_graph(read_tflite(data), outputs, description)


def convert_graph(graph: Graph, outputs: Mapping[str, str], description: str = "") -> bytes:
    """Convert a network that was read from a TFLite file; see :func:`convert_tflite`."""
    try:
        import onnx
    except ImportError as error:
        raise ResourceError(
            "Converting the weights needs the package `onnx`.",
            hint="Install it once with: pip install 'gonio[models]'",
            code="package-missing",
        ) from error
    names = {graph.tensors[index].name: index for index in graph.outputs}
    if missing := [name for name in outputs if name not in names]:
        raise _unsupported(f"have no output {', '.join(missing)}; their outputs are {', '.join(names)}")

    net = _Network(onnx, graph)
    for operator in _needed(graph, [names[name] for name in outputs]):
        if operator.kind not in CONVERTERS:
            raise _unsupported(f"use the operator {operator.kind}")
        CONVERTERS[operator.kind](net, operator)
    return net.serialize({names[theirs]: ours for theirs, ours in outputs.items()}, description)


class _Network:
    """The ONNX network under construction: nodes and constants, and which ONNX name each TFLite tensor has."""

    def __init__(self, onnx: Any, graph: Graph) -> None:
        self.onnx = onnx
        self.graph = graph
        self.nodes: list[Any] = []
        self.constants: list[Any] = []
        self.values = {i: tensor.value for i, tensor in enumerate(graph.tensors) if tensor.value is not None}
        self.names = {index: self.add("Transpose", ["image"], perm=NCHW) for index in graph.inputs}

    def add(self, kind: str, inputs: list[str], name: str | None = None, **attributes: Any) -> str:
        """Add a node with one output and give the output's name."""
        name = name or f"{kind.lower()}_{len(self.nodes)}"
        self.nodes.append(self.onnx.helper.make_node(kind, inputs, [name], **attributes))
        return name

    def constant(self, value: np.ndarray) -> str:
        """Add a constant; weights as float16 and a cast, which the runtime folds, if that loses nothing."""
        name = f"constant_{len(self.constants)}"
        with np.errstate(over="ignore"):
            half = value.astype(np.float16) if value.dtype == np.float32 and value.size > 1 else None
        exact = half is not None and np.array_equal(half.astype(np.float32), value)
        self.constants.append(self.onnx.numpy_helper.from_array(half if exact else value, name))
        return self.add("Cast", [name], to=self.onnx.TensorProto.FLOAT) if exact else name

    def shape(self, index: int) -> tuple[int, ...]:
        """Give the shape of a TFLite tensor, in TFLite's layout."""
        return self.graph.tensors[index].shape

    def nhwc(self, index: int) -> str:
        """Give a tensor in TFLite's layout."""
        name = self.names[index]
        return self.add("Transpose", [name], perm=NHWC) if len(self.shape(index)) == 4 else name

    def finish(self, operator: Operator, name: str) -> None:
        """Note ``name`` as the result of ``operator``, after its fused activation."""
        activation = operator.options.get("FusedActivationFunction", 0)
        if activation not in ACTIVATIONS:
            raise _unsupported(f"use the fused activation {activation}")
        limits = ACTIVATIONS[activation]
        if limits is not None:
            bounds = ["" if limit is None else self.constant(np.array(limit, dtype=np.float32)) for limit in limits]
            name = self.add("Clip", [name, *bounds])
        self.names[operator.outputs[0]] = name

    def serialize(self, outputs: Mapping[int, str], description: str) -> bytes:
        """Name the outputs and give the file's bytes."""
        make, float32 = self.onnx.helper, self.onnx.TensorProto.FLOAT
        for index, name in outputs.items():
            self.add("Identity", [self.nhwc(index)], name)

        def describe(name: str, index: int) -> Any:
            return make.make_tensor_value_info(name, float32, ["batch", *self.shape(index)[1:]])

        graph = make.make_graph(
            self.nodes,
            "gonio",
            [describe("image", index) for index in self.graph.inputs],
            [describe(name, index) for index, name in outputs.items()],
            self.constants,
        )
        model = make.make_model(
            graph,
            producer_name="gonio",
            doc_string=description,
            ir_version=IR_VERSION,
            opset_imports=[make.make_opsetid("", OPSET)],
        )
        self.onnx.checker.check_model(model)
        return model.SerializeToString()


def _needed(graph: Graph, outputs: list[int]) -> list[Operator]:
    """List the operators that the outputs depend on, in running order."""
    wanted, needed = set(outputs), []
    for operator in reversed(graph.operators):
        if wanted.intersection(operator.outputs):
            wanted.update(operator.inputs)
            needed.append(operator)
    return needed[::-1]


def _same_padding(size: int, kernel: int, stride: int, dilation: int) -> tuple[int, int]:
    """Give TensorFlow's SAME padding along one axis: ceil(size / stride) cells come out, an odd cell goes behind."""
    extent = (kernel - 1) * dilation + 1
    total = max((-(-size // stride) - 1) * stride + extent - size, 0)
    return total // 2, total - total // 2


def _window(net: _Network, operator: Operator, kernel: tuple[int, int]) -> dict[str, Any]:
    """Give the attributes that convolution and pooling share."""
    options = operator.options
    strides = options["StrideH"], options["StrideW"]
    dilations = options.get("DilationHFactor", 1), options.get("DilationWFactor", 1)
    pads = [(0, 0), (0, 0)]
    if options["Padding"] == PADDING_SAME:
        sizes = net.shape(operator.inputs[0])[1:3]
        pads = [_same_padding(*axis) for axis in zip(sizes, kernel, strides, dilations, strict=True)]
    (top, bottom), (left, right) = pads
    return {
        "kernel_shape": kernel,
        "strides": strides,
        "dilations": dilations,
        "pads": (top, left, bottom, right),
    }


def _convolution(net: _Network, operator: Operator) -> None:
    source, weights, bias = operator.inputs
    kernel = net.values[weights]  # (out, height, width, in); depthwise: (1, height, width, out)
    depthwise = operator.kind == "DEPTHWISE_CONV_2D"
    inputs = [
        net.names[source],
        net.constant(np.ascontiguousarray(kernel.transpose((3, 0, 1, 2) if depthwise else NCHW))),
        net.constant(net.values[bias]),
    ]
    group = net.shape(source)[3] if depthwise else 1
    net.finish(operator, net.add("Conv", inputs, group=group, **_window(net, operator, kernel.shape[1:3])))


def _max_pool(net: _Network, operator: Operator) -> None:
    window = _window(net, operator, (operator.options["FilterHeight"], operator.options["FilterWidth"]))
    net.finish(operator, net.add("MaxPool", [net.names[operator.inputs[0]]], **window))


def _add(net: _Network, operator: Operator) -> None:
    net.finish(operator, net.add("Add", [net.names[index] for index in operator.inputs]))


def _pad(net: _Network, operator: Operator) -> None:
    source, amounts = operator.inputs
    before, after = net.values[amounts][list(NCHW)].T
    pads = net.constant(np.concatenate([before, after]).astype(np.int64))
    net.finish(operator, net.add("Pad", [net.names[source], pads]))


def _resize(net: _Network, operator: Operator) -> None:
    if operator.options["AlignCorners"] or not operator.options["HalfPixelCenters"]:
        raise _unsupported("resize by other pixels than half-pixel centres")
    source, target = operator.inputs[0], operator.outputs[0]
    factors = np.divide(net.shape(target), net.shape(source))[list(NCHW)]
    inputs = [net.names[source], "", net.constant(factors.astype(np.float32))]
    net.finish(operator, net.add("Resize", inputs, mode="linear", coordinate_transformation_mode="half_pixel"))


def _depth_to_space(net: _Network, operator: Operator) -> None:
    size = operator.options["BlockSize"]
    net.finish(operator, net.add("DepthToSpace", [net.names[operator.inputs[0]]], blocksize=size, mode="DCR"))


def _reshape(net: _Network, operator: Operator) -> None:
    source, target = operator.inputs[0], operator.outputs[0]
    if len(net.shape(target)) == 4:
        raise _unsupported("reshape to four dimensions")
    shape = net.constant(np.array([0, *net.shape(target)[1:]], dtype=np.int64))  # 0 keeps the batch dimension
    net.finish(operator, net.add("Reshape", [net.nhwc(source), shape]))


def _sigmoid(net: _Network, operator: Operator) -> None:
    net.finish(operator, net.add("Sigmoid", [net.names[operator.inputs[0]]]))


def _concatenate(net: _Network, operator: Operator) -> None:
    axis, rank = operator.options["Axis"], len(net.shape(operator.outputs[0]))
    axis = NCHW.index(axis % rank) if rank == 4 else axis
    net.finish(operator, net.add("Concat", [net.names[index] for index in operator.inputs], axis=axis))


def _unpack_constant(net: _Network, operator: Operator) -> None:
    """Dequantize float16, or densify: the reader has already made sparse constants dense."""
    value = net.values.get(operator.inputs[0])
    if value is None or value.dtype.kind != "f":
        raise _unsupported("quantize more than their float16 constants")
    net.values[operator.outputs[0]] = value.astype(np.float32)


CONVERTERS: Mapping[str, Callable[[_Network, Operator], None]] = {
    "ADD": _add,
    "CONCATENATION": _concatenate,
    "CONV_2D": _convolution,
    "DENSIFY": _unpack_constant,
    "DEPTHWISE_CONV_2D": _convolution,
    "DEPTH_TO_SPACE": _depth_to_space,
    "DEQUANTIZE": _unpack_constant,
    "LOGISTIC": _sigmoid,
    "MAX_POOL_2D": _max_pool,
    "PAD": _pad,
    "RESHAPE": _reshape,
    "RESIZE_BILINEAR": _resize,
}


def _unsupported(what: str) -> InputError:
    return InputError(
        f"These weights {what}; gonio's converter does not know that.",
        hint="Use the weights that the model card names.",
        code="weights-invalid",
    )
