"""Oracle: images with known pixels, saved by Pillow in every supported format."""

import io
import struct
import zlib

import numpy as np
import pytest
from helpers.examples import examples
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from kissgs.cameras.photographs import PhotoHeader, read_photo, read_photo_header
from kissgs.core.errors import InvalidViewsError, KissgsError, UnsupportedError

BLACK, WHITE = np.zeros(3, dtype=np.float32), np.ones(3, dtype=np.float32)
GREY = np.arange(0, 240, 10, dtype=np.uint8).reshape(4, 6)
COLOUR = np.stack([GREY, GREY[::-1], 255 - GREY], axis=-1)
UNREADABLE = "is damaged, truncated, or not a JPEG, PNG, WebP, TIFF or BMP file; copy or export it again"


def saved(folder, image, name="a.png", **options):
    image.save(folder / name, **options)
    return folder / name


@pytest.mark.parametrize("name", ["a.png", "a.bmp", "a.tif", "a.webp"])
def test_colour(tmp_path, name):
    options = {"lossless": True} if name == "a.webp" else {}
    path = saved(tmp_path, Image.fromarray(COLOUR), name, **options)
    assert read_photo_header(path) == PhotoHeader(6, 4, transparent=False)
    np.testing.assert_array_equal(read_photo(path, 6, 4, BLACK), COLOUR)


def test_grey_of_8_and_16_bits_and_two_levels(tmp_path):
    expected = np.repeat(GREY[:, :, None], 3, axis=2)
    path = saved(tmp_path, Image.fromarray(GREY))
    np.testing.assert_array_equal(read_photo(path, 6, 4, BLACK), expected)
    for name in ("a.png", "a.tif"):
        path = saved(tmp_path, Image.fromarray(GREY.astype(np.uint16) * 257 + 100), name)
        np.testing.assert_array_equal(read_photo(path, 6, 4, BLACK), expected)
    path = saved(tmp_path, Image.fromarray(GREY > 100))
    np.testing.assert_array_equal(read_photo(path, 6, 4, BLACK), np.where(expected > 100, 255, 0))


def test_colour_of_16_bits(tmp_path):
    """The PNG file is written by hand, because Pillow cannot write 16-bit colour."""
    rows = b"".join(b"\0" + (row.astype(">u2") * 257).tobytes() for row in COLOUR)
    parts = [(b"IHDR", struct.pack(">IIBBBBB", 6, 4, 16, 2, 0, 0, 0)), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    data = b"\x89PNG\r\n\x1a\n"
    for kind, body in parts:
        data += struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    (tmp_path / "a.png").write_bytes(data)
    np.testing.assert_array_equal(read_photo(tmp_path / "a.png", 6, 4, BLACK), COLOUR)


@pytest.mark.parametrize("background", [BLACK, WHITE, np.array([0.2, 0.4, 0.6], dtype=np.float32)])
def test_transparent_pixels_show_the_background(tmp_path, background):
    alpha = np.linspace(0, 255, 24).round().reshape(4, 6, 1)
    image = Image.fromarray(np.concatenate([COLOUR, alpha], axis=2).astype(np.uint8))
    path = saved(tmp_path, image)
    assert read_photo_header(path) == PhotoHeader(6, 4, transparent=True)
    expected = COLOUR * (alpha / 255) + background * 255 * (1 - alpha / 255)
    assert np.abs(read_photo(path, 6, 4, background) - expected).max() <= 0.51


def test_palettes_and_grey_with_transparency(tmp_path):
    palette = Image.fromarray(COLOUR).quantize(4)
    palette.info["transparency"] = 0
    path = saved(tmp_path, palette, transparency=0)
    assert read_photo_header(path).transparent
    hole = np.asarray(palette) == 0
    assert (read_photo(path, 6, 4, WHITE)[hole] == 255).all()
    np.testing.assert_array_equal(read_photo(path, 6, 4, WHITE)[~hole], np.asarray(palette.convert("RGB"))[~hole])
    path = saved(tmp_path, Image.fromarray(np.stack([GREY, np.zeros_like(GREY)], axis=-1), mode=None))
    assert (read_photo(path, 6, 4, WHITE) == 255).all()


def test_cmyk(tmp_path):
    path = saved(tmp_path, Image.new("CMYK", (6, 4), (0, 255, 255, 0)), "a.jpg")
    assert np.abs(read_photo(path, 6, 4, BLACK).astype(int) - (255, 0, 0)).max() < 6


def test_orientation_is_ignored(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    path = saved(tmp_path, Image.fromarray(COLOUR), exif=exif)
    assert read_photo_header(path).width == 6
    np.testing.assert_array_equal(read_photo(path, 6, 4, BLACK), COLOUR)


def test_resizing_is_pillows_bicubic(tmp_path):
    photo = np.random.default_rng(0).integers(0, 256, (40, 60, 3), dtype=np.uint8)
    path = saved(tmp_path, Image.fromarray(photo))
    expected = np.asarray(Image.fromarray(photo).resize((20, 13), Image.Resampling.BICUBIC))
    np.testing.assert_array_equal(read_photo(path, 20, 13, BLACK), expected)


def message(path, kind=InvalidViewsError):
    with pytest.raises(kind) as caught:
        read_photo(path, 6, 4, BLACK)
    return str(caught.value)


def jpeg():
    stream = io.BytesIO()
    noise = np.random.default_rng(0).integers(0, 256, (40, 60, 3), dtype=np.uint8)
    Image.fromarray(noise).save(stream, "JPEG")
    return stream.getvalue()


def test_missing_and_damaged_photographs(tmp_path):
    path = tmp_path / "a.jpg"
    assert message(path) == f"cannot read {path}: there is no such file"
    for data in (b"", b"hello", b"GIF89a" + bytes(20), jpeg()[:2000], jpeg()[:10]):
        path.write_bytes(data)
        assert message(path) == f"{path} {UNREADABLE}"


def test_headers_of_truncated_photographs_are_still_read(tmp_path):
    path = tmp_path / "a.jpg"
    path.write_bytes(jpeg()[:2000])
    assert read_photo_header(path) == PhotoHeader(60, 40, transparent=False)


def png_header(path, width, height):
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    data = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + b"IHDR" + header
    path.write_bytes(data + struct.pack(">I", zlib.crc32(b"IHDR" + header)) + struct.pack(">I4s", 9, b"IDAT"))
    return path


def test_photographs_of_phones_are_read_without_a_warning_and_bombs_refused(tmp_path):
    """The largest phones have 200 megapixels; a file of a few kilobytes may declare any number."""
    assert read_photo_header(png_header(tmp_path / "a.png", 16320, 12240)).width == 16320
    for side in (16385, 60_000):
        bomb = png_header(tmp_path / "a.png", 16384, side)
        assert message(bomb) == f"{bomb} has 16384x{side} pixels; at most 268 megapixels are read; reduce it"


def test_a_large_jpeg_is_decoded_smaller_at_the_same_place(tmp_path, monkeypatch):
    """Sides that are no multiples of the factor, so that the last pixels of the draft reach beyond the photograph."""
    x, y = np.meshgrid(np.arange(1203) / 1203, np.arange(811) / 811)
    waves = np.stack([np.sin(20 * x), np.cos(14 * y), np.sin(9 * x + 11 * y)], axis=-1)
    image = Image.fromarray(np.uint8(127.5 + 120 * waves))
    path = saved(tmp_path, image, "a.jpg", quality=98, subsampling=0)
    monkeypatch.setattr("kissgs.cameras.photographs.DRAFT_PIXELS", 1203 * 811 - 1)
    found = read_photo(path, 120, 81, BLACK)
    expected = np.asarray(image.resize((120, 81), Image.Resampling.BOX))
    assert np.abs(found.astype(int) - expected).mean() < 1


@pytest.mark.parametrize("background", [BLACK, WHITE])
def test_bands_make_no_difference(tmp_path, monkeypatch, background):
    alpha = np.arange(24).reshape(4, 6, 1) * 10
    transparent = saved(tmp_path, Image.fromarray(np.uint8(np.concatenate([COLOUR, alpha], axis=2))))
    grey = saved(tmp_path, Image.fromarray(GREY.astype(np.uint16) * 257), "b.png")
    whole = [read_photo(path, 6, 4, background) for path in (transparent, grey)]
    monkeypatch.setattr("kissgs.cameras.photographs.BAND_PIXELS", 18)
    for path, expected in zip((transparent, grey), whole, strict=True):
        np.testing.assert_array_equal(read_photo(path, 6, 4, background), expected)


def test_pixels_of_32_bits(tmp_path):
    path = saved(tmp_path, Image.fromarray(GREY.astype(np.float32)), "a.tif")
    assert message(path, UnsupportedError) == (
        f"{path} has 32 bits per channel, which is not supported; save it with 8 or 16"
    )


def files():
    for extension, image in [
        ("png", Image.fromarray(COLOUR)),
        ("tif", Image.fromarray(GREY)),
        ("bmp", Image.fromarray(COLOUR)),
    ]:
        stream = io.BytesIO()
        image.save(stream, {"tif": "TIFF"}.get(extension, extension))
        yield stream.getvalue()
    yield jpeg()
    stream = io.BytesIO()
    Image.fromarray(COLOUR).save(stream, "WEBP")
    yield stream.getvalue()


FILES = list(files())


@pytest.mark.filterwarnings("ignore::UserWarning")  # Pillow warns about damaged TIFF and EXIF data
@examples(400)
@given(data=st.data())
def test_damaged_files(tmp_path, data):
    content = bytearray(data.draw(st.sampled_from(FILES)))
    for _ in range(data.draw(st.integers(1, 4))):
        start = data.draw(st.integers(0, len(content)))
        stop = start + data.draw(st.sampled_from([0, 1, 4, 1000]))
        content[start:stop] = data.draw(st.binary(max_size=6))
    path = tmp_path / "a.jpg"
    path.write_bytes(content)
    try:
        read_photo_header(path)
        photo, sentence = read_photo(path, 6, 4, BLACK), ""
    except KissgsError as error:
        photo, sentence = None, str(error)
    assert "\n" not in sentence
    assert photo is None or photo.shape == (4, 6, 3)
