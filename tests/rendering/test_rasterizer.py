"""Oracle: reference_rasterizer, a float64 renderer that shares nothing with the one under test. On all devices."""

import numpy as np
import pytest
import torch
from helpers import reference_rasterizer
from helpers.rasterized import render_tensors
from helpers.render_scenes import blobs, camera, in_float64, one, together
from hypothesis import given, settings
from hypothesis import strategies as st

from kissgs.core.errors import InvalidSceneError, InvalidViewsError, KissgsError, UnsupportedError
from kissgs.core.splats import ATTRIBUTES
from kissgs.rendering.camera import Camera
from kissgs.rendering.differentiable import rasterize
from kissgs.rendering.gsplat_backend import alpha_max
from kissgs.rendering.rasterizer import BLACK, load_kernels, render
from kissgs.rendering.tensors import tensors_of


def _cuda_is_missing():
    if not torch.cuda.is_available():
        return "no CUDA device here"
    try:
        import gsplat  # noqa: F401
    except ImportError:
        return "gsplat is not installed"
    return None


CUDA = pytest.param("cuda", marks=pytest.mark.skipif(_cuda_is_missing() is not None, reason=str(_cuda_is_missing())))
devices = pytest.mark.parametrize("device", ["cpu", CUDA])


def clamp_of(device):
    return alpha_max() if device == "cuda" else 0.99


def agree(splats, view, background, device="cpu", tolerance=1e-4):
    images, alphas, _ = render_tensors(splats, [view], device, [background])
    expected = reference_rasterizer.draw(in_float64(splats), view, np.array(background), alpha_max=clamp_of(device))
    sure = ~expected.doubtful
    np.testing.assert_allclose(images[0].detach().cpu().numpy()[sure], expected.image[sure], atol=tolerance, rtol=0)
    np.testing.assert_allclose(alphas[0].detach().cpu().numpy()[sure], expected.alpha[sure], atol=tolerance, rtol=0)
    return expected


@devices
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 60])
def test_pictures_are_those_of_the_oracle(count, degree, device):
    agree(blobs(count, degree, seed=count), camera(seed=count), (0.2, 0.5, 0.9), device)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    size=st.tuples(st.integers(1, 50), st.integers(1, 50)),
    distance=st.floats(0.05, 8),
    log_scale=st.floats(-6, 0.5),
)
def test_pictures_are_those_of_the_oracle_whatever_the_size(seed, size, distance, log_scale):
    splats = blobs(12, seed % 4, seed=seed, log_scale=log_scale)
    agree(splats, camera(*size, distance=distance, seed=seed), (1.0, 0.3, 0.0))


def test_needles_lose_no_digits():
    """A footprint 4000 pixels long and half a pixel wide: the classic form of the exponent would be off by 2 %."""
    needles = together(
        *(one(mean=(0, 0, 0.1 * i), quat=(1, 0.1 * i, 0.2, 0.5 * i), scale=(4, -6, -6)) for i in range(5))
    )
    agree(needles, camera(64, 64), BLACK)


def test_an_opaque_pile_ends_where_the_oracle_ends():
    pile = together(*(one(mean=(0, 0, 0.2 * i), scale=(0, 0, 0), opacity=4.0, sh0=(i, 1, -i)) for i in range(-4, 9)))
    expected = agree(pile, camera(), (1.0, 1.0, 1.0))
    drawn = np.sum([drawn for _, drawn, _ in expected.decisions], axis=0)
    assert drawn.min() < 5, "some pixels end after a few of the thirteen"


def test_equal_depths_are_drawn_in_the_scenes_order():
    straight = Camera(np.eye(4), np.array([[20.0, 0, 8], [0, 20.0, 8], [0, 0, 1]]), 16, 16)
    pair = [one(mean=(0, 0, 2), scale=(-1, -1, -1), opacity=1.0, sh0=colour) for colour in ((1, 0, -1), (-1, 0, 1))]
    first, _ = render(together(*pair), straight)
    second, _ = render(together(*pair[::-1]), straight)
    assert first[8, 8, 0] > first[8, 8, 2]
    assert second[8, 8, 0] < second[8, 8, 2]


def test_off_axis_principal_points_and_unequal_focal_lengths():
    view = camera(40, 30)
    K = np.array([[35.0, 0, 3.0], [0, 61.0, 40.0], [0, 0, 1]])
    agree(blobs(40, 2, spread=2.0), Camera(view.viewmat, K, 40, 30), (0.1, 0.1, 0.1))


@devices
def test_gradients_are_finite_differences(device):
    for seed, degree in enumerate([0, 1, 2, 3]):
        compare_gradients(blobs(10, degree, seed=seed), camera(25, 19, seed=seed), device, seed)


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
        "rotations of odd lengths": (together(one(quat=(1e-3, 2e-3, 0, 0), scale=(-1, -2, -3))), camera(21, 17)),
    }.values(),
    ids=lambda value: "",
)
def test_gradients_in_hard_places(splats, view):
    compare_gradients(splats, view, "cpu", seed=1)


def compare_gradients(splats, view, device, seed, tolerance=1e-3):
    """Every gradient within 0.1 % of the largest of its kind of the same Gaussian, or of next to nothing."""
    rng = np.random.default_rng(seed)
    background = rng.random(3)
    params = in_float64(splats)
    clamp = clamp_of(device)
    sure = ~reference_rasterizer.draw(params, view, background, alpha_max=clamp).doubtful
    v_image = rng.normal(0, 1, (view.height, view.width, 3)) * sure[:, :, None]
    v_alpha = rng.normal(0, 1, (view.height, view.width)) * sure
    expected = reference_rasterizer.gradient_by_differences(params, view, background, v_image, v_alpha, alpha_max=clamp)
    images, alphas, tensors = render_tensors(splats, [view], device, [background])
    loss = (images[0].cpu() * torch.from_numpy(v_image)).sum() + (alphas[0].cpu() * torch.from_numpy(v_alpha)).sum()
    loss.backward()
    for name in ATTRIBUTES:
        found = tensors[name].grad.cpu().numpy().reshape(len(splats), -1)
        wanted = expected[name].reshape(len(splats), -1)
        if wanted.size:
            size = np.abs(wanted).max(axis=1, keepdims=True)
            error = np.abs(found - wanted) / (tolerance * size + 2e-6 * (1 + np.abs(wanted).max()))
            assert error.max() <= 1, f"{name}: {error.max():.2f} times what is allowed"


@devices
def test_several_cameras_give_the_sum_of_their_gradients(device):
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


def test_pictures_and_gradients_are_the_same_for_any_number_of_threads():
    splats, view = blobs(300, 3, spread=1.5), camera(130, 70)
    results = []
    for threads in (1, 2, 3, 7):
        images, alphas, tensors = render_tensors(splats, [view], threads=threads)
        (images.square().sum() + alphas.sum()).backward()
        results.append([images, alphas, *(tensor.grad for tensor in tensors.values())])
    for result in results[1:]:
        for one_thread, several in zip(results[0], result, strict=True):
            assert torch.equal(one_thread, several)


def test_render_is_the_same_without_torch():
    splats, view = blobs(50, 3), camera()
    image, alpha = render(splats, view, background=(1.0, 1.0, 1.0))
    images, alphas, _ = render_tensors(splats, [view], backgrounds=[(1.0, 1.0, 1.0)])
    assert np.array_equal(image, images[0].detach().numpy())
    assert np.array_equal(alpha, alphas[0].detach().numpy())


def test_a_selection_with_steps_is_drawn_like_its_copy():
    splats, view = blobs(40, 2), camera()
    every_other = splats.select(slice(None, None, 2))
    image, _ = render(every_other, view)
    assert np.array_equal(image, render(splats.select(np.arange(0, 40, 2)), view)[0])


def test_the_input_is_not_changed_and_shared():
    splats = blobs(5)
    tensors = tensors_of(splats)
    assert tensors["means"].data_ptr() == splats.means.ctypes.data


def test_a_parameter_changed_before_the_way_back_is_noticed():
    images, _, tensors = render_tensors(blobs(5), [camera()])
    with torch.no_grad():
        tensors["means"].add_(1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        images.sum().backward()


def test_tensors_need_not_be_contiguous():
    splats, view = blobs(30, 2), camera()
    expected, _, _ = render_tensors(splats, [view])
    tensors = {name: tensor.repeat_interleave(2, 0)[::2] for name, tensor in tensors_of(splats).items()}
    viewmats, Ks = torch.from_numpy(view.viewmat[None]), torch.from_numpy(view.K[None])
    images, _ = rasterize(**tensors, viewmats=viewmats, Ks=Ks, width=view.width, height=view.height)
    assert torch.equal(images, expected)


@pytest.mark.parametrize(
    ("change", "kind", "sentence"),
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
def test_wrong_arguments_are_refused_in_one_sentence(change, kind, sentence):
    arguments = {**tensors_of(blobs(5)), "viewmats": torch.eye(4)[None], "Ks": torch.eye(3)[None], "width": 8}
    with pytest.raises(kind, match=sentence):
        rasterize(**{**arguments, **change}, height=8)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device here")
def test_no_cuda_is_said_in_one_sentence():
    with pytest.raises(UnsupportedError, match="no CUDA device"):
        render(blobs(1), camera(), device="cuda")


def test_loading_the_kernels_is_announced():
    told = []
    load_kernels(lambda stage, fraction: told.append((stage, fraction)))
    assert told == [("kernels", 0.0), ("kernels", 1.0)]


def test_cameras_of_any_type_and_layout():
    splats, view = blobs(20), camera()
    expected, _, _ = render_tensors(splats, [view, view])
    viewmats = torch.linalg.inv(torch.linalg.inv(torch.from_numpy(view.viewmat)))[None].expand(2, 4, 4)
    Ks = torch.from_numpy(view.K).expand(2, 3, 3)
    images, _ = rasterize(**tensors_of(splats), viewmats=viewmats, Ks=Ks, width=view.width, height=view.height)
    torch.testing.assert_close(images, expected, atol=1e-4, rtol=0)
    fortran = np.asfortranarray(view.viewmat.astype(np.float32))
    fortran.setflags(write=False)
    image, _ = render(splats, Camera(fortran, np.round(view.K).astype(int), view.width, view.height))
    assert np.isfinite(image).all()


@pytest.mark.parametrize("background", [(1.0,), (1.0, 0.5), (0.0, 0.0, 0.0, 1.0), (0.0, float("nan"), 0.0)])
def test_a_background_is_three_finite_numbers(background):
    with pytest.raises(InvalidViewsError, match="three finite numbers"):
        render(blobs(3), camera(), background=background)


def test_read_only_scenes_are_drawn():
    splats = blobs(10, 2)
    expected, _ = render(splats, camera())
    for name in ATTRIBUTES:
        getattr(splats, name).setflags(write=False)
    assert np.array_equal(render(splats, camera())[0], expected)


def test_too_many_in_one_tile_are_refused(monkeypatch):
    from kissgs.rendering.cpu import lists

    monkeypatch.setattr(lists, "MAX_MEMBERS", 10)
    with pytest.raises(UnsupportedError, match="meet in 16x16 pixels"):
        render(blobs(50), camera())


def test_a_picture_beyond_memory_is_refused(monkeypatch):
    from kissgs.rendering.cpu import frame

    def no_memory(*arguments):
        raise MemoryError

    monkeypatch.setattr(frame, "sort_into_tiles", no_memory)
    with pytest.raises(UnsupportedError, match="not enough memory for a picture of 37x29"):
        render(blobs(3), camera())


def test_too_many_tiles_are_refused(monkeypatch):
    from kissgs.rendering.cpu import lists

    monkeypatch.setattr(lists, "MAX_PAIRS", 10)
    with pytest.raises(KissgsError, match="Render it smaller"):
        render(blobs(50), camera(200, 200))
