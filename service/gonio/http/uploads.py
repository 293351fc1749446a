"""Receive a multipart form with one file, straight into the spool: never whole in memory, hashed on the way.

Starlette's own form parser would first fill a temporary file of unlimited size, which would then have to be copied and
read again, and would cut a path off the file's name without a word.
"""

import asyncio
import re
from collections.abc import AsyncGenerator
from contextlib import ExitStack, asynccontextmanager

from fastapi.concurrency import run_in_threadpool
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request

from gonio.errors import InputError
from gonio.jobs.filenames import check_file_name
from gonio.jobs.spool import Incoming, Spool

MAX_FIELD_BYTES = 1000
SILENCE_S = 20.0
"""A sender of whom nothing comes for so long is gone. Its connection may live for hours yet, and with it what it holds."""
_FILE_NAME = re.compile(rb';\s*filename="((?:[^"\\]|\\.)*)"', re.IGNORECASE)


class Form:
    """A form as far as it has been received: its text fields, and its file."""

    def __init__(self, boundary: bytes, spool: Spool, stack: ExitStack) -> None:
        self.fields: dict[str, str] = {}
        self.file: Incoming | None = None
        self.ended = False
        self._spool = spool
        self._stack = stack
        self._header = self._disposition = b""
        self._value = bytearray()
        self._field: str | None = None
        self._parser = MultipartParser(
            boundary,
            {
                "on_part_begin": self._begin_part,
                "on_header_field": self._take_header_name,
                "on_header_value": self._take_header_value,
                "on_header_end": self._end_header,
                "on_headers_finished": self._end_headers,
                "on_part_data": self._take_data,
                "on_part_end": self._end_part,
                "on_end": self._end,
            },
        )

    def feed(self, chunk: bytes) -> None:
        """Take the next bytes of the body."""
        try:
            self._parser.write(chunk)
        except FormParserError as error:
            raise _malformed("The body is no valid multipart form.") from error

    def _begin_part(self) -> None:
        self._disposition = b""
        self._header = b""
        self._value.clear()

    def _take_header_name(self, data: bytes, start: int, end: int) -> None:
        self._header += data[start:end]

    def _take_header_value(self, data: bytes, start: int, end: int) -> None:
        if self._header.lower() == b"content-disposition":
            self._disposition += data[start:end]

    def _end_header(self) -> None:
        self._header = b""

    def _end_headers(self) -> None:
        options = parse_options_header(self._disposition.decode("latin-1"))[1]
        self._field = options.get(b"name", b"").decode("utf-8", "replace")
        if self._field != "file":
            return
        if self.file is not None:
            raise _malformed("The form has two parts named `file`.")
        self.file = self._stack.enter_context(self._spool.receive(_file_name(self._disposition)))

    def _take_data(self, data: bytes, start: int, end: int) -> None:
        if self._field == "file":
            assert self.file is not None
            self.file.write(data[start:end])
            return
        self._value += data[start:end]
        if len(self._value) > MAX_FIELD_BYTES:
            raise _malformed(f"The form field {self._field!r} is longer than {MAX_FIELD_BYTES} bytes.")

    def _end_part(self) -> None:
        if self._field == "file":
            assert self.file is not None
            self.file.close()
        elif self._field is not None:
            self.fields[self._field] = self._value.decode("utf-8", "replace")

    def _end(self) -> None:
        self.ended = True


async def body_of(request: Request) -> AsyncGenerator[bytes]:
    """Give a body as it comes.

    Raises:
        ClientDisconnect: The sender went away in the middle, or fell silent.
    """
    chunks = request.stream()
    while True:
        try:
            async with asyncio.timeout(SILENCE_S):
                chunk = await anext(chunks)
        except StopAsyncIteration:
            return
        except TimeoutError:
            raise ClientDisconnect from None
        yield chunk


@asynccontextmanager
async def receive_form(request: Request, spool: Spool) -> AsyncGenerator[Form]:
    """Receive a form to its end; after the block, nothing is left of a file that wasn't accepted.

    Raises:
        HTTPException: 415 if the body is no form.
        InputError: ``malformed-body``, ``upload-truncated``, ``file-missing``, ``bad-file-name``, ``file-too-large``.
        ResourceError: ``disk-full``.
        ClientDisconnect: The sender went away in the middle, or fell silent.
    """
    media_type, options = parse_options_header(request.headers.get("content-type"))
    if media_type != b"multipart/form-data":
        raise HTTPException(415)
    if b"boundary" not in options:
        raise _malformed("The form has no boundary.")
    announced = int(request.headers.get("content-length", 0))
    spool.check_size(announced - _OVERHEAD)
    spool.check_room(announced)
    with ExitStack() as stack:
        form = Form(options[b"boundary"], spool, stack)
        async for chunk in body_of(request):
            await run_in_threadpool(form.feed, chunk)
        if not form.ended:
            raise InputError(
                "The upload ended before the file did; nothing was kept.",
                hint="Send it again.",
                code="upload-truncated",
            )
        if form.file is None:
            raise InputError(
                "The form has no part `file`.",
                hint="Send it as multipart/form-data, like `curl -F file=@cam01.mp4`.",
                code="file-missing",
            )
        yield form


_OVERHEAD = 10_000
"""What a form may have beside its file: headers, boundaries, the other fields."""


def _file_name(disposition: bytes) -> str:
    """Give the name exactly as it was sent: the form library drops a folder of Windows without a word."""
    match = _FILE_NAME.search(disposition)
    name = match.group(1).replace(b'\\"', b'"').decode("utf-8", "surrogateescape") if match else ""
    check_file_name(name)
    return name


def _malformed(message: str) -> InputError:
    return InputError(message, hint="Send one part `file` with a file name; see /docs.", code="malformed-body")
