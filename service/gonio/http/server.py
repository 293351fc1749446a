"""Run the service: the API in this process, the workers in processes of their own."""

import logging
import signal
import socket
import threading
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager, suppress

import uvicorn

from gonio.errors import ResourceError
from gonio.http.app import create_app
from gonio.jobs.access import opened
from gonio.jobs.database import upgrade
from gonio.jobs.probe import Probe, probe_file
from gonio.jobs.supervisor import WORKER_COMMAND, Supervisor
from gonio.settings import Settings

log = logging.getLogger(__name__)

GRACE_S = 3
"""How long requests may go on when the service stops; an upload that is cut then leaves nothing."""


def serve(
    settings: Settings,
    *,
    on_ready: Callable[[str], None] | None = None,
    worker_command: Sequence[str] = WORKER_COMMAND,
    probe: Probe = probe_file,
) -> None:
    """Serve until SIGINT or SIGTERM: `gonio serve`. ``on_ready`` hears the address as soon as it answers.

    Raises:
        ResourceError: ``port-taken``.
    """
    # Uvicorn ends its work, then raises the signal again, which would end this process before its workers are stopped.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with suppress(KeyboardInterrupt), _listening(settings) as listener:
        upgrade(settings)
        if not settings.is_embedded and not _has_keys(settings):
            log.warning("Nobody has a key yet, and nobody gets in without one: make one with `gonio keys create LAB`.")
        with Supervisor(settings, worker_command):
            _Server(settings, probe, lambda: on_ready and on_ready(_url(listener))).run(sockets=[listener])


@contextmanager
def serving(
    settings: Settings, *, worker_command: Sequence[str] = WORKER_COMMAND, probe: Probe = probe_file
) -> Generator[str]:
    """Serve in the background for as long as the block lasts, and give the address: `gonio demo`, and tests."""
    ready = threading.Event()
    with _listening(settings) as listener:
        upgrade(settings)
        server = _Server(settings, probe, ready.set)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, name="server")
        with Supervisor(settings, worker_command):
            thread.start()
            while not ready.wait(0.05) and thread.is_alive():
                pass
            try:
                yield _url(listener)
            finally:
                server.should_exit = True
                thread.join()


def _has_keys(settings: Settings) -> bool:
    with opened(settings) as access:
        return access.has_keys()


class _Server(uvicorn.Server):
    def __init__(self, settings: Settings, probe: Probe, on_ready: Callable[[], object]) -> None:
        app = create_app(settings, probe=probe)
        super().__init__(uvicorn.Config(app, timeout_graceful_shutdown=GRACE_S, access_log=False, log_level="warning"))
        self._on_ready = on_ready

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        if self.started:
            self._on_ready()


@contextmanager
def _listening(settings: Settings) -> Generator[socket.socket]:
    """Take the port before anything else is started."""
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    # The protocol is named, or asyncio would not see that it is TCP and leave Nagle's delay of 40 ms on each answer.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((settings.host, settings.port))
        listener.listen(2048)
    except OSError as error:
        listener.close()
        raise ResourceError(
            f"{settings.host}:{settings.port} can't be listened on: {error.strerror}.",
            hint="Another service may run there. Choose another port with GONIO_PORT.",
            code="port-taken",
        ) from error
    with listener:
        yield listener


def _url(listener: socket.socket) -> str:
    host, port = listener.getsockname()[:2]
    return f"http://{host}:{port}" if ":" not in host else f"http://[{host}]:{port}"
