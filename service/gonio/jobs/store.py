"""The artefact store: files and results under keys, each written whole or not at all, in a folder or in a bucket."""

import hashlib
import os
import tempfile
from collections.abc import Generator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import NamedTuple

import obstore
from obstore.exceptions import BaseError
from obstore.store import LocalStore, MemoryStore, S3Store, from_url

from gonio.errors import GonioError, InputError, ResourceError

CHUNK = 1 << 20
PATIENCE_S = 10.0
"""How long somebody who waits for an answer waits for a bucket that is out of reach."""


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
    def open(cls, url: str, *, patience_s: float = PATIENCE_S) -> "Store":
        """Open the store at a URL.

        Args:
            url: ``file:///folder``, which is made if it isn't there, or ``s3://bucket/prefix``. The bucket's server, region
                and credentials are taken from the environment (``AWS_ENDPOINT_URL``, ``AWS_REGION``,
                ``AWS_ACCESS_KEY_ID``, ``AWS_SECRET_ACCESS_KEY``), as other programs do.
            patience_s: How long requests to a bucket that is out of reach are tried again.

        Raises:
            InputError: ``store-unsupported``.
        """
        if url.startswith("file:"):
            objects = LocalStore.from_url(url, mkdir=True, automatic_cleanup=True)
            return cls(objects, objects.prefix)
        if not url.startswith("s3://"):
            raise InputError(
                f"Files can't be kept at {url}.",
                hint="Leave GONIO_OBJECTS_URL unset, or give it a file:/// or an s3:// URL.",
                code="store-unsupported",
            )
        objects = from_url(
            url,
            client_options={"allow_http": os.environ.get("AWS_ENDPOINT_URL", "").startswith("http:")},
            retry_config={
                "max_retries": 1000,
                "retry_timeout": timedelta(seconds=patience_s),
                "backoff": {"max_backoff": timedelta(seconds=2)},
            },
        )
        assert isinstance(objects, S3Store)
        return cls(objects)

    def put_bytes(self, prefix: str, name: str, content: bytes) -> Stored:
        """Store bytes below a prefix. The key has their hash in it, so no other content can take their place."""
        sha256 = hashlib.sha256(content).hexdigest()
        key = f"{prefix}/{sha256[:16]}/{name}"
        with _telling():
            obstore.put(self._objects, key, content)
        self._settle(key)
        return Stored(key, sha256, len(content))

    def put_file(self, prefix: str, name: str, path: Path) -> Stored:
        """Store a copy of a file, likewise."""
        with path.open("rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        key = f"{prefix}/{sha256[:16]}/{name}"
        with _telling():
            obstore.put(self._objects, key, path)
        self._settle(key)
        return Stored(key, sha256, path.stat().st_size)

    def take_file(self, key: str, path: Path) -> None:
        """Store a file that may be moved: in a folder on the same disk no byte of it is copied."""
        target = None if self._folder is None else self._folder / key
        with _telling():
            if target is None:
                obstore.put(self._objects, key, path)
            else:
                target.parent.mkdir(parents=True, exist_ok=True)
                try:
                    path.rename(target)
                except OSError:  # another disk
                    obstore.put(self._objects, key, path)
        path.unlink(missing_ok=True)
        self._settle(key)

    def get_bytes(self, stored: Stored) -> bytes:
        """Read an object whole, and check that it is what was stored.

        Raises:
            GonioError: ``artefact-damaged`` if it is missing or has changed.
        """
        try:
            with _telling():
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
    def local_path(self, key: str, folder: Path | None = None) -> Generator[Path]:
        """Give a local file with an object's content, for what can only read files; it must not be changed.

        In a folder it is the object itself; from a bucket it is a copy that lives as long as the block, in ``folder``, where
        one is given: a process that is killed leaves it there.

        Raises:
            GonioError: ``content-missing``: it was removed from the folder or bucket by somebody else.
        """
        if self._folder is not None:
            path = self._folder / key
            if not path.is_file():
                raise _missing(key)
            yield path
            return
        with tempfile.NamedTemporaryFile(prefix="gonio-", dir=folder) as file:
            try:
                with _telling():
                    for chunk in obstore.get(self._objects, key).stream(CHUNK):
                        file.write(chunk)
            except FileNotFoundError as error:
                raise _missing(key) from error
            file.flush()
            yield Path(file.name)

    def delete(self, prefix: str) -> None:
        """Delete an object, or all objects below a prefix; what isn't there is deleted already."""
        with _telling():
            keys = [meta["path"] for page in obstore.list(self._objects, prefix) for meta in page]
            for key in keys or [prefix]:
                try:
                    obstore.delete(self._objects, key)
                except FileNotFoundError:
                    continue

    def is_there(self, prefix: str) -> bool:
        """Tell whether there is anything below a prefix."""
        with _telling():
            return any(page for page in obstore.list(self._objects, prefix))

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


def _missing(key: str) -> GonioError:
    return GonioError(
        "The content of this file is no longer in the store, though the database knows the file.",
        hint="Somebody removed it there, or the store was restored to an older state than the database: restore both alike.",
        code="content-missing",
        key=key,
    )


@contextmanager
def _telling() -> Generator[None]:
    """Tell in gonio's words that the store can't be used."""
    try:
        yield
    except FileNotFoundError:
        raise
    except (BaseError, OSError) as error:
        if "os error 28" in str(error) or "No space left" in str(error):
            raise disk_full() from error
        raise store_unreachable() from error


def store_unreachable() -> ResourceError:
    """Say that files can't be kept or read."""
    return ResourceError(
        "The store of files and results can't be used at the moment.",
        hint="Try again in a minute; whoever runs the service finds the reason in its log.",
        code="store-unreachable",
    )


def disk_full() -> ResourceError:
    """Say that there is no room."""
    return ResourceError(
        "The disk of the service is nearly full.",
        hint="Delete sessions that are no longer needed, or make room on the disk of GONIO_DATA_DIR.",
        code="disk-full",
    )
