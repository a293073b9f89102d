"""Oracle: finite differences of the float64 rasteriser, whole pictures of them; and NumPy's least squares."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import reference_rasterizer
from helpers.render_scenes import blobs, camera, in_float64, one, together

import kissgs
from kissgs.cameras.virtual.sensitivity_cameras import sensitivity_cameras
from kissgs.core.sensitivity import OPACITY, ROTATION, SCALES, Sensitivity
from kissgs.core.spherical_harmonics import sh_basis
from kissgs.core.splats import SH_C0, clean
from kissgs.core.threads import Workers
from kissgs.rendering.color_refit import refit_colors
from kissgs.rendering.rasterizer import removal_scores, render
from kissgs.rendering.sensitivity import WeightedCameras, measure_sensitivity

BACKGROUND = np.array([0.3, 0.6, 0.1], np.float32)


def looked_at(*cameras, background=BACKGROUND, spread=0.0):
    return WeightedCameras(cameras, [1.0] * len(cameras), background, spread)


def turned(quat, axis, angle):
    """The rotation, and before it one about its own axis."""
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


def differences(splats, view, n):
    """Derivatives of the picture by (logit; log-scales; turns about the own axes) and by the position of Gaussian n."""
    params = in_float64(splats)

    def picture(name, change):
        moved = {key: value.copy() for key, value in params.items()}
        moved[name][n] = change(moved[name][n])
        return reference_rasterizer.draw(moved, view, BACKGROUND.astype(np.float64)).image

    def between(name, change, step):
        up, down = (picture(name, lambda value, s=s: change(value, s)) for s in (step, -step))
        return (up - down) / (2 * step)

    def derivative(name, change):
        """Where two steps agree: in some pixels a Gaussian begins or ends to be drawn."""
        coarse, fine = (between(name, change, step) for step in (1e-5, 2e-6))
        return np.where(np.abs(coarse - fine) < 1e-4, fine, 0).reshape(-1)

    axes = np.eye(3)
    shape = [derivative("opacities", lambda value, s: value + s)]
    shape += [derivative("scales", lambda value, s, axis=axis: value + s * axis) for axis in axes]
    shape += [derivative("quats", lambda value, s, axis=axis: turned(value, axis, s)) for axis in range(3)]
    place = [derivative("means", lambda value, s, axis=axis: value + s * axis) for axis in axes]
    return np.array(shape), np.array(place)


@pytest.mark.parametrize("seed", range(4))
def test_forms_are_those_of_the_pictures_derivatives(seed):
    splats, view = clean(blobs(6, seed % 3, seed=seed, log_scale=-1.5))[0], camera(seed=seed)
    found = measure_sensitivity(splats, looked_at(view))
    pixels = 3 * view.width * view.height
    for n in range(len(splats)):
        shape, _ = differences(splats, view, n)
        wanted = (shape @ shape.T / pixels)[np.triu_indices(7)]
        np.testing.assert_allclose(found.shape_hessian[n], wanted, rtol=2e-3, atol=2e-3 * np.abs(wanted).max())


@pytest.mark.parametrize("scale", [(30, -30, -30), (15, -3, -15), (30, 30, -30), (9, -3, -3)])
def test_forms_of_needles_lose_no_digits(scale):
    """As sums of terms as large as a footprint is long, costs once were off by 26 orders of magnitude."""
    splats = together(*(one(quat=(1, 0.1 * i, 0.2, 0.5 * i), scale=scale, opacity=1.0) for i in range(-1, 2)))
    splats, view = clean(splats)[0], camera(25, 19)
    found = measure_sensitivity(splats, looked_at(view))
    for n in range(len(splats)):
        shape, _ = differences(splats, view, n)
        wanted = (shape @ shape.T / (3 * 25 * 19))[np.triu_indices(7)]
        np.testing.assert_allclose(found.shape_hessian[n], wanted, rtol=2e-3, atol=2e-3 * np.abs(wanted).max())


@pytest.mark.parametrize("seed", range(3))
def test_forms_of_positions_are_those_of_small_gaussians(seed):
    """A move also changes a footprint's shape a little, which is left out: the less, the smaller it is."""
    splats, view = clean(blobs(6, 0, seed=seed, log_scale=-3.5))[0], camera(90, 70, seed=seed)
    found = measure_sensitivity(splats, looked_at(view))
    for n in range(len(splats)):
        _, place = differences(splats, view, n)
        wanted = (place @ place.T / (3 * view.width * view.height))[np.triu_indices(3)]
        np.testing.assert_allclose(found.position_hessian[n], wanted, rtol=0.03, atol=0.03 * np.abs(wanted).max())


def test_colors_are_what_a_change_of_one_channel_costs():
    splats, view = blobs(20, 0, seed=3), camera(seed=1)
    found = measure_sensitivity(splats, looked_at(view))
    for n in (0, 7, 19):
        splats.sh0[n] = 0.3  # not clamped
        sh0 = splats.sh0.copy()
        sh0[n, 1] += 0.1
        scenes = splats, replace(splats, sh0=sh0)
        before, after = (render(scene, view, background=BACKGROUND.tolist())[0] for scene in scenes)
        cost = np.mean(np.square(after.astype(np.float64) - before))
        np.testing.assert_allclose(cost, found.color_weight[n] * (0.1 * SH_C0) ** 2, rtol=2e-3, atol=1e-12)
        np.testing.assert_allclose(cost, found.base_colors()[n] * 0.1**2, rtol=2e-3, atol=1e-12)


def test_removal_is_the_exact_score():
    splats, view = blobs(40, 1, seed=5), camera(seed=2)
    splats.opacities[:3] = 5, 9, 13.8  # clamped to the largest alpha
    found = measure_sensitivity(splats, looked_at(view)).removal(splats) * (3 * view.width * view.height)
    scores = removal_scores(splats, [view], background=BACKGROUND.tolist())
    np.testing.assert_allclose(found, scores, rtol=1e-4, atol=1e-5 * scores.max())


@pytest.mark.parametrize("spread", [0.1, 0.5])
def test_an_unknown_background_is_the_mean_over_backgrounds(spread):
    splats, view = clean(blobs(12, 1, seed=6))[0], camera(seed=3)
    found = measure_sensitivity(splats, looked_at(view, spread=spread))
    ends = [
        measure_sensitivity(splats, looked_at(view, background=BACKGROUND + np.float32(step)))
        for step in (-spread, spread)
    ]
    for name in ("shape_hessian", "position_hessian", "color_weight"):
        wanted = 0.5 * (getattr(ends[0], name) + getattr(ends[1], name))
        np.testing.assert_allclose(getattr(found, name), wanted, rtol=1e-3, atol=1e-4 * np.abs(wanted).max())


@pytest.mark.parametrize(
    ("cameras", "weights", "spread", "told"),
    [
        (0, [], 0.2, "by one camera or more with a weight each, not by 0 cameras with 0 weights"),
        (2, [1.0], 0.2, "not by 2 cameras with 1 weights"),
        (1, [0.0], 0.2, "weights of cameras must be positive and finite"),
        (1, [np.nan], 0.2, "weights of cameras must be positive and finite"),
        (1, [1.0], -1.0, "the spread not negative"),
        (1, [1.0], np.inf, "the spread not negative"),
    ],
)
def test_what_cannot_be_watched_from_is_refused(cameras, weights, spread, told):
    with pytest.raises(kissgs.InvalidViewsError, match=told):
        WeightedCameras([camera()] * cameras, weights, BACKGROUND, spread)


def test_views_are_averaged_by_weight_and_directions_by_what_is_seen():
    splats, views = blobs(15, 3, seed=1), [camera(seed=1), camera(20, 31, seed=2)]
    apart = [measure_sensitivity(splats, looked_at(view)) for view in views]
    both = measure_sensitivity(splats, WeightedCameras(views, [1.0, 3.0], BACKGROUND, 0.0))
    np.testing.assert_allclose(
        both.shape_hessian, 0.25 * apart[0].shape_hessian + 0.75 * apart[1].shape_hessian, rtol=1e-4, atol=1e-12
    )
    colors = [0.25 * apart[0].color_weight, 0.75 * apart[1].color_weight]
    gaze = [splats.means - view.position for view in views]
    basis = [sh_basis(g / np.linalg.norm(g, axis=1, keepdims=True), 3)[:, 1:] for g in gaze]
    total = sum(colors)
    seen = total > 0
    mean = sum(color[:, None] * values for color, values in zip(colors, basis, strict=True))[seen] / total[seen, None]
    np.testing.assert_allclose(both.mean_sh_basis[seen], mean, rtol=1e-4, atol=1e-5)
    assert (both.mean_sh_basis[~seen] == 0).all()


def test_threads_do_not_change_it():
    splats, view = blobs(3000, 2, seed=8, log_scale=-3), camera(200, 150)
    one_thread, three = (measure_sensitivity(splats, looked_at(view), threads=threads) for threads in (1, 3))
    for name in ("position_hessian", "shape_hessian", "color_weight", "mean_sh_basis"):
        np.testing.assert_array_equal(getattr(one_thread, name), getattr(three, name))


def test_what_no_camera_sees_costs_nothing_until_hedged():
    splats = together(one(), one(mean=(0, 0, -50)), one(mean=(0.1, 0, 0)))
    plain = measure_sensitivity(splats, looked_at(camera()))
    assert plain.color_weight[1] == plain.shape_hessian[1].max() == plain.position_hessian[1].max() == 0
    hedged = measure_sensitivity(splats, looked_at(camera()), view_uncertainty=0.5)
    assert hedged.color_weight[1] > 0
    assert (hedged.diagonal(SCALES)[1] > 0).all()
    assert (hedged.diagonal(ROTATION)[1] >= 0).all()
    assert hedged.diagonal(OPACITY)[1, 0] > 0
    assert hedged.prior[1] == pytest.approx(hedged.color_weight[1])
    assert hedged.view_uncertainty == 0.5


def panes(*depths, side=10):
    """Opaque panes, one behind the other, of so many Gaussians in either direction."""
    x, y = np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side))
    flat = np.log([2.0 / side, 2.0 / side, 0.01])
    return together(
        *(one(mean=(a, b, z), scale=flat, opacity=8.0) for z in depths for a, b in zip(x.flat, y.flat, strict=True))
    )


def test_a_full_hedge_forgets_what_was_before_a_gaussian():
    """Two panes alike, one hidden by the other: to a camera near each they are worth the same."""
    splats, inner = panes(0.0, 2.0), np.zeros((2, 10, 10), bool)
    inner[:, 3:7, 3:7] = True
    front, behind = np.arange(200)[inner.flat].reshape(2, -1)
    plain, hedged = (
        measure_sensitivity(splats, looked_at(camera(120, 120)), view_uncertainty=view_uncertainty)
        for view_uncertainty in (0.0, 1.0)
    )
    assert plain.color_weight[behind].max() < 0.01 * plain.color_weight[front].min()
    assert 0.6 < np.median(hedged.color_weight[behind]) / np.median(hedged.color_weight[front]) < 1.6
    assert (hedged.prior[behind] > 0.98 * hedged.color_weight[behind]).all()


def test_an_image_is_what_is_measured_whatever_is_near_as_long_as_nothing_is_hedged():
    """Coverage is told, and nothing else: no prior, no floor."""
    splats = panes(0.0, 2.0)
    found = measure_sensitivity(splats, looked_at(camera(120, 120)))
    none = found.with_prior(splats, np.ones(len(splats)), np.full(len(splats), 0.25), 0.0)
    for name in ("position_hessian", "shape_hessian", "color_weight", "mean_sh_basis", "prior"):
        np.testing.assert_array_equal(getattr(none, name), getattr(found, name))
    np.testing.assert_array_equal(none.coverage, np.float32(0.25))
    assert none.view_uncertainty == found.view_uncertainty == 0
    assert found.coverage[:100].min() > 0.5
    assert found.coverage[100:].reshape(10, 10)[3:7, 3:7].max() < 0.05


def measured(colors, splats):
    """Sensitivity of such colours, in which opacity, scales and rotation cost what colours do."""
    nothing = Sensitivity.none(len(splats), splats.sh_degree)
    shapes = np.eye(7)[np.triu_indices(7)] * np.asarray(colors)[:, None]
    places = np.array([1, 0, 0, 1, 0, 1]) * np.asarray(colors)[:, None]
    return replace(
        nothing,
        color_weight=np.array(colors, np.float32),
        shape_hessian=shapes.astype(np.float32),
        position_hessian=places.astype(np.float32),
    )


@pytest.mark.parametrize("view_uncertainty", [0.1, 0.55, 1.0])
def test_what_no_camera_saw_takes_the_prior_whole(view_uncertainty):
    """The prior: 2e-6 per unit of what a camera nearby finds, the median of the seen ones."""
    splats = together(*[one()] * 6)
    close_up = np.array([0.1, 0.2, 0.4, 0.3, 0.05, 0.2])
    colors = np.array([2e-7, 4e-7, 8e-7, 0.0, 0.0, 0.0])
    coverage = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 1.0])  # the last: looked at, and nothing of it seen
    found = measured(colors, splats).with_prior(splats, close_up, coverage, view_uncertainty)
    np.testing.assert_allclose(found.color_weight[:3], colors[:3], rtol=1e-5)  # they are what the prior says
    np.testing.assert_allclose(found.color_weight[3:5], 2e-6 * close_up[3:5], rtol=1e-5)
    np.testing.assert_allclose(found.prior[3:5], found.color_weight[3:5])
    # Shapes and positions of the unseen cost in proportion, as those of the seen do.
    for of in (SCALES, ROTATION):
        np.testing.assert_allclose(found.diagonal(of)[3:5] / found.color_weight[3:5, None], 1, rtol=1e-4)
    np.testing.assert_allclose(
        found.position_hessian[3] / found.color_weight[3], found.position_hessian[0] / found.color_weight[0], rtol=1e-4
    )
    assert 0 < found.color_weight[5] <= found.color_weight[3]
    found.check(splats)


@pytest.mark.parametrize("view_uncertainty", [0.1, 0.55, 0.9])
def test_logarithms_move_towards_the_prior_by_the_hedge_and_none_falls_far_below(view_uncertainty):
    splats = together(*[one()] * 5)
    close_up, prior = np.ones(5), 1e-6
    colors = np.array([1e-6, 1e-6, 1e-6, 1e-4, 1e-12])  # their median is the prior
    found = measured(colors, splats).with_prior(splats, close_up, np.ones(5), view_uncertainty)
    np.testing.assert_allclose(
        np.log10(found.color_weight[3]), -4 * (1 - view_uncertainty) - 6 * view_uncertainty, rtol=1e-5
    )
    least = max(
        10 ** (-9 * (1 - view_uncertainty) - 6 * view_uncertainty), 0.55 * view_uncertainty * prior
    )  # a thousandth of the prior at least
    np.testing.assert_allclose(found.color_weight[4], least, rtol=1e-4)
    half = measured(colors, splats).with_prior(splats, close_up, np.array([1, 1, 1, 0.5, 0.5]), view_uncertainty)
    share = 1 - 0.5 * (1 - view_uncertainty)
    np.testing.assert_allclose(np.log10(half.color_weight[3]), -4 * (1 - share) - 6 * share, rtol=1e-5)
    # A whole form is raised as its colour is.
    np.testing.assert_allclose(
        found.shape_hessian[3], measured(colors, splats).shape_hessian[3] * (found.color_weight[3] / 1e-4), rtol=1e-4
    )


@pytest.mark.parametrize("brightest", [2.0, 1e5])
def test_a_display_shows_no_more_than_white(brightest):
    """What is far brighter costs what something twice as bright as white does."""
    bright = [one(opacity=3.0, sh0=[(b - 0.5) / SH_C0] * 3) for b in (2.0, brightest)]
    usual, found = (measure_sensitivity(together(b, one(mean=(0.1, 0, 1))), looked_at(camera())) for b in bright)
    np.testing.assert_allclose(
        found.shape_hessian, usual.shape_hessian, rtol=1e-3, atol=1e-6 * usual.shape_hessian.max()
    )
    np.testing.assert_allclose(
        found.position_hessian, usual.position_hessian, rtol=1e-3, atol=1e-6 * usual.position_hessian.max()
    )


def test_refitting_is_least_squares():
    """The matrix, written down: one picture per coefficient."""
    original, cameras = blobs(12, 1, seed=4), [camera(seed=n) for n in range(5)]
    original = replace(original, sh0=np.abs(original.sh0) + 1, shN=original.shN * np.float32(0.1))
    decoded = replace(original, opacities=original.opacities + np.float32(0.3), shN=original.shN * 0)
    views = looked_at(*cameras)
    colors = measure_sensitivity(decoded, views).color_weight

    def pictures(scene):
        return np.stack([render(scene, c, background=BACKGROUND.tolist())[0][:, :, 0] for c in cameras]).reshape(-1)

    start = pictures(decoded).astype(np.float64)
    columns = []
    for n in range(len(decoded)):
        sh0 = decoded.sh0.copy()
        sh0[n, 0] += 1
        columns.append(pictures(replace(decoded, sh0=sh0)) - start)
    matrix = np.array(columns).T
    wanted = np.linalg.lstsq(matrix, pictures(original) - start, rcond=None)[0]
    found = refit_colors(decoded, original, views, colors, colors * 0, steps=30)[:, 0] - decoded.sh0[:, 0]
    before, best, after = (np.sum((matrix @ x - pictures(original) + start) ** 2) for x in (0 * wanted, wanted, found))
    assert after < best + 0.1 * (before - best)


def test_refitting_goes_no_further_than_half_a_colour():
    """However much is missing: the original is far brighter than any colour that is allowed."""
    splats, views = blobs(6, 0, seed=2), looked_at(camera(seed=1), camera(seed=2))
    colors = measure_sensitivity(splats, views).color_weight
    original = replace(splats, sh0=splats.sh0 + np.float32(9))
    found = refit_colors(splats, original, views, colors, colors * 0, steps=6)
    np.testing.assert_allclose(np.abs(found - splats.sh0).max(), 0.5 / SH_C0, rtol=1e-5)


def test_refitting_draws_anew_what_would_not_fit_into_memory(monkeypatch):
    splats, views = blobs(20, 1, seed=2), looked_at(camera(seed=1), camera(seed=2))
    colors = measure_sensitivity(splats, views).color_weight
    decoded = replace(splats, shN=splats.shN * 0)
    kept = refit_colors(decoded, splats, views, colors, colors * 0, steps=2)
    monkeypatch.setattr(kissgs.rendering.color_refit, "KEPT", 10)
    np.testing.assert_array_equal(refit_colors(decoded, splats, views, colors, colors * 0, steps=2), kept)


def test_refitting_without_steps_or_without_sight_changes_nothing():
    splats = blobs(5)
    views, nothing = looked_at(camera()), np.zeros(5, np.float32)
    assert refit_colors(splats, splats, views, nothing + 1, nothing, steps=0) is splats.sh0
    assert refit_colors(splats, splats, views, nothing, nothing, steps=3) is splats.sh0


def test_the_sensitivity_of_another_scene_is_refused():
    splats = blobs(5, 1)
    for other in (Sensitivity.none(4, 1), Sensitivity.none(5, 2)):
        with pytest.raises(kissgs.InvalidSceneError, match="does not fit the scene"):
            other.check(splats)
    right = measure_sensitivity(splats, looked_at(camera()))
    right.check(splats)
    for name, value, told in (
        ("color_weight", -right.color_weight - 1, "color_weight has a negative or non-finite value"),
        ("prior", right.prior + np.float32(np.nan), "prior has a negative or non-finite value"),
        ("coverage", right.coverage + np.float32(1.5), "coverage must be from 0 to 1, and has [12]"),
        ("coverage", right.coverage - np.float32(1.5), "coverage must be from 0 to 1, and has -"),
        ("captured", right.captured + np.float32(1.5), "captured must be from 0 to 1, and has [12]"),
        ("view_uncertainty", 5.0, "view_uncertainty must be from 0 to 1, not 5.0"),
        ("view_uncertainty", float("nan"), "view_uncertainty must be from 0 to 1, not nan"),
    ):
        with pytest.raises(kissgs.InvalidSceneError, match=told):
            replace(right, **{name: value}).check(splats)


def test_a_capture_is_watched_from_its_training_cameras_and_a_little_all_around():
    splats = clean(blobs(300, seed=2))[0]
    views = [kissgs.View(f"{n}", camera(120, 80, seed=n)) for n in range(9)]
    capture = kissgs.Views(tuple(views[1:]), tuple(views[:1]), BACKGROUND, "a capture")
    found = sensitivity_cameras(splats, capture, count=4, size=60)
    assert [(c.width, c.height) for c in found.cameras[:4]] == [(60, 40)] * 4
    given = [view.camera.position.tolist() for view in views[1:]]
    assert [given.index(c.position.tolist()) for c in found.cameras[:4]] == [0, 2, 4, 7]
    np.testing.assert_allclose(sum(found.weights[4:]), 0.3 * 4)
    assert found.background is BACKGROUND
    alone = sensitivity_cameras(splats, None, count=4, size=60)
    assert len(alone.cameras) == 4
    with Workers(1):
        assert sensitivity_cameras(splats, capture, count=100, size=500).cameras[0].width == 120
