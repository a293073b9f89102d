"""Oracle: Pillow, which writes and reads the same images by itself."""

import io
import struct

import numpy as np
import pytest
from helpers.examples import examples
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from kissgs.core.context import blas_workers
from kissgs.core.errors import InvalidContainerError
from kissgs.io.images import compress_images, decode_plane, effort_of, encode_plane, probe_webp
from kissgs.settings import EncodeSettings


def random_image(height, width, channels, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (height, width, channels), dtype=np.uint8)


def webp(image, **options):
    """Compress by Pillow."""
    buffer = io.BytesIO()
    Image.fromarray(image[:, :, 0] if image.shape[2] == 1 else image).save(buffer, "WEBP", **options)
    return buffer.getvalue()


def decoded(data, image, channels=None):
    """Decode by kissgs, to the shape of ``image``."""
    height, width, own = image.shape
    rows = decode_plane(data, "some.webp", width=width, height=height, channels=channels or own)
    return rows.reshape(height, width, channels or own)


@examples(40)
@given(
    st.integers(1, 40),
    st.integers(1, 40),
    st.sampled_from([1, 3, 4]),
    st.integers(0, 100),
    st.integers(0, 6),
    st.booleans(),
)
def test_every_image_comes_back_as_it_was(height, width, channels, quality, method, few_levels):
    image = random_image(height, width, channels, seed=height)
    if few_levels:
        image //= 128
    data = encode_plane(image, quality=quality, method=method)
    assert (decoded(data, image) == image).all()
    seen = np.asarray(Image.open(io.BytesIO(data)))
    assert (seen[:, :, : channels if channels != 4 else seen.shape[2]] == image[:, :, : seen.shape[2]]).all()
    assert probe_webp(data, "some.webp") == (width, height)


def test_images_that_libwebp_treats_in_a_way_of_its_own():
    """It blackens pixels of alpha 0 without ``exact``, drops an alpha of 255 throughout, and packs constants well."""
    transparent, opaque, constant = random_image(16, 16, 4), random_image(8, 8, 4), np.zeros((8, 8, 4), np.uint8)
    transparent[::2, :, 3] = 0
    opaque[:, :, 3] = 255
    for image, quality, method in ((transparent, 50, 2), (opaque, 50, 2), (constant, 100, 6)):
        data = encode_plane(image, quality=quality, method=method)
        assert (decoded(data, image) == image).all()
    assert len(data) < 30
    assert Image.open(io.BytesIO(encode_plane(opaque, quality=50, method=2))).mode == "RGB"


@pytest.mark.parametrize("written", [1, 3, 4])
@pytest.mark.parametrize("wanted", [1, 3, 4])
def test_any_channels_are_read_from_any_file(written, wanted):
    """Other encoders store grey as colour, and colour with an alpha channel."""
    image = random_image(8, 8, written)
    found = decoded(webp(image, lossless=True, exact=True), image, wanted)
    full = np.concatenate([image] * 3 if written == 1 else [image], axis=2)
    full = np.concatenate([full[:, :, :4], np.full((8, 8, 1), 255, np.uint8)], axis=2)
    assert (found == full[:, :, :wanted]).all()


def test_all_images_of_a_container_keep_their_names_and_order():
    images = {
        f"{name}.webp": random_image(8, 8, channels) for name, channels in (("b", 3), ("a", 1), ("f_rest_centroids", 3))
    }
    fractions = []
    with blas_workers(2) as pool:
        files = compress_images(images, EncodeSettings(), pool, fractions.append)
    assert list(files) == list(images)
    assert all((decoded(files[name], images[name]) == images[name]).all() for name in images)
    assert len(fractions) == len(images)
    assert fractions == sorted(fractions)
    assert 0 < fractions[0] < fractions[-1] == pytest.approx(1)


IMAGE = random_image(24, 16, 3)
LOSSLESS = webp(IMAGE, lossless=True)


def animated():
    buffer = io.BytesIO()
    frames = [Image.fromarray(random_image(8, 8, 3, seed)) for seed in (0, 1)]
    frames[0].save(buffer, "WEBP", save_all=True, append_images=frames[1:], lossless=True)
    return buffer.getvalue()


def png():
    buffer = io.BytesIO()
    Image.fromarray(IMAGE).save(buffer, "PNG")
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        (b"", "some.webp is not a WebP image"),
        (b"RIFF", "some.webp is not a WebP image"),
        (png(), "some.webp is not a WebP image"),
        (webp(IMAGE), "some.webp is a lossy or animated WebP; planes must be lossless"),
        (webp(random_image(8, 8, 4)), "some.webp is a lossy or animated WebP; planes must be lossless"),
        (animated(), "some.webp is a lossy or animated WebP; planes must be lossless"),
        (LOSSLESS[:-1], "some.webp is cut off: its header announces more bytes than there are"),
        (LOSSLESS[:100], "some.webp is cut off: its header announces more bytes than there are"),
        (b"RIFF\x20\0\0\0WEBPXXXX\x14\0\0\0" + bytes(20), "some.webp is damaged: it has no lossless WebP image inside"),
        (LOSSLESS[:20] + b"\x30" + LOSSLESS[21:], "some.webp is damaged: it has no lossless WebP image inside"),
    ],
)
def test_what_is_no_lossless_webp_is_refused_by_name(data, sentence):
    with pytest.raises(InvalidContainerError) as caught:
        probe_webp(data, "some.webp")
    assert str(caught.value) == sentence


@pytest.mark.parametrize("extra", [{"exif": b"Exif\0\0MM\0*\0\0\0\x08\0\0\0\0\0\0"}, {"icc_profile": b"x" * 131}])
def test_size_of_images_with_metadata_is_that_of_the_image(extra):
    data = webp(IMAGE, lossless=True, **extra)
    assert data[12:16] == b"VP8X"
    assert probe_webp(data, "some.webp") == (16, 24)
    assert (decoded(data, IMAGE) == IMAGE).all()


def test_two_sizes_in_one_file_are_refused():
    """The outer header says 16 x 24, the image inside is of another size: for which memory must not be allocated?"""
    data = bytearray(webp(IMAGE, lossless=True, icc_profile=b"x" * 131))
    data[24:27] = struct.pack("<I", 99)[:3]
    with pytest.raises(InvalidContainerError, match="has no lossless WebP image inside"):
        probe_webp(bytes(data), "some.webp")


@pytest.mark.parametrize("size", [(16, 25), (24, 16), (15, 24), (13376, 13376)])
def test_another_size_than_the_metadata_says_is_refused(size):
    with pytest.raises(InvalidContainerError) as caught:
        decode_plane(LOSSLESS, "some.webp", width=size[0], height=size[1], channels=3)
    assert str(caught.value) == f"some.webp is 16 x 24 pixels; the metadata asks for {size[0]} x {size[1]}"


def test_damage_inside_the_image_is_refused():
    """The header is whole, so only decoding can tell; libwebp notices most damage, not all."""
    broken = LOSSLESS[:30] + bytes(len(LOSSLESS) - 30)
    with pytest.raises(InvalidContainerError, match=r"some\.webp is damaged: its WebP data cannot be decoded"):
        decode_plane(broken, "some.webp", width=16, height=24, channels=3)


@pytest.mark.parametrize(
    ("shape", "asked", "wanted"),
    [
        ((500, 999, 3), (75, 4), (75, 4)),
        ((500, 1000, 3), (75, 4), (50, 2)),
        ((1000, 1000, 4), (50, 2), (50, 2)),
        ((1000, 1000, 1), (75, 4), (25, 4)),
        ((2000, 2000, 3), (30, 1), (30, 1)),
        ((2000, 2000, 3), (76, 4), (76, 4)),
        ((2000, 2000, 3), (75, 6), (75, 6)),
    ],
)
def test_large_images_take_less_effort_unless_more_than_the_usual_is_asked_for(shape, asked, wanted):
    assert effort_of(shape, *asked) == wanted
