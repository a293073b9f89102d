"""FLIP. Oracle: the published algorithm, computed anew in float64 with convolutions of SciPy."""

import importlib.util
import math
import sys

import numpy as np
import pytest
from scipy.ndimage import correlate

from kissgs.core.errors import InvalidViewsError, UnsupportedError
from kissgs.evaluation.evaluate import evaluate
from kissgs.rendering.metrics import Flip
from kissgs.synthetic import sample_scene

needs_package = pytest.mark.skipif(
    importlib.util.find_spec("flip_evaluator") is None, reason="flip-evaluator is not installed: pip install '.[flip]'"
)
TO_XYZ = np.array([[10135552, 8788810, 4435075], [2613072, 8788810, 887015], [1425312, 8788810, 70074425]]) / [
    [24577794],
    [12288897],
    [73733382],
]
WHITE = TO_XYZ.sum(axis=1)
PIXELS_PER_DEGREE = 0.7 * 3840 / 0.7 * math.pi / 180


def to_lab(linear):
    ratio = linear @ TO_XYZ.T / WHITE
    root = np.where(ratio > (6 / 29) ** 3, np.cbrt(ratio), ratio / (3 * (6 / 29) ** 2) + 4 / 29)
    return hunt(
        np.stack(
            [116 * root[..., 1] - 16, 500 * (root[..., 0] - root[..., 1]), 200 * (root[..., 1] - root[..., 2])], -1
        )
    )


def hunt(lab):
    """Chroma fades with lightness."""
    return lab * np.stack([np.ones_like(lab[..., 0]), 0.01 * lab[..., 0], 0.01 * lab[..., 0]], -1)


def hyab(a, b):
    """Distance of lightness plus distance of chroma, to the power of 0.7."""
    return (np.abs(a - b)[..., 0] + np.hypot(*np.moveaxis(a - b, -1, 0)[1:])) ** 0.7


def spatially_filtered(image):
    """Blur opponent colours as the eye does, and return linear RGB."""
    linear = np.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4)
    x, y, z = np.moveaxis(linear @ TO_XYZ.T / WHITE, -1, 0)
    opponent = 116 * y - 16, 500 * (x - y), 200 * (y - z)
    radius = math.ceil(3 * math.sqrt(0.04 / (2 * math.pi**2)) * PIXELS_PER_DEGREE)
    distance = np.square(np.indices((2 * radius + 1,) * 2) - radius).sum(axis=0) / PIXELS_PER_DEGREE**2
    sensitivities = [(1, 0.0047, 0, 1e-5)], [(1, 0.0053, 0, 1e-5)], [(34.1, 0.04, 13.5, 0.025)]
    blurred = []
    for channel, ((a, b, c, d),) in zip(opponent, sensitivities, strict=True):
        kernel = sum(
            amplitude * math.sqrt(math.pi / width) * np.exp(-(math.pi**2) * distance / width)
            for amplitude, width in ((a, b), (c, d))
        )
        blurred.append(correlate(channel, kernel / kernel.sum(), mode="nearest"))
    y = (blurred[0] + 16) / 116
    xyz = np.stack([y + blurred[1] / 500, y, y - blurred[2] / 200], -1) * WHITE
    return np.clip(xyz @ np.linalg.inv(TO_XYZ).T, 0, 1)


def features(image):
    """Return the strengths of edges and of points in the lightness of an image."""
    linear = np.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4)
    lightness = linear @ TO_XYZ[1]
    sigma = 0.5 * 0.082 * PIXELS_PER_DEGREE
    radius = math.ceil(3 * sigma)
    offsets = np.arange(-radius, radius + 1)
    profile = np.exp(-(offsets**2) / (2 * sigma**2))
    strengths = []
    for weights in (-offsets * profile, (offsets**2 / sigma**2 - 1) * profile):
        weights = np.where(weights < 0, weights / -weights[weights < 0].sum(), weights / weights[weights > 0].sum())
        kernel = np.outer(profile / profile.sum(), weights)
        strengths.append(np.hypot(*(correlate(lightness, each, mode="nearest") for each in (kernel, kernel.T))))
    return strengths


def naive_flip(image, reference):
    a, b = image.astype(np.float64), reference.astype(np.float64)
    most = hyab(*(to_lab(np.array(colour, dtype=float)) for colour in ((0, 1, 0), (0, 0, 1))))
    colour = hyab(to_lab(spatially_filtered(a)), to_lab(spatially_filtered(b)))
    limit = 0.4 * most
    colour = np.where(colour < limit, colour * 0.95 / limit, 0.95 + (colour - limit) / (most - limit) * 0.05)
    differences = [np.abs(x - y) for x, y in zip(features(a), features(b), strict=True)]
    feature = (np.maximum(*differences) / math.sqrt(2)) ** 0.5
    return (colour ** (1 - feature)).mean()


def image_pair(height=40, width=57, noise=0.1):
    rng = np.random.default_rng(height)
    y, x = np.mgrid[:height, :width][..., None]
    image = np.clip(0.5 + 0.4 * np.sin(x / 5 + np.arange(3)) * np.cos(y / 7), 0, 1).astype(np.float32)
    return image, np.clip(image + noise * rng.standard_normal(image.shape), 0, 1).astype(np.float32)


@needs_package
@pytest.mark.parametrize("size", [(40, 57), (3, 80), (1, 1)])
@pytest.mark.parametrize("noise", [0.02, 0.3])
def test_it_is_the_mean_of_the_published_algorithm(size, noise):
    image, reference = image_pair(*size, noise=noise)
    assert Flip()(image, reference) == pytest.approx(naive_flip(image, reference), abs=2e-4)


@needs_package
def test_equal_images_have_no_difference_and_bytes_are_255ths():
    image, reference = image_pair()
    assert Flip()(image, image.copy()) == 0
    quantised = np.round(image * 255).astype(np.uint8)
    assert 0 < Flip()(quantised, image) < 0.05
    assert Flip()(quantised, quantised.astype(np.float32) / np.float32(255)) == 0
    assert Flip()(image * 3 - 1, reference) == Flip()(np.clip(image * 3 - 1, 0, 1), reference)


@needs_package
@pytest.mark.parametrize("where", [0, 1])
def test_nan_is_not_hidden_and_the_inputs_are_not_changed(where):
    pair = image_pair()
    before = [image.copy() for image in pair]
    Flip()(*pair)
    assert all((after == image).all() for after, image in zip(pair, before, strict=True))
    pair[where][3, 3, 1] = math.nan
    assert math.isnan(Flip()(*pair))


@needs_package
def test_nothing_is_printed(capfd):
    Flip()(*image_pair())
    assert capfd.readouterr() == ("", "")


@needs_package
def test_images_of_different_sizes_are_refused():
    with pytest.raises(InvalidViewsError, match="must have one shape"):
        Flip()(np.zeros((16, 16, 3), dtype=np.float32), np.zeros((16, 17, 3), dtype=np.float32))


def test_an_error_names_the_extra_if_the_package_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    with pytest.raises(UnsupportedError, match=r"not installed \(.*flip_evaluator.*\): pip install 'kissgs\[flip\]'"):
        Flip()
    with pytest.raises(UnsupportedError, match="FLIP needs a package"):
        evaluate(sample_scene(3, seed=1), sample_scene(3, seed=1), flip=True)
