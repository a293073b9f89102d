"""FLIP. Oracle: values of the published algorithm, computed once in float64 with convolutions of SciPy."""

import importlib.util
import math
import sys

import numpy as np
import pytest

from kissgs.core.errors import InvalidViewsError, UnsupportedError
from kissgs.evaluation.evaluate import evaluate
from kissgs.rendering.metrics import Flip
from kissgs.synthetic import sample_scene

needs_package = pytest.mark.skipif(
    importlib.util.find_spec("flip_evaluator") is None, reason="flip-evaluator is not installed: pip install '.[flip]'"
)


def image_pair(height=40, width=57, noise=0.1):
    rng = np.random.default_rng(height)
    y, x = np.mgrid[:height, :width][..., None]
    image = np.clip(0.5 + 0.4 * np.sin(x / 5 + np.arange(3)) * np.cos(y / 7), 0, 1).astype(np.float32)
    return image, np.clip(image + noise * rng.standard_normal(image.shape), 0, 1).astype(np.float32)


@needs_package
@pytest.mark.parametrize(
    ("size", "noise", "expected"),
    [((40, 57), 0.02, 0.05342), ((40, 57), 0.3, 0.42744), ((3, 80), 0.3, 0.47236), ((1, 1), 0.02, 0.11824)],
)
def test_it_is_the_mean_of_the_published_algorithm(size, noise, expected):
    image, reference = image_pair(*size, noise=noise)
    assert Flip()(image, reference) == pytest.approx(expected, abs=2e-4)


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
