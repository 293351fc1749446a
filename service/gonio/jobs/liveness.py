"""Locks that vanish when their owner dies, however it dies: they tell a live process from a dead one.

On one machine the kernel keeps them, on several PostgreSQL does.
"""

import fcntl
import os
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol
from urllib.parse import quote, unquote

from gonio.jobs.postgres import ServerLocks, is_postgres
from gonio.settings import Settings


class Locks(Protocol):
    """Named locks."""

    @contextmanager
    def hold(self, name: str) -> Generator[None]:
        """Wait for a lock and hold it."""
        ...

    @contextmanager
    def try_hold(self, name: str) -> Generator[bool]:
        """Hold a lock if nobody else does, and say so: its owner is dead then. Afterwards the name is forgotten."""
        ...

    def names(self) -> list[str]:
        """List the locks that may still have to be forgotten."""
        ...

    def renew(self) -> bool:
        """Take again what an outage of the database took away, and tell whether there was one."""
        ...


def open_locks(settings: Settings) -> Locks:
    """Give the locks among all processes that share a database."""
    if is_postgres(settings.resolved_database_url):
        return ServerLocks(settings.resolved_database_url)
    return FileLocks(settings.data_dir / "locks")


class FileLocks:
    """Locks among the processes of one machine: files in a folder on a local disk (never on NFS)."""

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
        """Hold a lock if nobody else does, and say so. Afterwards its file is gone."""
        with self._path(name).open("a") as file:
            free = _try_lock(file.fileno())
            yield free
            if free:
                self._path(name).unlink(missing_ok=True)

    def names(self) -> list[str]:
        """List the locks that somebody holds or held."""
        return [unquote(path.stem) for path in self._folder.glob("*.lock")]

    def renew(self) -> bool:
        """Do nothing: the kernel takes no lock away from a living process."""
        return False

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
