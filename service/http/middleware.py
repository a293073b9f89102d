"""Middleware for every request: host and origin checks, request ids, security headers, metrics and access log."""

from __future__ import annotations

import logging
import re
import time
import uuid
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ..core.metrics import Metrics
from ..core.problems import ProblemError, answer
from ..core.settings import ServiceSettings

log = logging.getLogger("kissgs.access")

PAGE_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
    "form-action 'none'; base-uri 'none'; frame-ancestors 'none'"
)
"""Content-Security-Policy of the pages: no external resources, no embedding in frames."""

SECURITY_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
}
"""Headers of every answer. The last keeps pages of other sites from embedding images and files of jobs; it does not
concern the requests of scripts, which CORS permits or not."""

METHODS = ("GET", "HEAD", "POST", "DELETE", "OPTIONS", "PUT", "PATCH")


class RequestMiddleware:
    """ASGI middleware around the application; metrics have the template of a route as a label, never client input."""

    def __init__(self, app: ASGIApp, metrics: Metrics, settings: ServiceSettings) -> None:
        self._app, self._metrics, self._settings = app, metrics, settings

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        given = headers.get("x-request-id", "")
        request_id = given if re.fullmatch(r"[A-Za-z0-9._-]{1,64}", given) else uuid.uuid4().hex[:16]
        scope.setdefault("state", {})["request_id"] = request_id
        begun, status = time.perf_counter(), 0

        async def sending(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                self._metrics.latency.labels(_route(scope)).observe(time.perf_counter() - begun)
                answered = MutableHeaders(scope=message)
                answered["X-Request-ID"] = request_id
                answered.update(SECURITY_HEADERS)
                answered.setdefault("Content-Security-Policy", PAGE_POLICY)  # the preview page has its own
            await send(message)

        try:
            refusal = self._refusal(scope["method"], headers)
            await (self._app if refusal is None else answer(refusal))(scope, receive, sending)
        except Exception:
            log.exception("request %s failed", request_id)
            if status == 0:
                text = f"an internal error of the service; report it with the request id {request_id}"
                await answer(ProblemError("internal", text))(scope, receive, sending)
        finally:
            method = scope["method"] if scope["method"] in METHODS else "other"
            self._metrics.requests.labels(method, _route(scope), status).inc()
            target = scope.get("raw_path", b"").decode("ascii", "replace")
            spent = 1e3 * (time.perf_counter() - begun)
            log.info("%s %s %d %.0f ms %s", method, target[:500], status, spent, request_id)

    def _refusal(self, method: str, headers: Headers) -> ProblemError | None:
        """Return the error for a foreign host name (DNS rebinding) or a foreign origin (CSRF); None to allow. Requests
        without an ``Origin`` header do not come from a page of another site."""
        host = headers.get("host", "")
        name = host.rpartition(":")[0] if re.search(r":[0-9]*$", host) else host
        if not self._settings.answers_to(name.strip("[]").lower()):
            text = f"the host name {host[:100]!r} is not accepted; the operator can add it to KISSGS_NAMES"
            return ProblemError("foreign", text)
        origin = headers.get("origin")
        if method in ("GET", "HEAD", "OPTIONS") or origin is None or origin.lower() in self._settings.cors_origins:
            return None
        if "*" in self._settings.cors_origins or _site(origin) == host.lower():
            return None
        text = f"pages of {origin[:100]!r} may not use this service; the operator can add it to KISSGS_CORS_ORIGINS"
        return ProblemError("foreign", text)


def _site(origin: str) -> str | None:
    """Return host and port of an origin in lower case; None if it has none or is malformed."""
    try:
        return urlsplit(origin).netloc.lower() or None
    except ValueError:  # brackets without a valid IPv6 address
        return None


def _route(scope: Scope) -> str:
    route = scope.get("route")
    return str(getattr(route, "path", "none"))
