"""PSNR, SSIM and MS-SSIM.

Reference: the textbook formulas in float64, by convolutions of SciPy, and values in closed form.
"""

import math

import numpy as np
import pytest
from helpers.examples import examples
from helpers.reference_ssim import C1, C2, similarities
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.signal import convolve2d

from kissgs.core.context import Workers
from kissgs.core.errors import InvalidViewsError
from kissgs.rendering.metrics import differences_and_ssim, ms_ssim, patch_edges, psnr, ssim, ssim_with_patches


def naive_ms_ssim(image, reference):
    """Return MS-SSIM by five convolutions for each scale and channel, of windows inside the image."""
    profile = np.exp(-(np.arange(-5.0, 6.0) ** 2) / (2 * 1.5**2))
    window = np.outer(profile, profile) / profile.sum() ** 2
    weights = [0.0448, 0.2856, 0.3001, 0.2363, 0.1333]
    while min(image.shape[:2]) < 11 * 2 ** (len(weights) - 1):
        weights = weights[:-1]
    total = sum(weights) if len(weights) < 5 else 1
    channels = []
    for x, y in zip(image.astype(np.float64).transpose(2, 0, 1), reference.transpose(2, 0, 1), strict=True):
        score = 1
        for n, weight in enumerate(weights):
            mx, my, xx, yy, xy = (convolve2d(m, window, mode="valid") for m in (x, y, x * x, y * y, x * y))
            luminance = (2 * mx * my + C1) / (mx**2 + my**2 + C1)
            structure = (2 * (xy - mx * my) + C2) / (xx - mx**2 + yy - my**2 + C2)
            mean = (luminance * structure if n == len(weights) - 1 else structure).mean()
            score *= max(mean, 0) ** (weight / total)
            x, y = (convolve2d(m, np.full((2, 2), 0.25), mode="valid")[::2, ::2] for m in (x, y))
        channels.append(score)
    return np.mean(channels)


def smooth_image(rng, height, width):
    """Return a smooth image with some noise, in [0, 1]."""
    y, x = np.mgrid[:height, :width][..., None]
    wave = 0.5 + 0.4 * np.sin(x / 5 + np.arange(3)) * np.cos(y / 7)
    return np.clip(wave + 0.1 * rng.standard_normal((height, width, 3)), 0, 1).astype(np.float32)


def image_pair(height, width, seed=0):
    rng = np.random.default_rng(seed)
    image = smooth_image(rng, height, width)
    return image, np.clip(image + 0.1 * rng.standard_normal(image.shape), 0, 1).astype(np.float32)


@pytest.mark.parametrize(
    ("height", "width"), [(1, 1), (1, 2), (3, 5), (11, 11), (12, 40), (131, 3), (2, 163), (130, 161), (1, 700)]
)
def test_ssim_is_that_of_the_textbook(height, width):
    """Smaller than the window, and with one or several tiles in either direction."""
    image, reference = image_pair(height, width)
    assert ssim(image, reference) == pytest.approx(similarities(image, reference).mean(), abs=1e-6)


def naive_patches(length):
    """Return the pixels of each patch along a side, one by one: a remainder below 16 joins the patch before."""
    patches = [list(range(start, min(start + 32, length))) for start in range(0, length, 32)]
    if len(patches) > 1 and len(patches[-1]) < 16:
        patches[-2:] = [patches[-2] + patches[-1]]
    return patches


@pytest.mark.parametrize(
    ("height", "width"), [(1, 1), (15, 31), (16, 47), (47, 48), (80, 33), (79, 240), (130, 163), (270, 15), (33, 500)]
)
def test_patches_have_the_mean_of_their_pixels(height, width):
    """Smaller than a patch, remainders on both sides of a half, and patches that tiles of the kernel divide."""
    image, reference = image_pair(height, width)
    whole, patches = ssim_with_patches(image, reference)
    pixels = similarities(image, reference)
    rows, columns = naive_patches(height), naive_patches(width)
    assert patch_edges(height).tolist() == [row[0] for row in rows] + [height]
    expected = [[pixels[np.ix_(row, column)].mean() for column in columns] for row in rows]
    np.testing.assert_allclose(patches, expected, rtol=0, atol=2e-6)
    assert whole == ssim(image, reference)
    assert (ssim_with_patches(image, image)[1] == 1).all()


def test_patches_of_uniform_images_follow_from_their_means():
    """Without variance SSIM is its first factor; away from the border, where zeros come in."""
    one, other = (np.full((128, 128, 3), level, np.float32) for level in (0.25, 0.75))
    expected = (2 * 0.25 * 0.75 + C1) / (0.25**2 + 0.75**2 + C1)
    np.testing.assert_allclose(ssim_with_patches(one, other)[1][1:-1, 1:-1], expected, atol=1e-5)
    assert (ssim_with_patches(one, one)[1] == 1).all()


def test_nan_spoils_the_patches_that_it_reaches_and_no_other():
    image, reference = image_pair(128, 96)
    image[31, 40, 2] = math.nan
    whole, patches = ssim_with_patches(image, reference)
    assert math.isnan(whole)
    assert np.isnan(patches).tolist() == [[False, True, False]] * 2 + [[False] * 3] * 2


@pytest.mark.quick(3)
@pytest.mark.parametrize(("height", "width"), [(177, 195), (11, 11), (22, 57), (21, 300), (87, 99), (400, 176)])
def test_ms_ssim_is_that_of_the_textbook(height, width):
    """All numbers of scales, sizes at their limits and odd ones, and several tiles in either direction."""
    image, reference = image_pair(height, width)
    assert ms_ssim(image, reference) == pytest.approx(naive_ms_ssim(image, reference), abs=2e-6)


def test_ms_ssim_of_images_below_the_window_is_ssim():
    image, reference = image_pair(10, 300)
    assert ms_ssim(image, reference) == ssim(image, reference) > 0


@pytest.mark.parametrize("side", [8, 80])
def test_ms_ssim_of_an_inverted_image_is_zero(side):
    """A negative mean has no real root."""
    image = (np.indices((side, side)).sum(axis=0) % 2 * np.ones((3, 1, 1))).transpose(1, 2, 0).astype(np.float32)
    assert ssim(image, 1 - image) < 0
    assert ms_ssim(image, 1 - image) == 0


def test_ssim_of_bright_and_uniform_images_is_accurate():
    """The variance is a small difference of large numbers: computed in float32, it would have no correct digit."""
    rng = np.random.default_rng(3)
    image = np.float32(0.9) + np.float32(0.001) * rng.standard_normal((30, 30, 3), dtype=np.float32)
    reference = image + np.float32(0.01) * rng.standard_normal((30, 30, 3), dtype=np.float32)
    assert ssim(image, reference) == pytest.approx(similarities(image, reference).mean(), abs=2e-6)


def test_psnr_of_a_known_offset():
    image, reference = np.zeros((4, 5, 3), dtype=np.float32), np.full((4, 5, 3), 0.1, dtype=np.float32)
    assert psnr(image, reference) == pytest.approx(20, abs=1e-5)
    assert psnr(image, np.ones_like(image)) == 0
    assert psnr(image, np.full_like(image, 10)) == pytest.approx(-20)


def test_bytes_are_255ths():
    rng = np.random.default_rng(1)
    image, reference = rng.integers(0, 256, (2, 9, 14, 3), dtype=np.uint8)
    a, b = image / 255, reference / 255
    assert psnr(image, reference) == pytest.approx(-10 * math.log10(np.mean((a - b) ** 2)), abs=1e-5)
    assert ssim(image, reference) == pytest.approx(similarities(a, b).mean(), abs=1e-6)
    assert psnr(image, a.astype(np.float32)) > 140


def test_arrays_need_not_be_contiguous():
    image, reference = image_pair(40, 40)
    expected = ssim(np.ascontiguousarray(image[::2, 5:30]), np.ascontiguousarray(reference[::2, 5:30]))
    assert ssim(image[::2, 5:30], reference[::2, 5:30]) == expected
    assert ssim(image[::2, 5:30].astype(np.float64), reference[::2, 5:30]) == expected


sizes = st.tuples(st.integers(1, 24), st.integers(1, 24), st.just(3))


@examples(60)
@given(data=st.data(), shape=sizes, limit=st.sampled_from([1.0, 100.0, 1e6, 2.0**127]))
def test_properties_of_the_metrics(data, shape, limit):
    """Both are exactly symmetric, in [-1, 1], and 1 for equal images, for any values that a renderer may produce."""
    values = st.floats(-limit, limit, width=32, allow_nan=False)
    image, reference = (data.draw(arrays(np.float32, shape, elements=values)) for _ in range(2))
    before = image.copy(), reference.copy()
    score = ssim(image, reference)
    assert -1 - 1e-6 <= score <= 1 + 1e-6
    assert score == ssim(reference, image)
    assert ssim(image, image.copy()) == 1
    assert 0 <= ms_ssim(image, reference) == ms_ssim(reference, image) <= 1 + 1e-6
    assert ms_ssim(image, image.copy()) == 1
    assert psnr(image, reference) == psnr(reference, image)
    assert psnr(image, image.copy()) == math.inf
    assert np.array_equal(image, before[0])
    assert np.array_equal(reference, before[1])


@pytest.mark.parametrize("extreme", [math.inf, -math.inf, 3e38, -1e20, 1e-40])
def test_extreme_values_give_a_finite_value(extreme):
    image, reference = image_pair(25, 25)
    image[12, 12] = extreme
    assert -1 <= ssim(image, reference) <= 1
    assert 0 <= ms_ssim(image, reference) <= 1
    assert not math.isnan(psnr(image, reference))


@pytest.mark.parametrize("where", [0, 1])
def test_nan_is_not_hidden(where):
    pair = image_pair(200, 200)
    pair[where][199, 0, 1] = math.nan
    assert math.isnan(ssim(*pair))
    assert math.isnan(ms_ssim(*pair))
    assert math.isnan(psnr(*pair))


@pytest.mark.parametrize(
    ("first", "second"),
    [((4, 4, 3), (4, 5, 3)), ((4, 4, 4), (4, 4, 4)), ((4, 4), (4, 4)), ((0, 4, 3), (0, 4, 3)), ((1, 4, 4, 3),) * 2],
)
@pytest.mark.parametrize("metric", [psnr, ssim, ms_ssim])
def test_images_of_different_or_invalid_shapes_are_refused(metric, first, second):
    with pytest.raises(InvalidViewsError, match=r"must have one shape, \(height, width, 3\), not \("):
        metric(np.zeros(first, dtype=np.float32), np.zeros(second, dtype=np.float32))
    with pytest.raises(InvalidViewsError, match="uint8 or floats in \\[0, 1\\], not int64"):
        metric(np.zeros((2, 2, 3), dtype=np.int64), np.zeros((2, 2, 3), dtype=np.int64))


def test_the_result_does_not_depend_on_threads():
    images, targets = (
        np.stack(images) for images in zip(image_pair(140, 330), image_pair(140, 330, seed=5), strict=True)
    )
    results = []
    for threads in (1, 2, 5):
        gradient = np.full_like(images, np.nan)
        with Workers(threads) as pool:
            sums = differences_and_ssim(images, targets, pool, gradient, (0.3, 0.7, -0.2))
        results.append((sums.tobytes(), gradient.tobytes()))
        assert np.isfinite(gradient).all()
    assert results[0] == results[1] == results[2]
