"""Where uploads grow: a file that isn't whole yet is nobody's, and vanishes with its sender or its server."""

import hashlib
import shutil
from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from uuid import uuid4

from gonio.errors import InputError
from gonio.jobs.liveness import hold_folder, try_hold_folder
from gonio.jobs.store import disk_full


class Spool:
    """The folder of the uploads of all server processes of this machine.

    Each upload has a folder of its own, locked while it grows: one that is unlocked has lost its server.
    """

    def __init__(self, folder: Path, *, limit: int, free_disk_floor: int) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.limit = limit
        self._folder = folder
        self._floor = free_disk_floor

    @contextmanager
    def receive(self, name: str) -> Generator["Incoming"]:
        """Receive a file under a name that was checked; after the block nothing is left that wasn't moved away."""
        folder = self._folder / uuid4().hex
        with ExitStack() as stack:
            with hold_folder(self._folder):  # or a sweep could come between the making and the locking
                folder.mkdir()
                stack.enter_context(try_hold_folder(folder))
            stack.callback(shutil.rmtree, folder)
            incoming = Incoming(folder / name, self)
            stack.callback(incoming.close)
            yield incoming

    def check_room(self, size: int) -> None:
        """Refuse bytes that would take the disk below its floor.

        Raises:
            ResourceError: ``disk-full``.
        """
        if shutil.disk_usage(self._folder).free - size < self._floor:
            raise disk_full()

    def check_size(self, size: int) -> None:
        """Refuse a file that is larger than the limit.

        Raises:
            InputError: ``file-too-large``.
        """
        if size > self.limit:
            raise InputError(
                f"The file is larger than the limit of {self.limit} bytes.",
                hint="Cut or compress the recording, or raise GONIO_MAX_UPLOAD_BYTES.",
                code="file-too-large",
            )

    def sweep(self) -> None:
        """Remove the uploads whose server died."""
        with hold_folder(self._folder):
            for folder in self._folder.iterdir():
                try:
                    with try_hold_folder(folder) as dead:
                        if dead:
                            shutil.rmtree(folder)
                except FileNotFoundError:  # it ended by itself just now
                    continue


class Incoming:
    """A file that is being received: written piece by piece, hashed on the way."""

    def __init__(self, path: Path, spool: Spool) -> None:
        self.path = path
        self.size = 0
        self._spool = spool
        self._hash = hashlib.sha256()
        self._file = path.open("xb")

    @property
    def name(self) -> str:
        """The name that its owner gave it."""
        return self.path.name

    @property
    def sha256(self) -> str:
        """The hash of what was received so far."""
        return self._hash.hexdigest()

    def write(self, chunk: bytes) -> None:
        """Take the next bytes.

        Raises:
            InputError: ``file-too-large``.
            ResourceError: ``disk-full``, when the disk is at its floor.
            OSError: It is full, or fails.
        """
        self.size += len(chunk)
        self._spool.check_size(self.size)
        self._spool.check_room(len(chunk))
        self._file.write(chunk)
        self._file.flush()  # so that a full disk is noticed here, and the probe sees all
        self._hash.update(chunk)

    def close(self) -> None:
        """Close the file."""
        self._file.close()
