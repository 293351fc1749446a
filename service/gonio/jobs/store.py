"""The artefact store: files and results under keys, each written whole or not at all, in a folder or in a bucket."""

import hashlib
import os
import tempfile
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import obstore
from obstore.store import LocalStore, MemoryStore, S3Store, from_url

from gonio.errors import GonioError

CHUNK = 1 << 20


class Stored(NamedTuple):
    """What is stored under a key."""

    key: str
    sha256: str
    size: int


class Store:
    """Objects under keys such as ``labs/<lab>/sessions/<session>/files/<file>``."""

    def __init__(self, objects: LocalStore | MemoryStore | S3Store, folder: Path | None = None) -> None:
        self._objects = objects
        self._folder = folder

    @classmethod
    def open(cls, url: str) -> "Store":
        """Open the store at a URL (``file:///folder``, ``s3://bucket/prefix``); a folder is made if it isn't there."""
        if url.startswith("file:"):
            objects = LocalStore.from_url(url, mkdir=True, automatic_cleanup=True)
            return cls(objects, objects.prefix)
        objects = from_url(url)
        assert isinstance(objects, (MemoryStore, S3Store))
        return cls(objects)

    def put_bytes(self, prefix: str, name: str, content: bytes) -> Stored:
        """Store bytes below a prefix. The key has their hash in it, so no other content can take their place."""
        sha256 = hashlib.sha256(content).hexdigest()
        key = f"{prefix}/{sha256[:16]}/{name}"
        obstore.put(self._objects, key, content)
        self._settle(key)
        return Stored(key, sha256, len(content))

    def put_file(self, prefix: str, name: str, path: Path) -> Stored:
        """Store a copy of a file, likewise."""
        with path.open("rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        key = f"{prefix}/{sha256[:16]}/{name}"
        obstore.put(self._objects, key, path)
        self._settle(key)
        return Stored(key, sha256, path.stat().st_size)

    def take_file(self, key: str, path: Path) -> None:
        """Store a file that may be moved: in a folder on the same disk no byte of it is copied."""
        if self._folder is not None:
            target = self._folder / key
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                path.rename(target)
            except OSError:  # another disk
                obstore.put(self._objects, key, path)
        else:
            obstore.put(self._objects, key, path)
        path.unlink(missing_ok=True)
        self._settle(key)

    def get_bytes(self, stored: Stored) -> bytes:
        """Read an object whole, and check that it is what was stored.

        Raises:
            GonioError: ``artefact-damaged`` if it is missing or has changed.
        """
        try:
            content = obstore.get(self._objects, stored.key).bytes().to_bytes()
        except FileNotFoundError:
            content = b""
        if hashlib.sha256(content).hexdigest() != stored.sha256:
            raise GonioError(
                "An intermediate result of the analysis is damaged or missing.",
                hint="Start the analysis again. If it happens twice, check the disk.",
                code="artefact-damaged",
                key=stored.key,
            )
        return content

    @contextmanager
    def local_path(self, key: str) -> Generator[Path]:
        """Give a local file with an object's content, for what can only read files; it must not be changed.

        In a folder it is the object itself; from a bucket it is a copy that lives as long as the block.

        Raises:
            FileNotFoundError: There is no such object.
        """
        if self._folder is not None:
            path = self._folder / key
            path.stat()
            yield path
            return
        with tempfile.NamedTemporaryFile(prefix="gonio-") as file:
            for chunk in obstore.get(self._objects, key).stream(CHUNK):
                file.write(chunk)
            file.flush()
            yield Path(file.name)

    def delete(self, prefix: str) -> None:
        """Delete an object, or all objects below a prefix; what isn't there is deleted already."""
        keys = [meta["path"] for page in obstore.list(self._objects, prefix) for meta in page]
        for key in keys or [prefix]:
            try:
                obstore.delete(self._objects, key)
            except FileNotFoundError:
                continue

    def _settle(self, key: str) -> None:
        """Make an object outlive a power cut: a rename is only safe when the file and its folder are on the disk."""
        if self._folder is None:
            return
        path = self._folder / key
        for place in (path, path.parent):
            descriptor = os.open(place, os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
