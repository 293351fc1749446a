"""What holds for every answer, whoever gives it: security headers, and no error that is not a problem document."""

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import ClientDisconnect, Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from gonio.http import problems

CONTENT_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'"
"""Pages carry their style and images in themselves and run nothing. The report is such a page, too."""


class Envelope:
    """An ASGI middleware around the whole application."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        answer = _Answer(scope, receive, send)
        try:
            await self._app(scope, receive, answer.send)
        except ClientDisconnect:
            return  # nobody is there to hear an answer
        except Exception as error:
            if answer.started:
                raise
            await problems.of_unforeseen_error(Request(scope), error)(scope, receive, answer.send)


class _Answer:
    """One answer on its way out."""

    def __init__(self, scope: Scope, receive: Receive, send: Send) -> None:
        self.started = False
        self._replaced = False
        self._scope = scope
        self._receive = receive
        self._send = send

    async def send(self, message: Message) -> None:
        if self._replaced:
            return
        if message["type"] == "http.response.start":
            self.started = True
            headers = MutableHeaders(scope=message)
            headers.setdefault("x-content-type-options", "nosniff")
            headers.setdefault("referrer-policy", "no-referrer")
            headers.setdefault("content-security-policy", CONTENT_POLICY)
            headers.setdefault("x-frame-options", "SAMEORIGIN")
            if message["status"] >= 400 and headers.get("content-type", "").startswith("text/plain"):
                self._replaced = True
                await self._replace(message["status"], Headers(scope=message))
                return
        await self._send(message)

    async def _replace(self, status: int, headers: Headers) -> None:
        """Say in a problem document what the framework says in plain text."""
        kept = {name: value for name, value in headers.items() if name not in ("content-type", "content-length")}
        response = problems.of_status(Request(self._scope), status, kept)
        await response(self._scope, self._receive, self._send)
