"""Optional packages. Reference: a fake gsplat, with gsplat's interface, that renders with the CPU backend.

It checks the arguments of gsplat without a GPU; with one, test_rasterizer.py renders on it. Without torch, the scene is
rendered in a process that cannot import it.
"""

import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.render_scenes import blobs, camera

from kissgs.core.errors import UnsupportedError
from kissgs.rendering.differentiable import rasterize
from kissgs.rendering.rasterizer import rasterize_on_cuda, tensors_of

CONSTANTS = {"near_plane": 0.01, "far_plane": 1e10, "tile_size": 16}


def fake_rasterization(
    means,
    quats,
    scales,
    opacities,
    colors,
    viewmats,
    Ks,
    width,
    height,
    sh_degree,
    backgrounds,
    eps2d,
    rasterize_mode,
    **rest,
):
    """Render like gsplat.rasterization: scales and opacities are activated, colours are all SH coefficients."""
    assert rest == CONSTANTS
    assert rasterize_mode in ("classic", "antialiased")
    assert colors.shape[1] == (sh_degree + 1) ** 2
    images, alphas = rasterize(
        {
            "means": means,
            "quats": quats,
            "scales": torch.log(scales),
            "opacities": torch.logit(opacities.double()).float(),
            "sh0": colors[:, 0],
            "shN": colors[:, 1:],
        },
        viewmats,
        Ks,
        width,
        height,
        backgrounds=backgrounds,
        dilation=eps2d,
        antialiased=rasterize_mode == "antialiased",
    )
    return images, alphas[..., None], {}


@pytest.fixture
def gsplat(monkeypatch):
    module = types.ModuleType("gsplat")
    module.rasterization = fake_rasterization
    monkeypatch.setitem(sys.modules, "gsplat", module)


def arguments(count, degree, dilation=0.3):
    views = [camera(seed=1), camera(seed=2)]
    return {
        "parameters": tensors_of(blobs(count, degree)),
        "viewmats": torch.from_numpy(np.stack([view.viewmat for view in views])).float(),
        "Ks": torch.from_numpy(np.stack([view.K for view in views])).float(),
        "width": views[0].width,
        "height": views[0].height,
        "backgrounds": torch.tensor([[0.1, 0.5, 0.9], [1.0, 0.0, 0.3]]),
        "dilation": dilation,
    }


@pytest.mark.parametrize(
    ("degree", "dilation", "antialiased"), [(0, 0.3, False), (1, 0.03, True), (2, 1.0, False), (3, 0.3, True)]
)
def test_gsplat_gets_the_arguments_of_the_same_image(gsplat, degree, dilation, antialiased):
    given = {**arguments(30, degree, dilation), "antialiased": antialiased}
    images, alphas = rasterize_on_cuda(**given)
    expected_images, expected_alphas = rasterize(**given)
    torch.testing.assert_close(images, expected_images, atol=2e-5, rtol=0)
    torch.testing.assert_close(alphas, expected_alphas, atol=2e-5, rtol=0)


def test_an_empty_scene_is_its_background(gsplat):
    given = arguments(0, 1)
    for found, expected in zip(rasterize_on_cuda(**given), rasterize(**given), strict=True):
        assert torch.equal(found, expected)


def test_an_error_says_that_gsplat_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(UnsupportedError, match="pip install gsplat"):
        rasterize_on_cuda(**arguments(3, 0))


CODE = """
import sys
sys.modules["torch"] = None
sys.path.insert(0, sys.argv[1])
import kissgs, pytest
from helpers.fewer_cameras import try_fewer
from kissgs.core.errors import UnsupportedError
try_fewer(pytest.MonkeyPatch(), azimuths=4, radii=(1.1,))
settings = kissgs.Settings.research("balanced", sensitivity_views=4, sensitivity_view_size=48)
scene = kissgs.sample_scene(300, sh_degree=1)
views = kissgs.virtual_views(scene, width=32, height=24, count=2)
result = kissgs.evaluate(scene, kissgs.decompress(kissgs.compress(scene, settings=settings).files), views)
assert result.mean.candidate_vs_reference.psnr > 15
with pytest.raises(UnsupportedError, match="pip install torch"):
    import kissgs.rendering.differentiable
with pytest.raises(UnsupportedError, match="pip install torch gsplat"):
    kissgs.render(scene, views.train[0].camera, device="cuda")
"""


def test_rendering_does_not_need_torch():
    command = [sys.executable, "-c", CODE, str(Path(__file__).parents[1])]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device here")
def test_the_check_of_cuda_says_what_is_missing():
    script = Path(__file__).parents[2] / "scripts" / "check_cuda.py"
    done = subprocess.run([sys.executable, script], check=False, capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("nothing was checked: torch ")
