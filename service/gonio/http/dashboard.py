"""The dashboard: a page that runs in the browser on the same REST API, and how a browser signs in to it.

Its source is ``service/dashboard``; what Vite builds of it lies beside this module, in ``page`` (`make .venv/dashboard`).
"""

from pathlib import Path

from fastapi import APIRouter, FastAPI, Response
from fastapi.responses import HTMLResponse
from starlette.requests import Request
from starlette.responses import FileResponse
from starlette.staticfiles import StaticFiles

from gonio.errors import InputError
from gonio.http import pages
from gonio.http.dependencies import KEY_COOKIE, TheCaller, TheService, refuse_foreign_pages
from gonio.http.problems import GUARD, fails
from gonio.http.schemas import CallerOut, SignIn

PAGE = Path(__file__).with_name("page")

POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; media-src 'self'; connect-src 'self'; "
    "frame-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""Nothing but what this service itself gives; no script and no style that stands in the page."""

COOKIE_S = 30 * 24 * 3600

router = APIRouter(tags=["access"], responses=fails())


def add_dashboard(app: FastAPI) -> None:
    """Give the built page and what it loads; names of assets hold their hashes, so browsers may keep them."""
    app.include_router(router)
    app.mount("/assets", _Assets(directory=PAGE / "assets", check_dir=False), name="assets")


class _Assets(StaticFiles):
    def file_response(self, *args: object, **named: object) -> Response:  # the base class's arguments, passed on
        response = super().file_response(*args, **named)  # pyright: ignore[reportArgumentType]
        response.headers["Cache-Control"] = "public, max-age=31536000, immutable"
        return response


@router.get("/", response_class=HTMLResponse, include_in_schema=False)
def show_dashboard() -> Response:
    """Show the dashboard. The page itself holds nobody's data."""
    index = PAGE / "index.html"
    if not index.is_file():
        return HTMLResponse(pages.render("unbuilt.html"))
    return FileResponse(index, headers={"Content-Security-Policy": POLICY, "Cache-Control": "no-cache"})


@router.get("/v1/caller", responses=fails(*GUARD))
def read_caller(request: Request, caller: TheCaller) -> CallerOut:
    """Tell on whose behalf the request comes, and what it may do."""
    return CallerOut(lab=caller.lab, scopes=list(caller.scopes), signed_in=KEY_COOKIE in request.cookies)


@router.post(
    "/sign-in", status_code=204, responses=fails("key-invalid", "foreign-page", "malformed-body", "body-too-large")
)
def sign_in(body: SignIn, request: Request, response: Response, service: TheService) -> None:
    """Keep a key in a cookie that the browser sends with its requests to this service, and that no script can read."""
    refuse_foreign_pages(request)
    if service.access.caller(body.key) is None:
        raise InputError(
            "The key is unknown, has expired or was revoked.", hint="Ask your lab for a valid one.", code="key-invalid"
        )
    response.set_cookie(
        KEY_COOKIE, body.key, max_age=COOKIE_S, httponly=True, samesite="strict", secure=request.url.scheme == "https"
    )


@router.post("/sign-out", status_code=204, responses=fails("foreign-page"))
def sign_out(request: Request, response: Response) -> None:
    """Forget the key."""
    refuse_foreign_pages(request)
    response.delete_cookie(KEY_COOKIE, httponly=True, samesite="strict", secure=request.url.scheme == "https")
