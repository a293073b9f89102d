"""Files that are not lossless WebP or are damaged; reference: the format, and Pillow (libwebp) for changed bytes."""

import base64
import io
import struct

import numpy as np
import pytest
from helpers.reference_vp8l import Writer, chunk, riff, stream_of, wrapped
from helpers.web_scenes import IMAGES, container
from helpers.web_tools import decode_all, pillow, sha_of, webp
from PIL import Image

RNG = np.random.default_rng(0)
NOISE = webp(RNG.integers(0, 256, (9, 11, 4)).astype(np.uint8))
SMALL = webp((np.mgrid[:5, :7].sum(axis=0)[:, :, None] * [1, 9, 20]).astype(np.uint8))


def saved(image=None, **options):
    buffer = io.BytesIO()
    image = image or Image.fromarray(RNG.integers(0, 256, (16, 16, 3)).astype(np.uint8))
    image.save(buffer, "WEBP", **options)
    return buffer.getvalue()


def frames():
    return [Image.fromarray(RNG.integers(0, 256, (16, 16, 3)).astype(np.uint8)) for _ in range(2)]


def declared(width, height):
    """Return a valid file of some 60 bytes that declares a large image, with codes of zero bits."""
    writer = Writer(width, height)
    writer.put(0, 3)
    for symbol in (1, 2, 3, 255, 0):
        writer.simple(symbol)
    return wrapped(np.packbits(writer.bits, bitorder="little").tobytes() + bytes(8))


def refusals(folder, files, **options):
    found = decode_all(folder, files, **options)
    assert [got.get("name") for got in found] == ["WebPError"] * len(files)
    assert all(got["error"] and "\n" not in got["error"] for got in found)
    return [got["error"] for got in found]


def extended(canvas, *chunks, flags=0):
    size = struct.pack("<I", canvas[0] - 1)[:3] + struct.pack("<I", canvas[1] - 1)[:3]
    return riff(chunk(b"VP8X", bytes([flags, 0, 0, 0]) + size), *chunks)


NO_IMAGES = [
    (b"", "not a WebP"),
    (b"RIFF", "not a WebP"),
    (b"\x89PNG\r\n\x1a\n" + bytes(60), "not a WebP"),
    (b"RIFX" + NOISE[4:], "not a WebP"),
    (NOISE[:8] + b"WAVE" + NOISE[12:], "not a WebP"),
    (saved(lossless=False), "lossy"),
    (saved(Image.fromarray(RNG.integers(0, 256, (16, 16, 4)).astype(np.uint8)), lossless=False), "lossy"),
    (saved(frames()[0], save_all=True, append_images=frames(), lossless=True), "animation"),
    (saved(frames()[0], save_all=True, append_images=frames()), "animation"),
    (riff(chunk(b"abcd", bytes(30))), "without an image"),
    (extended((11, 9)), "without an image"),
    (extended((11, 8), chunk(b"VP8L", stream_of(NOISE))), "canvas"),
    (extended((12, 9), chunk(b"VP8L", stream_of(NOISE))), "canvas"),
    (NOISE[:4] + struct.pack("<I", len(NOISE) - 7) + NOISE[8:], "cut off"),
    (NOISE[:4] + b"\xff" * 4 + NOISE[8:], "cut off"),
    (NOISE[:4] + struct.pack("<I", 20) + NOISE[8:], "longer than the file"),
    (NOISE[:16] + struct.pack("<I", len(NOISE)) + NOISE[20:], "longer than the file"),
    (NOISE[:16] + b"\xff" * 4 + NOISE[20:], "longer than the file"),
    (wrapped(b"\x2e" + stream_of(NOISE)[1:]), "not VP8L"),
    (wrapped(b""), ""),
    (wrapped(b"\x2f"), "ends too soon"),
    (wrapped(stream_of(NOISE)[:-8]), "ends too soon"),
]


def test_errors_name_the_reason(tmp_path):
    for error, (_, why) in zip(refusals(tmp_path, [data for data, _ in NO_IMAGES]), NO_IMAGES, strict=True):
        assert why in error


def test_a_canvas_of_the_same_size_is_right(tmp_path):
    data = extended((11, 9), chunk(b"VP8L", stream_of(NOISE)), flags=0x10)
    assert decode_all(tmp_path, [data])[0]["sha256"] == sha_of(pillow(NOISE))


def test_cut_off_anywhere(tmp_path):
    """Both the file and its stream, in a file that declares the shorter length, are cut off."""
    large = webp(RNG.integers(0, 256, (120, 90, 3)).astype(np.uint8))
    for data, places in ((SMALL, range(len(SMALL))), (NOISE, range(len(NOISE))), (large, range(0, len(large), 149))):
        refusals(tmp_path, [data[:length] for length in places])
        stream = stream_of(data).rstrip(b"\0")
        cut = [wrapped(stream[:length]) for length in places if length < len(stream)]
        refusals(tmp_path, cut)
        # libwebp reads the padding byte of a chunk of odd length.
        assert all(pillow(shorter) is None for shorter in cut[:-4:2])


def test_too_many_pixels_are_refused_before_memory_is_allocated(tmp_path):
    files = [declared(16384, 16384), declared(16383, 16384), declared(8192, 8193)]
    assert max(map(len, files)) < 70
    for error in refusals(tmp_path, files):
        assert "pixels, more than the 67108864 allowed" in error
    files = [declared(w, h) for w, h in ((10, 10), (16384, 1), (100, 1), (101, 1), (1, 101), (9, 11))]
    found = decode_all(tmp_path, files, maxPixels=100)
    assert ["error" in got for got in found] == [False, True, False, True, True, False]


CHANGES = 2_400
PARTS = 4
LIMIT = 1 << 20


def planes():
    """Return small images of containers of several presets, and others."""
    found = [SMALL, NOISE, saved(lossless=True, exif=b"Exif\0\0abc")]
    return found + [container(preset, 3, 150)[name] for preset in ("fast", "paper") for name in IMAGES]


def changed(data, rng):
    """Return the file with bytes or bits changed, inserted or deleted, or blocks exchanged; sizes are mostly corrected.

    The length is even then, because libwebp reads the padding byte of a chunk.
    """
    new = bytearray(data)
    for _ in range(rng.integers(1, 4)):
        at, other = (int(offset) for offset in rng.integers(12 if rng.random() < 0.1 else 20, len(new), 2))
        kind = rng.integers(6)
        if kind == 0:
            new[at] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            new[at] = int(rng.integers(256))
        elif kind == 2:
            new[at:at] = rng.bytes(int(rng.integers(1, 4)))
        elif kind == 3 and len(new) > 60:
            del new[at : at + int(rng.integers(1, 4))]
        elif kind == 4:
            size = int(rng.integers(1, 9))
            new[at : at + size], new[other : other + size] = new[other : other + size], new[at : at + size]
        else:
            new[at : at + 2] = bytes([int(rng.choice([0, 255]))]) * 2
    if rng.random() < 0.8 and new[12:16] == b"VP8L":
        return wrapped(bytes(new[20:]) + bytes(len(new) % 2))
    return bytes(new)


def size_of(data):
    """Return the size that the stream's header declares, or None."""
    at = data.find(b"VP8L")
    if at < 0 or len(data) < at + 13:
        return None
    bits = struct.unpack_from("<I", data, at + 9)[0]
    return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1


@pytest.fixture(scope="module")
def corpus():
    return planes()


@pytest.mark.parametrize("part", range(PARTS))
@pytest.mark.quick(1)
def test_changed_bytes(part, corpus, tmp_path):
    """Any change gives an error of one sentence or an image, the same as libwebp's if that decodes the file."""
    rng = np.random.default_rng(part)
    files = [changed(corpus[int(rng.integers(len(corpus)))], rng) for _ in range(CHANGES // PARTS)]
    found = decode_all(tmp_path, files, maxPixels=LIMIT, pixels=True)
    both = 0
    for data, got in zip(files, found, strict=True):
        assert got.get("name", "WebPError") == "WebPError", got
        size = size_of(data)
        if size is None or size[0] * size[1] > LIMIT:
            assert "error" in got
            continue
        wanted, begin = pillow(data), data.find(b"VP8L")
        if wanted is None:
            # Pillow also reads chunks after the image, which are not needed.
            assert "error" in got or data[12:16] == b"VP8X"
        elif "error" in got:
            # libwebp may have read the padding byte.
            assert struct.unpack_from("<I", data, begin + 4)[0] & 1, got
        else:
            rgba = np.frombuffer(base64.b64decode(got["rgba"]), np.uint8).reshape(wanted.shape)
            channels = 3 + (data[begin + 12] >> 4 & 1)  # Pillow ignores alpha if the hint says so
            assert (rgba[:, :, :channels] == wanted[:, :, :channels]).all()
            both += 1
    assert both > 20


def with_large_codes(choice):
    """Return an image whose 4 x 4 tiles use these groups of codes, each with 2,644 entries."""
    side, groups = choice.shape[0], int(choice.max()) + 1
    image = Writer(4 * side, 4 * side)
    image.put(0, 1)
    image.put(1, 1)
    image.put(11, 4)  # a colour cache, for an alphabet of 280 + 2048
    image.put(1, 1)
    image.put(0, 3)
    image.image([0xFF000000 | int(group) << 8 for group in choice.reshape(-1)])
    one = Writer(1, 1)
    begin = len(one.bits)
    one.code([9] * 212 + [length for length in range(10, 15) for _ in range(300)] + [15] * 600, 280 + 2048)
    for symbol in (1, 2, 255, 0):
        one.simple(symbol)
    bits = np.concatenate([image.bits, np.tile(one.bits[begin:], groups), np.zeros(9 * 16 * side * side, np.uint8)])
    return wrapped(np.packbits(bits.astype(np.uint8), bitorder="little").tobytes())


@pytest.mark.quick(0)
def test_tables_for_codes_are_bounded(tmp_path):
    """A file could declare gigabytes of them; tables of unused groups are not built."""
    all_used = with_large_codes(np.arange(6561).reshape(81, 81))
    (why,) = refusals(tmp_path, [all_used])
    assert "too many prefix codes" in why
    one_used = with_large_codes(np.full((3, 3), 6999))
    (found,) = decode_all(tmp_path, [one_used])
    assert found["sha256"] == sha_of(pillow(one_used))
