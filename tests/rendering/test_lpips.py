"""LPIPS, with a fake package of the interface of lpips 0.1.4 that records its calls."""

import math
import sys
import types
import urllib.error
import warnings

import numpy as np
import pytest
import torch

from kissgs.core.errors import InvalidViewsError, UnsupportedError
from kissgs.rendering.metrics import Lpips


class FakeNetwork(torch.nn.Module):
    """A module with the interface of lpips.LPIPS: from two (N, 3, H, W) tensors to (N, 1, 1, 1)."""

    def __init__(self, net, verbose):
        super().__init__()
        warnings.warn("The parameter 'pretrained' is deprecated", UserWarning, stacklevel=2)
        self.chosen, self.verbose, self.calls = net, verbose, []

    def forward(self, first, second, retPerLayer=False, normalize=False):
        self.calls.append((first, second, normalize, torch.is_grad_enabled()))
        return (first - second).square().mean(dim=(1, 2, 3), keepdim=True)


@pytest.fixture
def package(monkeypatch):
    module = types.ModuleType("lpips")
    module.LPIPS = FakeNetwork
    monkeypatch.setitem(sys.modules, "lpips", module)
    return module


def test_the_network_gets_images_as_in_the_evaluation_of_3dgs(package):
    """VGG, channels first, in [0, 1] and not rescaled to [-1, 1]; warnings are suppressed."""
    rng = np.random.default_rng(0)
    image, reference = rng.random((2, 20, 33, 3), dtype=np.float32)
    metric = Lpips()
    distance = metric(image, reference)
    assert distance == pytest.approx(np.mean((image - reference) ** 2))
    network = metric._network
    ((first, second, normalize, gradients),) = network.calls
    assert (network.chosen, network.verbose, normalize, gradients) == ("vgg", False, False, False)
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


def test_an_error_names_the_extra_if_the_package_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "lpips", None)
    with pytest.raises(UnsupportedError, match=r"not installed \(.*lpips.*\): pip install 'kissgs\[lpips\]'"):
        Lpips()


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

    monkeypatch.setattr(package, "LPIPS", offline)
    with pytest.raises(UnsupportedError, match="weights of its network, vgg16, which torchvision downloads") as caught:
        Lpips()
    assert str(reason) in str(caught.value)
    assert caught.value.__cause__ is reason
