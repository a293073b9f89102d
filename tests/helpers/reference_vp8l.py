"""A naive reader and a naive writer of VP8L (RFC 9649), bit by bit, to count features and to write streams."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

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


@dataclass
class Facts:
    """Counts of the features that occur in a stream."""

    transforms: list = field(default_factory=list)
    tile_bits: list = field(default_factory=list)
    palettes: list = field(default_factory=list)
    caches: list = field(default_factory=list)
    groups: int = 0
    longest: int = 0
    literals: int = 0
    cached: int = 0
    near: int = 0
    far: int = 0
    single: int = 0


class Reader:
    """Reader of a whole stream, without inverting transforms."""

    def __init__(self, data):
        self.bits = np.unpackbits(np.frombuffer(stream_of(data), np.uint8), bitorder="little").tolist()
        self.at = 0
        self.facts = Facts()
        assert self.read(8) == 0x2F
        self.width, self.height = self.read(14) + 1, self.read(14) + 1
        self.alpha = self.read(1)
        assert self.read(3) == 0
        self.run()

    def read(self, count):
        found = self.bits[self.at : self.at + count]
        assert len(found) == count
        self.at += count
        return sum(bit << i for i, bit in enumerate(found))

    def symbol(self, codes):
        if len(codes) == 1:
            return next(iter(codes.values()))
        code = 0
        for length in range(1, 16):
            code = 2 * code + self.read(1)
            if (length, code) in codes:
                return codes[length, code]
        raise AssertionError("no such code")

    def number(self, symbol):
        if symbol < 4:
            return symbol + 1
        extra = (symbol - 2) >> 1
        return ((2 + (symbol & 1)) << extra) + self.read(extra) + 1

    def run(self):
        width = self.width
        while self.read(1):
            kind = self.read(2)
            self.facts.transforms.append(kind)
            if kind == INDEXING:
                size = self.read(8) + 1
                self.image(size, 1)
                self.facts.palettes.append(size)
                width = tiles(width, 0 if size > 16 else 1 if size > 4 else 2 if size > 2 else 3)
            elif kind != SUBTRACT_GREEN:
                bits = self.read(3) + 2
                self.facts.tile_bits.append(bits)
                self.image(tiles(width, bits), tiles(self.height, bits))
        self.image(width, self.height, main=True)

    def lengths(self, size):
        lengths = [0] * size
        if self.read(1):
            two = self.read(1)
            symbols = [self.read(8 if self.read(1) else 1)] + ([self.read(8)] if two else [])
            for symbol in symbols:
                lengths[symbol] = 1
            return lengths
        of_lengths = [0] * 19
        for symbol in ORDER[: self.read(4) + 4]:
            of_lengths[symbol] = self.read(3)
        codes = codes_of(of_lengths)
        left = 2 + self.read(2 + 2 * self.read(3)) if self.read(1) else size
        at, last = 0, 8
        while at < size and left:
            left -= 1
            length = self.symbol(codes)
            if length < 16:
                lengths[at] = length
                last = length or last
                at += 1
                continue
            count = self.read({16: 2, 17: 3, 18: 7}[length]) + {16: 3, 17: 3, 18: 11}[length]
            lengths[at : at + count] = [last if length == 16 else 0] * count
            at += count
        assert len(lengths) == size
        return lengths

    def image(self, width, height, main=False):
        cache_bits = self.read(4) if self.read(1) else 0
        facts, groups, choice, bits = self.facts, 1, [0], 14
        if main:
            facts.caches.append(cache_bits)
            if self.read(1):
                bits = self.read(3) + 2
                choice = [pixel >> 8 & 0xFFFF for pixel in self.image(tiles(width, bits), tiles(height, bits))]
                groups = max(choice) + 1
            facts.groups = groups
        codes = []
        for _ in range(groups):
            sizes = (280 + (1 << cache_bits if cache_bits else 0), 256, 256, 256, 40)
            codes.append([codes_of(self.lengths(size)) for size in sizes])
            facts.single += sum(len(code) == 1 for code in codes[-1])
            facts.longest = max(facts.longest, *(length for code in codes[-1] for length, _ in code))
        pixels, cache, kept = [], [0] * (1 << cache_bits), 0
        while len(pixels) < width * height:
            y, x = divmod(len(pixels), width)
            green, red, blue, alpha, distance = codes[choice[(y >> bits) * tiles(width, bits) + (x >> bits)]]
            symbol = self.symbol(green)
            if symbol < 256:
                facts.literals += 1
                pixel = symbol << 8 | self.symbol(red) << 16
                pixels.append(pixel | self.symbol(blue) | self.symbol(alpha) << 24)
            elif symbol < 280:
                length = self.number(symbol - 256)
                code = self.number(self.symbol(distance))
                if code > 120:
                    facts.far, back = facts.far + 1, code - 120
                else:
                    left, up = NEAR[code - 1]
                    facts.near, back = facts.near + 1, max(left + up * width, 1)
                for _ in range(length):
                    pixels.append(pixels[-back])
            else:
                facts.cached += 1
                for pixel in pixels[kept:]:
                    cache[(0x1E35A7BD * pixel & 0xFFFFFFFF) >> (32 - cache_bits)] = pixel
                kept = len(pixels)
                pixels.append(cache[symbol - 280])
        assert len(pixels) == width * height
        return pixels


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
