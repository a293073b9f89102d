"""uvicorn, with what a public service needs beyond it: a time limit for silent connections, and a drain that starts at
the signal rather than after the last stream has ended."""

from __future__ import annotations

import asyncio
import logging
import resource
import socket
import time
from types import FrameType

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from service.core.problems import MEDIA_TYPE, problem
from service.core.settings import ServiceSettings, SettingsError
from service.jobs.container import ServiceContainer

log = logging.getLogger("kissgs.service")

HEADER_SECONDS = 20.0
"""For the headers of a request, from the first byte of the connection or of the next one; and for the rest of a body
that has been refused, so that the client sees why."""

READ_SECONDS = 60.0
"""For a client to take something of an answer that waits for it."""

READ_BYTES = 32 << 10
"""At a time."""

FAIR_SECONDS = 2e-7
"""For parsing a byte. A body takes a hundredth of it; one in chunks of single bytes takes ten times as much."""

MOST_DEBT = 0.1
"""Seconds of parsing beyond that, after which a connection is closed."""

MAX_CONNECTIONS = 1000

SPARE_DESCRIPTORS = 256
"""For what is not a connection: files on their way in and out, the database, jobs."""


class _Impatient(H11Protocol):
    """Closes connections that say too little to make a request, or that do not take the answer; and gives none of them
    more of the processor than is due to it."""

    _listening: asyncio.TimerHandle | None = None
    _watching: asyncio.TimerHandle | None = None
    most_connections = MAX_CONNECTIONS
    _debt = 0.0
    _unsent = 0
    _taken = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)  # type: ignore[arg-type]
        if len(self.connections) > self.most_connections:
            self.transport.abort()
            return
        self.transport.max_size = READ_BYTES  # type: ignore[attr-defined]
        self._listening = self.loop.call_later(HEADER_SECONDS, self.transport.close)
        self._watching = self.loop.call_later(READ_SECONDS, self._watch)

    def data_received(self, data: bytes) -> None:
        request, begun = self.cycle, time.thread_time()
        super().data_received(data)
        spent = time.thread_time() - begun - FAIR_SECONDS * len(data)
        self._debt = max(0.0, self._debt + spent) if self.cycle is request else 0.0  # of one body, not of many requests
        self.transport.max_size = READ_BYTES >> (4 if self._debt else 0)  # type: ignore[attr-defined]
        if self._debt > MOST_DEBT:
            log.warning("a connection was closed: its bytes take too long to read")
            self.transport.abort()
            return
        busy = self.scope is not None and not self.cycle.response_complete
        if busy and self._listening is not None:
            self._listening.cancel()
            self._listening = None
        elif not busy and self._listening is None:
            self._listening = self.loop.call_later(HEADER_SECONDS, self.transport.close)

    def resume_writing(self) -> None:
        super().resume_writing()
        self._taken = True

    def _watch(self) -> None:
        """Give up on a client that has taken nothing of what waits for it since the last look."""
        unsent = self.transport.get_write_buffer_size()
        if unsent and unsent == self._unsent and not self._taken:
            self.transport.abort()
            return
        self._unsent, self._taken = unsent, False
        self._watching = self.loop.call_later(READ_SECONDS, self._watch)

    def send_400_response(self, msg: str) -> None:
        """What is no HTTP, or has headers of more than 64 KiB: the same kind of answer as to everything else."""
        found = problem("bad-http", "this is not HTTP, or its headers take more than 64 KiB")
        body = found.model_dump_json(exclude_none=True).encode()
        headers = [
            (b"content-type", MEDIA_TYPE.encode()),
            (b"content-length", str(len(body)).encode()),
            (b"connection", b"close"),
        ]
        events = (h11.Response(status_code=found.status, headers=headers), h11.Data(data=body), h11.EndOfMessage())
        for event in events:
            self.transport.write(self.conn.send(event) or b"")
        self.transport.close()

    def connection_lost(self, exc: Exception | None) -> None:
        for timer in (self._listening, self._watching):
            if timer is not None:
                timer.cancel()
        super().connection_lost(exc)


def allow_connections() -> None:
    """Have enough descriptors for all connections; where the system forbids that, have fewer connections."""
    wanted = MAX_CONNECTIONS + SPARE_DESCRIPTORS
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft < wanted:
        most = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
        _Impatient.most_connections = max(10, most - SPARE_DESCRIPTORS)


def listen(settings: ServiceSettings) -> socket.socket:
    """Take the port, before anything else is begun.

    Raises:
        SettingsError: it is taken, or the address is none of this machine.
    """
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    try:
        listener = socket.create_server((settings.host, settings.port), family=family, backlog=2048)
    except OSError as error:
        where, reason = f"{settings.host}:{settings.port}", (error.strerror or str(error)).lower()
        raise SettingsError(f"KISSGS_HOST, KISSGS_PORT: cannot listen on {where}: {reason}; choose others") from error
    # Inherited by its connections. asyncio would set it, but not for sockets that it has not made: 40 ms an answer.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return listener


class Server(uvicorn.Server):
    """Serves one application, and tells its parts at once when it is to stop."""

    def __init__(self, app: object, context: ServiceContainer) -> None:
        self._context = context
        super().__init__(config_of(app))

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Say where, once it can be reached."""
        await super().startup(sockets)
        for listener in sockets or []:
            host, port = listener.getsockname()[:2]
            log.info("listening on http://%s:%d", f"[{host}]" if ":" in host else host, port)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Let jobs and requests finish at the same time."""
        await asyncio.gather(self._context.worker.drain(), super().shutdown(sockets))

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Take no more jobs, end streams and long polls, then let uvicorn finish its requests.

        uvicorn's own would end the process by the same signal afterwards, which looks like a crash.
        """
        if self.should_exit:
            self._context.worker.kill_running()
        self._context.worker.draining = True
        self._context.notifier.close()
        self.force_exit = self.should_exit  # asked twice
        self.should_exit = True


def config_of(app: object) -> uvicorn.Config:
    """How uvicorn is to serve an application."""
    return uvicorn.Config(
        app,  # type: ignore[arg-type]
        http=_Impatient,
        ws="none",
        access_log=False,
        log_config=None,
        server_header=False,
        proxy_headers=False,
        timeout_graceful_shutdown=10,
    )
