"""Streams that no encoder writes, made bit by bit; reference: Pillow (libwebp) on the same bytes."""

import base64
import hashlib
import itertools

import numpy as np
import pytest
from helpers.reference_vp8l import (
    CROSS_COLOUR,
    INDEXING,
    NEAR,
    ORDER,
    PREDICTOR,
    SUBTRACT_GREEN,
    Writer,
    codes_of,
    tiles,
)
from helpers.web_tools import decode_all, pillow

RNG = np.random.default_rng(0)


def argb(count, seed=0):
    return np.random.default_rng(seed).integers(0, 1 << 32, count).tolist()


ACCEPTED, REFUSED = [], []


def accepted(cases=None, into=ACCEPTED, why=""):
    """Register streams that both decoders read to the same pixels: all of a list, or one for each case."""

    def register(make):
        into.append((make.__name__, lambda: make() if cases is None else map(make, cases), why))
        return make

    return register


def refused(why, cases=None):
    """Register streams that both decoders refuse, this one with these words."""
    return accepted(cases, REFUSED, why)


def assert_like_pillow(name, data, got, channels=4):
    """Check that both decoders return the same pixels or refuse the file."""
    wanted = pillow(data)
    if wanted is None:
        assert got["name"] == "WebPError", (name, got)
        return
    assert "rgba" in got, (name, got)
    found = np.frombuffer(base64.b64decode(got["rgba"]), np.uint8).reshape(got["height"], got["width"], 4)
    assert (found[:, :, :channels] == wanted[:, :, :channels]).all(), name


def plain(width, height, seed=0):
    writer = Writer(width, height)
    writer.put(0, 1)
    writer.image(argb(width * height, seed), main=True)
    return writer


def with_tiles(kind, bits, width, height, pixel):
    """Return an image of noise with one transform, with a pixel for each tile."""
    writer = Writer(width, height)
    writer.transform(kind, bits)
    writer.image([pixel(i) for i in range(tiles(width, bits) * tiles(height, bits))])
    writer.put(0, 1)
    writer.image(argb(width * height, seed=bits), main=True)
    return writer


@accepted()
def plain_noise():
    return [plain(1, 1), plain(5, 3), plain(33, 17)]


@accepted()
def every_predictor_of_noise():
    """Modes 14 and 15 mean black; other bits of the tiles are ignored; narrow images have no pixel to the right."""
    writers = []
    for mode in range(16):
        tile = 0xFF0000FF | mode << 8
        sizes = (40, 19), (1, 9), (2, 9), (9, 1), (17, 33)
        writers += [with_tiles(PREDICTOR, 4, *size, lambda _, tile=tile: tile) for size in sizes]
        writers.append(with_tiles(PREDICTOR, 3, 30, 30, lambda i, mode=mode: (0xF0 | mode) << 8 | i))
    return writers


@accepted()
def every_size_of_tiles():
    writers = []
    for bits in range(2, 10):
        side = (1 << bits) + 5 if bits < 8 else 40
        writers += [
            with_tiles(PREDICTOR, bits, side, 21, lambda i: i % 14 << 8),
            with_tiles(CROSS_COLOUR, bits, side, 21, lambda i: i * 2654435761 & 0xFFFFFFFF),
            with_tiles(PREDICTOR, bits, 21, side, lambda i: i % 14 << 8),
        ]
    return writers


@accepted()
def every_factor_of_cross_colour():
    """Factors are signed bytes from -128 to 127, two tiles of each."""
    return [with_tiles(CROSS_COLOUR, 2, 64, 64, lambda i, at=at: (i % 256) << at) for at in (0, 8, 16)]


@accepted([(2, 0, 1), (1, 2, 0), (0, 1, 2), (0, 2), (1, 0), (2, 1)])
def transforms_in_any_order(order):
    writer = Writer(30, 20)
    for kind in order:
        writer.transform(kind, None if kind == SUBTRACT_GREEN else 3)
        if kind != SUBTRACT_GREEN:
            writer.image(np.array(argb(4 * 3, seed=kind)) & (0xFFFFF5FF if kind == PREDICTOR else -1))
    writer.put(0, 1)
    writer.image(argb(600), main=True)
    return writer


SIZES = (1, 2, 3, 4, 5, 15, 16, 17, 200, 256)
OTHERS = ((), (SUBTRACT_GREEN,), (PREDICTOR,), (CROSS_COLOUR, PREDICTOR))


@accepted([*itertools.product(SIZES, (True, False), OTHERS)])
def palettes_with_indices_beyond_their_end(case):
    """Transforms after a palette apply to packed pixels."""
    size, before, others = case
    width, height = 29, 11
    writer = Writer(width, height)

    def put_others():
        for kind in others:
            writer.transform(kind, None if kind == SUBTRACT_GREEN else 2)
            if kind != SUBTRACT_GREEN:
                writer.image([(i * 37 % 14) << 8 for i in range(tiles(across, 2) * tiles(height, 2))])

    across = width
    if before:
        put_others()
    writer.transform(INDEXING)
    writer.put(size - 1, 8)
    writer.image(argb(size, seed=size))
    across = tiles(width, 0 if size > 16 else 1 if size > 4 else 2 if size > 2 else 3)
    if not before:
        put_others()
    writer.put(0, 1)
    writer.image(argb(across * height), main=True)
    return writer


@accepted()
def codes_of_one_and_two_symbols():
    """Codes are simple or not, of one symbol of any length, of two equal symbols, or of a one-bit first symbol."""

    def green_of(write):
        writer = Writer(16, 16)
        writer.put(0, 3)
        codes = [write(writer), *(writer.simple(symbol) for symbol in (7, 255, 128, 0))]
        for value in np.random.default_rng(1).choice(list(codes[0]), 256):
            writer.symbol(codes[0], int(value))
        return writer

    def one_bit(writer):
        writer.put(0b0001, 4)  # read upwards: simple, one symbol, of one bit, 0
        return {0: (1, 0)}

    def only(length, symbol):
        return lambda writer: writer.code([0] * symbol + [length], 280)

    return [
        *(green_of(lambda writer, pair=pair: writer.simple(*pair)) for pair in [(3,), (3, 200), (200, 3), (0, 1)]),
        green_of(lambda writer: writer.simple(9, 9)),
        green_of(one_bit),
        *(green_of(only(length, 77)) for length in (1, 2, 8, 15)),
        green_of(lambda writer: writer.code([0] * 50 + [1, 1], 280)),
    ]


@accepted(range(1, 16))
def codes_up_to_15_bits(longest):
    """One symbol of each length gives the longest possible codes, with one or two tables."""
    lengths = [*range(1, longest + 1), longest]
    writer = Writer(32, 32)
    writer.put(0, 3)
    shuffled = np.random.default_rng(longest).permutation(longest + 1)
    codes = [writer.code([lengths[i] for i in shuffled], size) for size in (280, 256, 256, 256)]
    codes.append(writer.simple(0))
    for _ in range(1024):
        for code in codes[:4]:
            writer.symbol(code, int(RNG.integers(0, longest + 1)))
    return writer


@accepted()
def code_lengths_in_all_encodings():
    """Repeats 16, 17 and 18, also at the beginning (16 repeats 8 there), and a number of lengths."""
    writer = Writer(16, 16)
    writer.put(0, 3)
    writer.put(0, 1)
    writer.put(19 - 4, 4)
    of = {16: 1, 17: 2, 0: 3, 18: 3}
    for symbol in ORDER:
        writer.put(of.get(symbol, 0), 3)
    table = codes_of([of.get(symbol, 0) for symbol in range(19)])
    writer.put(0, 1)
    lengths = []
    for _ in range(42):  # 252 of 256
        writer.symbol(table, 16)
        writer.put(3, 2)
        lengths += [8] * 6
    writer.symbol(table, 16)
    writer.put(1, 2)
    lengths += [8] * 4
    writer.symbol(table, 0)
    writer.symbol(table, 17)
    writer.put(10 - 3, 3)
    writer.symbol(table, 18)
    writer.put(13 - 11, 7)
    assert 256 + 1 + 10 + 13 == 280
    assert len(lengths) == 256
    green = codes_of(lengths)
    rest = [writer.simple(symbol) for symbol in (1, 2, 255, 0)]
    for value in range(256):
        writer.symbol(green, value)
    assert len(rest) == 4
    return [writer]


def with_cache(width, height, bits):
    """Return an image with a colour cache and its codes, for pixels to follow."""
    writer = Writer(width, height)
    writer.put(0, 1)
    writer.put(1, 1)
    writer.put(bits, 4)
    writer.put(0, 1)
    return writer, writer.literal_codes(cache=bits)


@accepted(range(1, 12))
def colour_caches(bits):
    """Caches of all sizes, with pixels from filled and from empty slots, which are transparent black."""
    writer, codes = with_cache(40, 30, bits)
    rng = np.random.default_rng(bits)
    count = 0
    while count < 1200:
        if rng.random() < 0.5:
            writer.symbol(codes[0], 280 + int(rng.integers(0, 1 << bits)))
            count += 1
        elif rng.random() < 0.2 and 0 < count < 1190:
            writer.symbol(codes[0], 256 + 3)  # four pixels
            writer.symbol(codes[4], 1)  # from the left
            count += 4
        else:
            writer.pixel(codes, int(rng.integers(0, 1 << 32)))
            count += 1
    return writer


@accepted()
def a_colour_from_an_empty_slot_is_put_into_the_cache():
    """The colour of an empty slot is 0, which then replaces the colour in slot 0."""
    bits = 1
    kept = next(value for value in range(0xFF000001, 0xFFFFFFFF) if (0x1E35A7BD * value & 0xFFFFFFFF) >> 31 == 0)
    writer, codes = with_cache(3, 1, bits)
    writer.pixel(codes, kept)
    writer.symbol(codes[0], 281)
    writer.symbol(codes[0], 280)
    return [writer]


@accepted([1, 2, 5, 9, 40])
def every_distance_and_length(width):
    """Includes the 120 near distances; those that are not positive mean the previous pixel."""
    height = 400 // width + 30
    near = [*range(1, 121), 121, 125, 200, 300]
    writer = Writer(width, height)
    writer.put(0, 3)
    codes = writer.literal_codes(lengths=True)
    count, first = width * height, 9 * width + 300 if width < 9 else 9 * width
    first = min(max(first, 8 * 8), count - 1)

    def prefix(value):
        """Return the symbol, the extra bits and their number."""
        value -= 1
        if value < 4:
            return value, 0, 0
        extra = value.bit_length() - 2
        return 2 * (extra + 1) + (value >> extra & 1), value & ((1 << extra) - 1), extra

    at = 0
    for value in argb(first):
        writer.pixel(codes, value)
        at += 1
    step = 0
    while at < count:
        length = min(1 + step % 5 + (step % 11 == 0) * 17, count - at)
        code = near[step % len(near)]
        back = code - 120 if code > 120 else max(NEAR[code - 1][0] + NEAR[code - 1][1] * width, 1)
        step += 1
        if back > at:
            continue
        symbol, value, extra = prefix(length)
        writer.symbol(codes[0], 256 + symbol)
        writer.put(value, extra)
        symbol, value, extra = prefix(code)
        writer.symbol(codes[4], symbol)
        writer.put(value, extra)
        at += length
    return writer


@accepted(range(2, 10))
def groups_of_codes(bits):
    """Each tile has a group, whose number takes both bytes; some groups are never used."""
    width, height = (70, 9) if bits < 7 else (2 * (1 << bits) + 3, 2)
    writer = Writer(width, height)
    writer.put(0, 2)
    writer.put(1, 1)
    writer.put(bits - 2, 3)
    across = tiles(width, bits)
    count = across * tiles(height, bits)
    groups = [(i * 3 + 1) % 300 for i in range(count)]
    writer.image([group << 8 for group in groups])
    values = np.random.default_rng(bits).integers(0, 256, (max(groups) + 1, 4))
    for red, green, blue, alpha in values.tolist():
        for symbol in (green, red, blue, alpha, 0):
            writer.simple(symbol)
    return writer


@accepted()
def groups_of_codes_that_are_not_used():
    """All tiles use group 300, so that 301 groups are written and one is used."""
    writer = Writer(9, 9)
    writer.put(0, 2)
    writer.put(1, 1)
    writer.put(0, 3)
    writer.image([0xFF0000FF | 300 << 8] * 9)
    for i in range(301):
        for symbol in (i & 255, 1, 2, 255, 0):
            writer.simple(symbol)
    return [writer]


@pytest.mark.parametrize("hint", [0, 1])
def test_alpha_does_not_depend_on_the_hint(hint, tmp_path):
    """Pillow ignores alpha if the hint says so; then the reference is what was written."""
    writer = Writer(6, 4, alpha=hint)
    writer.put(0, 1)
    pixels = argb(24)
    writer.image(pixels, main=True)
    (got,) = decode_all(tmp_path, [writer.file()], pixels=True)
    assert_like_pillow(f"hint {hint}", writer.file(), got, channels=3 + hint)
    wanted = np.array(pixels, dtype=np.uint32).view(np.uint8).reshape(-1, 4)[:, [2, 1, 0, 3]]
    assert got["sha256"] == hashlib.sha256(np.ascontiguousarray(wanted)).hexdigest()


@refused("a transform that occurs twice", range(4))
def a_transform_twice(kind):
    writer = Writer(4, 4)
    for _ in range(2):
        writer.transform(kind, None if kind in (SUBTRACT_GREEN, INDEXING) else 2)
        if kind == INDEXING:
            writer.put(199, 8)
        if kind != SUBTRACT_GREEN:
            writer.image([0xFF000000] * (200 if kind == INDEXING else 1))
    writer.put(0, 1)
    writer.image(argb(16), main=True)
    return writer


@refused("version", range(1, 8))
def other_versions(version):
    writer = Writer(4, 4, version=version)
    writer.put(0, 1)
    writer.image(argb(16), main=True)
    return writer


@refused("cache", [0, 12, 13, 14, 15])
def caches_of_invalid_size(bits):
    writer, codes = with_cache(4, 4, bits)
    for value in argb(16):
        writer.pixel(codes, value)
    return writer


def made_code(lengths, which):
    writer = Writer(4, 4)
    writer.put(0, 3)
    for i, size in enumerate((280, 256, 256, 256, 40)):
        writer.code((lengths if i == which else [1, 1])[:size], size)
    writer.put(0, 200)
    return writer


@accepted()
def codes_of_one_long_symbol():
    return [made_code([2], which) for which in range(5)]


@refused("prefix code")
def incomplete_and_oversubscribed_codes():
    wrong = [], [1, 2], [1, 1, 1], [1, 2, 2, 2], [3] * 7, [3] * 9, [15] * 2, [1, *[15] * 200]
    return list(itertools.starmap(made_code, itertools.product(wrong, range(5))))


def test_copies_from_outside_the_image(tmp_path):
    writers = []
    for at, (length, distance) in itertools.product((0, 1, 5), ((0, 5 - 1), (3, 1))):
        writer = Writer(3, 2 if at < 5 else 3)
        writer.put(0, 3)
        codes = writer.literal_codes(lengths=True)
        for value in argb(at):
            writer.pixel(codes, value)
        writer.symbol(codes[0], 256 + length)
        writer.symbol(codes[4], distance)
        writer.put(0, 200)
        writers.append(writer)
    files = [writer.file() for writer in writers]
    for number, (data, got) in enumerate(zip(files, decode_all(tmp_path, files, pixels=True), strict=True)):
        assert_like_pillow(number, data, got)


@refused("more code lengths")
def more_code_lengths_than_symbols():
    """The number of code lengths exceeds the alphabet."""
    counted = Writer(4, 4)
    counted.put(0, 3)
    counted.put(0, 1)
    counted.put(15, 4)
    for i in range(19):
        counted.put(4 * (i not in (0, 1, 8)), 3)
    counted.put(1, 1)
    counted.put(7, 3)
    counted.put(0xFFFF, 16)
    counted.put(0, 4000)
    return [counted]


@refused("prefix code")
def a_symbol_outside_its_alphabet():
    """The alphabet of distances has 40 symbols."""
    writer = Writer(2, 2)
    writer.put(0, 3)
    for symbol in (1, 2, 3, 4, 200):
        writer.simple(symbol)
    return [writer]


@accepted()
def one_of_two_symbols_outside_its_alphabet():
    writer = Writer(2, 2)
    writer.put(0, 3)
    for symbols in ((1,), (2,), (3,), (4,), (3, 200)):
        writer.simple(*symbols)
    return [writer]


def test_streams_that_both_decoders_read(tmp_path):
    cases = [(name, writer.file()) for name, make, _ in ACCEPTED for writer in make()]
    for (name, data), got in zip(cases, decode_all(tmp_path, [data for _, data in cases], pixels=True), strict=True):
        assert pillow(data) is not None, name
        assert_like_pillow(name, data, got)


def test_streams_that_both_decoders_refuse(tmp_path):
    cases = [(name, why, writer.file()) for name, make, why in REFUSED for writer in make()]
    for (name, why, data), got in zip(cases, decode_all(tmp_path, [data for *_, data in cases]), strict=True):
        assert pillow(data) is None, name
        assert got.get("name") == "WebPError", (name, got)
        assert why in got["error"], name
