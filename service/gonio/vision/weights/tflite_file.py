# ruff: noqa: ANN401
# pyright: standard
# (The `tflite` package is generated and has no types: its objects are Any here.)
"""Read a TFLite file into plain tuples and numpy arrays.

Only what a float network in one subgraph needs: no quantized arithmetic, no control flow. The format is described in
``tensorflow/lite/schema/schema.fbs``; the ``tflite`` package is its generated reader and is imported when it is needed,
because an installed service with cached weights never needs it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import numpy as np

from gonio.errors import InputError, ResourceError

OPTIONS = {
    "ADD": ("AddOptions", "FusedActivationFunction"),
    "CONCATENATION": ("ConcatenationOptions", "Axis FusedActivationFunction"),
    "CONV_2D": (
        "Conv2DOptions",
        "Padding StrideH StrideW DilationHFactor DilationWFactor FusedActivationFunction",
    ),
    "DEPTHWISE_CONV_2D": (
        "DepthwiseConv2DOptions",
        "Padding StrideH StrideW DilationHFactor DilationWFactor FusedActivationFunction",
    ),
    "DEPTH_TO_SPACE": ("DepthToSpaceOptions", "BlockSize"),
    "MAX_POOL_2D": ("Pool2DOptions", "Padding StrideH StrideW FilterHeight FilterWidth FusedActivationFunction"),
    "RESIZE_BILINEAR": ("ResizeBilinearOptions", "AlignCorners HalfPixelCenters"),
}
"""For each operator with options, the options' table in the schema and its entries that matter here."""


Level = int | tuple[np.ndarray, np.ndarray]
"""One level of a sparse tensor: the size of a dense one, or the segments and indices of a compressed one."""


@dataclass(frozen=True)
class Tensor:
    """A tensor: its name and shape, and its value if it is a constant (a sparse one is already made dense)."""

    name: str
    shape: tuple[int, ...]
    value: np.ndarray | None = None


@dataclass(frozen=True)
class Operator:
    """An operator: its kind by the schema's name, tensors by index, and options by the schema's names."""

    kind: str
    inputs: tuple[int, ...]
    outputs: tuple[int, ...]
    options: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class Graph:
    """A network: tensors, and the operators in the order in which they run."""

    tensors: tuple[Tensor, ...]
    operators: tuple[Operator, ...]
    inputs: tuple[int, ...]
    outputs: tuple[int, ...]


def read_tflite(data: bytes) -> Graph:
    """Read a TFLite file's first subgraph.

    Raises:
        InputError: This is no TFLite file (``weights-invalid``).
        ResourceError: The ``tflite`` package is not installed (``package-missing``).
    """
    tflite = _tflite()
    if data[4:8] != b"TFL3":
        raise InputError(
            "These weights are no TFLite file: the identifier TFL3 is missing at byte 4.",
            hint="Give the .tflite file itself, or the package that contains it.",
            code="weights-invalid",
        )
    model = tflite.Model.GetRootAs(data, 0)
    graph = model.Subgraphs(0)
    return Graph(
        tensors=tuple(_read_tensor(tflite, model, graph.Tensors(i)) for i in range(graph.TensorsLength())),
        operators=tuple(_read_operator(tflite, model, graph.Operators(i)) for i in range(graph.OperatorsLength())),
        inputs=tuple(graph.InputsAsNumpy().tolist()),
        outputs=tuple(graph.OutputsAsNumpy().tolist()),
    )


def densify(values: np.ndarray, shape: Sequence[int], order: Sequence[int], levels: Sequence[Level]) -> np.ndarray:
    """Make a sparse tensor dense.

    TFLite stores a sparse tensor as a tree with one level per dimension, in the given order. A level is dense (its
    size) or compressed (segments and indices, as in a CSR matrix: the children of node ``i`` are
    ``indices[segments[i]:segments[i + 1]]``).

    Args:
        values: The stored elements, in walking order.
        shape: The dense shape.
        order: For each level, the dimension that it walks.
        levels: For each level, its size or its segments and indices.
    """
    path = np.zeros((1, 0), dtype=np.intp)  # (node, level): the index at each level on the way to the node
    for level in levels:
        if isinstance(level, int):
            counts, step = level, np.tile(np.arange(level), len(path))
        else:
            segments, step = level
            counts = np.diff(segments)
        path = np.column_stack([np.repeat(path, counts, axis=0), step])
    dense = np.zeros(shape, dtype=values.dtype)
    dense[tuple(path[:, order.index(dimension)] for dimension in range(len(shape)))] = values
    return dense


def _tflite() -> ModuleType:
    try:
        import tflite
    except ImportError as error:
        raise ResourceError(
            "Converting the weights needs the package `tflite`.",
            hint="Install it once with: pip install 'gonio[models]'",
            code="package-missing",
        ) from error
    return tflite


def _read_operator(tflite: ModuleType, model: Any, operator: Any) -> Operator:
    code = model.OperatorCodes(operator.OpcodeIndex())
    # Files older than the 128th operator keep its number in the deprecated field.
    kind = tflite.opcode2name(max(code.BuiltinCode(), code.DeprecatedBuiltinCode()))
    options = {}
    if kind in OPTIONS and operator.BuiltinOptions() is not None:
        table_name, entries = OPTIONS[kind]
        table, raw = getattr(tflite, table_name)(), operator.BuiltinOptions()
        table.Init(raw.Bytes, raw.Pos)
        options = {entry: int(getattr(table, entry)()) for entry in entries.split()}
    return Operator(kind, tuple(operator.InputsAsNumpy().tolist()), tuple(operator.OutputsAsNumpy().tolist()), options)


def _read_tensor(tflite: ModuleType, model: Any, tensor: Any) -> Tensor:
    name, buffer = tensor.Name().decode(), model.Buffers(tensor.Buffer())
    shape = tuple(tensor.ShapeAsNumpy().tolist()) if tensor.ShapeLength() else ()
    if not buffer.DataLength():
        return Tensor(name, shape)
    dtypes = {tflite.TensorType.FLOAT32: "<f4", tflite.TensorType.FLOAT16: "<f2", tflite.TensorType.INT32: "<i4"}
    if tensor.Type() not in dtypes:
        raise InputError(
            f"The constant {name} of these weights has the type {tensor.Type()}, which gonio does not read.",
            hint="Use a float network: quantized ones are not supported.",
            code="weights-invalid",
        )
    values = np.frombuffer(buffer.DataAsNumpy().tobytes(), dtype=dtypes[tensor.Type()])
    sparsity = tensor.Sparsity()
    if sparsity is None:
        return Tensor(name, shape, values.reshape(shape))
    if sparsity.BlockMapLength():
        raise InputError(
            f"The constant {name} of these weights is sparse in blocks, which gonio does not read.",
            hint="Use the weights that the model card names.",
            code="weights-invalid",
        )
    levels = [_read_level(tflite, sparsity.DimMetadata(i)) for i in range(sparsity.DimMetadataLength())]
    return Tensor(name, shape, densify(values, shape, sparsity.TraversalOrderAsNumpy().tolist(), levels))


def _read_level(tflite: ModuleType, metadata: Any) -> Level:
    if metadata.Format() == tflite.DimensionType.DENSE:
        return metadata.DenseSize()
    return (
        _read_vector(tflite, metadata.ArraySegmentsType(), metadata.ArraySegments()),
        _read_vector(tflite, metadata.ArrayIndicesType(), metadata.ArrayIndices()),
    )


def _read_vector(tflite: ModuleType, kind: int, table: Any) -> np.ndarray:
    kinds = {
        tflite.SparseIndexVector.Int32Vector: tflite.Int32Vector,
        tflite.SparseIndexVector.Uint16Vector: tflite.Uint16Vector,
        tflite.SparseIndexVector.Uint8Vector: tflite.Uint8Vector,
    }
    vector = kinds[kind]()
    vector.Init(table.Bytes, table.Pos)
    return vector.ValuesAsNumpy().astype(np.intp)
