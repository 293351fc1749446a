"""A thin client of the service: what `gonio demo`, the tests and a lab's own scripts use to talk to it over HTTP.

::

    with Client("http://127.0.0.1:8000") as gonio:
        session = gonio.create_session(name="Anna, walking", subject={"mass_kg": 61.0})
        for path in files:
            gonio.upload(session["id"], path)
        job = gonio.wait(gonio.analyse(session["id"])["id"], on_progress=print)
        gonio.download(job["id"], Path("report"))

It imports nothing of gonio but its errors: an answer that is a problem becomes a :class:`gonio.errors.GonioError` with
the problem's code, message and hint, and with its ``status`` and other members in ``details``.
"""

import base64
import time
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Literal, Self, cast

import httpx

from gonio.errors import Cancelled, GonioError, InputError, ResourceError

Document = dict[str, Any]
"""A JSON object of the service, as its OpenAPI page describes it."""

Role = Literal[
    "video", "keypoints", "calibration", "body_model", "marker_set", "pressure", "pressure_card", "force_plates",
    "force_coefficients",
    "sweep", "lens", "floor", "board", "optics", "floor_points", "previous",
]  # fmt: skip
"""What a file is: the first nine in a session of a person, the others in a session of kind ``calibration``."""

RESUMABLE_BYTES = 8_000_000
"""From this size on, an upload can be gone on with after a cut; a smaller one is simply sent again."""

LONGEST_PAUSE_S = 2.0
"""Before an upload is gone on with: a service that comes and goes is there for seconds at a time."""

MOST_CUTS = 60
"""After how many cuts in a row, with nothing added in between, an upload is given up: after two minutes, in which a service
on a slow machine is started anew."""

_TUS = {"Tus-Resumable": "1.0.0"}

FINAL_STATES = ("succeeded", "failed", "cancelled")


class Client:
    """A connection to one service; use it in a ``with`` block.

    Args:
        url: Where the service listens.
        key: The lab's key, where the service wants one.
        timeout_s: How long the service may be silent before a request fails.
        transport: Another way to the service, for example past a proxy.
    """

    def __init__(
        self,
        url: str = "http://127.0.0.1:8000",
        *,
        key: str = "",
        timeout_s: float = 60.0,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        self.url = url
        # `trust_env=False`: a proxy in the environment must not get between a lab and its own machine.
        self._http = httpx.Client(
            base_url=url,
            headers={"Authorization": f"Bearer {key}"} if key else {},
            timeout=timeout_s,
            transport=transport,
            trust_env=False,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self._http.close()

    def is_ready(self) -> bool:
        """Tell whether the service is up and can take work."""
        try:
            return self._http.get("/readyz").is_success
        except httpx.HTTPError:
            return False

    def create_session(
        self,
        *,
        kind: Literal[
            "human_multicamera", "human_monocular", "articulated_object", "calibration"
        ] = "human_multicamera",
        name: str = "",
        subject: Mapping[str, float | str] | None = None,
        calibration: str | None = None,
    ) -> Document:
        """Create a session.

        ``subject`` may hold ``code``, ``mass_kg``, ``stature_m`` and ``sex``; ``calibration`` is an id.
        """
        body = {"kind": kind, "name": name, "subject": dict(subject or {}), "calibration": calibration}
        return self._json("POST", "/v1/sessions", json=body)

    def session(self, session_id: str) -> Document:
        """Read a session."""
        return self._json("GET", f"/v1/sessions/{session_id}")

    def sessions(self) -> Iterator[Document]:
        """Give all sessions, newest first."""
        return self._pages("/v1/sessions")

    def delete_session(self, session_id: str) -> None:
        """Delete a session with its files, jobs and reports."""
        self._request("DELETE", f"/v1/sessions/{session_id}")

    def upload(
        self,
        session_id: str,
        path: Path,
        *,
        role: Role | None = None,
        camera: str | None = None,
        name: str | None = None,
        on_progress: Callable[[int, int], None] | None = None,
    ) -> Document:
        """Upload a file without reading it into memory; ``on_progress`` hears the bytes sent so far and in all.

        A large one is gone on with after a cut, also when the service was started anew in between.
        """
        fields = {"role": role, "camera": camera}
        told = {key: value for key, value in fields.items() if value is not None}
        size = path.stat().st_size
        with path.open("rb") as file:
            source = cast("IO[bytes]", _Counted(file, size, on_progress) if on_progress else file)
            if size >= RESUMABLE_BYTES:
                return self._upload_in_pieces(session_id, source, size, {"filename": name or path.name, **told})
            return self._json(
                "POST",
                f"/v1/sessions/{session_id}/files",
                data=told,
                files={"file": (name or path.name, source, "application/octet-stream")},
            )

    def _upload_in_pieces(self, session_id: str, file: IO[bytes], size: int, told: dict[str, str]) -> Document:
        """Upload by tus 1.0: one request, and after each cut another one from where the service stands."""
        metadata = ",".join(f"{key} {base64.b64encode(value.encode()).decode()}" for key, value in told.items())
        begin = {**_TUS, "Upload-Length": str(size), "Upload-Metadata": metadata}
        url, offset, cuts_in_a_row = "", 0, 0
        while True:
            try:
                if cuts_in_a_row:
                    time.sleep(min(0.1 * 2**cuts_in_a_row, LONGEST_PAUSE_S))
                place = ""
                if not url:
                    url = self._request("POST", f"/v1/sessions/{session_id}/uploads", headers=begin).headers["Location"]
                elif cuts_in_a_row:
                    stands = self._request("HEAD", url, headers=_TUS).headers
                    cuts_in_a_row = 1 if int(stands["Upload-Offset"]) > offset else cuts_in_a_row
                    offset = int(stands["Upload-Offset"])
                    place = stands.get("Content-Location", "")
                place = place or self._send_rest(url, file, offset, size)
                return next(each for each in self.files(session_id) if each["content"] == place)
            except GonioError as error:
                cuts_in_a_row += 1
                if cuts_in_a_row > MOST_CUTS or not _passes(error):
                    raise

    def _send_rest(self, url: str, file: IO[bytes], offset: int, size: int) -> str:
        """Send an upload from an offset to its end, and give the place of the file that it became."""
        file.seek(offset)
        headers = {
            **_TUS,
            "Upload-Offset": str(offset),
            "Content-Type": "application/offset+octet-stream",
            "Content-Length": str(size - offset),
        }
        return self._request("PATCH", url, content=_read_on(file), headers=headers).headers["Content-Location"]

    def files(self, session_id: str) -> list[Document]:
        """List a session's files."""
        return list(self._pages(f"/v1/sessions/{session_id}/files"))

    def delete_file(self, session_id: str, file_id: str) -> None:
        """Delete a file."""
        self._request("DELETE", f"/v1/sessions/{session_id}/files/{file_id}")

    def analyse(
        self,
        session_id: str,
        parameters: Mapping[str, Any] | None = None,
        *,
        calibration: str | None = None,
        idempotency_key: str | None = None,
    ) -> Document:
        """Start an analysis or a calibration and give its job; the same ``idempotency_key`` gives the same job again.

        ``calibration`` is the id of the calibration to use; in a session of kind ``calibration``, of the one to check.
        """
        headers = {"Idempotency-Key": idempotency_key} if idempotency_key else {}
        body = {"parameters": dict(parameters or {}), "calibration": calibration}
        return self._json("POST", f"/v1/sessions/{session_id}/analyses", json=body, headers=headers)

    def job(self, job_id: str) -> Document:
        """Read a job."""
        return self._json("GET", f"/v1/jobs/{job_id}")

    def jobs(self) -> Iterator[Document]:
        """Give all jobs, newest first."""
        return self._pages("/v1/jobs")

    def cancel(self, job_id: str) -> Document:
        """Cancel a job; one that has ended stays as it is."""
        return self._json("POST", f"/v1/jobs/{job_id}/cancel")

    def wait(
        self,
        job_id: str,
        on_progress: Callable[[Document], None] | None = None,
        *,
        timeout_s: float | None = None,
        poll_s: float = 0.5,
    ) -> Document:
        """Wait for a job's end and give the job; ``on_progress`` hears each state that was seen.

        Raises:
            Cancelled: The job was cancelled.
            GonioError: The job failed (with its problem's code, message and hint), or the time is over.
        """
        deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            job = self.job(job_id)
            if on_progress is not None:
                on_progress(job)
            if job["state"] in FINAL_STATES:
                break
            if deadline_s is not None and time.monotonic() > deadline_s:
                raise GonioError(
                    f"Job {job_id} didn't end within {timeout_s:g} seconds.",
                    hint="It goes on; wait for it again.",
                    code="wait-timeout",
                )
            time.sleep(poll_s)
        if job["state"] == "cancelled":
            raise Cancelled
        if job["state"] == "failed":
            problem = job["problem"]
            raise GonioError(problem["message"], hint=problem["hint"], code=problem["code"], job=job_id)
        return job

    def report(self, report_id: str) -> Document:
        """Read a report: the JSON document that the analysis wrote."""
        return self._json("GET", f"/v1/reports/{report_id}")

    def report_files(self, report_id: str) -> list[Document]:
        """List a report's files."""
        return self._json("GET", f"/v1/reports/{report_id}/files")["items"]

    def calibration(self, calibration_id: str) -> Document:
        """Read a calibration: its verdict, findings and files. It has the id of its job."""
        return self._json("GET", f"/v1/calibrations/{calibration_id}")

    def calibrations(self) -> Iterator[Document]:
        """Give all calibrations, newest first."""
        return self._pages("/v1/calibrations")

    def download(self, report_id: str, folder: Path) -> list[Path]:
        """Download all files of a report into a folder and give their paths."""
        return self._save(self.report_files(report_id), folder)

    def download_calibration(self, calibration_id: str, folder: Path) -> list[Path]:
        """Download all files of a calibration into a folder and give their paths."""
        return self._save(self.calibration(calibration_id)["files"], folder)

    def _save(self, files: list[Document], folder: Path) -> list[Path]:
        folder.mkdir(parents=True, exist_ok=True)
        paths: list[Path] = []
        for file in files:
            path = folder / Path(file["name"]).name
            with self._told(), self._http.stream("GET", file["url"]) as response, path.open("wb") as out:
                _raise_for_problem(response)
                for chunk in response.iter_bytes():
                    out.write(chunk)
            paths.append(path)
        return paths

    def _pages(self, path: str) -> Iterator[Document]:
        cursor: str | None = None
        while True:
            page = self._json("GET", path, params={"cursor": cursor} if cursor else {})
            yield from page["items"]
            cursor = page.get("next_cursor")
            if cursor is None:
                return

    def _json(self, method: str, path: str, **how: Any) -> Document:  # noqa: ANN401 - httpx's arguments
        return self._request(method, path, **how).json()

    def _request(self, method: str, path: str, **how: Any) -> httpx.Response:  # noqa: ANN401 - httpx's arguments
        with self._told():
            response = self._http.request(method, path, **how)
        _raise_for_problem(response)
        return response

    @contextmanager
    def _told(self) -> Generator[None]:
        """Tell a broken connection in gonio's words."""
        try:
            yield
        except httpx.ConnectError as error:
            raise ResourceError(
                f"No service answers at {self.url}.", hint="Start it with `gonio serve`.", code="service-unreachable"
            ) from error
        except httpx.HTTPError as error:
            raise ResourceError(
                f"The connection to {self.url} broke ({type(error).__name__}).",
                hint="See whether the service still runs, then try again.",
                code="connection-broken",
            ) from error


class _Counted:
    """A file that tells how much of it was read; httpx streams anything that it can read and measure."""

    def __init__(self, file: IO[bytes], size: int, on_progress: Callable[[int, int], None]) -> None:
        self._file = file
        self._size = size
        self._on_progress = on_progress

    def read(self, count: int = -1) -> bytes:
        chunk = self._file.read(count)
        self._on_progress(self._file.tell(), self._size)
        return chunk

    def fileno(self) -> int:
        return self._file.fileno()

    def tell(self) -> int:
        return self._file.tell()

    def seek(self, offset: int, whence: int = 0) -> int:
        return self._file.seek(offset, whence)

    def seekable(self) -> bool:
        return True


def _passes(error: GonioError) -> bool:
    """Tell whether an upload may be gone on with: after a cut, or while its service starts anew.

    The request that was cut may still hold the upload (423), and still write what had come (another offset).
    """
    status = error.details.get("status")
    if status in (423, 429) or error.code == "upload-offset-wrong":
        return True
    return isinstance(error, ResourceError) and status != 507


def _read_on(file: IO[bytes]) -> Iterator[bytes]:
    while chunk := file.read(1 << 16):
        yield chunk


def _raise_for_problem(response: httpx.Response) -> None:
    if response.is_success:
        return
    response.read()
    try:
        problem = cast("Document", response.json())
    except ValueError:
        problem = {}
    kind = (
        InputError if response.is_client_error else ResourceError if response.status_code in (503, 507) else GonioError
    )
    members = {key: value for key, value in problem.items() if key not in {"code", "detail", "hint", "title", "type"}}
    raise kind(
        str(problem.get("detail") or problem.get("title") or f"The service answered {response.status_code}."),
        hint=str(problem.get("hint") or "See the service's log."),
        code=problem.get("code"),
        **{"status": response.status_code, **members},
    )
