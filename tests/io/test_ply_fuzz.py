"""Oracle: whatever the bytes, reading them gives a scene or a KissgsError, and takes little memory."""

import io

from helpers.examples import examples
from helpers.memory import takes_less_than
from helpers.reference_compressed_ply import header_bytes as compressed_header
from helpers.reference_ply import ENCODINGS, STRUCT_CODES, assert_identical, ply_bytes, random_columns
from hypothesis import example, given
from hypothesis import strategies as st

from kissgs.core.errors import KissgsError
from kissgs.core.splats import clean
from kissgs.io.ply import read_ply, read_ply_info, write_ply

MEMORY = 20_000_000
"""Bytes; the files here are below 20 kB, so anything near this came from trusting a count."""

SEEDS = [ply_bytes(random_columns(3, 1), encoding) for encoding in ENCODINGS]
SEEDS += [compressed_header(3, 9) + bytes(range(72)) + bytes(range(75)), compressed_header(1, 0, False) + b"\x7f" * 64]

KEYWORDS = ["ply", "format", "element", "property", "list", "comment", "end_header", "vertex", "chunk", "sh"]
NUMBERS = ["0", "1", "2", "-1", "1.0", "99999999999999999"]
ODDITIES = ["packed_position", "red", "\0", "é", "\r", ""]
WORDS = st.sampled_from([*KEYWORDS, *NUMBERS, *ODDITIES, *STRUCT_CODES, *ENCODINGS, *random_columns(1, 1)])
LINES = st.lists(WORDS, max_size=5).map(" ".join)


@st.composite
def mutated_header(draw):
    """A valid file, some of its header lines replaced, removed, or out of place."""
    header, _, body = draw(st.sampled_from(SEEDS)).partition(b"end_header\n")
    lines = header.decode().splitlines()
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(1, len(lines)))
        lines[at : at + draw(st.integers(0, 2))] = draw(st.lists(LINES | st.sampled_from(lines), max_size=2))
    return "\n".join([*lines, "end_header", ""]).encode() + body


def check(data):
    splats, message = outcome(data)
    if splats is None:
        assert message.startswith("the data")
        assert "\n" not in message
        return
    info = read_ply_info(data)
    assert (info.count, info.sh_degree) == (len(splats), splats.sh_degree)
    stream = io.BytesIO()
    write_ply(stream, splats)
    assert_identical(read_ply(stream.getvalue()), splats)
    clean(splats)


def outcome(data):
    """The scene, or the sentence. Anything else that is raised fails the test, as does much memory."""
    outcomes = []

    def run():
        try:
            outcomes.append((read_ply(data), ""))
        except KissgsError as error:
            outcomes.append((None, str(error)))

    assert takes_less_than(MEMORY, run)
    return outcomes[0]


@examples(300)
@given(mutated_header())
def test_mutated_headers(data):
    check(data)


@examples(100)
@given(st.binary(max_size=200) | st.lists(LINES, max_size=20).map(lambda lines: "\n".join(["ply", *lines]).encode()))
@example(b"ply\nformat ascii 1.0\nelement vertex " + b"9" * 5000 + b"\nend_header\n")
def test_any_bytes(data):
    check(data)
