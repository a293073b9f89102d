"""Images, gradients and scores of any finite Gaussians are finite."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.examples import examples
from helpers.rasterized import all_is_finite, render_tensors
from helpers.render_scenes import blobs, camera, one, together
from hypothesis import given
from hypothesis import strategies as st

from kissgs.core.splats import ATTRIBUTES, Splats

finite32 = {"allow_nan": False, "allow_infinity": False, "width": 32}
anywhere = st.one_of(
    st.floats(-1, 1, **finite32), st.floats(-(2.0**20), 2.0**20, **finite32), st.sampled_from([0.0, 1e6, -1e6])
)
log_scale = st.one_of(st.floats(-30, 30, **finite32), st.sampled_from([-30.0, 30.0]))
quat = st.one_of(st.floats(-1, 1, **finite32), st.sampled_from([0.0, 1e-30, 1e-13, 1e-7]))
gaussian = st.builds(
    one,
    mean=st.tuples(anywhere, anywhere, anywhere),
    quat=st.tuples(quat, quat, quat, quat),
    scale=st.tuples(log_scale, log_scale, log_scale),
    opacity=st.one_of(st.floats(-30, 30, **finite32), st.sampled_from([-30.0, 30.0, -5.5])),
    sh0=st.tuples(anywhere, anywhere, anywhere),
    shN=st.lists(st.floats(-100, 100, **finite32), min_size=9, max_size=9),
)
sizes = st.sampled_from([(1, 1), (1, 4096), (4096, 1), (16, 16), (17, 15)])


@examples(150)
@given(gaussians=st.lists(gaussian, min_size=1, max_size=9), size=sizes, seed=st.integers(0, 99))
def test_images_gradients_and_scores_are_finite(gaussians, size, seed):
    all_is_finite(together(*gaussians), camera(*size, seed=seed))


@examples(60)
@given(depth=st.sampled_from([0.0, 1e-9, -1e-9, 0.0099, 0.01, 0.0101, 1.0]), scale=log_scale, side=anywhere)
def test_gaussians_on_and_behind_the_camera_plane(depth, scale, side):
    view = camera(33, 17)
    position = view.position + view.viewmat[2, :3] * depth + view.viewmat[0, :3] * side
    all_is_finite(one(mean=tuple(position), scale=(scale, -3, scale), quat=(1, 1, 0, 0)), view)


@pytest.mark.parametrize("size", [(1, 1), (1, 4096), (4096, 1)])
def test_images_of_one_pixel_and_of_one_line_are_finite(size):
    all_is_finite(blobs(200, 3, spread=2.0), camera(*size))


def test_a_gaussian_larger_than_the_scene_is_a_uniform_colour():
    splats = one(scale=(30, 30, 30), opacity=0.0, sh0=(0, 1, 2))
    images, alphas, _ = render_tensors(splats, [camera()])
    torch.testing.assert_close(alphas, torch.full_like(alphas, 0.5), atol=1e-6, rtol=0)
    expected = 0.5 * (0.5 + 0.28209479177387814 * torch.tensor([0.0, 1.0, 2.0]))
    torch.testing.assert_close(images[0], expected.expand_as(images[0]), atol=1e-6, rtol=0)


def test_nan_in_a_parameter_does_not_crash_the_rasteriser():
    """kissgs.clean removes NaN; kernels do not check bounds, so an invalid index would crash them."""
    good = one()
    for name in ("means", "quats", "scales", "opacities"):
        for value in (np.nan, np.inf, -np.inf):
            arrays = {field: getattr(good, field).copy() for field in ATTRIBUTES}
            arrays[name].flat[0] = value
            render_tensors(Splats(**arrays), [camera(200, 100)])


BOUNDS = """
import sys
sys.path.insert(0, sys.argv[1])
import numpy as np, torch
from helpers.render_scenes import blobs, camera, one, together
from helpers.rasterized import all_is_finite
from kissgs.rendering.camera import Camera
from kissgs.rendering.differentiable import photometric_loss
for degree, size in enumerate(((1, 1), (33, 50), (1, 4096), (300, 7))):
    all_is_finite(blobs(0, degree), camera(*size))
    all_is_finite(blobs(400, degree, spread=2.0), camera(*size))
    away = camera(*size)
    K = away.K.copy()
    K[:2, 2] = 1e4, -1e5
    all_is_finite(blobs(40, degree, spread=9.0, log_scale=3), Camera(away.viewmat, K, *size))
    all_is_finite(together(one(scale=(30, 30, -30)), one(mean=(1e6, 0, 0), scale=(30, 2, 2))), camera(*size))
    image = torch.rand(size[1], size[0], 3, requires_grad=True)
    photometric_loss(image, torch.rand(size[1], size[0], 3)).backward()
"""


@pytest.mark.quick(0)
def test_kernels_stay_within_their_arrays(tmp_path):
    """Bounds checks of numba are enabled in a separate process with a separate cache."""
    environment = {**os.environ, "NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", BOUNDS, str(Path(__file__).parents[1])]
    done = subprocess.run(command, check=False, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
