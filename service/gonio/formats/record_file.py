"""Records in a file and back, exactly: an ``.npz`` whose ``document`` is JSON and whose other members are its arrays.

Kept are records (any dataclass), tuples, lists, dicts, str, int, float, bool, None, paths, enums, numpy scalars and
numpy arrays: values, types, NaN and infinities. The same value always gives the same bytes, so their hash names it.
A path below ``root`` is stored relative to it, so a record that names files stays true when its folder moves.

Unlike a pickle, a file can't run code: only classes are looked up, they must be dataclasses or enums, and modules are
imported from gonio alone.
"""

import importlib
import json
import math
import sys
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import IO, Any, Literal
from zipfile import BadZipFile

import numpy as np

from gonio.errors import InputError

KIND = "$"
"""The key that marks a JSON object as something JSON has no word for; a dict is itself one of those."""


def write_record(file: Path | IO[bytes], value: object, root: Path | None = None) -> None:
    """Write a value.

    Raises:
        TypeError: The value holds something that a record file can't; the message says where.
    """
    encoder = _Encoder(root)
    document = json.dumps(encoder.encode(value, "value"), allow_nan=False).encode()
    with _opened(file, "wb") as out:
        np.savez(out, allow_pickle=False, document=np.frombuffer(document, dtype=np.uint8), **encoder.arrays)


def read_record(file: Path | IO[bytes], root: Path | None = None) -> Any:  # noqa: ANN401 - whatever was written
    """Read what :func:`write_record` wrote; ``root`` replaces the folder that was its root then.

    Raises:
        InputError: The file is damaged, or its records are of another version of gonio.
    """
    try:
        with _opened(file, "rb") as source, np.load(source, allow_pickle=False) as members:
            document = json.loads(members["document"].tobytes())
            return _Decoder(members, root).decode(document)
    except (OSError, EOFError, BadZipFile, KeyError, ValueError, TypeError, AttributeError, ImportError) as error:
        raise InputError(
            f"A record file can't be read: {type(error).__name__}.",
            hint="It is damaged or of another version of gonio. Run the analysis again.",
            code="record-unreadable",
        ) from error


def _opened(file: Path | IO[bytes], mode: Literal["rb", "wb"]) -> AbstractContextManager[IO[bytes]]:
    """Open a path: given one, numpy would add a suffix when it writes and leave the file open when it can't read."""
    return file.open(mode) if isinstance(file, Path) else nullcontext(file)


class _Encoder:
    def __init__(self, root: Path | None) -> None:
        self.arrays: dict[str, np.ndarray] = {}
        self._root = root

    def encode(self, value: object, where: str) -> Any:  # noqa: ANN401 - JSON
        # Enums and numpy scalars first: some of them are also a str, an int or a float.
        if isinstance(value, Enum):
            return {KIND: "enum", "class": _class_name(type(value), where), "name": value.name}
        if type(value) is np.ndarray or isinstance(value, np.generic):
            return self._encode_array(value, where)
        if value is None or isinstance(value, (bool, int, str)):
            return value
        if isinstance(value, float):
            return value if math.isfinite(value) else {KIND: "float", "value": str(value)}
        if isinstance(value, Path):
            return self._encode_path(value)
        return self._encode_container(value, where)

    def _encode_array(self, value: np.ndarray | np.generic, where: str) -> dict[str, str]:
        if value.dtype.hasobject:
            raise TypeError(f"{where} is an array of Python objects; a record file holds numbers.")
        name = f"a{len(self.arrays)}"
        self.arrays[name] = np.asarray(value)
        return {KIND: "array" if isinstance(value, np.ndarray) else "scalar", "name": name}

    def _encode_path(self, value: Path) -> dict[str, str]:
        if self._root is not None and value.is_relative_to(self._root):
            return {KIND: "path", "below": value.relative_to(self._root).as_posix()}
        return {KIND: "path", "path": str(value)}

    def _encode_container(self, value: object, where: str) -> Any:  # noqa: ANN401 - JSON
        if type(value) is list:
            return [self.encode(item, f"{where}[{i}]") for i, item in enumerate(value)]
        if type(value) is tuple:
            return {KIND: "tuple", "items": [self.encode(item, f"{where}[{i}]") for i, item in enumerate(value)]}
        if type(value) is dict:
            return {
                KIND: "dict",
                "items": [
                    [self.encode(k, f"{where} key"), self.encode(v, f"{where}[{k!r}]")] for k, v in value.items()
                ],
            }
        if is_dataclass(value) and not isinstance(value, type):
            members = {
                f.name: self.encode(getattr(value, f.name), f"{where}.{f.name}") for f in fields(value) if f.init
            }
            return {KIND: "record", "class": _class_name(type(value), where), "fields": members}
        raise TypeError(f"{where} is a {type(value).__name__}; a record file can't hold that.")


class _Decoder:
    def __init__(self, members: Mapping[str, np.ndarray], root: Path | None) -> None:
        self._members = members
        self._root = root
        self._kinds: dict[str, Callable[[dict[str, Any]], Any]] = {
            "enum": lambda document: _find_class(document["class"])[document["name"]],
            "array": lambda document: self._members[document["name"]],
            "scalar": lambda document: self._members[document["name"]][()],
            "float": lambda document: float(document["value"]),
            "path": self._decode_path,
            "tuple": lambda document: tuple(self.decode(item) for item in document["items"]),
            "dict": lambda document: {self.decode(key): self.decode(item) for key, item in document["items"]},
            "record": self._decode_record,
        }

    def decode(self, document: Any) -> Any:  # noqa: ANN401 - JSON
        if isinstance(document, list):
            return [self.decode(item) for item in document]
        if isinstance(document, dict):
            return self._kinds[document[KIND]](document)
        return document

    def _decode_path(self, document: dict[str, str]) -> Path:
        if "below" not in document:
            return Path(document["path"])
        if self._root is None:
            raise ValueError("A path is relative to a root, and none was given.")
        return self._root / document["below"]

    def _decode_record(self, document: dict[str, Any]) -> Any:  # noqa: ANN401 - any record
        cls = _find_class(document["class"])
        return cls(**{name: self.decode(item) for name, item in document["fields"].items()})


def _class_name(cls: type, where: str) -> str:
    if "<locals>" in cls.__qualname__:
        raise TypeError(f"{where} is a {cls.__qualname__}; a class inside a function can't be found again.")
    return f"{cls.__module__}:{cls.__qualname__}"


def _find_class(name: str) -> Any:  # noqa: ANN401 - a dataclass or an enum
    module_name, _, qualified_name = name.partition(":")
    if module_name == "gonio" or module_name.startswith("gonio."):
        found: Any = importlib.import_module(module_name)
    else:  # a file never causes a foreign module to be imported
        found = sys.modules[module_name]
    for part in qualified_name.split("."):
        found = getattr(found, part)
    if not (isinstance(found, type) and (is_dataclass(found) or issubclass(found, Enum))):
        raise TypeError(f"{name} is neither a dataclass nor an enum.")
    return found
