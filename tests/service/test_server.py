"""Connections that are only there to be there; oracle: a clock."""

import asyncio
import contextlib
import socket
import threading
import time

import pytest
import uvicorn

from service.http import server

PATIENCE = 0.6


async def application(scope, receive, send):
    """Answers ``/`` at once, and anything else with more than any buffer takes, slowly asked or not."""
    assert scope["type"] == "http"
    await send({"type": "http.response.start", "status": 200, "headers": []})
    for _ in range(1 if scope["path"] == "/" else 400):
        await send({"type": "http.response.body", "body": bytes(100_000), "more_body": True})
        await asyncio.sleep(0)
    await send({"type": "http.response.body", "body": b""})


@pytest.fixture
def port(monkeypatch):
    monkeypatch.setattr(server, "HEADER_SECONDS", PATIENCE)
    monkeypatch.setattr(server, "READ_SECONDS", PATIENCE)
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
    connection.settimeout(20 * PATIENCE)
    with contextlib.suppress(ConnectionError):
        while connection.recv(1 << 16):
            pass
    connection.close()
    return time.monotonic() - begun


REQUEST = b"GET / HTTP/1.1\r\nHost: x\r\n\r\n"


@pytest.mark.parametrize(
    "said", [b"", b"GET / HTTP/1.1\r\nHost", REQUEST + b"GET / HTT", REQUEST + REQUEST + b"G"], ids=repr
)
def test_a_request_that_never_comes(port, said):
    with socket.create_connection(("127.0.0.1", port)) as connection:
        connection.sendall(said)
        assert 0.5 * PATIENCE < seconds_until_closed(connection) < 10 * PATIENCE


def test_headers_that_drip(port):
    begun = time.monotonic()
    with socket.create_connection(("127.0.0.1", port)) as connection, contextlib.suppress(ConnectionError):
        for byte in b"GET / HTTP/1.1\r\nX: " + b"x" * 1000:
            connection.sendall(bytes([byte]))
            time.sleep(0.05)
    assert time.monotonic() - begun < 10 * PATIENCE


def test_an_answer_that_nobody_takes(port):
    with socket.create_connection(("127.0.0.1", port)) as connection:
        connection.sendall(b"GET /long HTTP/1.1\r\nHost: x\r\n\r\n")
        time.sleep(4 * PATIENCE)
        taken = 0
        with contextlib.suppress(ConnectionError):
            while block := connection.recv(1 << 20):
                taken += len(block)
    assert taken < 400 * 100_000


def test_an_answer_that_is_taken_slowly_but_surely(port):
    with socket.create_connection(("127.0.0.1", port)) as connection:
        connection.sendall(b"GET /long HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n")
        taken = 0
        while block := connection.recv(1 << 20):
            taken += len(block)
            time.sleep(0.02)
    assert taken > 400 * 100_000


def test_what_is_used_stays_open(port):
    with socket.create_connection(("127.0.0.1", port)) as connection:
        for _ in range(6):
            connection.sendall(REQUEST)
            time.sleep(0.5 * PATIENCE)
            answer = b""
            while not answer.endswith(b"\r\n0\r\n\r\n"):
                answer += connection.recv(1 << 20)
            assert answer.startswith(b"HTTP/1.1 200")


def test_a_connection_may_be_used_for_long(port):
    """What parsing costs counts against a body, not against thousands of requests in a row."""
    with socket.create_connection(("127.0.0.1", port)) as connection:
        for _ in range(2000):
            connection.sendall(REQUEST)
            answer = b""
            while not answer.endswith(b"\r\n0\r\n\r\n"):
                block = connection.recv(1 << 20)
                assert block, "closed"
                answer += block
