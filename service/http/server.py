"""uvicorn with timeouts for idle and slow connections, and with a shutdown that drains jobs and requests concurrently.
uvicorn itself would begin to drain only after the last stream has ended."""

from __future__ import annotations

import asyncio
import logging
import resource
import socket
import time
from collections import Counter
from types import FrameType
from typing import cast

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from ..core.problems import MEDIA_TYPE, problem
from ..core.settings import ServiceSettings, SettingsError
from ..jobs.container import ServiceContainer
from .app import SECURITY_HEADERS
from .submission import address_of

log = logging.getLogger("kissgs.service")

HEADER_SECONDS = 20.0
"""Timeout for the headers of a request, and for the remaining body of a refused request, whose client is still to
receive the response."""

READ_SECONDS = 60.0  # timeout for a client to receive any bytes of a pending response
MAX_HEADER_BYTES = 64 << 10  # maximum bytes of the headers of a request
READ_BYTES = 32 << 10  # maximum bytes per read from a connection
PARSE_SECONDS_PER_BYTE = 2e-7  # CPU time allowed; a normal body needs a hundredth, chunks of one byte tenfold
MAX_PARSE_DEBT_SECONDS = 0.1  # CPU seconds beyond the allowance after which a connection is closed

MAX_CONNECTIONS = 1000
"""Maximum number of connections. Beyond it, the address with the most loses one, so that no address, by event streams
or slow requests, shuts out the others; a proxy, whose address is that of all clients, may still have all."""

OTHER_DESCRIPTORS = 256  # file descriptors reserved for uploads, downloads, the database, jobs


class StrictConnection(h11.Connection):
    """h11 that refuses requests whose end other programs may see elsewhere, and take the rest for a request."""

    def next_event(self) -> h11.Event | type[h11.NEED_DATA] | type[h11.PAUSED]:
        """Return the next event."""
        event = super().next_event()
        if isinstance(event, h11.Request):
            names = {name for name, _ in event.headers}
            if b"transfer-encoding" in names and (b"content-length" in names or event.http_version < b"1.1"):
                raise h11.RemoteProtocolError("Transfer-Encoding with Content-Length or HTTP/1.0")
        return event


class TimeoutProtocol(H11Protocol):
    """HTTP protocol that closes connections that send no complete request, do not receive the response, or need too
    much CPU time to parse."""

    _listening: asyncio.TimerHandle | None = None
    _watching: asyncio.TimerHandle | None = None
    most_connections = MAX_CONNECTIONS
    address = ""
    _debt = 0.0
    _unsent = 0
    _taken = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Start the timers of the connection; if there are too many, abort it or one of the address with the most."""
        self.conn = StrictConnection(h11.SERVER, MAX_HEADER_BYTES)
        super().connection_made(transport)  # type: ignore[arg-type]
        self.address = address_of(self.client)
        if len(self.connections) > self.most_connections and (excess := self._excess()) is not None:
            excess.transport.abort()
            if excess is self:
                return
        self.transport.max_size = READ_BYTES  # type: ignore[attr-defined]
        self._listening = self.loop.call_later(HEADER_SECONDS, self.transport.close)
        self._watching = self.loop.call_later(READ_SECONDS, self._watch)

    def _excess(self) -> TimeoutProtocol | None:
        """Return the connection to abort: this one, unless another address has more; None if enough are closing."""
        others = cast("set[TimeoutProtocol]", self.connections)
        open_ones = [one for one in others if not one.transport.is_closing()]
        if len(open_ones) <= self.most_connections:
            return None
        counts = Counter(one.address for one in open_ones)
        most = max(counts, key=counts.__getitem__)
        return next(one for one in open_ones if one.address == most) if counts[most] > counts[self.address] else self

    def data_received(self, data: bytes) -> None:
        """Parse a piece of a request, and close connections whose requests take too much CPU time to parse."""
        request, begun = self.cycle, time.thread_time()
        super().data_received(data)
        spent = time.thread_time() - begun - PARSE_SECONDS_PER_BYTE * len(data)
        self._debt = max(0.0, self._debt + spent) if self.cycle is request else 0.0  # per body, not across requests
        self.transport.max_size = READ_BYTES >> (4 if self._debt else 0)  # type: ignore[attr-defined]
        if self._debt > MAX_PARSE_DEBT_SECONDS:
            log.warning("a connection was closed: parsing its request needs too much CPU time")
            self.transport.abort()
            return
        busy = self.scope is not None and not self.cycle.response_complete
        if busy and self._listening is not None:
            self._listening.cancel()
            self._listening = None
        elif not busy and self._listening is None:
            self._listening = self.loop.call_later(HEADER_SECONDS, self.transport.close)

    def resume_writing(self) -> None:
        """Note that the client has received a part of the response."""
        super().resume_writing()
        self._taken = True

    def _watch(self) -> None:
        """Close the connection if its client has received nothing of the pending response since the last call."""
        unsent = self.transport.get_write_buffer_size()
        if unsent and unsent == self._unsent and not self._taken:
            self.transport.abort()
            return
        self._unsent, self._taken = unsent, False
        self._watching = self.loop.call_later(READ_SECONDS, self._watch)

    def send_400_response(self, msg: str) -> None:
        """Answer invalid HTTP and headers of more than 64 KiB with a problem document, like all other errors."""
        found = problem(
            "bad-http",
            "the request is not valid HTTP, has an ambiguous length, or has headers above 64 KiB; send a valid request",
        )
        body = found.model_dump_json(exclude_none=True).encode()
        headers = [
            (b"content-type", MEDIA_TYPE.encode()),
            (b"content-length", str(len(body)).encode()),
            (b"connection", b"close"),
            *((name.encode(), value.encode()) for name, value in SECURITY_HEADERS.items()),
        ]
        events = (h11.Response(status_code=found.status, headers=headers), h11.Data(data=body), h11.EndOfMessage())
        for event in events:
            self.transport.write(self.conn.send(event) or b"")
        self.transport.close()

    def connection_lost(self, exc: Exception | None) -> None:
        """Cancel the timers of the connection."""
        for timer in (self._listening, self._watching):
            if timer is not None:
                timer.cancel()
        super().connection_lost(exc)


def allow_connections() -> None:
    """Raise the limit of file descriptors for all connections; if that is not permitted, limit the connections."""
    wanted = MAX_CONNECTIONS + OTHER_DESCRIPTORS
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft < wanted:
        most = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
        TimeoutProtocol.most_connections = max(10, most - OTHER_DESCRIPTORS)


def listen(settings: ServiceSettings) -> socket.socket:
    """Open the listening socket."""
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    try:
        listener = socket.create_server((settings.host, settings.port), family=family, backlog=2048)
    except OSError as error:
        where, reason = f"{settings.host}:{settings.port}", (error.strerror or str(error)).lower()
        raise SettingsError(f"KISSGS_HOST, KISSGS_PORT: cannot listen on {where}: {reason}; choose others") from error
    # Inherited by its connections. asyncio sets it only for sockets of its own; without it, responses take 40 ms more.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return listener


class Server(uvicorn.Server):
    """uvicorn server that notifies the application's parts as soon as a shutdown is requested."""

    def __init__(self, app: object, context: ServiceContainer) -> None:
        self._context = context
        super().__init__(config_of(app))

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Log the address once the server accepts connections."""
        await super().startup(sockets)
        for listener in sockets or []:
            host, port = listener.getsockname()[:2]
            log.info("listening on http://%s:%d", f"[{host}]" if ":" in host else host, port)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Drain jobs and requests concurrently."""
        await asyncio.gather(self._context.worker.drain(), super().shutdown(sockets))
        if self.force_exit:  # uvicorn leaves out the application's own end then, and logs a traceback
            await self.lifespan.shutdown()

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Stop starting jobs, end streams and long polls, then let uvicorn finish its requests. uvicorn's handler would
        raise the signal again afterwards, so that the exit status would look like a crash."""
        if self.should_exit:
            self._context.worker.kill_running()
        self._context.worker.draining = True
        self._context.notifier.close()
        self.force_exit = self.should_exit  # on the second signal
        self.should_exit = True


def config_of(app: object) -> uvicorn.Config:
    """Return the uvicorn configuration for an application."""
    return uvicorn.Config(
        app,  # type: ignore[arg-type]
        http=TimeoutProtocol,
        ws="none",
        access_log=False,
        log_config=None,
        server_header=False,
        proxy_headers=False,
        timeout_graceful_shutdown=10,
        timeout_keep_alive=15,  # clients that reuse idle connections for 5 s, as httpx does, must not meet a closed one
    )
