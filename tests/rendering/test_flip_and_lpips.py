"""FLIP and LPIPS. Oracle: values of FLIP's published algorithm, computed once in float64 with convolutions of SciPy.

LPIPS has a fake package of the interface of torchmetrics that records its calls. With the same random weights of the
network, torchmetrics 1.4 and 1.9 return the distances of the package lpips 0.1.4.
"""

import importlib.util
import math
import sys
import types
import urllib.error

import numpy as np
import pytest
import torch

from kissgs.core.errors import InvalidViewsError, UnsupportedError
from kissgs.evaluation.evaluate import evaluate
from kissgs.rendering.metrics import Flip, Lpips
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
def test_flip_is_the_mean_of_the_published_algorithm(size, noise, expected):
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
def test_flip_does_not_hide_nan_and_the_inputs_are_not_changed(where):
    pair = image_pair()
    before = [image.copy() for image in pair]
    Flip()(*pair)
    assert all((after == image).all() for after, image in zip(pair, before, strict=True))
    pair[where][3, 3, 1] = math.nan
    assert math.isnan(Flip()(*pair))


@needs_package
def test_flip_prints_nothing(capfd):
    Flip()(*image_pair())
    assert capfd.readouterr() == ("", "")


@needs_package
def test_images_of_different_sizes_have_no_flip():
    with pytest.raises(InvalidViewsError, match="must have one shape"):
        Flip()(np.zeros((16, 16, 3), dtype=np.float32), np.zeros((16, 17, 3), dtype=np.float32))


@pytest.mark.parametrize(("metric", "package"), [(Flip, "flip_evaluator"), (Lpips, "torchmetrics")])
def test_an_error_names_the_package_that_is_missing(monkeypatch, metric, package):
    monkeypatch.setitem(sys.modules, package, None)
    extra = metric.__name__.lower()
    with pytest.raises(
        UnsupportedError, match=f"{metric.__name__.upper()} needs {package.replace('_', '-')}.*: pip install"
    ):
        metric()
    with pytest.raises(UnsupportedError, match=f"{metric.__name__.upper()} needs"):
        evaluate(sample_scene(3, seed=1), sample_scene(3, seed=1), **{extra: True})


class FakeNetwork(torch.nn.Module):
    """A module with the interface of LearnedPerceptualImagePatchSimilarity: from two (N, 3, H, W) tensors to a mean."""

    def __init__(self, net_type="alex", reduction="mean", normalize=False):
        super().__init__()
        self.chosen, self.normalize, self.calls = net_type, normalize, []

    def forward(self, first, second):
        if not first.min() >= -1:
            raise ValueError("Expected both input arguments to be normalized tensors")
        self.calls.append((first, second, torch.is_grad_enabled()))
        return (first - second).square().mean()


@pytest.fixture
def package(monkeypatch):
    module = types.ModuleType("torchmetrics.image.lpip")
    module.LearnedPerceptualImagePatchSimilarity = FakeNetwork
    for name in ("torchmetrics", "torchmetrics.image"):
        monkeypatch.setitem(sys.modules, name, types.ModuleType(name))
    monkeypatch.setitem(sys.modules, module.__name__, module)
    return module


def test_the_network_gets_images_as_in_the_evaluation_of_3dgs(package):
    """VGG, channels first, in [0, 1] and not rescaled to [-1, 1]."""
    rng = np.random.default_rng(0)
    image, reference = rng.random((2, 20, 33, 3), dtype=np.float32)
    metric = Lpips()
    distance = metric(image, reference)
    assert distance == pytest.approx(np.mean((image - reference) ** 2))
    network = metric._network
    ((first, second, gradients),) = network.calls
    assert (network.chosen, network.normalize, gradients) == ("vgg", False, False)
    for tensor, array in ((first, image), (second, reference)):
        assert tensor.shape == (1, 3, 20, 33)
        assert (tensor[0].permute(1, 2, 0).numpy() == array).all()


def test_bytes_are_255ths_and_nan_is_not_hidden(package):
    metric, black = Lpips(), np.zeros((16, 16, 3), dtype=np.float32)
    assert metric(np.full((16, 16, 3), 51, dtype=np.uint8), black) == pytest.approx(0.04)
    assert math.isnan(metric(black * math.nan, black))


def test_images_that_are_too_small_or_of_different_sizes_are_refused(package):
    with pytest.raises(UnsupportedError, match="at least 16x16 pixels, not 4096x1"):
        Lpips()(*np.zeros((2, 1, 4096, 3), dtype=np.float32))
    with pytest.raises(InvalidViewsError, match="must have one shape"):
        Lpips()(np.zeros((16, 16, 3), dtype=np.float32), np.zeros((16, 17, 3), dtype=np.float32))


@pytest.mark.parametrize(
    "reason",
    [
        urllib.error.URLError("Name or service not known"),
        ConnectionResetError("connection reset"),
        RuntimeError("invalid hash value"),
    ],
)
def test_an_error_says_how_to_get_the_weights(package, monkeypatch, reason):
    def offline(**options):
        raise reason

    monkeypatch.setattr(package, "LearnedPerceptualImagePatchSimilarity", offline)
    with pytest.raises(UnsupportedError, match="could not load its network, vgg16") as caught:
        Lpips()
    assert str(reason) in str(caught.value)
    assert caught.value.__cause__ is reason
