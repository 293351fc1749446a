"""Videos made on the spot, networks small enough to read, and the real weights where they have been fetched."""

from collections.abc import Callable, Sequence
from pathlib import Path

import flatbuffers
import numpy as np
import pytest
import tflite

from gonio.vision.model_cards import load_card
from gonio.vision.weights import cached_weights


@pytest.fixture(scope="session")
def tiny_tflite() -> bytes:
    """A TFLite file: a 1 × 1 convolution of three channels to two with float16 weights and Relu6, 4 × 4 pixels.

    Output channel 0 is red, channel 1 is 8 times green minus 1.
    """
    build = flatbuffers.Builder(0)
    weights = np.array([[1, 0, 0], [0, 8, 0]], np.float16).tobytes()
    bias = np.array([0, -1], np.float32).tobytes()
    buffers = [_table(build, "Buffer", data=build.CreateByteVector(data)) for data in (b"", weights, bias)]
    half, full = tflite.TensorType.FLOAT16, tflite.TensorType.FLOAT32
    tensors = [
        _tensor(build, "image", [1, 4, 4, 3], full, 0),
        _tensor(build, "half", [2, 1, 1, 3], half, 1),
        _tensor(build, "weights", [2, 1, 1, 3], full, 0),
        _tensor(build, "bias", [2], full, 2),
        _tensor(build, "Identity", [1, 4, 4, 2], full, 0),
    ]
    options = _table(build, "Conv2DOptions", strideW=1, strideH=1, fusedActivationFunction=3)
    operators = [
        _table(build, "Operator", opcodeIndex=0, inputs=_ints(build, [1]), outputs=_ints(build, [2])),
        _table(
            build, "Operator", opcodeIndex=1, inputs=_ints(build, [0, 2, 3]), outputs=_ints(build, [4]),
            builtinOptionsType=tflite.BuiltinOptions.Conv2DOptions, builtinOptions=options,
        ),
    ]  # fmt: skip
    graph = _table(
        build, "SubGraph", tensors=_offsets(build, tensors), inputs=_ints(build, [0]), outputs=_ints(build, [4]),
        operators=_offsets(build, operators),
    )  # fmt: skip
    kinds = tflite.BuiltinOperator.DEQUANTIZE, tflite.BuiltinOperator.CONV_2D
    codes = [_table(build, "OperatorCode", deprecatedBuiltinCode=kind, builtinCode=kind) for kind in kinds]
    model = _table(
        build, "Model", version=3, operatorCodes=_offsets(build, codes), subgraphs=_offsets(build, [graph]),
        buffers=_offsets(build, buffers),
    )  # fmt: skip
    build.Finish(model, b"TFL3")
    return bytes(build.Output())


def _table(build: flatbuffers.Builder, kind: str, **fields: int) -> int:
    getattr(tflite, f"{kind}Start")(build)
    for name, value in fields.items():
        getattr(tflite, f"{kind}Add{name[0].upper()}{name[1:]}")(build, value)
    return getattr(tflite, f"{kind}End")(build)


def _tensor(build: flatbuffers.Builder, name: str, shape: Sequence[int], kind: int, buffer: int) -> int:
    text, dimensions = build.CreateString(name), _ints(build, shape)
    return _table(build, "Tensor", name=text, shape=dimensions, type=kind, buffer=buffer)


def _ints(build: flatbuffers.Builder, values: Sequence[int]) -> int:
    return build.CreateNumpyVector(np.array(values, np.int32))


def _offsets(build: flatbuffers.Builder, offsets: Sequence[int]) -> int:
    build.StartVector(4, len(offsets), 4)
    for offset in reversed(offsets):
        build.PrependUOffsetTRelative(offset)
    return build.EndVector()


@pytest.fixture(scope="session")
def real_weights() -> Callable[[str], Path]:
    """Gives the fetched weights of a model; skips where they have not been fetched."""

    def path_of(name: str) -> Path:
        path = cached_weights(load_card(name))
        if path is None:
            pytest.skip(f"the weights of {name} are not in the cache (gonio models fetch {name})")
        return path

    return path_of
