"""Damaged files: many mutations of a valid one, each read to a scene or to one sentence, within time and memory."""

import random
import time

import numpy as np

from helpers.examples import thorough
from helpers.memory import takes_less_than
from kissgs.core.errors import KissgsError

DEFAULT_MUTATIONS, THOROUGH_MUTATIONS = 15, 1000

MEMORY = 40_000_000
"""Bytes; the files here hold some dozen Gaussians, so anything near this came from trusting a number."""

SECONDS = 5.0
"""Longest time of one reading on a busy machine; one takes some milliseconds."""

WORDS = [0, 1, 0xFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 1 << 20, 3_000_000]
MEMORY_EVERY = 10
"""Memory is measured at every so many mutations, because tracing makes a call ten times slower."""


def mutations(data, seed):
    """Yield damaged copies: cut off, bits flipped, bytes and numbers overwritten, parts removed or doubled."""
    draw = random.Random(seed)
    for _ in range(THOROUGH_MUTATIONS if thorough() else DEFAULT_MUTATIONS):
        damaged = bytearray(data)
        for _ in range(draw.choice([1, 1, 1, 2, 4])):
            # Headers are at the beginning, where most of the decisions are.
            at = draw.randrange(min(len(damaged), 64) if draw.random() < 0.5 else len(damaged) or 1)
            kind = draw.choice(["cut off", "flip", "byte", "number", "remove", "double", "append"])
            if kind == "cut off":
                del damaged[at:]
            elif kind == "flip" and damaged:
                damaged[at] ^= 1 << draw.randrange(8)
            elif kind == "byte" and damaged:
                damaged[at] = draw.randrange(256)
            elif kind == "number":
                damaged[at : at + 4] = draw.choice(WORDS).to_bytes(4, "little")
            elif kind == "remove":
                del damaged[at : at + draw.randrange(1, 40)]
            elif kind == "double":
                damaged[at:at] = damaged[at : at + draw.randrange(1, 40)]
            elif kind == "append":
                damaged += draw.randbytes(draw.randrange(1, 40))
            if not damaged:
                break
        yield bytes(damaged)


def check(read):
    """Call ``read``: it returns a scene or raises a KissgsError of one sentence. Return whether it was a scene."""
    problem = ""
    try:
        splats = read()
        assert splats.means.dtype == np.float32
        return True
    except KissgsError as error:
        problem = str(error)
    assert problem
    assert "\n" not in problem
    assert len(problem) < 400, problem
    return False


def check_all(data, read, seed=0):
    """Check ``read`` with damaged copies of ``data``, and that at least one was refused."""
    refused = 0
    for i, damaged in enumerate(mutations(data, seed)):
        begin = time.perf_counter()
        refused += not check(lambda damaged=damaged: read(damaged))
        assert time.perf_counter() - begin < SECONDS
        if i % MEMORY_EVERY == 0:
            assert takes_less_than(MEMORY, lambda damaged=damaged: check(lambda: read(damaged)))
    assert refused
