"""The page for people."""

from __future__ import annotations

from pathlib import Path

from fastapi import APIRouter
from fastapi.responses import FileResponse
from fastapi.staticfiles import StaticFiles
from starlette.responses import Response
from starlette.types import Scope

router = APIRouter(include_in_schema=False)

STATIC = Path(__file__).parents[2] / "static"

FRESH = {"Cache-Control": "no-cache"}
"""Ask whether it has changed: after an upgrade, old and new files must not meet."""


class Fresh(StaticFiles):
    """Files that browsers keep, and ask about each time."""

    async def get_response(self, path: str, scope: Scope) -> Response:
        """As the base class, with that header."""
        response = await super().get_response(path, scope)
        response.headers.update(FRESH)
        return response


@router.head("/")
@router.get("/")
async def get_page() -> FileResponse:
    """Drop a scene, follow it, fetch the container."""
    return FileResponse(STATIC / "index.html", headers=FRESH)


@router.head("/favicon.ico")
@router.get("/favicon.ico")
async def get_icon() -> FileResponse:
    """What browsers ask for unbidden."""
    return FileResponse(STATIC / "icon.svg", media_type="image/svg+xml", headers=FRESH)
