"""Idle and slow connections; oracle: a clock."""

import asyncio
import contextlib
import socket
import threading
import time

import pytest
import uvicorn

from service.http import server

TIMEOUT = 0.6


async def application(scope, receive, send):
    """Respond to ``/`` with little data, and to other paths with more data than all buffers hold."""
    assert scope["type"] == "http"
    await send({"type": "http.response.start", "status": 200, "headers": []})
    for _ in range(1 if scope["path"] == "/" else 400):
        await send({"type": "http.response.body", "body": bytes(100_000), "more_body": True})
        await asyncio.sleep(0)
    await send({"type": "http.response.body", "body": b""})


@pytest.fixture
def port(monkeypatch):
    monkeypatch.setattr(server, "HEADER_SECONDS", TIMEOUT)
    monkeypatch.setattr(server, "READ_SECONDS", TIMEOUT)
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        config = server.config_of(application)
        config.lifespan = "off"
        running = uvicorn.Server(config)
        thread = threading.Thread(target=running.run, kwargs={"sockets": [listener]})
        thread.start()
        while not running.started:
            time.sleep(0.01)
        yield listener.getsockname()[1]
        running.should_exit = True
        thread.join(20)
        assert not thread.is_alive()


def seconds_until_closed(connection):
    begun = time.monotonic()
    connection.settimeout(20 * TIMEOUT)
    with contextlib.suppress(ConnectionError):
        while connection.recv(1 << 16):
            pass
    connection.close()
    return time.monotonic() - begun


REQUEST = b"GET / HTTP/1.1\r\nHost: x\r\n\r\n"


@pytest.mark.parametrize(
    "sent", [b"", b"GET / HTTP/1.1\r\nHost", REQUEST + b"GET / HTT", REQUEST + REQUEST + b"G"], ids=repr
)
@pytest.mark.quick(1)
def test_incomplete_requests(port, sent):
    with socket.create_connection(("127.0.0.1", port)) as connection:
        connection.sendall(sent)
        assert 0.5 * TIMEOUT < seconds_until_closed(connection) < 10 * TIMEOUT


def test_slow_headers(port):
    begun = time.monotonic()
    with socket.create_connection(("127.0.0.1", port)) as connection, contextlib.suppress(ConnectionError):
        for byte in b"GET / HTTP/1.1\r\nX: " + b"x" * 1000:
            connection.sendall(bytes([byte]))
            time.sleep(0.05)
    assert time.monotonic() - begun < 10 * TIMEOUT


def test_a_response_that_is_not_read(port):
    with socket.create_connection(("127.0.0.1", port)) as connection:
        connection.sendall(b"GET /long HTTP/1.1\r\nHost: x\r\n\r\n")
        time.sleep(4 * TIMEOUT)
        received = 0
        with contextlib.suppress(ConnectionError):
            while block := connection.recv(1 << 20):
                received += len(block)
    assert received < 400 * 100_000


def test_a_response_that_is_read_slowly(port):
    with socket.create_connection(("127.0.0.1", port)) as connection:
        connection.sendall(b"GET /long HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n")
        received = 0
        while block := connection.recv(1 << 20):
            received += len(block)
            time.sleep(0.02)
    assert received > 400 * 100_000


def test_active_connections_stay_open(port):
    with socket.create_connection(("127.0.0.1", port)) as connection:
        for _ in range(4):
            connection.sendall(REQUEST)
            time.sleep(0.5 * TIMEOUT)
            answer = b""
            while not answer.endswith(b"\r\n0\r\n\r\n"):
                answer += connection.recv(1 << 20)
            assert answer.startswith(b"HTTP/1.1 200")


def test_a_connection_with_a_thousand_requests(port):
    """The limit on parsing time applies to each body, not to all requests of a connection."""
    with socket.create_connection(("127.0.0.1", port)) as connection:
        for _ in range(1000):
            connection.sendall(REQUEST)
            answer = b""
            while not answer.endswith(b"\r\n0\r\n\r\n"):
                block = connection.recv(1 << 20)
                assert block, "closed"
                answer += block
