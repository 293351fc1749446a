"""Uploads that may be cut and gone on with: a file grows on the disk until it is whole, however often its sender is cut.

The offset of an upload is the size of its file. Nothing else counts the bytes, so nothing can disagree with the disk: what a
killed server had written is there when the next one looks.
"""

import base64
import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any
from uuid import uuid4

from gonio.errors import InputError
from gonio.jobs.liveness import hold_folder, try_hold_folder
from gonio.jobs.spool import Spool
from gonio.pipeline.run import Role

CHECKSUMS = ("sha256", "sha1", "md5")
_RECORD = "upload.json"


@dataclass(frozen=True)
class Upload:
    """An upload: whose it is, what it will be, and in the end the file that it became."""

    id: str
    lab: str
    session_id: str
    name: str
    role: Role | None
    camera: str | None
    length: int
    file_id: str | None = None


@dataclass(frozen=True)
class Whole:
    """A file that was received whole."""

    path: Path
    size: int
    sha256: str

    @property
    def name(self) -> str:
        """The name that its owner gave it."""
        return self.path.name


class PartialUploads:
    """The folder of uploads that aren't whole yet, each in a folder of its own that its one sender locks.

    Args:
        folder: Where they are. Server processes on several machines must share it, or each sender must stay with one.
        spool: What limits the size of a file and keeps the disk from filling.
        lifetime_s: An upload to which nothing was added for so long is removed.
    """

    def __init__(self, folder: Path, spool: Spool, lifetime_s: float) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._spool = spool
        self._lifetime_s = lifetime_s

    def create(
        self, lab: str, session_id: str, name: str, role: Role | None, camera: str | None, length: int
    ) -> Upload:
        """Begin an upload under a name that was checked.

        Raises:
            InputError: ``file-too-large``.
            ResourceError: ``disk-full``.
        """
        self._spool.check_size(length)
        self._spool.check_room(length)
        upload = Upload(str(uuid4()), lab, session_id, name, role, camera, length)
        with hold_folder(self._folder):  # or a sweep could come between the making and the writing
            self._content(upload).parent.mkdir(parents=True)
            self._content(upload).touch()
            self._write(upload)
        return upload

    def get(self, lab: str, upload_id: str) -> Upload:
        """Give an upload of a lab.

        Raises:
            InputError: ``not-found``: there is none, it has expired, or it is another lab's.
        """
        try:
            upload = Upload(**json.loads((self._folder / upload_id / _RECORD).read_text()))
        except FileNotFoundError:
            upload = None
        if upload is None or upload.lab != lab or self.expires_at_s(upload) < time.time():
            raise InputError("There is no such upload.", hint="Begin it again: it may have expired.", code="not-found")
        return upload

    def announced(self, lab: str) -> int:
        """Tell how many bytes a lab's uploads will have that aren't whole yet: they count, or a quota could be passed."""
        texts = [text for folder in self._folder.iterdir() if (text := _text(folder / _RECORD))]
        uploads = [Upload(**json.loads(text)) for text in texts]
        return sum(upload.length for upload in uploads if upload.lab == lab and upload.file_id is None)

    def offset(self, upload: Upload) -> int:
        """Tell how many bytes are safely there."""
        return upload.length if upload.file_id else self._size(upload) or 0

    def is_receiving(self, upload: Upload) -> bool:
        """Tell whether bytes are still to come: not to a whole file, nor to one that was taken over to be accepted."""
        size = self._size(upload)
        return not upload.file_id and size is not None and size < upload.length

    def expires_at_s(self, upload: Upload) -> float:
        """Tell when an upload is removed if nothing is added to it, in seconds since 1970."""
        return self._touched_s(self._folder / upload.id) + self._lifetime_s

    @contextmanager
    def locked(self, upload: Upload) -> Generator[None]:
        """Be the only one who changes an upload.

        Raises:
            InputError: ``upload-locked``: somebody else does at the moment; ``not-found``: it was removed just now.
        """
        try:
            with try_hold_folder(self._folder / upload.id) as free:
                if not free:
                    raise InputError(
                        "Another request writes to this upload.",
                        hint="Send one PATCH at a time; ask again in a moment if the other one was cut.",
                        code="upload-locked",
                    )
                yield
        except FileNotFoundError:
            raise InputError("There is no such upload.", hint="Begin it again.", code="not-found") from None

    def extend(self, upload: Upload, offset: int, checksum: str | None) -> "Piece":
        """Take a piece of a locked upload; what was received of it when its sender is cut stays.

        Raises:
            InputError: ``upload-offset-wrong``, or ``upload-header-wrong`` if the checksum can't be read.
        """
        if offset != self.offset(upload):
            raise InputError(
                f"The upload stands at byte {self.offset(upload)}, not at {offset}.",
                hint="Ask with HEAD where it stands, and go on from there.",
                code="upload-offset-wrong",
            )
        return Piece(self._content(upload), offset, upload.length, checksum, self._spool.check_room)

    def whole(self, upload: Upload) -> Whole:
        """Give the content of an upload to which nothing is missing."""
        path = self._content(upload)
        with path.open("rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        return Whole(path, upload.length, sha256)

    def end(self, upload: Upload, file_id: str) -> Upload:
        """Note which file an upload became: whoever missed the answer can ask for it."""
        ended = replace(upload, file_id=file_id)
        self._write(ended)
        self._content(upload).unlink(missing_ok=True)
        return ended

    def delete(self, upload: Upload) -> None:
        """Remove a locked upload."""
        shutil.rmtree(self._folder / upload.id, ignore_errors=True)

    def delete_of_session(self, session_id: str) -> None:
        """Remove the uploads to a session that was deleted."""
        for folder in self._folder.iterdir():
            if f'"{session_id}"' in _text(folder / _RECORD):
                shutil.rmtree(folder, ignore_errors=True)

    def sweep(self) -> None:
        """Remove the uploads that have expired."""
        with hold_folder(self._folder):
            for folder in self._folder.iterdir():
                try:
                    with try_hold_folder(folder) as free:
                        if free and self._touched_s(folder) + self._lifetime_s < time.time():
                            shutil.rmtree(folder)
                except FileNotFoundError:  # it ended by itself just now
                    continue

    def _content(self, upload: Upload) -> Path:
        return self._folder / upload.id / "content" / upload.name

    def _size(self, upload: Upload) -> int | None:
        try:
            return self._content(upload).stat().st_size
        except FileNotFoundError:
            return None

    def _touched_s(self, folder: Path) -> float:
        paths = [folder, *folder.glob("content/*")]
        return max((path.stat().st_mtime for path in paths if path.exists()), default=0.0)

    def _write(self, upload: Upload) -> None:
        path = self._folder / upload.id / _RECORD
        draft = path.with_suffix(".draft")
        with draft.open("w") as file:
            json.dump(asdict(upload), file)
            file.flush()
            os.fsync(file.fileno())
        draft.rename(path)


class Piece:
    """A piece of an upload on its way to the disk; to be closed in any case."""

    def __init__(
        self, path: Path, offset: int, length: int, checksum: str | None, check_room: Callable[[int], None]
    ) -> None:
        self.offset = self._begin = offset
        self._length = length
        self._check_room = check_room
        self._hash, self._expected = _parse_checksum(checksum)
        self._file = path.open("ab")

    def write(self, content: bytes) -> None:
        """Take the next bytes.

        Raises:
            InputError: ``upload-too-long``; then nothing of the piece is kept.
            ResourceError: ``disk-full``, when the disk is at its floor.
            OSError: It is full, or fails.
        """
        if self.offset + len(content) > self._length:
            self._undo()
            raise InputError(
                f"The upload is longer than the {self._length} bytes that were announced.",
                hint="Begin it again with the right Upload-Length.",
                code="upload-too-long",
            )
        self._check_room(len(content))
        self._file.write(content)
        self._file.flush()
        self.offset += len(content)
        if self._hash is not None:
            self._hash.update(content)

    def check(self) -> None:
        """Refuse a piece that isn't what its sender says it is.

        Raises:
            InputError: ``upload-checksum-wrong``; then nothing of the piece is kept.
        """
        if self._hash is not None and self._hash.digest() != self._expected:
            self._undo()
            raise InputError(
                "The piece was damaged on its way: its checksum is another one.",
                hint="Send it again.",
                code="upload-checksum-wrong",
            )

    def close(self) -> None:
        """Make what was received outlive a power cut, before anybody is told that it is there."""
        with self._file:
            os.fsync(self._file.fileno())

    def _undo(self) -> None:
        self._file.truncate(self._begin)


def _parse_checksum(header: str | None) -> tuple[Any, bytes]:
    if header is None:
        return None, b""
    algorithm, _, encoded = header.partition(" ")
    try:
        digest = base64.b64decode(encoded, validate=True)
    except ValueError:
        digest = b""
    if algorithm not in CHECKSUMS or not digest:
        raise InputError(
            "Upload-Checksum can't be read.",
            hint=f"Send an algorithm ({', '.join(CHECKSUMS)}), a space, and the digest in base 64.",
            code="upload-header-wrong",
        )
    return hashlib.new(algorithm, usedforsecurity=False), digest


def _text(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ""
