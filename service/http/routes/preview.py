"""The page that shows a scene in the browser: what it consists of lies in ``web_decoder``, beside this package."""

from __future__ import annotations

import base64
import hashlib
import re
from pathlib import Path

from anyio.to_thread import run_sync
from fastapi import APIRouter, Request
from fastapi.responses import RedirectResponse
from starlette.responses import Response

from service.core.problems import ProblemError
from service.http.routes.page import FRESH, Fresh

router = APIRouter(include_in_schema=False)

FOLDER = Path(__file__).parents[3] / "web_decoder"

POLICY = (
    "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'{hashes}; worker-src 'self' blob:; style-src 'self'; "
    "img-src 'self' data:; connect-src 'self'; form-action 'none'; base-uri 'none'; frame-ancestors 'none'"
)
"""Of the page. Spark sorts in WebAssembly, in workers that it makes from blobs; the hash is that of the import map,
which browsers take only from the page itself."""

_JOB = re.compile(r"[0-9a-f]{32}")
_FILE = re.compile(
    r"(preview/)?[\w-]+\.(js|css|svg)|vendor/([\w-]+/)+([\w.-]+\.js|LICENSE)|vendor/versions\.json", re.ASCII
)
"""What the page may ask for: no tests, no settings of tools, and no way out of the folder."""

_TYPES = {
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
    ".json": "application/json",
    "": "text/plain; charset=utf-8",
}
"""Told outright: where the system says what .js is, it may say something that browsers refuse to run."""


@router.head("/preview")
@router.get("/preview")
async def get_no_job() -> RedirectResponse:
    """The page finds its parts relative to this folder, which a proxy may have put into another."""
    return RedirectResponse("preview/", headers=FRESH)


@router.head("/preview/{path:path}")
@router.get("/preview/{path:path}")
async def get_preview(request: Request, path: str) -> Response:
    """The page, for any job that there might be, and its parts. Whether there is such a job only the API tells."""
    if path in ("", "preview.html") or _JOB.fullmatch(path):
        return await run_sync(_page)
    if not _FILE.fullmatch(path):
        raise ProblemError("not-found", f"there is nothing at {request.url.path[:200]}")
    response = await Fresh(directory=FOLDER, check_dir=False).get_response(path, request.scope)
    if "content-type" in response.headers:
        response.headers["Content-Type"] = _TYPES[Path(path).suffix]
    return response


def _page() -> Response:
    """Read anew each time, so that the policy is always that of the page it comes with."""
    try:
        page = (FOLDER / "preview.html").read_bytes()
    except OSError as error:
        raise ProblemError("not-found", "this service was installed without its preview page") from error
    maps = re.findall(rb'<script type="importmap">(.*?)</script>', page.replace(b"\r\n", b"\n"), re.DOTALL)
    hashes = "".join(f" 'sha256-{base64.b64encode(hashlib.sha256(text).digest()).decode()}'" for text in maps)
    return Response(
        page, media_type="text/html", headers={**FRESH, "Content-Security-Policy": POLICY.format(hashes=hashes)}
    )
