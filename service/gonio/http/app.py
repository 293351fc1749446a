"""The application: everything http is made of, put together once."""

import asyncio
import logging
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from datetime import timedelta
from http import HTTPStatus
from importlib.metadata import version
from typing import Any

from fastapi import FastAPI
from fastapi.concurrency import run_in_threadpool
from fastapi.exceptions import RequestValidationError
from sqlalchemy.exc import OperationalError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp

from gonio.errors import GonioError
from gonio.http import problems
from gonio.http.dashboard import add_dashboard
from gonio.http.middleware import Envelope
from gonio.http.pace import Pace
from gonio.http.routes import (
    analyses,
    calibrations,
    files,
    jobs,
    keys,
    meta,
    metrics,
    reports,
    sessions,
    uploads,
    webhooks,
)
from gonio.http.schemas import Problem
from gonio.jobs.database import upgrade
from gonio.jobs.probe import Probe, probe_file
from gonio.jobs.service import Service
from gonio.settings import Settings

log = logging.getLogger(__name__)

HOUSEKEEPING_S = 60
MESSAGES_S = 2.0

DESCRIPTION = """\
A gait laboratory: upload the videos of a capture and their calibration, start an analysis, read its report.

  G=localhost:8000/v1
  S=$(curl -s $G/sessions -H 'content-type: application/json' -d '{"kind": "human_multicamera"}' | jq -r .id)
  for f in cam0?.mp4 calibration.qca.txt; do curl -F file=@$f $G/sessions/$S/files; done
  J=$(curl -s -X POST $G/sessions/$S/analyses | jq -r .id)
  curl $G/jobs/$J
  curl $G/reports/$J

Cameras are calibrated by a session of kind "calibration": upload each camera's video of a board (role=sweep) and the board's
card, start it, and read its verdict at calibrations/$J; later sessions name it as "calibration".

Every answer that is no success is a problem document (application/problem+json) with a code, a detail
and a hint.
"""


class Application(FastAPI):
    """A FastAPI application in an envelope, whose OpenAPI document knows problem documents."""

    def build_middleware_stack(self) -> ASGIApp:
        """Put the envelope around everything: what FastAPI adds by itself answers in plain text."""
        return Envelope(super().build_middleware_stack())

    def openapi(self) -> dict[str, Any]:
        """Give the OpenAPI document."""
        document = super().openapi()
        schema = Problem.model_json_schema(ref_template="#/components/schemas/{model}")
        document["components"]["schemas"].setdefault("Problem", schema)
        for methods in document["paths"].values():
            for operation in methods.values():
                for status, response in operation["responses"].items():
                    if response["description"] == "Successful Response":  # the framework's word for all of them
                        response["description"] = HTTPStatus(int(status)).phrase
        return document


async def _keep_house(service: Service, settings: Settings) -> None:
    """Remove, now and then, the uploads that nobody goes on with and the sessions whose time is over."""
    while True:
        await asyncio.sleep(HOUSEKEEPING_S)
        try:
            await run_in_threadpool(service.sweep)
            await run_in_threadpool(service.erase_again)
            if settings.retention_days:
                count = await run_in_threadpool(service.delete_what_is_over, timedelta(days=settings.retention_days))
                if count:
                    log.info("%d sessions were deleted after %g days", count, settings.retention_days)
        except Exception:
            log.exception("Housekeeping failed; it is tried again in %d s", HOUSEKEEPING_S)


async def _send_messages(service: Service) -> None:
    """Send the messages to webhooks as they become due."""
    while True:
        sent = 0
        try:
            sent = await run_in_threadpool(service.webhooks.send_due)
        except OperationalError as error:
            log.warning("Messages wait for the database: %s", error.orig)
        except Exception:
            log.exception("Sending messages failed; it is tried again")
        if not sent:
            await asyncio.sleep(MESSAGES_S)


def create_app(settings: Settings, *, probe: Probe = probe_file) -> FastAPI:
    """Make the application.

    Args:
        settings: What the environment says.
        probe: What looks into a file before it is accepted.
    """

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncGenerator[None]:
        await run_in_threadpool(upgrade, settings)
        service = await run_in_threadpool(Service, settings, probe)
        app.state.service = service
        tasks = [asyncio.create_task(_keep_house(service, settings)), asyncio.create_task(_send_messages(service))]
        yield
        for task in tasks:
            task.cancel()
        await run_in_threadpool(service.close)

    app = Application(
        title="gonio",
        version=version("gonio"),
        description=DESCRIPTION,
        lifespan=lifespan,
        docs_url=None,  # FastAPI's own page loads its scripts from a foreign host
        redoc_url=None,
        max_body_size=settings.max_json_bytes,
    )
    app.state.settings = settings
    app.state.pace = Pace(settings.requests_per_minute)
    app.add_exception_handler(Exception, problems.of_unforeseen_error)
    app.add_exception_handler(ClientDisconnect, problems.of_disconnect)
    app.add_exception_handler(GonioError, problems.of_gonio_error)
    app.add_exception_handler(OperationalError, problems.of_database_error)
    app.add_exception_handler(OSError, problems.of_disk_error)
    app.add_exception_handler(HTTPException, problems.of_http_error)
    app.add_exception_handler(RequestValidationError, problems.of_invalid_request)
    for module in (sessions, files, uploads, analyses, jobs, reports, calibrations, keys, webhooks, meta, metrics):
        app.include_router(module.router)
    app.include_router(uploads.discovery)
    add_dashboard(app)
    return app
