"""Reference: finite differences of images of the float64 rasteriser, and NumPy's least squares."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import reference_float64
from helpers.fewer_cameras import try_fewer
from helpers.random_sensitivity import packed_hessian
from helpers.reference_harmonics import real_harmonics
from helpers.render_scenes import blobs, camera, one, together

import kissgs
from kissgs.cameras.virtual.samples import sensitivity_cameras
from kissgs.core.sensitivity import OPACITY, ROTATION, SCALES, Sensitivity
from kissgs.core.spherical_harmonics import sh_basis
from kissgs.core.splats import SH_C0, clean
from kissgs.rendering.constants import TRANSMITTANCE_MIN
from kissgs.rendering.cpu import frame
from kissgs.rendering.rasterizer import removal_scores, render
from kissgs.rendering.sensitivity import HIDDEN, WeightedCameras, measure_sensitivity, refit_colors

BACKGROUND = np.array([0.3, 0.6, 0.1], np.float32)


def weighted(*cameras, background=BACKGROUND, spread=0.0):
    return WeightedCameras(cameras, [1.0] * len(cameras), background, spread)


def rotated(quat, axis, angle):
    """Return the quaternion after a rotation about one of the Gaussian's own axes."""
    w, x, y, z = quat
    half = np.zeros(3)
    half[axis] = np.sin(angle / 2)
    c, (a, b, d) = np.cos(angle / 2), half
    return np.array(
        [
            w * c - x * a - y * b - z * d,
            w * a + x * c + y * d - z * b,
            w * b - x * d + y * c + z * a,
            w * d + x * b - y * a + z * c,
        ]
    )


def derivatives(splats, view, n, changes):
    """Return derivatives of the image by changes of one attribute each: its name and the change by a step."""
    params = reference_float64.tensors(splats)

    def image(name, change):
        moved = params[name].clone()
        moved[n] = torch.as_tensor(change(moved[n].numpy()))
        return reference_float64.draw(params | {name: moved}, view, BACKGROUND, splats.antialiased).image.numpy()

    def difference_quotient(name, change, step):
        up, down = (image(name, lambda value, s=s: change(value, s)) for s in (step, -step))
        return (up - down) / (2 * step)

    def derivative(name, change):
        """Return the derivative, and 0 where two steps disagree: a Gaussian appears or disappears in that pixel."""
        coarse, fine = (difference_quotient(name, change, step) for step in (1e-5, 2e-6))
        return np.where(np.abs(coarse - fine) < 1e-4, fine, 0).reshape(-1)

    return np.array([derivative(name, change) for name, change in changes])


AXES = np.eye(3)
SHAPE = [
    ("opacities", lambda value, s: value + s),
    *(("scales", lambda value, s, axis=axis: value + s * axis) for axis in AXES),
    *(("quats", lambda value, s, axis=axis: rotated(value, axis, s)) for axis in range(3)),
]
"""Logit, log-scales, rotations about own axes."""

POSITION = [("means", lambda value, s, axis=axis: value + s * axis) for axis in AXES]


def needles(scale):
    return together(*(one(quat=(1, 0.1 * i, 0.2, 0.5 * i), scale=scale, opacity=1.0) for i in range(-1, 2)))


def antialiased(log_scale):
    splats = blobs(6, 1, seed=2, log_scale=log_scale)
    return replace(splats, opacities=splats.opacities + 3, antialiased=True)  # else nothing is left of them


SHAPES = {
    "blobs": (blobs(6, 0, seed=0), camera(seed=0)),
    "blobs with harmonics": (blobs(6, 2, seed=2), camera(seed=2)),
    **{
        f"needles {scale}": (needles(scale), camera(25, 19)) for scale in ((30, -30, -30), (15, -3, -15), (30, 30, -30))
    },
    **{f"antialiased {log_scale}": (antialiased(log_scale), camera(seed=2)) for log_scale in (-5, -3.5, -2)},
}
"""A sum of terms that are as large as a needle is long would be wrong by 26 orders of magnitude. The compensation of
antialiased scenes changes with scale and rotation; for points it changes alone."""


@pytest.mark.parametrize("name", SHAPES)
def test_shape_hessians_agree_with_derivatives_of_the_image(name):
    splats, view = clean(SHAPES[name][0])[0], SHAPES[name][1]
    found, tolerance = measure_sensitivity(splats, weighted(view)), 3e-3 if splats.antialiased else 2e-3
    assert (found.color_weight > 0).sum() > 2
    for n in range(len(splats)):
        shape = derivatives(splats, view, n, SHAPE)
        expected = packed_hessian(shape @ shape.T / (3 * view.width * view.height))
        np.testing.assert_allclose(
            found.shape_hessian[n], expected, rtol=tolerance, atol=tolerance * np.abs(expected).max()
        )


def test_position_hessians_of_small_gaussians_agree_with_derivatives():
    """The change of a footprint's shape by position is neglected; it is small for small Gaussians."""
    splats, view = clean(blobs(6, 0, seed=0, log_scale=-3.5))[0], camera(60, 45, seed=0)
    found = measure_sensitivity(splats, weighted(view))
    for n in range(len(splats)):
        position = derivatives(splats, view, n, POSITION)
        expected = np.diag(position @ position.T) / (3 * view.width * view.height)
        np.testing.assert_allclose(found.position_hessian[n], expected, rtol=0.03, atol=0.03 * np.abs(expected).max())


def test_color_weight_is_the_error_of_a_change_of_one_channel():
    splats, view = blobs(20, 0, seed=3), camera(seed=1)
    found = measure_sensitivity(splats, weighted(view))
    for n in (0, 7, 19):
        splats.sh0[n] = 0.3  # so that the colour is not clamped
        sh0 = splats.sh0.copy()
        sh0[n, 1] += 0.1
        scenes = splats, replace(splats, sh0=sh0)
        before, after = (render(scene, view, background=BACKGROUND.tolist())[0] for scene in scenes)
        error = np.mean(np.square(after.astype(np.float64) - before))
        np.testing.assert_allclose(error, found.color_weight[n] * (0.1 * SH_C0) ** 2, rtol=2e-3, atol=1e-12)
        np.testing.assert_allclose(error, found.base_colors()[n] * 0.1**2, rtol=2e-3, atol=1e-12)


@pytest.mark.parametrize(("end", "tolerance"), [(TRANSMITTANCE_MIN, 1e-4), (HIDDEN, 1e-2)])
def test_removal_agrees_with_removal_scores(monkeypatch, end, tolerance):
    """Exact with the lists of the image model, whose end comes later."""
    monkeypatch.setattr(kissgs.rendering.sensitivity, "HIDDEN", end)
    splats, view = blobs(40, 1, seed=5), camera(seed=2)
    splats.opacities[:3] = 5, 9, 13.8  # clamped to the largest alpha
    found = measure_sensitivity(splats, weighted(view)).removal(splats) * (3 * view.width * view.height)
    scores = removal_scores(splats, [view], background=BACKGROUND.tolist())
    np.testing.assert_allclose(found, scores, rtol=tolerance, atol=0.1 * tolerance * scores.max())


def test_an_unknown_background_is_the_mean_over_backgrounds():
    spread = 0.5
    splats, view = clean(blobs(12, 1, seed=6))[0], camera(seed=3)
    found = measure_sensitivity(splats, weighted(view, spread=spread))
    ends = [
        measure_sensitivity(splats, weighted(view, background=BACKGROUND + np.float32(step)))
        for step in (-spread, spread)
    ]
    for name in ("shape_hessian", "position_hessian", "color_weight"):
        expected = 0.5 * (getattr(ends[0], name) + getattr(ends[1], name))
        np.testing.assert_allclose(getattr(found, name), expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("cameras", "weights", "spread", "message"),
    [
        (0, [], 0.2, "at least one camera and a weight for each, not 0 cameras with 0 weights"),
        (2, [1.0], 0.2, "not 2 cameras with 1 weights"),
        (1, [0.0], 0.2, "weights of cameras must be positive and finite"),
        (1, [np.nan], 0.2, "weights of cameras must be positive and finite"),
        (1, [1.0], -1.0, "the spread finite and not negative"),
        (1, [1.0], np.inf, "the spread finite and not negative"),
    ],
)
def test_invalid_cameras_and_weights_are_refused(cameras, weights, spread, message):
    with pytest.raises(kissgs.InvalidViewsError, match=message):
        WeightedCameras([camera()] * cameras, weights, BACKGROUND, spread)


def test_images_are_averaged_by_weight_and_sh_bases_by_visibility():
    splats, views = blobs(15, 3, seed=1), [camera(seed=1), camera(20, 31, seed=2)]
    single = [measure_sensitivity(splats, weighted(view)) for view in views]
    both = measure_sensitivity(splats, WeightedCameras(views, [1.0, 3.0], BACKGROUND, 0.0))
    np.testing.assert_allclose(
        both.shape_hessian, 0.25 * single[0].shape_hessian + 0.75 * single[1].shape_hessian, rtol=1e-4, atol=1e-12
    )
    colors = [0.25 * single[0].color_weight, 0.75 * single[1].color_weight]
    directions = [splats.means - view.position for view in views]
    basis = [sh_basis(d / np.linalg.norm(d, axis=1, keepdims=True), 3)[:, 1:] for d in directions]
    total = sum(colors)
    seen = total > 0
    mean = sum(color[:, None] * values for color, values in zip(colors, basis, strict=True))[seen] / total[seen, None]
    np.testing.assert_allclose(both.mean_harmonics[seen], mean, rtol=1e-4, atol=1e-5)
    assert (both.mean_harmonics[~seen] == 0).all()
    captured = measure_sensitivity(splats, WeightedCameras(views, [1.0, 3.0], BACKGROUND, 0.0, captured=1))
    np.testing.assert_array_equal(captured.mean_harmonics, both.mean_harmonics)
    higher = [real_harmonics(d / np.linalg.norm(d, axis=1, keepdims=True), 6)[:, 16:] for d in directions]
    mean = sum(color[:, None] * values for color, values in zip(colors, higher, strict=True))[seen] / total[seen, None]
    np.testing.assert_allclose(captured.higher_harmonics[seen], mean, rtol=1e-4, atol=1e-5)
    assert both.higher_harmonics.shape == (15, 0)


def test_sensitivity_does_not_depend_on_threads():
    splats, view = blobs(3000, 2, seed=8, log_scale=-3), camera(200, 150)
    one_thread, three = (measure_sensitivity(splats, weighted(view), threads=threads) for threads in (1, 3))
    for name in ("position_hessian", "shape_hessian", "color_weight", "mean_harmonics"):
        np.testing.assert_array_equal(getattr(one_thread, name), getattr(three, name))


def test_sensitivity_does_not_depend_on_bands_of_tiles(monkeypatch):
    scene, views = kissgs.sample_scene(3000, sh_degree=1), weighted(camera(96, 64), camera(64, 96))
    whole = measure_sensitivity(scene, views)
    monkeypatch.setattr(frame, "BAND", 64)
    parts = measure_sensitivity(scene, views)
    for name in ("shape_hessian", "position_hessian", "color_weight", "mean_harmonics", "coverage"):
        wanted = getattr(whole, name)
        np.testing.assert_allclose(getattr(parts, name), wanted, rtol=1e-5, atol=1e-6 * np.abs(wanted).max())
    np.testing.assert_array_equal(measure_sensitivity(scene, views, threads=1).shape_hessian, parts.shape_hessian)


def test_the_sensitivity_of_unseen_gaussians_is_0_without_view_uncertainty():
    splats = together(one(), one(mean=(0, 0, -50)), one(mean=(0.1, 0, 0)))
    plain = measure_sensitivity(splats, weighted(camera()))
    assert plain.color_weight[1] == plain.shape_hessian[1].max() == plain.position_hessian[1].max() == 0
    shrunk = measure_sensitivity(splats, weighted(camera()), view_uncertainty=0.5)
    assert shrunk.color_weight[1] > 0
    assert (shrunk.diagonal(SCALES)[1] > 0).all()
    assert (shrunk.diagonal(ROTATION)[1] >= 0).all()
    assert shrunk.diagonal(OPACITY)[1, 0] > 0
    assert shrunk.prior[1] == pytest.approx(shrunk.color_weight[1])
    assert shrunk.view_uncertainty == 0.5


def panes(*depths, side=10):
    """Return opaque square panes at these depths, ``side`` by ``side`` Gaussians each."""
    x, y = np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side))
    flat = np.log([2.0 / side, 2.0 / side, 0.01])
    return together(
        *(one(mean=(a, b, z), scale=flat, opacity=8.0) for z in depths for a, b in zip(x.flat, y.flat, strict=True))
    )


def test_at_view_uncertainty_1_occlusion_has_no_effect():
    """The front pane hides an equal one; a camera near each of them would see both alike."""
    splats, inner = panes(0.0, 2.0), np.zeros((2, 10, 10), bool)
    inner[:, 3:7, 3:7] = True
    front, behind = np.arange(200)[inner.flat].reshape(2, -1)
    plain, shrunk = (
        measure_sensitivity(splats, weighted(camera(120, 120)), view_uncertainty=view_uncertainty)
        for view_uncertainty in (0.0, 1.0)
    )
    assert plain.color_weight[behind].max() < 0.01 * plain.color_weight[front].min()
    assert 0.6 < np.median(shrunk.color_weight[behind]) / np.median(shrunk.color_weight[front]) < 1.6
    assert (shrunk.prior[behind] > 0.98 * shrunk.color_weight[behind]).all()


def test_without_view_uncertainty_the_prior_has_no_effect():
    """Only coverage is set: there is no prior and no floor."""
    splats = panes(0.0, 2.0)
    found = measure_sensitivity(splats, weighted(camera(120, 120)))
    same = found.with_prior(splats, np.ones(len(splats)), np.full(len(splats), 0.25), 0.0)
    for name in ("position_hessian", "shape_hessian", "color_weight", "mean_harmonics", "prior"):
        np.testing.assert_array_equal(getattr(same, name), getattr(found, name))
    np.testing.assert_array_equal(same.coverage, np.float32(0.25))
    assert same.view_uncertainty == found.view_uncertainty == 0
    assert found.coverage[:100].min() > 0.5
    assert found.coverage[100:].reshape(10, 10)[3:7, 3:7].max() < 0.05


def measured(colors, splats):
    """Return a sensitivity with these colour weights, and Hessians whose diagonals are equal to them."""
    zeros = Sensitivity.none(len(splats), splats.sh_degree)
    shapes = packed_hessian(np.eye(7)) * np.asarray(colors)[:, None]
    positions = np.ones(3) * np.asarray(colors)[:, None]
    return replace(
        zeros,
        color_weight=np.array(colors, np.float32),
        shape_hessian=shapes.astype(np.float32),
        position_hessian=positions.astype(np.float32),
    )


@pytest.mark.parametrize("view_uncertainty", [0.1, 1.0])
def test_unseen_gaussians_take_the_prior(view_uncertainty):
    """The prior is 2e-6 per unit of ``close_up``, the median of the seen Gaussians."""
    splats = together(*[one()] * 6)
    close_up = np.array([0.1, 0.2, 0.4, 0.3, 0.05, 0.2])
    colors = np.array([2e-7, 4e-7, 8e-7, 0.0, 0.0, 0.0])
    coverage = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 1.0])  # the last one is covered but invisible
    found = measured(colors, splats).with_prior(splats, close_up, coverage, view_uncertainty)
    np.testing.assert_allclose(found.color_weight[:3], colors[:3], rtol=1e-5)  # they are equal to the prior
    np.testing.assert_allclose(found.color_weight[3:5], 2e-6 * close_up[3:5], rtol=1e-5)
    np.testing.assert_allclose(found.prior[3:5], found.color_weight[3:5])
    # Hessians of unseen Gaussians are proportional to their colour weight, as those of seen ones are.
    for of in (SCALES, ROTATION):
        np.testing.assert_allclose(found.diagonal(of)[3:5] / found.color_weight[3:5, None], 1, rtol=1e-4)
    np.testing.assert_allclose(
        found.position_hessian[3] / found.color_weight[3], found.position_hessian[0] / found.color_weight[0], rtol=1e-4
    )
    assert 0 < found.color_weight[5] <= found.color_weight[3]
    found.check(splats)


@pytest.mark.parametrize("view_uncertainty", [0.1, 0.9])
def test_logarithms_are_shrunk_towards_the_prior_by_view_uncertainty(view_uncertainty):
    splats = together(*[one()] * 5)
    close_up, prior = np.ones(5), 1e-6
    colors = np.array([1e-6, 1e-6, 1e-6, 1e-4, 1e-12])  # their median is the prior
    found = measured(colors, splats).with_prior(splats, close_up, np.ones(5), view_uncertainty)
    np.testing.assert_allclose(
        np.log10(found.color_weight[3]), -4 * (1 - view_uncertainty) - 6 * view_uncertainty, rtol=1e-5
    )
    floor = max(
        10 ** (-9 * (1 - view_uncertainty) - 6 * view_uncertainty), 0.55 * view_uncertainty * prior
    )  # at least a thousandth of the prior
    np.testing.assert_allclose(found.color_weight[4], floor, rtol=1e-4)
    half_covered = measured(colors, splats).with_prior(
        splats, close_up, np.array([1, 1, 1, 0.5, 0.5]), view_uncertainty
    )
    share = 1 - 0.5 * (1 - view_uncertainty)
    np.testing.assert_allclose(np.log10(half_covered.color_weight[3]), -4 * (1 - share) - 6 * share, rtol=1e-5)
    # Hessians are scaled as the colour weight is.
    np.testing.assert_allclose(
        found.shape_hessian[3], measured(colors, splats).shape_hessian[3] * (found.color_weight[3] / 1e-4), rtol=1e-4
    )


@pytest.mark.parametrize("brightness", [2.0, 1e5])
def test_colours_count_as_2_at_most(brightness):
    bright = [one(opacity=3.0, sh0=[(b - 0.5) / SH_C0] * 3) for b in (2.0, brightness)]
    expected, found = (measure_sensitivity(together(b, one(mean=(0.1, 0, 1))), weighted(camera())) for b in bright)
    np.testing.assert_allclose(
        found.shape_hessian, expected.shape_hessian, rtol=1e-3, atol=1e-6 * expected.shape_hessian.max()
    )
    np.testing.assert_allclose(
        found.position_hessian, expected.position_hessian, rtol=1e-3, atol=1e-6 * expected.position_hessian.max()
    )


def test_the_colour_refit_is_a_least_squares_fit():
    """The matrix is built explicitly, with one image per coefficient."""
    original, cameras = blobs(8, 1, seed=4), [camera(seed=n) for n in range(3)]
    original = replace(original, sh0=np.abs(original.sh0) + 1, shN=original.shN * np.float32(0.1))
    decoded = replace(original, opacities=original.opacities + np.float32(0.3), shN=original.shN * 0)
    views = weighted(*cameras)
    colors = measure_sensitivity(decoded, views).color_weight

    def images(scene):
        return np.stack([render(scene, c, background=BACKGROUND.tolist())[0][:, :, 0] for c in cameras]).reshape(-1)

    start = images(decoded).astype(np.float64)
    columns = []
    for n in range(len(decoded)):
        sh0 = decoded.sh0.copy()
        sh0[n, 0] += 1
        columns.append(images(replace(decoded, sh0=sh0)) - start)
    matrix = np.array(columns).T
    solution = np.linalg.lstsq(matrix, images(original) - start, rcond=None)[0]
    found = refit_colors(decoded, original, views, colors, colors * 0, steps=30)[:, 0] - decoded.sh0[:, 0]
    before, best, after = (
        np.sum((matrix @ x - images(original) + start) ** 2) for x in (0 * solution, solution, found)
    )
    assert after < best + 0.1 * (before - best)


def test_the_colour_refit_changes_a_colour_by_half_its_range_at_most():
    """The original is far brighter than that."""
    splats, views = blobs(6, 0, seed=2), weighted(camera(seed=1), camera(seed=2))
    colors = measure_sensitivity(splats, views).color_weight
    original = replace(splats, sh0=splats.sh0 + np.float32(9))
    found = refit_colors(splats, original, views, colors, colors * 0, steps=6)
    np.testing.assert_allclose(np.abs(found - splats.sh0).max(), 0.5 / SH_C0, rtol=1e-5)


def test_the_colour_refit_without_cached_images_is_the_same(monkeypatch):
    splats, views = blobs(20, 1, seed=2), weighted(camera(seed=1), camera(seed=2))
    colors = measure_sensitivity(splats, views).color_weight
    decoded = replace(splats, shN=splats.shN * 0)
    cached = refit_colors(decoded, splats, views, colors, colors * 0, steps=2)
    monkeypatch.setattr(kissgs.rendering.sensitivity, "MAX_CACHED_PIXELS", 10)
    np.testing.assert_array_equal(refit_colors(decoded, splats, views, colors, colors * 0, steps=2), cached)


def test_the_colour_refit_without_steps_or_visible_gaussians_changes_nothing():
    splats = blobs(5)
    views, zeros = weighted(camera()), np.zeros(5, np.float32)
    assert refit_colors(splats, splats, views, zeros + 1, zeros, steps=0) is splats.sh0
    assert refit_colors(splats, splats, views, zeros, zeros, steps=3) is splats.sh0


def test_the_sensitivity_of_another_scene_is_refused():
    splats = blobs(5, 1)
    for other in (Sensitivity.none(4, 1), Sensitivity.none(5, 2)):
        with pytest.raises(kissgs.InvalidSceneError, match="does not fit the scene"):
            other.check(splats)
    valid = measure_sensitivity(splats, weighted(camera()))
    valid.check(splats)
    for name, value, message in (
        ("color_weight", -valid.color_weight - 1, "color_weight has a negative or non-finite value"),
        ("prior", valid.prior + np.float32(np.nan), "prior has a negative or non-finite value"),
        ("coverage", valid.coverage + np.float32(1.5), "coverage must be from 0 to 1, and has [12]"),
        ("coverage", valid.coverage - np.float32(1.5), "coverage must be from 0 to 1, and has -"),
        ("captured", valid.captured + np.float32(1.5), "captured must be from 0 to 1, and has [12]"),
        ("view_uncertainty", 5.0, "view_uncertainty must be from 0 to 1, not 5.0"),
        ("view_uncertainty", float("nan"), "view_uncertainty must be from 0 to 1, not nan"),
    ):
        with pytest.raises(kissgs.InvalidSceneError, match=message):
            replace(valid, **{name: value}).check(splats)


def test_sensitivity_cameras_of_a_capture_are_its_training_cameras_and_some_around_the_scene(monkeypatch):
    try_fewer(monkeypatch)
    splats = clean(blobs(300, seed=2))[0]
    views = [kissgs.View(f"{n}", camera(120, 80, seed=n)) for n in range(9)]
    capture = kissgs.Views(tuple(views[1:]), tuple(views[:1]), BACKGROUND, "a capture")
    found, _ = sensitivity_cameras(splats, capture, count=4, size=60)
    assert [(c.width, c.height) for c in found.cameras[:4]] == [(60, 40)] * 4
    given = [view.camera.position.tolist() for view in views[1:]]
    assert [given.index(c.position.tolist()) for c in found.cameras[:4]] == [0, 2, 4, 7]
    np.testing.assert_allclose([c.dilation for c in found.cameras], [0.3 / 4] * 4 + [0.3] * len(found.cameras[4:]))
    np.testing.assert_allclose(sum(found.weights[4:]), 0.3 * 4)
    assert found.background is BACKGROUND
    virtual, _ = sensitivity_cameras(splats, None, count=4, size=60)
    assert len(virtual.cameras) == 4
    assert sensitivity_cameras(splats, capture, count=4, size=500)[0].cameras[0].width == 120


@pytest.mark.parametrize("name", ["mean_harmonics", "higher_harmonics"])
def test_harmonics_that_are_no_means_are_refused(name):
    splats = blobs(4, 2)
    damaged = Sensitivity.none(4, 2, captured=True)
    getattr(damaged, name)[1] = 1e15
    with pytest.raises(kissgs.InvalidSceneError, match="no means of spherical harmonics"):
        damaged.check(splats)


def test_the_sensitivity_of_an_empty_scene_is_valid_with_a_capture():
    Sensitivity.none(0, 3, captured=True).check(blobs(0, 3))
