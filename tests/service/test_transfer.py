"""Transfers by signed addresses. Oracle: a small HTTP server whose failures a test chooses, and what it received."""

import errno
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

import kissgs
from service.jobs import transfer
from service.jobs.transfer import NodeDiskError, NodeError, StorageAccessError, client, fetch, store

DATA = bytes(range(256)) * 4000
SECRET = "?X-Amz-Signature=secret"
EXPIRED = b"<Error><Code>AccessDenied</Code><Message>Request has expired</Message></Error>"


class Storage:
    """Server whose answers a test chooses: each request takes the next of ``answers``, and the last ones succeed.

    An answer is a status with a body, "truncate" for half of the rest of the bytes, "close" for no answer at all,
    "wait" for one that comes too late, or "whole" for all bytes in spite of a range.
    """

    def __init__(self):
        self.answers, self.stored, self.requests = [], {}, []
        storage = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def log_message(self, *arguments):
                pass

            def do_GET(self):
                storage.requests.append(("GET", self.headers.get("Range")))
                first = int((self.headers.get("Range") or "bytes=0-")[6:-1])
                rest, answer = DATA[first:], storage.next()
                match answer:
                    case "close":
                        self.close_connection = True
                    case "wait":
                        storage.released.wait(30)
                        self.close_connection = True
                    case "truncate":
                        self.reply(206 if first else 200, rest[: len(rest) // 2], len(rest))
                        self.close_connection = True
                    case "whole":
                        self.reply(200, DATA)
                    case None:
                        self.reply(206 if first else 200, rest)
                    case _:
                        self.reply(*answer)

            def do_PUT(self):
                length = int(self.headers["Content-Length"])
                storage.requests.append(("PUT", self.headers.get("Transfer-Encoding")))
                answer = storage.next()
                if answer == "close":
                    self.close_connection = True
                    return
                if answer == "refuse early":  # as S3 does: without reading what follows
                    self.reply(403, EXPIRED)
                    self.close_connection = True
                    return
                body = self.rfile.read(length)
                if answer is None:
                    storage.stored[self.path.partition("?")[0]] = body
                    self.reply(200, b"")
                else:
                    self.reply(*answer)

            def reply(self, status, body, length=None):
                self.send_response(status)
                self.send_header("Content-Length", str(len(body) if length is None else length))
                self.end_headers()
                self.wfile.write(body)

        self.released = threading.Event()
        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.server.daemon_threads = True
        self.url = f"http://127.0.0.1:{self.server.server_port}/key{SECRET}"
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    def next(self):
        return self.answers.pop(0) if self.answers else None

    def close(self):
        self.released.set()
        self.server.shutdown()
        self.server.server_close()


@pytest.fixture
def storage():
    it = Storage()
    yield it
    it.close()


@pytest.fixture(autouse=True)
def brief_pauses(monkeypatch):
    monkeypatch.setattr(transfer, "PAUSES", (0.01, 0.02, 0.03))
    monkeypatch.setattr(transfer.time, "sleep", lambda seconds: None)


@pytest.fixture
def http():
    with client() as it:
        yield it


def test_a_file_arrives_and_is_stored(storage, http, tmp_path):
    fetch(http, storage.url, tmp_path / "file", len(DATA))
    assert (tmp_path / "file").read_bytes() == DATA
    store(http, tmp_path / "file", storage.url)
    assert storage.stored == {"/key": DATA}
    (tmp_path / "file").write_bytes(b"")
    store(http, tmp_path / "file", storage.url)
    assert storage.stored == {"/key": b""}
    assert storage.requests == [("GET", None), ("PUT", None), ("PUT", None)]  # with their lengths, not in chunks


BUSY = (503, b"<Error><Code>SlowDown</Code></Error>")


@pytest.mark.parametrize("failure", [BUSY, (500, b""), (429, b""), "close"])
def test_what_may_pass_is_tried_again(storage, http, tmp_path, failure):
    storage.answers = [failure, failure]
    fetch(http, storage.url, tmp_path / "file", len(DATA))
    assert (tmp_path / "file").read_bytes() == DATA
    storage.answers = [failure, failure]
    store(http, tmp_path / "file", storage.url)
    assert storage.stored == {"/key": DATA}


def test_a_download_goes_on_where_it_stopped(storage, http, tmp_path):
    """Every piece begins the pauses anew, so that a slow line needs no patience in all."""
    storage.answers = ["truncate"] * 8
    fetch(http, storage.url, tmp_path / "file", len(DATA))
    assert (tmp_path / "file").read_bytes() == DATA
    firsts = [int(sent[6:-1]) if sent else 0 for _, sent in storage.requests]
    assert firsts == sorted(set(firsts))
    assert len(firsts) == 9


def test_a_server_that_ignores_ranges(storage, http, tmp_path):
    storage.answers = ["truncate", "whole"]
    fetch(http, storage.url, tmp_path / "file", len(DATA))
    assert (tmp_path / "file").read_bytes() == DATA


def test_a_server_that_does_not_answer_in_time(storage, tmp_path, monkeypatch):
    monkeypatch.setattr(transfer, "IDLE_SECONDS", 0.3)
    storage.answers = ["wait"]
    with client() as http:
        fetch(http, storage.url, tmp_path / "file", len(DATA))
    assert (tmp_path / "file").read_bytes() == DATA


@pytest.mark.parametrize(
    ("answers", "expected"),
    [
        ([(403, EXPIRED)], "does not accept the signed addresses of the job any more: 403 AccessDenied"),
        ([(400, b"<Error><Code>ExpiredToken</Code></Error>")], "any more: 400 ExpiredToken"),
        ([(404, b"<Error><Code>NoSuchKey</Code></Error>")], "the storage refused a request: 404 NoSuchKey"),
        ([BUSY] * 9, "cannot use the storage: it answers 503 SlowDown"),
        (["close"] * 9, "cannot use the storage: server disconnected"),
        (["truncate", *["close"] * 9], "cannot use the storage: server disconnected"),
    ],
)
def test_one_sentence_without_the_address(storage, http, tmp_path, answers, expected):
    path = tmp_path / "file"
    for request in (lambda: fetch(http, storage.url, path, len(DATA)), lambda: store(http, path, storage.url)):
        storage.answers = [each for each in answers if each != "truncate" or not storage.requests]
        with pytest.raises(StorageAccessError) as raised:
            request()
        assert expected in str(raised.value)
        assert "secret" not in str(raised.value)
        path.write_bytes(DATA)


def test_an_address_that_expires_while_a_large_file_is_sent(storage, http, tmp_path):
    """The server closes the connection without reading; what it has answered counts, and is no reason to try again."""
    path = tmp_path / "file"
    with path.open("wb") as file:
        file.truncate(200 << 20)
    storage.answers = ["refuse early"]
    with pytest.raises(StorageAccessError, match="any more: 403 AccessDenied"):
        store(http, path, storage.url)
    assert len(storage.requests) == 1


def test_a_file_of_another_size(storage, http, tmp_path):
    with pytest.raises(StorageAccessError, match="has more than its 7 bytes"):
        fetch(http, storage.url, tmp_path / "file", 7)
    with pytest.raises(StorageAccessError, match=f"it sent {len(DATA)} of {len(DATA) + 1} bytes"):
        fetch(http, storage.url, tmp_path / "file", len(DATA) + 1)


def test_an_unreachable_storage(http, tmp_path):
    with pytest.raises(StorageAccessError, match=r"cannot use the storage: .*connection refused"):
        fetch(http, "http://127.0.0.1:1/key" + SECRET, tmp_path / "file", 5)


def test_a_file_that_one_request_cannot_hold(storage, http, tmp_path, monkeypatch):
    monkeypatch.setattr(transfer, "MAX_PUT_BYTES", len(DATA) - 1)
    (tmp_path / "scene.zip").write_bytes(DATA)
    with pytest.raises(kissgs.UnsupportedError, match=r"scene.zip has more than .* GiB, the most that"):
        store(http, tmp_path / "scene.zip", storage.url)
    assert storage.requests == []


def test_a_full_disk(storage, http, tmp_path, monkeypatch):
    def full(*arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(transfer, "_fetch_rest", full)
    with pytest.raises(NodeDiskError, match="is full: no space left on device"):
        fetch(http, storage.url, tmp_path / "file", len(DATA))
    with pytest.raises(NodeError, match="cannot write the job's files: no such file"):
        fetch(http, storage.url, tmp_path / "none" / "file", len(DATA))
