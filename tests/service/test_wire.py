"""Requests split into any packets; oracles: RFC 2046, RFC 6454 and the grammar of PLY."""

import asyncio
import contextlib
import time

import pytest
from helpers.service import SMALL, problem, read_response

from service.core.problems import ProblemError
from service.core.settings import ServiceSettings
from service.http.uploads import MAX_PREAMBLE_BYTES, PartBegin, SceneUpload, parts
from service.jobs.admission import Admission

HEAD = SMALL.index(b"end_header\n") + 11
BOUNDARY = "multipart/form-data; boundary=b"
FORM = (
    b'--b\r\nContent-Disposition: form-data; name="options"\r\n\r\n{}\r\n'
    b'--b\r\nContent-Disposition: form-data; name="file"; filename="x.ply"\r\n\r\nply\n\r\n--b--\r\n'
)


@pytest.mark.parametrize(
    "origin", ["http://[x", "http://[::1", "http://]", "http://[v1.x]y", "null", "", "//", "http:/x"]
)
def test_invalid_origins_are_foreign(service, origin):
    answer = service.http.post("/v1/jobs", content=b"", headers={"Origin": origin})
    problem(answer, 403, "foreign")


@pytest.mark.parametrize("host", ["[x", "[::1", "]", "[x]:80:80"])
@pytest.mark.quick(1)
def test_invalid_hosts(start, host):
    service = start(KISSGS_KEYS=f"a:{'0' * 64}")  # with keys, all host names are allowed
    for path in ("nothing", "livez", "readyz", "preview/x"):
        with service.raw(f"PATCH /{path} HTTP/1.1\r\nHost: {host}\r\n\r\n".encode()) as connection:
            assert read_response(connection)[:10] == b"HTTP/1.1 4"


def test_enormous_content_lengths(service):
    head = b"POST /v1/jobs HTTP/1.1\r\nHost: localhost\r\nContent-Length: %s\r\n\r\n"
    for digits in (19, 5000):
        with service.raw(head % (b"9" * digits)) as connection:
            assert read_response(connection)[:10] == b"HTTP/1.1 4"


class UnlimitedAdmission:
    """Admission without limits."""

    parsing = contextlib.nullcontext()

    def check_space(self, size):
        pass

    reserve = wrote = check_space

    def release(self, size, written):
        pass


async def receive_scene(folder, *packets, complete=True):
    async with SceneUpload(ServiceSettings(), UnlimitedAdmission(), folder / "x.part") as spool:
        for packet in packets:
            await spool.write(packet)
        if complete:
            _, info = await spool.finish()
            assert (spool.size, spool.path.stat().st_size, info.count) == (*[sum(map(len, packets))] * 2, 300)


@pytest.mark.parametrize("end", [b"\n", b"\r\n"])
@pytest.mark.quick(1)
def test_comments_that_look_like_the_end_of_the_header(tmp_path, end):
    """The header may be split anywhere; a packet that ended after such a comment was once refused."""
    comments = b"comment see end_header\ncomment end_header \ncomment x, end_header\n"
    head = SMALL[:HEAD].replace(b"element", comments + b"element", 1).replace(b"\n", end)

    async def receive():
        for cut in range(len(head) + 3):
            await receive_scene(tmp_path, head[:cut], head[cut:] + SMALL[HEAD:], complete=cut % 50 == 0)
        await receive_scene(tmp_path, *(head[i : i + 1] for i in range(len(head))), SMALL[HEAD:])

    asyncio.run(receive())


def test_a_header_is_still_checked_before_the_body(tmp_path):
    head = SMALL[:HEAD].replace(b"vertex 300\n", b"vertex 5000001\n")

    asyncio.run(receive_scene(tmp_path, head[:-1], complete=False))
    with pytest.raises(ProblemError, match="5,000,001 Gaussians"):
        asyncio.run(receive_scene(tmp_path, head[:-1], head[-1:], complete=False))


def events_of(*packets):
    """Return the beginnings of the parts of a form, and the bytes between them."""

    async def chunks():
        for packet in packets:
            yield packet

    async def collect():
        return [event async for event in parts(BOUNDARY, chunks())]

    return asyncio.run(collect())


def parsed(*packets):
    fields, name = {}, None
    for event in events_of(*packets):
        match event:
            case PartBegin(name, _):
                fields[name] = b""
            case bytes():
                fields[name] += event
    return fields


FIELDS = {"options": b"{}", "file": b"ply\n"}

WRAPPED = {
    "preamble": b"This is a message with several parts.\r\n--bb\r\n --b\r\nx--b\r\n" + FORM,
    "empty lines": b"\r\n\r\n" + FORM,
    "epilogue": FORM + b"This is the epilogue.\r\n--b\r\nIt is also to be ignored.",
    "both": b"preamble\r\n" + FORM + b"epilogue",
    "padding": b"--b \t \r\n" + FORM[5:],
    "neither": FORM,
}


@pytest.mark.parametrize("kind", WRAPPED)
def test_text_around_a_form_is_ignored(kind):
    body = WRAPPED[kind]
    for cut in range(0, len(body) + 1, 3):
        assert parsed(body[:cut], body[cut:]) == FIELDS, cut
    assert parsed(*(body[i : i + 1] for i in range(len(body)))) == FIELDS


def test_the_preamble_is_limited():
    assert parsed(b"x" * (MAX_PREAMBLE_BYTES - 2) + b"\r\n" + FORM) == FIELDS
    for packets in ([b"x" * 100] * 1000, [b"x" * 100_000], [b"x" * 50_000 + b"\r\n" + FORM]):
        with pytest.raises(ProblemError, match="before its first boundary"):
            parsed(*packets)
    with pytest.raises(ProblemError, match="no line with its boundary"):
        parsed(b"nothing of the kind")


@pytest.mark.parametrize("where", ["before", "after"])
def test_text_around_a_form_is_limited(service, where):
    form = b'--b\r\nContent-Disposition: form-data; name="file"\r\n\r\n' + SMALL + b"\r\n--b--\r\n"
    packets = [b"x" * 10_000 + b"\r\n"] * 100
    packets = [*packets, form] if where == "before" else [form, *packets]
    answer = service.http.post("/v1/jobs", content=iter(packets), headers={"Content-Type": BOUNDARY})
    problem(answer, 422, "invalid-request")
    assert list((service.folder / "incoming").iterdir()) == []


FRAMINGS = {
    "both": (b"HTTP/1.1", b"Content-Length: 4\r\nTransfer-Encoding: chunked\r\n"),
    "both, chunked first": (b"HTTP/1.1", b"Transfer-Encoding: Chunked\r\nContent-Length: 4\r\n"),
    "two lengths": (b"HTTP/1.1", b"Content-Length: 4\r\nContent-Length: 5\r\n"),
    "two lengths in one line": (b"HTTP/1.1", b"Content-Length: 4, 5\r\n"),
    "signed length": (b"HTTP/1.1", b"Content-Length: +4\r\n"),
    "another coding": (b"HTTP/1.1", b"Transfer-Encoding: gzip, chunked\r\n"),
    "two codings": (b"HTTP/1.1", b"Transfer-Encoding: chunked\r\nTransfer-Encoding: identity\r\n"),
    "chunked in HTTP/1.0": (b"HTTP/1.0", b"Connection: keep-alive\r\nTransfer-Encoding: chunked\r\n"),
    "space before the colon": (b"HTTP/1.1", b"Transfer-Encoding : chunked\r\nContent-Length: 4\r\n"),
    "bare carriage return": (b"HTTP/1.1", b"X: a\rTransfer-Encoding: chunked\r\nContent-Length: 4\r\n"),
}


def all_received(connection):
    """Return all that the service sends until it closes the connection."""
    connection.settimeout(60)
    answer = b""
    with contextlib.suppress(ConnectionResetError):
        while block := connection.recv(65536):
            answer += block
    return answer


@pytest.mark.parametrize("kind", FRAMINGS)
def test_requests_of_ambiguous_length_are_refused(service, kind):
    """The rest was once answered as another request. Oracle: RFC 9112, sections 2.2, 5.1, 6.1 and 6.3."""
    version, headers = FRAMINGS[kind]
    rest = b"0\r\n\r\nGET /version HTTP/1.1\r\nHost: localhost\r\n\r\n"
    with service.raw(b"POST /v1/jobs %s\r\nHost: localhost\r\n%s\r\n%s" % (version, headers, rest)) as connection:
        answer = all_received(connection)
    assert answer.startswith(b"HTTP/1.1 400")
    assert answer.count(b"HTTP/1.1 ") == 1
    assert b"\r\nCross-Origin-Resource-Policy: same-origin\r\n" in answer


@pytest.mark.parametrize("path", ["/", "/v1/jobs", "/static/style.css", "/preview/", "/nothing", "/docs"])
def test_other_sites_cannot_embed_answers(service, path):
    """Oracle: the Fetch standard's Cross-Origin-Resource-Policy check."""
    assert service.http.get(path).headers["cross-origin-resource-policy"] == "same-origin"


def test_lines_of_a_header_may_end_without_a_carriage_return(service):
    """RFC 9112, section 2.2, permits it; the end of the request is then the same for everyone."""
    head = b"POST /v1/jobs HTTP/1.1\nHost: localhost\nContent-Length: 4\nConnection: close\n\n"
    with service.raw(head + b"ply\nGET /version HTTP/1.1\r\nHost: localhost\r\n\r\n") as connection:
        answer = all_received(connection)
    assert answer.count(b"HTTP/1.1 ") == 1
    assert answer.startswith(b"HTTP/1.1 422")


NAMES = {
    "filename*=UTF-8''s%C3%BC%C3%9F.ply": "süß.ply",
    "filename*=utf-8'de'%e2%82%ac.ply": "€.ply",
    "filename*=iso-8859-1''caf%e9.ply": "café.ply",
    "filename=\"plain.ply\"; filename*=UTF-8''n%C3%A9.ply": "né.ply",
    "filename*=UTF-8''n%C3%A9.ply; filename=plain.ply": "né.ply",
    "filename*=\"UTF-8''quoted.ply\"": "quoted.ply",
    "FileName* = UTF-8''spaced.ply ": "spaced.ply",
    # Malformed, or of an encoding that RFC 8187 does not name.
    "filename*=UTF-8''caf%e9.ply; filename=plain.ply": "plain.ply",
    "filename*=UTF-8''%zz.ply; filename=plain.ply": "plain.ply",
    "filename*=UTF-8''a b.ply; filename=plain.ply": "plain.ply",
    "filename*=UTF-16''a.ply; filename=plain.ply": "plain.ply",
    "filename*=süß.ply; filename=plain.ply": "plain.ply",
    "filename*=UTF-8''; filename=plain.ply": "plain.ply",
    "filename*=UTF-8''%e9.ply": None,
    # Text in quotes is no parameter.
    "filename=\"x; filename*=UTF-8''other.ply\"": "x; filename*=UTF-8''other.ply",
}


def file_names(parameters):
    form = b'--b\r\nContent-Disposition: form-data; name="file"; %s\r\n\r\n\r\n--b--\r\n' % parameters.encode()
    return [event.filename for event in events_of(form)]


@pytest.mark.parametrize("given", NAMES)
def test_extended_file_names(given):
    """Oracle: RFC 8187 and RFC 6266, section 4.3."""
    assert file_names(given) == [NAMES[given]]


def test_two_uploads_at_a_time_are_parsed(tmp_path, monkeypatch):
    """The headers of sixteen simultaneous uploads once took memory all at once."""
    running, counts, read = [], [], SceneUpload._read_info

    def watched(spool):
        running.append(spool)
        counts.append(len(running))
        time.sleep(0.02)
        running.remove(spool)
        return read(spool)

    monkeypatch.setattr(SceneUpload, "_read_info", watched)

    async def receive():
        admission = UnlimitedAdmission()
        admission.parsing = Admission(ServiceSettings(), None, None, None).parsing
        await asyncio.gather(*(one(admission, tmp_path / f"{i}.part") for i in range(8)))

    async def one(admission, path):
        async with SceneUpload(ServiceSettings(), admission, path) as spool:
            await spool.write(SMALL)
            assert (await spool.finish())[1].count == 300

    asyncio.run(receive())
    assert max(counts) == 2
