"""Images that libwebp wrote, decoded by JavaScript; reference: the original pixels, and Pillow's decoder."""

import hashlib
import itertools
import shutil
import subprocess

import numpy as np
import pytest
from helpers.reference_vp8l import CROSS_COLOUR, INDEXING, PREDICTOR, SUBTRACT_GREEN, Reader, chunk, riff, stream_of
from helpers.web_tools import as_rgba, decode_all, pillow, webp
from PIL import Image

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


def tinted(w, h, rng):
    """Return red and blue proportional to green, for the cross-colour transform."""
    green = rng.integers(0, 256, (h, w))
    return np.stack([green * 0.7 + rng.integers(0, 3, (h, w)), green, 255 - green * 0.4], axis=2)


def grey(w, h, rng):
    return np.repeat(rng.integers(0, 256, (h, w, 1)), 3, axis=2)


def single(w, h, rng):
    """Return an image of one channel."""
    return rng.integers(0, 40, (h, w, 1))


def checker(w, h, rng):
    y, x = grid(w, h)
    return ((x // 3 + y // 2) % 2)[:, :, None] * np.array([255, 10, 90])


def pattern(w, h, rng):
    """Return a repeated piece of noise with small shifts, for copies."""
    piece = rng.integers(0, 256, (11, 23, 3))
    y, x = grid(w, h)
    return piece[(y + x // 50) % 11, x % 23]


def few_colours(w, h, rng):
    """Return repeated colours, more than a palette holds, for the colour cache."""
    return rng.integers(0, 256, (700, 3))[np.minimum(rng.geometric(0.01, (h, w)), 699)]


def transparent(w, h, rng):
    """Return colours of transparent pixels, which are kept if ``exact``."""
    image = rng.integers(0, 256, (h, w, 4))
    image[:, :, 3] = np.where(rng.random((h, w)) < 0.5, 0, 255)
    return image


def transparent_black(w, h, rng):
    image = photograph(w, h, rng)
    alpha = np.where(np.add(*grid(w, h)) % 7 < 3, 0, 255)[:, :, None]
    return np.concatenate([image * (alpha > 0), alpha], axis=2)


def alpha_noise(w, h, rng):
    return rng.integers(0, 256, (h, w, 4))


def rotations(w, h, rng):
    """Return four correlated channels of few levels, like a plane of quaternions."""
    return np.clip(rng.normal(40, 12, (h, w, 4)) + 8 * np.sin(np.add(*grid(w, h)) / 9)[:, :, None], 0, 255)


def labels(w, h, rng):
    """Return two channels of few levels, like a plane of codebook labels."""
    return np.concatenate([rng.integers(0, 40, (h, w, 2)), np.zeros((h, w, 1))], axis=2)


def quarters(w, h, rng):
    """Return parts of different statistics, for several groups of codes."""
    image = noise(w, h, rng)
    image[: h // 2, : w // 2] = gradient(w, h, rng)[: h // 2, : w // 2]
    image[h // 2 :, w // 2 :] = rng.integers(0, 3, (h, w, 3))[h // 2 :, w // 2 :] * 70
    return image


def steep(w, h, rng):
    """Return levels of very different frequency, for long codes."""
    return np.minimum(rng.geometric(0.5, (h, w, 3)) ** 2, 255)


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
    *(noise, gradient, photograph, tinted, grey, single, checker, pattern, few_colours, transparent),
    *(transparent_black, alpha_noise, rotations, labels, quarters, steep, palette_alpha),
    *map(palette, (1, 2, 3, 4, 5, 16, 17, 256, 257)),
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
    image = np.zeros((4096, 4096, 3), np.uint8)
    image[:, :, 0] = np.arange(4096) >> 4
    image[1000:1100, 300:4000] = np.random.default_rng(0).integers(0, 256, (100, 3700, 3))
    assert_exact(tmp_path, [("4096 x 4096", webp(image, method=0, quality=0), image)])


@pytest.mark.quick(0)
def test_groups_of_codes_and_copies_in_an_image_of_many_tiles(tmp_path):
    image = np.concatenate([image_of(content, 400, 150)[:, :, :3] for content in (quarters, pattern, photograph)])
    cases = [(f"method {method}", webp(image, method=method, quality=90), image) for method in range(7)]
    assert_exact(tmp_path, cases)
    facts = [Reader(webp(image, method=method, quality=90)).facts for method in (0, 6)]
    assert max(fact.groups for fact in facts) > 2
    assert len({bits for fact in facts for bits in fact.tile_bits}) > 1


@pytest.mark.quick(0)
def test_the_images_use_all_features_of_the_format():
    """Each predictor, and features that no encoder uses, are tested in test_webp_by_hand.py."""
    facts = [
        Reader(webp(image_of(content, 65, 49), method=method, quality=100)).facts
        for content in CONTENTS
        for method in (1, 4, 6)
    ]
    assert {kind for fact in facts for kind in fact.transforms} == {
        *(PREDICTOR, CROSS_COLOUR, SUBTRACT_GREEN, INDEXING)
    }
    sizes = {size for fact in facts for size in fact.palettes}
    assert {2, 3, 4, 5, 16, 17, 256} <= sizes
    assert max(sizes) == 256
    assert any(cache for fact in facts for cache in fact.caches)
    assert any(fact.groups > 1 for fact in facts)
    assert max(fact.longest for fact in facts) > 9  # needs a second lookup
    assert all(sum(getattr(fact, what) for fact in facts) > 99 for what in ("literals", "cached", "near", "single"))
    assert any(fact.far for fact in facts)


def test_near_lossless(tmp_path):
    """The option of cwebp changes pixels slightly and writes a lossless stream."""
    if shutil.which("cwebp") is None:
        pytest.skip("no cwebp is installed")
    cases = []
    for content in (photograph, alpha_noise, gradient):
        Image.fromarray(image_of(content, 131, 67)).save(tmp_path / "x.png")
        for level in (0, 20, 60, 80):
            order = ["cwebp", "-quiet", "-near_lossless", str(level), tmp_path / "x.png", "-o", tmp_path / "x.webp"]
            subprocess.run(order, check=True)
            cases.append((f"{content.__name__} {level}", (tmp_path / "x.webp").read_bytes(), None))
    assert_exact(tmp_path, cases)


# --- Data around a stream --------------------------------------------------------------------


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
