"""The photometric loss. Reference: the textbook formula in float64, its finite differences, torch's autograd of it."""

import math

import numpy as np
import pytest
import torch
from helpers.reference_ssim import similarities

from kissgs.core.errors import InvalidViewsError
from kissgs.rendering.differentiable import photometric_loss, plain_photometric_loss


def textbook_loss(image, target, weight=0.2, mse_weight=0.0):
    """Return the loss in float64."""
    x, y = np.asarray(image, dtype=np.float64), np.asarray(target, dtype=np.float64)
    l1, squares = np.abs(x - y).mean(), np.square(x - y).mean()
    return (1 - weight) * l1 + weight * (1 - similarities(x, y).mean()) + mse_weight * squares


def pair(*shape, seed=0):
    """Return noisy and smooth images, partly outside [0, 1], as renderings are."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[: shape[-3], : shape[-2]][..., None]
    target = 0.5 + 0.5 * np.sin(columns / 6 + np.arange(3)) * np.cos(rows / 4) + 0.02 * rng.standard_normal(shape)
    image = target + 0.1 * rng.standard_normal(shape)
    return torch.from_numpy(image.astype(np.float32)), torch.from_numpy(target.astype(np.float32))


def gradient_of(loss, image):
    leaf = image.clone().requires_grad_()
    loss(leaf).backward()
    return leaf.grad


@pytest.mark.parametrize(
    ("height", "width", "weight", "mse_weight"),
    [(1, 1, 0.2, 5.0), (7, 4, 1.0, 100.0), (11, 30, 0.0, 0.0), (140, 330, 0.2, 5.0)],
)
def test_value_and_gradient_agree_with_the_textbook_formula_in_float64(height, width, weight, mse_weight):
    """Sizes include several tiles and images smaller than the window."""
    image, target = pair(height, width, 3)
    weights = {"ssim_weight": weight, "mse_weight": mse_weight}
    wanted = textbook_loss(image, target, weight, mse_weight)
    assert photometric_loss(image, target, **weights).item() == pytest.approx(wanted, abs=1e-6)
    plain = photometric_loss(image.double(), target.double(), **weights)
    assert plain.dtype == torch.float64
    assert plain.item() == pytest.approx(wanted, abs=1e-12)
    gradient = gradient_of(lambda leaf: photometric_loss(leaf, target, **weights), image)
    expected = gradient_of(lambda leaf: plain_photometric_loss(leaf, target.double(), **weights), image.double())
    torch.testing.assert_close(gradient.double(), expected, rtol=0, atol=3e-5 * expected.abs().max().item())


def test_the_loss_of_a_stack_is_the_mean_over_views():
    images, targets = pair(3, 20, 17, 3)
    gradient = gradient_of(lambda leaf: photometric_loss(leaf, targets), images)
    losses = [photometric_loss(image, target).item() for image, target in zip(images, targets, strict=True)]
    assert photometric_loss(images, targets).item() == pytest.approx(np.mean(losses), abs=1e-7)
    for view in range(3):
        single = gradient_of(lambda leaf: photometric_loss(leaf, targets[view]), images[view])  # noqa: B023
        torch.testing.assert_close(gradient[view], single / 3)


def test_equal_images_have_no_loss_and_no_gradient():
    image, _ = pair(30, 30, 3)
    leaf = image.clone().requires_grad_()
    loss = photometric_loss(leaf, image)
    loss.backward()
    assert loss.detach().item() == 0
    assert (leaf.grad == 0).all()


def test_the_gradient_is_scaled_by_the_upstream_gradient_and_accumulated():
    image, target = pair(20, 20, 3)
    once = gradient_of(lambda leaf: photometric_loss(leaf, target), image)
    torch.testing.assert_close(gradient_of(lambda leaf: -3 * photometric_loss(leaf, target), image), -3 * once)
    leaf = image.clone().requires_grad_()
    loss = photometric_loss(leaf, target)
    loss.backward(retain_graph=True)
    loss.backward()
    torch.testing.assert_close(leaf.grad, 2 * once)


def test_the_gradient_flows_to_parameters_of_the_image():
    image, target = pair(14, 25, 3)
    gain = torch.tensor(0.7, requires_grad=True)
    photometric_loss((gain * image).transpose(0, 1), target.transpose(0, 1)).backward()  # not contiguous either
    gain64 = torch.tensor(0.7, dtype=torch.float64, requires_grad=True)
    plain_photometric_loss(gain64 * image.double(), target.double(), 0.2).backward()
    assert gain.grad.item() == pytest.approx(gain64.grad.item(), rel=1e-5)


def test_without_a_gradient_the_value_is_the_same():
    image, target = pair(40, 50, 3)
    leaf = image.clone().requires_grad_()
    with_gradient = photometric_loss(leaf, target)
    with torch.no_grad():
        without = photometric_loss(leaf, target)
    assert with_gradient.requires_grad
    assert not without.requires_grad
    assert not photometric_loss(image, target).requires_grad
    assert with_gradient.detach().item() == without.item()


@pytest.mark.parametrize("value", [50.0, -2e4, 1e9, -1e30, 3e38, math.inf])
def test_extreme_renderings_give_finite_values(value):
    """A diverged Gaussian must not spoil the others by NaN."""
    image, target = pair(30, 30, 3)
    image[10:13, 7] = value
    leaf = image.clone().requires_grad_()
    loss = photometric_loss(leaf, target, mse_weight=5.0)
    loss.backward()
    assert math.isfinite(loss.detach().item())
    assert leaf.grad.abs().max() <= 100 / image.numel()
    plain = gradient_of(lambda leaf: plain_photometric_loss(leaf, target, 0.2, 5.0), image)
    assert torch.isfinite(plain).all()


@pytest.mark.parametrize(("difference", "expected", "slope"), [(0.5, 0.25, 1.0), (1.0, 1.0, 2.0), (-3.0, 5.0, -2.0)])
def test_the_squared_error_is_linear_beyond_1(difference, expected, slope):
    target = torch.zeros(5, 5, 3)
    for dtype in (torch.float32, torch.float64):  # the kernel and plain torch
        leaf = torch.full((5, 5, 3), difference, dtype=dtype).requires_grad_()
        plain, squared = (photometric_loss(leaf, target.to(dtype), mse_weight=weight) for weight in (0.0, 1.0))
        (squared - plain).backward()
        assert float((squared - plain).detach()) == pytest.approx(expected, rel=1e-5)
        np.testing.assert_allclose(leaf.grad.numpy(), slope / leaf.numel(), rtol=1e-3)


@pytest.mark.parametrize("weight", [0.0, 0.2])
def test_nan_is_not_hidden(weight):
    image, target = pair(30, 30, 3)
    image[3, 4, 1] = math.nan
    assert math.isnan(photometric_loss(image, target, ssim_weight=weight).item())
    assert math.isnan(photometric_loss(image, target, ssim_weight=weight, mse_weight=5.0).item())
    gradient = gradient_of(lambda leaf: photometric_loss(leaf, target, ssim_weight=0.2, mse_weight=5.0), image)
    assert torch.isnan(gradient[3, 4, 1])
    assert torch.isfinite(gradient[20:]).all()


@pytest.mark.cuda
def test_a_gpu_computes_the_same():
    """The accuracy is that of float32; TF32 would lose the variances."""
    image, target = pair(64, 70, 3)
    expected = gradient_of(lambda leaf: photometric_loss(leaf, target), image)
    on_gpu = gradient_of(lambda leaf: photometric_loss(leaf, target.cuda()), image.cuda())
    torch.testing.assert_close(on_gpu.cpu(), expected, rtol=0, atol=1e-4 * expected.abs().max().item())


@pytest.mark.parametrize(
    ("first", "second"), [((4, 4, 3), (4, 5, 3)), ((4, 4, 4), (4, 4, 4)), ((4, 3), (4, 3)), ((2, 0, 4, 3),) * 2]
)
def test_images_of_different_or_invalid_shapes_are_refused(first, second):
    with pytest.raises(
        InvalidViewsError, match=r"one shape, \(height, width, 3\) or \(count, height, width, 3\), not \("
    ):
        photometric_loss(torch.zeros(first), torch.zeros(second))


def test_a_target_that_requires_a_gradient_is_refused():
    with pytest.raises(ValueError, match="detach it"):
        photometric_loss(torch.zeros(4, 4, 3), torch.zeros(4, 4, 3, requires_grad=True))
