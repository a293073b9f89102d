"""Oracle: a smooth function imaged project the lens, whose distortion iteration inverts for every pixel."""

import numpy as np
import pytest
from helpers.examples import examples
from hypothesis import given
from hypothesis import strategies as st

from kissgs.cameras.photographs import MIN_AREA, Distortion, Lens, Window, full_window, undistort
from kissgs.core.errors import InvalidViewsError

BARREL = Distortion(k1=-0.15, k2=0.02)
PINCUSHION = Distortion(k1=0.2, k2=-0.03, p1=0.002, p2=-0.003)
RATIONAL = Distortion(k1=0.3, k2=0.1, p1=0.001, p2=0.001, k3=0.05, k4=0.2, k5=0.1, k6=0.02)
LENSES = [Lens(90, 95, 62.3, 38.1, 120, 80, d) for d in (BARREL, PINCUSHION, RATIONAL, Distortion(k1=1e-9))]


def project(lens, x, y):
    """Return the pixel coordinates of the ray (x, y, 1)."""
    d = lens.distortion
    r2 = x**2 + y**2
    radial = (1 + d.k1 * r2 + d.k2 * r2**2 + d.k3 * r2**3) / (1 + d.k4 * r2 + d.k5 * r2**2 + d.k6 * r2**3)
    u = x * radial + 2 * d.p1 * x * y + d.p2 * (r2 + 2 * x**2)
    v = y * radial + d.p1 * (r2 + 2 * y**2) + 2 * d.p2 * x * y
    return lens.fx * u + lens.cx, lens.fy * v + lens.cy


def scene(x, y):
    """Return the colour in the direction (x, y, 1)."""
    return 128 + 100 * np.stack([np.sin(4 * x + 1), np.cos(5 * y), np.sin(3 * x - 4 * y)], axis=-1)


def photograph(lens):
    target = np.stack(np.meshgrid(np.arange(lens.width), np.arange(lens.height))) + 0.5
    focal = np.reshape((lens.fx, lens.fy), (2, 1, 1))
    ray = (target - np.reshape((lens.cx, lens.cy), (2, 1, 1))) / focal
    for _ in range(200):
        ray = ray - (project(lens, *ray) - target) / focal
    np.testing.assert_allclose(project(lens, *ray), target, atol=1e-6)
    return np.rint(scene(*ray)).astype(np.uint8)


@pytest.mark.parametrize("lens", LENSES)
def test_undistorted_pixels_equal_those_of_a_pinhole(lens):
    window = full_window(lens)
    image = undistort(photograph(lens), window)
    K = window.K
    x = (np.arange(window.width) + 0.5 - K[0, 2]) / K[0, 0]
    y = (np.arange(window.height) + 0.5 - K[1, 2]) / K[1, 1]
    expected = scene(*np.meshgrid(x, y))
    assert np.abs(image - expected)[2:-2, 2:-2].max() < 1.5  # rounding twice, and interpolation
    assert np.abs(image - expected).max() < 4  # border pixels are repeated


@pytest.mark.parametrize("lens", LENSES)
def test_the_photograph_covers_the_window_but_no_larger_one(lens):
    window = full_window(lens)
    assert all_covered(window)
    larger = Window(lens, window.left - 1, window.top - 1, window.width + 2, window.height + 2)
    in_photo = larger.left >= 0 and larger.top >= 0
    in_photo = in_photo and larger.left + larger.width <= 120 and larger.top + larger.height <= 80
    assert not (in_photo and all_covered(larger))


def all_covered(window):
    lens = window.lens
    columns, rows = window.left + np.arange(window.width), window.top + np.arange(window.height)
    x, y = np.meshgrid((columns + 0.5 - lens.cx) / lens.fx, (rows + 0.5 - lens.cy) / lens.fy)
    u, v = project(lens, x, y)
    return (u >= 0).all() and (u <= lens.width).all() and (v >= 0).all() and (v <= lens.height).all()


def test_barrel_distortion_loses_nothing_and_pincushion_keeps_the_aspect_ratio():
    assert full_window(LENSES[0]) == Window(LENSES[0], 0, 0, 120, 80)
    window = full_window(LENSES[1])
    assert 90 < window.width < 120
    assert window.width / window.height == pytest.approx(1.5, abs=0.05)
    np.testing.assert_array_equal(window.K, [[90, 0, 62.3 - window.left], [0, 95, 38.1 - window.top], [0, 0, 1]])


def test_photographs_without_distortion_stay_unchanged():
    photo = np.random.default_rng(0).integers(0, 256, (80, 120, 3), dtype=np.uint8)
    lens = Lens(90, 95, 62.3, 38.1, 120, 80)
    assert not lens.distortion
    np.testing.assert_array_equal(undistort(photo, Window(lens, 0, 0, 120, 80)), photo)
    np.testing.assert_array_equal(undistort(photo, Window(lens, 5, 7, 20, 30)), photo[7:37, 5:25])


def test_windows_exclude_rays_beyond_the_invertible_range():
    """A k1 this negative images rays far from the axis inside the photograph again, so bounds are not enough."""
    lens = Lens(60, 60, 60, 40, 120, 80, Distortion(k1=-0.4))
    window = full_window(lens)
    corner = np.hypot(window.width / 2 - 0.5, window.height / 2 - 0.5) / 60
    assert 1 - 3 * 0.4 * corner**2 > 0
    assert window.width > 60


@pytest.mark.parametrize(
    ("lens", "sentence"),
    [
        (
            Lens(90, 95, -1, 38.1, 120, 80, BARREL),
            "the principal point (-1, 38.1) of a distorting lens is outside its 120x80 photograph; calibrate again",
        ),
        (
            Lens(90, 95, 60, 40, 120, 80, Distortion(k1=1e6)),
            "the lens distortion leaves less than a tenth of the photograph; calibrate again, or undistort with "
            "'colmap image_undistorter'",
        ),
    ],
)
def test_invalid_lenses(lens, sentence):
    with pytest.raises(InvalidViewsError) as caught:
        full_window(lens)
    assert str(caught.value) == sentence


COEFFICIENTS = st.floats(-1, 1) | st.floats(allow_nan=False, allow_infinity=False)


@examples(150)
@given(st.builds(Distortion, *[COEFFICIENTS] * 8), st.floats(1, 1e4), st.floats(1, 119))
def test_any_coefficients(distortion, focal, cx):
    lens = Lens(focal, focal, cx, 40, 120, 80, distortion)
    try:
        window = full_window(lens)
    except InvalidViewsError:
        return
    assert window.width * window.height >= MIN_AREA * 120 * 80
    assert window.left >= 0
    assert window.left + window.width <= 120
    image = undistort(np.full((80, 120, 3), 77, dtype=np.uint8), window)
    assert (image == 77).all()
