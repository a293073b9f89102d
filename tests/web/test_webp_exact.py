"""Images that libwebp wrote, decoded by JavaScript; reference: the original pixels, and Pillow's decoder."""

import hashlib
import itertools

import numpy as np
import pytest
from helpers.reference_vp8l import chunk, riff, stream_of
from helpers.web_tools import as_rgba, decode_all, pillow, webp

SIZES = [
    *((1, 1), (1, 2), (2, 1), (2, 2), (3, 3), (1, 37), (37, 1), (7, 13), (13, 7), (31, 61), (97, 5)),
    *((15, 16), (16, 17), (17, 15), (63, 64), (64, 65), (65, 63), (129, 130)),
]


def grid(w, h):
    return np.mgrid[:h, :w]


def noise(w, h, rng):
    return rng.integers(0, 256, (h, w, 3))


def gradient(w, h, rng):
    y, x = grid(w, h)
    return np.stack([x * 255 // w, y * 255 // h, (x + y) * 255 // (w + h)], axis=2)


def photograph(w, h, rng):
    """Return sums of waves with sensor noise and correlated channels."""
    y, x = grid(w, h)
    light = sum(np.sin(x / rng.uniform(2, 40) + rng.uniform(0, 6)) * np.cos(y / rng.uniform(2, 40)) for _ in range(5))
    image = 128 + light[:, :, None] * np.array([25, 22, 15]) + rng.normal(0, 2, (h, w, 3)) + np.array([20, 0, -20])
    return np.clip(image, 0, 255)


def single(w, h, rng):
    """Return an image of one channel."""
    return rng.integers(0, 40, (h, w, 1))


def few_colours(w, h, rng):
    """Return repeated colours, more than a palette holds, for the colour cache."""
    return rng.integers(0, 256, (700, 3))[np.minimum(rng.geometric(0.01, (h, w)), 699)]


def transparent(w, h, rng):
    """Return colours of transparent pixels, which are kept if ``exact``."""
    image = rng.integers(0, 256, (h, w, 4))
    image[:, :, 3] = np.where(rng.random((h, w)) < 0.5, 0, 255)
    return image


def alpha_noise(w, h, rng):
    return rng.integers(0, 256, (h, w, 4))


def quarters(w, h, rng):
    """Return parts of different statistics, for several groups of codes."""
    image = noise(w, h, rng)
    image[: h // 2, : w // 2] = gradient(w, h, rng)[: h // 2, : w // 2]
    image[h // 2 :, w // 2 :] = rng.integers(0, 3, (h, w, 3))[h // 2 :, w // 2 :] * 70
    return image


def palette(colours):
    def content(w, h, rng):
        table = rng.integers(0, 256, (colours, 3))
        chosen = rng.integers(0, colours, (h, w))
        chosen.ravel()[:colours] = np.arange(colours)[: w * h]
        return table[chosen]

    content.__name__ = f"palette{colours}"
    return content


def palette_alpha(w, h, rng):
    return rng.integers(0, 256, (5, 4))[rng.integers(0, 5, (h, w))]


CONTENTS = [
    noise,
    gradient,
    photograph,
    single,
    few_colours,
    transparent,
    alpha_noise,
    quarters,
    palette_alpha,
    *map(palette, (1, 2, 3, 5, 16, 17, 256, 257)),
]


def image_of(content, w, h):
    return np.ascontiguousarray(content(w, h, np.random.default_rng(w * 7919 + h)).astype(np.uint8))


def sha(rgba):
    return hashlib.sha256(np.ascontiguousarray(rgba)).hexdigest()


def assert_exact(folder, cases):
    """Check cases (name, file, pixels); the reference is Pillow if pixels are None."""
    found = decode_all(folder, [data for _, data, _ in cases])
    failures = []
    for (name, data, wanted), got in zip(cases, found, strict=True):
        rgba = pillow(data) if wanted is None else as_rgba(wanted)
        if (got.get("height"), got.get("width"), got.get("sha256")) != (*rgba.shape[:2], sha(rgba)):
            failures.append((name, got))
    assert failures == []


@pytest.mark.parametrize("content", CONTENTS, ids=lambda content: content.__name__)
@pytest.mark.quick(6)
def test_every_effort_and_size(content, tmp_path):
    """Methods and qualities at one size, all sizes with one method, ``exact`` or not."""
    cases = []
    image = image_of(content, 65, 49)
    for method, quality in itertools.product((0, 2, 4, 6), (0, 50, 100)):
        data = webp(image, method=method, quality=quality)
        cases.append((f"method {method} quality {quality}", data, image))
    for w, h in SIZES:
        image = image_of(content, w, h)
        cases.append((f"{w} x {h}", webp(image, method=3), image))
    cases.append(("not exact", webp(image, exact=False, method=3), None))
    assert_exact(tmp_path, cases)


@pytest.mark.parametrize(
    ("w", "h", "content"),
    [(4096, 1, noise), (1, 4096, photograph), (16383, 1, noise), (1, 16383, few_colours), (16383, 3, palette(3))],
)
def test_long_and_thin(w, h, content, tmp_path):
    image = image_of(content, w, h)
    assert_exact(tmp_path, [(f"method {method}", webp(image, method=method), image) for method in (0, 4)])


def test_large(tmp_path):
    image = np.zeros((1500, 1500, 3), np.uint8)
    image[:, :, 0] = np.arange(1500) >> 4
    image[1000:1100, 300:1400] = np.random.default_rng(0).integers(0, 256, (100, 1100, 3))
    assert_exact(tmp_path, [("1500 x 1500", webp(image, method=0, quality=0), image)])


@pytest.mark.parametrize("content", [photograph, alpha_noise, palette(4)], ids=lambda content: content.__name__)
def test_metadata_and_odd_sizes(content, tmp_path):
    """Profiles, EXIF and XMP before and after the image, chunks of odd length, bytes after the end."""
    image = image_of(content, 21, 10)
    cases = []
    for more in (
        *({"icc_profile": b"p" * 131}, {"exif": b"Exif\0\0" + b"e" * 51}, {"xmp": b"<x/>"}),
        *({"icc_profile": b"p" * 130, "exif": b"Exif\0\0" + b"e" * 51, "xmp": b"<xm/>"},),
    ):
        data = webp(image, **more)
        assert b"VP8X" in data[:20]
        cases += [(str(more), data, image), (f"{more} and bytes", data + b"after", image)]
    plain = webp(image)
    stream = stream_of(plain)
    for end in (b"", b"\0", b"\xff", b"rest"):
        cases += [("bytes after", plain + end, image)]
        cases += [("bytes in the chunk", riff(chunk(b"VP8L", stream + end)), image)]
        cases += [("an unknown chunk", riff(chunk(b"VP8L", stream), chunk(b"abcd", end)), image)]
    assert_exact(tmp_path, cases)
