"""Routes of the web page."""

from __future__ import annotations

from pathlib import Path

from fastapi import APIRouter
from fastapi.responses import FileResponse
from fastapi.staticfiles import StaticFiles
from starlette.responses import Response
from starlette.types import Scope

router = APIRouter(include_in_schema=False)

STATIC = Path(__file__).parents[2] / "static"

REVALIDATE = {"Cache-Control": "no-cache"}
"""Headers that make browsers revalidate a cached file, so that old and new files do not mix after an upgrade."""


class RevalidatedFiles(StaticFiles):
    """Static files that browsers cache and revalidate on each request."""

    async def get_response(self, path: str, scope: Scope) -> Response:
        """Return the response of the base class with :data:`REVALIDATE`."""
        response = await super().get_response(path, scope)
        response.headers.update(REVALIDATE)
        return response


@router.head("/")
@router.get("/")
async def get_page() -> FileResponse:
    """Return the web page."""
    return FileResponse(STATIC / "index.html", headers=REVALIDATE)


@router.head("/docs")
@router.get("/docs")
async def get_explorer() -> FileResponse:
    """Return the page that shows the OpenAPI document and sends requests; its script is in ``web_decoder/vendor``."""
    return FileResponse(STATIC / "docs.html", headers=REVALIDATE)


@router.head("/favicon.ico")
@router.get("/favicon.ico")
async def get_icon() -> FileResponse:
    """Return the icon that browsers request by default."""
    return FileResponse(STATIC / "icon.svg", media_type="image/svg+xml", headers=REVALIDATE)
