"""About the service itself: health, the problems it can answer with, and pages for people."""

import logging
from importlib.metadata import version
from typing import Any

from fastapi import APIRouter
from fastapi.responses import HTMLResponse
from starlette.requests import Request

from gonio.errors import InputError, ResourceError
from gonio.http import pages
from gonio.http.dependencies import CurrentLab, TheService
from gonio.http.problems import GUARD, KINDS, fails
from gonio.http.schemas import Health, ParametersOut
from gonio.pipeline.params import calibration_parameters_schema, parameters_schema

log = logging.getLogger(__name__)

router = APIRouter(tags=["service"])


@router.get("/healthz", responses=fails())
async def is_alive() -> Health:
    """Tell that the process answers."""
    return Health(status="alive", version=version("gonio"))


@router.get("/readyz", responses=fails("not-ready"))
def is_ready(service: TheService) -> Health:
    """Tell whether the service can take work: its database answers and its disk has room."""
    try:
        service.check()
    except Exception as error:
        log.warning("Not ready: %s", error)
        raise ResourceError("The service can't work at the moment.", hint="See its log.", code="not-ready") from error
    return Health(status="ready", version=version("gonio"))


@router.get("/v1/parameters", responses=fails(*GUARD))
def list_parameters(_lab: CurrentLab) -> ParametersOut:
    """List what the `parameters` of an analysis and of a calibration may be."""
    return ParametersOut(analysis=parameters_schema(), calibration=calibration_parameters_schema())


@router.get("/docs", response_class=HTMLResponse, include_in_schema=False)
def show_reference(request: Request) -> str:
    """Show the reference of this API, made from its OpenAPI document; nothing is loaded from elsewhere."""
    document: dict[str, Any] = request.app.openapi()
    return pages.render("reference.html", document=document, operations=pages.operations(document))


@router.get("/problems", response_class=HTMLResponse, include_in_schema=False)
def show_problems() -> str:
    """Explain all kinds of problems."""
    return pages.render("problems.html", kinds=KINDS)


@router.get("/problems/{code}", response_class=HTMLResponse, include_in_schema=False)
def show_problem(code: str) -> str:
    """Explain one kind of problem."""
    if code not in KINDS:
        raise InputError("There is no such problem.", hint="GET /problems lists them.", code="not-found")
    return pages.render("problems.html", kinds={code: KINDS[code]})
