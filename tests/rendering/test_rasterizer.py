"""Reference: a float64 renderer that shares no code with the tested one, and its derivatives; autograd. On all
devices."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import reference_float64
from helpers.examples import examples
from helpers.rasterized import render_tensors
from helpers.render_scenes import blobs, camera, one, together
from hypothesis import given
from hypothesis import strategies as st

from kissgs.core.context import load_kernels
from kissgs.core.errors import InvalidSceneError, InvalidViewsError, UnsupportedError
from kissgs.core.splats import ATTRIBUTES
from kissgs.rendering.camera import Camera
from kissgs.rendering.cpu import frame, tiles
from kissgs.rendering.cpu.frame import Gradients
from kissgs.rendering.differentiable import rasterize
from kissgs.rendering.rasterizer import BLACK, render, tensors_of

devices = pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])


def clamp_of(device):
    """Return the largest alpha; releases of gsplat up to 1.5.3 have 0.999, and do not export it."""
    if device == "cpu":
        return 0.99
    try:
        from gsplat.cuda import _constants
    except ImportError:
        return 0.999
    return float(_constants.MAX_ALPHA)


def check_image(splats, view, background, device="cpu", tolerance=1e-4):
    images, alphas, _ = render_tensors(splats, [view], device, [background])
    more = {"alpha_max": clamp_of(device), "antialiased": splats.antialiased}
    expected = reference_float64.draw(reference_float64.tensors(splats), view, background, **more)
    for found, wanted in ((images[0], expected.image), (alphas[0], expected.alpha)):
        found = found.detach().cpu().numpy()[expected.sure]
        np.testing.assert_allclose(found, wanted.numpy()[expected.sure], atol=tolerance, rtol=0)
    return expected


@devices
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [0, 1, 130])
def test_images_agree_with_the_reference(count, degree, device):
    check_image(blobs(count, degree, seed=count), camera(seed=count), (0.2, 0.5, 0.9), device)


@examples(40)
@given(
    seed=st.integers(0, 2**31),
    size=st.tuples(st.integers(1, 50), st.integers(1, 50)),
    distance=st.floats(0.05, 8),
    log_scale=st.floats(-6, 0.5),
)
def test_images_of_any_size_agree_with_the_reference(seed, size, distance, log_scale):
    splats = blobs(12, seed % 4, seed=seed, log_scale=log_scale)
    check_image(splats, camera(*size, distance=distance, seed=seed), (1.0, 0.3, 0.0))


def test_needles_lose_no_digits():
    """Footprints are 4000 pixels long and half a pixel wide: the usual form of the exponent would be wrong by 2 %."""
    needles = together(
        *(one(mean=(0, 0, 0.1 * i), quat=(1, 0.1 * i, 0.2, 0.5 * i), scale=(4, -6, -6)) for i in range(5))
    )
    check_image(needles, camera(64, 64), BLACK)


SMALL = {
    "small": (blobs(60, 1, seed=3, log_scale=-4), camera(seed=1)),
    "of all sizes": (blobs(30, 2, seed=4, log_scale=-2), camera(40, 30, seed=2)),
    "clipped at the frustum's edge": (blobs(20, 1, spread=2.5, log_scale=-2), camera(21, 17, distance=2)),
    "needles": (
        together(*(one(mean=(0, 0, 0.1 * i), quat=(1, 0.1 * i, 0.2, 0.5 * i), scale=(4, -4, -5)) for i in range(5))),
        camera(32, 32),
    ),
    "discs": (together(*(one(quat=(1, 0.3 * i, -0.2, 0), scale=(-2, -2, -12)) for i in range(-2, 3))), camera(30, 20)),
    "of no size": (together(one(scale=(-30, -30, -30)), one(scale=(0, -30, -30)), one(scale=(0, 0, -30))), camera()),
}
"""Scenes whose opacities antialiasing changes much."""


@devices
@pytest.mark.parametrize("name", SMALL)
def test_images_and_gradients_of_antialiased_scenes_agree_with_the_reference(name, device):
    splats, view = SMALL[name]
    splats = replace(splats, antialiased=True)
    check_image(splats, view, (0.2, 0.5, 0.9), device)
    check_gradients(splats.select(slice(8)), view, device, seed=2)
    assert np.abs(render(splats, view)[0] - render(replace(splats, antialiased=False), view)[0]).max() > 0.02


def test_pixels_behind_opaque_gaussians_end_where_those_of_the_reference_do():
    pile = together(*(one(mean=(0, 0, 0.2 * i), scale=(0, 0, 0), opacity=4.0, sh0=(i, 1, -i)) for i in range(-4, 9)))
    expected = check_image(pile, camera(), (1.0, 1.0, 1.0))
    assert (expected.alphas > 0).sum(0).min() < 5, "some pixels are complete after a few of the thirteen"


def test_gaussians_of_equal_depth_are_drawn_in_the_order_of_the_scene():
    straight = Camera(np.eye(4), np.array([[20.0, 0, 8], [0, 20.0, 8], [0, 0, 1]]), 16, 16)
    pair = [one(mean=(0, 0, 2), scale=(-1, -1, -1), opacity=1.0, sh0=colour) for colour in ((1, 0, -1), (-1, 0, 1))]
    first, _ = render(together(*pair), straight)
    second, _ = render(together(*pair[::-1]), straight)
    assert first[8, 8, 0] > first[8, 8, 2]
    assert second[8, 8, 0] < second[8, 8, 2]


def test_off_axis_principal_points_and_unequal_focal_lengths():
    view = camera(40, 30)
    K = np.array([[35.0, 0, 3.0], [0, 61.0, 40.0], [0, 0, 1]])
    check_image(blobs(40, 2, spread=2.0), Camera(view.viewmat, K, 40, 30), (0.1, 0.1, 0.1))


@devices
def test_gradients_agree_with_the_reference(device):
    for seed, degree in enumerate([0, 1, 2, 3]):
        check_gradients(blobs(6, degree, seed=seed), camera(21, 17, seed=seed), device, seed)


@pytest.mark.parametrize(
    ("splats", "view"),
    {
        "clipped at the frustum's edge": (blobs(10, 3, spread=2.5, log_scale=-1), camera(21, 17, distance=2)),
        "around the camera": (blobs(14, 1, spread=1.0), camera(21, 17, distance=0.5)),
        "off screen": (together(one(mean=(30, 0, 0)), one(mean=(0, 1.4, 0), scale=(-1, -1, -1))), camera(21, 17)),
        "needles": (together(one(scale=(1, -9, -9), quat=(1, 2, 3, 4)), one(scale=(-9, 0, -9))), camera(21, 17)),
        "needles of 1e13": (
            together(one(scale=(30, -30, -30), quat=(1, 2, 3, 4)), one(scale=(-3, 15, -9))),
            camera(21, 17),
        ),
        "transparent": (together(one(opacity=-5.4), one(opacity=-30.0), one(opacity=-6.0)), camera(21, 17)),
        "opaque": (together(one(opacity=9.0), one(mean=(0, 0, 1), scale=(0, 0, 0), opacity=30.0)), camera(21, 17)),
        "black": (together(one(sh0=(-3, 1, -3)), one(mean=(0.1, 0, 1), sh0=(1, -9, 1))), camera(21, 17)),
        "quaternions that are not normalised": (
            together(one(quat=(1e-3, 2e-3, 0, 0), scale=(-1, -2, -3))),
            camera(21, 17),
        ),
    }.values(),
    ids=lambda value: "",
)
def test_gradients_of_difficult_scenes_agree_with_the_reference(splats, view):
    check_gradients(splats, view, "cpu", seed=1)


def check_gradients(splats, view, device, seed, tolerance=1e-3):
    """Check that errors are within 0.1 % of the largest gradient by the same attribute of the same Gaussian."""
    rng = np.random.default_rng(seed)
    background = rng.random(3)
    leaves = reference_float64.tensors(splats, leaf=True)
    more = {"alpha_max": clamp_of(device), "antialiased": splats.antialiased}
    expected = reference_float64.draw(leaves, view, background, **more)
    v_image, v_alpha = (
        torch.from_numpy((rng.normal(0, 1, shape).T * expected.sure.T).T)
        for shape in ((view.height, view.width, 3), (view.height, view.width))
    )
    images, alphas, tensors = render_tensors(splats, [view], device, [background])
    for image, alpha in ((expected.image, expected.alpha), (images[0].cpu(), alphas[0].cpu())):
        ((image * v_image).sum() + (alpha * v_alpha).sum()).backward()
    for name in ATTRIBUTES:
        found = tensors[name].grad.cpu().numpy().reshape(len(splats), -1)
        wanted = torch.zeros_like(leaves[name]) if leaves[name].grad is None else leaves[name].grad
        reference = wanted.numpy().reshape(len(splats), -1)
        if reference.size:
            size = np.abs(reference).max(axis=1, keepdims=True)
            error = np.abs(found - reference) / (tolerance * size + 2e-6 * (1 + np.abs(reference).max()))
            assert error.max() <= 1, f"{name}: {error.max():.2f} times what is allowed"


@devices
def test_gradients_of_several_cameras_are_added(device):
    splats, views = blobs(20, 2), [camera(seed=1), camera(seed=2)]
    backgrounds = [[0.1, 0.2, 0.3], [1.0, 0.0, 0.5]]
    images, alphas, tensors = render_tensors(splats, views, device, backgrounds)
    ((images**2).sum() + alphas.sum()).backward()
    total = {name: torch.zeros_like(tensor) for name, tensor in tensors.items()}
    for view, background, image in zip(views, backgrounds, images, strict=True):
        single, alpha, parts = render_tensors(splats, [view], device, [background])
        torch.testing.assert_close(single[0], image)
        ((single**2).sum() + alpha.sum()).backward()
        for name, part in parts.items():
            total[name] += part.grad
    for name, tensor in tensors.items():
        torch.testing.assert_close(tensor.grad, total[name], atol=1e-5, rtol=1e-4)


def test_images_and_gradients_do_not_depend_on_threads():
    splats, view = blobs(300, 3, spread=1.5), camera(130, 70)
    results = []
    for threads in (1, 2, 3, 7):
        images, alphas, tensors = render_tensors(splats, [view], threads=threads)
        (images.square().sum() + alphas.sum()).backward()
        results.append([images, alphas, *(tensor.grad for tensor in tensors.values())])
    for result in results[1:]:
        for one_thread, several in zip(results[0], result, strict=True):
            assert torch.equal(one_thread, several)


def test_a_parameter_changed_before_the_backward_pass_is_an_error():
    images, _, tensors = render_tensors(blobs(5), [camera()])
    with torch.no_grad():
        tensors["means"].add_(1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        images.sum().backward()


def test_arrays_may_be_read_only_and_neither_they_nor_tensors_need_be_contiguous():
    splats, view = blobs(30, 2), camera()
    expected, alphas, _ = render_tensors(splats, [view])
    arrays = {name: np.repeat(getattr(splats, name), 2, axis=0)[::2] for name in ATTRIBUTES}
    for array in arrays.values():
        array.setflags(write=False)
    image, alpha = render(replace(splats, **arrays), view)
    assert np.array_equal(image, expected[0].detach().numpy())
    assert np.array_equal(alpha, alphas[0].detach().numpy())
    tensors = {name: tensor.repeat_interleave(2, 0)[::2] for name, tensor in tensors_of(splats).items()}
    viewmats, Ks = torch.from_numpy(view.viewmat[None]), torch.from_numpy(view.K[None])
    images, _ = rasterize(tensors, viewmats=viewmats, Ks=Ks, width=view.width, height=view.height)
    assert torch.equal(images, expected)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"means": torch.zeros(5, 3, dtype=torch.float64)}, UnsupportedError, "float32"),
        ({"quats": torch.zeros(4, 4)}, InvalidSceneError, "quats"),
        ({"shN": torch.zeros(5, 4, 3)}, InvalidSceneError, "shN has shape"),
        ({"viewmats": torch.eye(4)[None].requires_grad_()}, UnsupportedError, "detach"),
        ({"viewmats": torch.eye(4)[None] * 2}, InvalidViewsError, "orthonormal"),
        ({"Ks": -torch.eye(3)[None]}, InvalidViewsError, "positive"),
        ({"Ks": torch.full((1, 3, 3), float("nan"))}, InvalidViewsError, "finite"),
        ({"width": 0}, InvalidViewsError, "from 1 to 65,536, not 0"),
        ({"Ks": torch.eye(3)[None].repeat(2, 1, 1)}, InvalidViewsError, "Ks must be of shape"),
        ({"Ks": 2 * torch.eye(3)[None]}, InvalidViewsError, "without skew"),
        ({"backgrounds": torch.ones(1, 2)}, InvalidViewsError, "backgrounds must be of shape"),
        ({"backgrounds": torch.full((1, 3), float("nan"))}, InvalidViewsError, "three finite numbers"),
        ({"means": torch.zeros(5, 3, device="meta")}, UnsupportedError, "one device"),
        ({"viewmats": torch.zeros(0, 4, 4), "Ks": torch.zeros(0, 3, 3)}, InvalidViewsError, "no camera"),
    ],
)
def test_invalid_arguments_are_refused(change, error, message):
    parameters = tensors_of(blobs(5))
    views = {"viewmats": torch.eye(4)[None], "Ks": torch.eye(3)[None], "width": 8, "height": 8}
    for name, value in change.items():
        (parameters if name in parameters else views)[name] = value
    with pytest.raises(error, match=message):
        rasterize(parameters, **views)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device here")
def test_rendering_on_cuda_without_a_device_is_refused():
    with pytest.raises(UnsupportedError, match="no CUDA device"):
        render(blobs(1), camera(), device="cuda")


def test_cameras_may_have_any_dtype_and_layout():
    splats, view = blobs(20), camera()
    expected, _, _ = render_tensors(splats, [view, view])
    viewmats = torch.linalg.inv(torch.linalg.inv(torch.from_numpy(view.viewmat)))[None].expand(2, 4, 4)
    Ks = torch.from_numpy(view.K).expand(2, 3, 3)
    images, _ = rasterize(tensors_of(splats), viewmats=viewmats, Ks=Ks, width=view.width, height=view.height)
    torch.testing.assert_close(images, expected, atol=1e-4, rtol=0)
    fortran = np.asfortranarray(view.viewmat.astype(np.float32))
    fortran.setflags(write=False)
    image, _ = render(splats, Camera(fortran, np.round(view.K).astype(int), view.width, view.height))
    assert np.isfinite(image).all()


@pytest.mark.parametrize("background", [(1.0,), (1.0, 0.5), (0.0, 0.0, 0.0, 1.0), (0.0, float("nan"), 0.0)])
def test_a_background_must_be_three_finite_numbers(background):
    with pytest.raises(InvalidViewsError, match="three finite numbers"):
        render(blobs(3), camera(), background=background)


def test_an_image_that_does_not_fit_into_memory_is_refused(monkeypatch):
    def no_memory(*arguments):
        raise MemoryError

    monkeypatch.setattr(frame, "sort_into_tiles", no_memory)
    with pytest.raises(UnsupportedError, match="not enough memory for an image of 37x29"):
        render(blobs(3), camera())


@pytest.mark.parametrize(
    ("limit", "message"), [("MAX_MEMBERS", "touch the same 16x16 pixels"), ("MAX_PAIRS", "render a smaller image")]
)
def test_more_gaussians_in_a_tile_or_pairs_than_kernels_can_number_are_refused(monkeypatch, limit, message):
    monkeypatch.setattr(tiles, limit, 10)
    with pytest.raises(UnsupportedError, match=message):
        render(blobs(50), camera(100, 100))


def received(splats, views):
    """Return the gradients of each view of a loss without symmetry, by receiver and by autograd."""
    found = []
    for receive in (found.append, None):
        images, alphas, tensors = render_tensors(splats, views, receive=receive)
        weights = torch.rand(images.shape, generator=torch.Generator().manual_seed(3))
        ((images * weights).sum() + (alphas * weights[..., 0]).sum()).backward()
        if receive is not None:
            assert all(tensor.grad is None for tensor in tensors.values())
    return found, {name: tensor.grad.numpy() for name, tensor in tensors.items()}


@pytest.mark.parametrize("count", [0, 1, 60])
def test_received_gradients_are_those_of_autograd(count):
    views = [camera(seed=1), camera(20, 40, seed=2)] if count else [camera()]
    splats = blobs(count, 2)
    found, wanted = received(splats, views if count == 60 else views[:1])
    total = Gradients.sum(found)
    assert (np.diff(total.gaussians) > 0).all()
    for name in ATTRIBUTES:
        dense = np.zeros_like(wanted[name])
        total.add_to(name, dense)
        np.testing.assert_array_equal(dense, wanted[name])
        if count:
            assert dense.any()


def test_gaussians_outside_the_image_and_hidden_ones_have_none():
    wall = [one(mean=(0, 0, 0.2 * i), scale=(2, 2, 2), opacity=9.0) for i in range(4)]
    splats = together(one(mean=(0, 0, -50)), *wall, one(mean=(0, 0, 3)))
    found, _ = received(splats, [camera()])
    assert found[0].gaussians.tolist() == [1, 2]  # which leave less than TRANSMITTANCE_MIN


def test_loading_the_kernels_reports_progress():
    events = []
    load_kernels(lambda stage, fraction: events.append((stage, fraction)))
    assert events == [("kernels", 0.0), ("kernels", 1.0)]
