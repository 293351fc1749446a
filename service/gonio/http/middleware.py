"""What holds for every answer, whoever gives it: security headers, and no error that is not a problem document."""

import logging
import time
from uuid import uuid4

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from gonio.http import problems
from gonio.http.routes.metrics import count_request
from gonio.jobs.logs import about

log = logging.getLogger(__name__)

METHODS = {"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"}

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
        answer, begin_s = _Answer(scope, receive, send), time.monotonic()
        with about(request=answer.request_id):
            try:
                await self._app(scope, receive, answer.send)
            except Exception:
                if not answer.ended:  # or the error was logged and answered, and is only raised again for test clients
                    raise
            finally:
                _note(scope, answer.status, time.monotonic() - begin_s)


def _note(scope: Scope, status: int, seconds: float) -> None:
    """Count a request, and log it; by its route's pattern, since an address can hold a name."""
    route = getattr(scope.get("route"), "path", "none")
    method = scope["method"] if scope["method"] in METHODS else "other"
    count_request(method, route, status, seconds)
    log.info("%s %s: %d in %.0f ms", method, route, status, 1000 * seconds)


class _Answer:
    """One answer on its way out."""

    def __init__(self, scope: Scope, receive: Receive, send: Send) -> None:
        self.ended = False
        self.status = 0
        self.request_id = uuid4().hex[:16]
        self._replaced = False
        self._scope = scope
        self._receive = receive
        self._send = send

    async def send(self, message: Message) -> None:
        if self._replaced:
            return
        if message["type"] == "http.response.start":
            self.status = message["status"]
            headers = MutableHeaders(scope=message)
            headers["x-request-id"] = self.request_id
            headers.setdefault("x-content-type-options", "nosniff")
            headers.setdefault("referrer-policy", "no-referrer")
            headers.setdefault("content-security-policy", CONTENT_POLICY)
            headers.setdefault("x-frame-options", "SAMEORIGIN")
            if "/uploads" in self._scope["path"]:  # tus wants it on every answer, also on a problem
                headers["tus-resumable"] = "1.0.0"
            if message["status"] >= 400 and headers.get("content-type", "").startswith("text/plain"):
                self._replaced = True
                await self._replace(message["status"], Headers(scope=message))
                return
        await self._send(message)
        self.ended = message["type"] == "http.response.body" and not message.get("more_body", False)

    async def _replace(self, status: int, headers: Headers) -> None:
        """Say in a problem document what the framework says in plain text."""
        kept = {name: value for name, value in headers.items() if name not in ("content-type", "content-length")}
        response = problems.of_status(Request(self._scope), status, kept)
        await response(self._scope, self._receive, self._send)
