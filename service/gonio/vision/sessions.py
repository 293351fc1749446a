# pyright: standard
# (onnxruntime ships no types)
"""Run ONNX networks behind a seam that tests can fake."""

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import onnxruntime as ort

from gonio.errors import ResourceError


@runtime_checkable
class InferenceSession(Protocol):
    """A network that is ready to run; safe to call from several threads at once."""

    def run(self, inputs: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Run the network: named arrays in (batch first), named arrays out."""
        ...


class OnnxSession:
    """An ONNX file in onnxruntime, on the processor."""

    def __init__(self, session: ort.InferenceSession) -> None:
        self._session = session
        self._outputs = [output.name for output in session.get_outputs()]

    def run(self, inputs: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Run the network; the interpreter's lock is released meanwhile."""
        arrays = self._session.run(self._outputs, dict(inputs))
        return {name: np.asarray(array) for name, array in zip(self._outputs, arrays, strict=True)}


def open_session(path: Path, threads: int = 1) -> OnnxSession:
    """Open an ONNX file for inference on ``threads`` threads.

    One thread is the best choice when several sessions or callers can be kept busy: two one-thread workers have the
    throughput of one two-thread worker, and less trouble. Threads that wait do not spin: on a shared machine, spinning
    doubles the processor time per crop (87 against 44 ms) and makes everyone slower.

    Raises:
        ResourceError: The file is missing or is no ONNX file (``weights-invalid``).
    """
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 3  # errors only: they come as exceptions too
    try:
        session = ort.InferenceSession(os.fspath(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime has no common class for its errors
        raise ResourceError(
            f"The network {path.name} can't be opened: {str(error).splitlines()[0]}",
            hint=f"Delete {path} and run `gonio models fetch`.",
            code="weights-invalid",
        ) from error
    return OnnxSession(session)


def available_cores() -> int:
    """Count the cores that this process may use: its affinity, and its container's quota (cgroup 2), rounded up."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text(encoding="ascii").split()
    except (OSError, ValueError):
        return cores
    return cores if quota == "max" else max(1, min(cores, math.ceil(int(quota) / int(period))))
