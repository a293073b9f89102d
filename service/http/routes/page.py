"""Routes of the web page, and of the preview page, which shows a scene in the browser."""

from __future__ import annotations

import base64
import hashlib
import re
from pathlib import Path

from anyio.to_thread import run_sync
from fastapi import APIRouter, Request
from fastapi.responses import FileResponse, RedirectResponse
from fastapi.staticfiles import StaticFiles
from starlette.responses import Response
from starlette.types import Scope

from ...core.files import WEB_DECODER
from ...core.problems import ProblemError
from ...storage.job_files import JOB

router = APIRouter(include_in_schema=False)

READ = ["GET", "HEAD"]

STATIC = Path(__file__).parents[2] / "static"

REVALIDATE = {"Cache-Control": "no-cache"}  # so that old and new files do not mix after an upgrade

POLICY = (
    "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'{hashes}; worker-src 'self' blob:; style-src 'self'; "
    "img-src 'self' data:; connect-src 'self'; form-action 'none'; base-uri 'none'; frame-ancestors 'none'"
)
"""Content security policy. Spark sorts in WebAssembly, in workers that it creates from blobs; the hash is that of the
import map, which must be inline."""

_FILE = re.compile(
    r"(preview/)?[\w-]+\.(js|css|svg)|vendor/([\w-]+/)+([\w.-]+\.(js|css)|LICENSE|NOTICE)|vendor/versions\.json",
    re.ASCII,
)
"""Paths that are served: no tests, no tool settings, and nothing outside the folder."""

_TYPES = {
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
    ".json": "application/json",
    "": "text/plain; charset=utf-8",
}
"""Media types by suffix, explicit because a system's type of .js may be one that browsers refuse to run."""


class RevalidatedFiles(StaticFiles):
    """Static files that browsers cache and revalidate on each request."""

    async def get_response(self, path: str, scope: Scope) -> Response:
        """Return the response of the base class with :data:`REVALIDATE`."""
        response = await super().get_response(path, scope)
        response.headers.update(REVALIDATE)
        return response


@router.api_route("/", methods=READ)
async def get_page() -> FileResponse:
    """Return the web page."""
    return FileResponse(STATIC / "index.html", headers=REVALIDATE)


@router.api_route("/docs", methods=READ)
async def get_explorer() -> FileResponse:
    """Return the page that shows the OpenAPI document and sends requests; its script is in ``web_decoder/vendor``."""
    return FileResponse(STATIC / "docs.html", headers=REVALIDATE)


@router.api_route("/favicon.ico", methods=READ)
async def get_icon() -> FileResponse:
    """Return the icon that browsers request by default."""
    return FileResponse(STATIC / "icon.svg", media_type="image/svg+xml", headers=REVALIDATE)


@router.api_route("/preview", methods=READ)
async def get_no_job() -> RedirectResponse:
    """Redirect to the folder, because the page's links are relative and a proxy may serve it under another path."""
    return RedirectResponse("preview/", headers=REVALIDATE)


@router.api_route("/preview/{path:path}", methods=READ)
async def get_preview(request: Request, path: str) -> Response:
    """Return the page or one of its files; the page itself finds out whether the job exists."""
    if path in ("", "preview.html") or JOB.fullmatch(path):
        return await run_sync(_page)
    if not _FILE.fullmatch(path):
        raise ProblemError("not-found", f"{request.url.path[:200]} does not exist")
    response = await RevalidatedFiles(directory=WEB_DECODER, check_dir=False).get_response(path, request.scope)
    if "content-type" in response.headers:
        response.headers["Content-Type"] = _TYPES[Path(path).suffix]
    return response


def _page() -> Response:
    """Return the page, read anew each time, so that the policy always fits it."""
    try:
        page = (WEB_DECODER / "preview.html").read_bytes()
    except OSError as error:
        raise ProblemError("not-found", "this service was installed without its preview page") from error
    maps = re.findall(rb'<script type="importmap">(.*?)</script>', page.replace(b"\r\n", b"\n"), re.DOTALL)
    hashes = "".join(f" 'sha256-{base64.b64encode(hashlib.sha256(text).digest()).decode()}'" for text in maps)
    headers = {**REVALIDATE, "Content-Security-Policy": POLICY.format(hashes=hashes)}
    return Response(page, media_type="text/html", headers=headers)
