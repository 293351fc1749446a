"""Locks that the kernel drops when their owner dies, however it dies: they tell a live process from a dead one."""

import fcntl
import os
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import quote, unquote


class Locks:
    """Named locks among the processes of one machine: files in a folder on a local disk (never on NFS)."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    @contextmanager
    def hold(self, name: str) -> Generator[None]:
        """Wait for a lock and hold it."""
        with self._path(name).open("a") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield

    @contextmanager
    def try_hold(self, name: str) -> Generator[bool]:
        """Hold a lock if nobody else does, and say so: its owner is dead then. Afterwards the name is forgotten."""
        with self._path(name).open("a") as file:
            free = _try_lock(file.fileno())
            yield free
            if free:
                self._path(name).unlink(missing_ok=True)

    def names(self) -> list[str]:
        """List the locks that somebody holds or held."""
        return [unquote(path.stem) for path in self._folder.glob("*.lock")]

    def _path(self, name: str) -> Path:
        return self._folder / f"{quote(name, safe='')}.lock"


@contextmanager
def hold_folder(folder: Path) -> Generator[None]:
    """Wait for a lock on a folder itself, and hold it."""
    with _opened(folder) as descriptor:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield


@contextmanager
def try_hold_folder(folder: Path) -> Generator[bool]:
    """Hold a lock on a folder itself if nobody else does, and say so.

    Raises:
        FileNotFoundError: There is no such folder any more.
    """
    with _opened(folder) as descriptor:
        yield _try_lock(descriptor)


@contextmanager
def _opened(folder: Path) -> Generator[int]:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def _try_lock(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
