"""A naive writer of VP8L (RFC 9649), bit by bit."""

from __future__ import annotations

import struct

import numpy as np

ORDER = (17, 18, 0, 1, 2, 3, 4, 5, 16, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15)
PREDICTOR, CROSS_COLOUR, SUBTRACT_GREEN, INDEXING = range(4)


def stream_of(data):
    """Return the VP8L chunk of a file."""
    at = 12
    while data[at : at + 4] != b"VP8L":
        size = struct.unpack_from("<I", data, at + 4)[0]
        at += 8 + size + (size & 1)
    return data[at + 8 : at + 8 + struct.unpack_from("<I", data, at + 4)[0]]


def codes_of(lengths):
    """Return the symbols of a canonical code by (length, code), shortest first."""
    code, last, found = 0, 0, {}
    for length, symbol in sorted((length, symbol) for symbol, length in enumerate(lengths) if length):
        code <<= length - last
        found[length, code] = symbol
        code, last = code + 1, length
    return found


def tiles(size, bits):
    return -(-size // (1 << bits))


# In the order of RFC 9649: columns to the left, rows up.
NEAR = [
    *((0, 1), (1, 0), (1, 1), (-1, 1), (0, 2), (2, 0), (1, 2), (-1, 2), (2, 1), (-2, 1), (2, 2), (-2, 2), (0, 3)),
    *((3, 0), (1, 3), (-1, 3), (3, 1), (-3, 1), (2, 3), (-2, 3), (3, 2), (-3, 2), (0, 4), (4, 0), (1, 4), (-1, 4)),
    *((4, 1), (-4, 1), (3, 3), (-3, 3), (2, 4), (-2, 4), (4, 2), (-4, 2), (0, 5), (3, 4), (-3, 4), (4, 3), (-4, 3)),
    *((5, 0), (1, 5), (-1, 5), (5, 1), (-5, 1), (2, 5), (-2, 5), (5, 2), (-5, 2), (4, 4), (-4, 4), (3, 5), (-3, 5)),
    *((5, 3), (-5, 3), (0, 6), (6, 0), (1, 6), (-1, 6), (6, 1), (-6, 1), (2, 6), (-2, 6), (6, 2), (-6, 2), (4, 5)),
    *((-4, 5), (5, 4), (-5, 4), (3, 6), (-3, 6), (6, 3), (-6, 3), (0, 7), (7, 0), (1, 7), (-1, 7), (5, 5), (-5, 5)),
    *((7, 1), (-7, 1), (4, 6), (-4, 6), (6, 4), (-6, 4), (2, 7), (-2, 7), (7, 2), (-7, 2), (3, 7), (-3, 7), (7, 3)),
    *((-7, 3), (5, 6), (-5, 6), (6, 5), (-6, 5), (8, 0), (4, 7), (-4, 7), (7, 4), (-7, 4), (8, 1), (8, 2), (6, 6)),
    *((-6, 6), (8, 3), (5, 7), (-5, 7), (7, 5), (-7, 5), (8, 4), (6, 7), (-6, 7), (7, 6), (-7, 6), (8, 5), (7, 7)),
    *((-7, 7), (8, 6), (8, 7)),
]


class Writer:
    """Writer of a stream's bits, lowest first."""

    def __init__(self, width, height, alpha=1, version=0):
        self.bits = []
        self.put(0x2F, 8)
        self.put(width - 1, 14)
        self.put(height - 1, 14)
        self.put(alpha, 1)
        self.put(version, 3)

    def put(self, value, count):
        self.bits += [value >> i & 1 for i in range(count)]

    def simple(self, *symbols):
        """Write a code of one or two symbols."""
        self.put(1, 1)
        self.put(len(symbols) - 1, 1)
        self.put(1, 1)
        for symbol in symbols:
            self.put(symbol, 8)
        return codes_of([int(symbol in symbols) for symbol in range(256)])

    def code(self, lengths, size=None):
        """Write a code with these lengths, padded with zeros to ``size``; each length takes four bits."""
        self.put(0, 1)
        self.put(15, 4)
        for symbol in ORDER:
            self.put(4 * (symbol < 16), 3)
        self.put(0, 1)
        lengths = [*lengths, *[0] * ((size or 0) - len(lengths))]
        for length in lengths:
            self.bits += [length >> i & 1 for i in (3, 2, 1, 0)]
        return codes_of(lengths)

    def symbol(self, codes, symbol):
        if len(codes) == 1:
            assert symbol in codes.values()
            return
        length, code = next(key for key, found in codes.items() if found == symbol)
        self.bits += [code >> i & 1 for i in reversed(range(length))]

    def literal_codes(self, cache=0, lengths=False):
        """Write five codes with all symbols: 8 bits per value, or 9 bits with lengths and cached colours."""
        size = 280 + (1 << cache if cache else 0)
        if not cache and not lengths:
            green = self.code([8] * 256, size)
        else:
            depth = (size - 1).bit_length()
            short = (1 << depth) - size  # this number of codes is one bit shorter, so that the code is complete
            green = self.code([depth - 1] * short + [depth] * (size - short))
        rest = [self.code([8] * 256) for _ in range(3)]
        return [green, *rest, self.code([5] * 24 + [6] * 16)]

    def pixel(self, codes, argb):
        for code, shift in zip(codes, (8, 16, 0, 24), strict=False):
            self.symbol(code, argb >> shift & 255)

    def image(self, pixels, main=False):
        """Write an image as literals, without a cache or meta codes."""
        self.put(0, 1 + main)
        codes = self.literal_codes()
        for argb in pixels:
            self.pixel(codes, int(argb))

    def transform(self, kind, bits=None):
        self.put(1, 1)
        self.put(kind, 2)
        if bits is not None:
            self.put(bits - 2, 3)

    def file(self):
        stream = np.packbits(self.bits, bitorder="little").tobytes()
        return wrapped(stream)


def chunk(kind, data):
    return kind + struct.pack("<I", len(data)) + data + b"\0" * (len(data) & 1)


def riff(*chunks):
    body = b"WEBP" + b"".join(chunks)
    return b"RIFF" + struct.pack("<I", len(body)) + body


def wrapped(stream):
    return riff(chunk(b"VP8L", stream))
