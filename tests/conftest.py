"""Fixtures and shape checks for all tests."""

from pathlib import Path

import helpers.shape_checks  # noqa: F401  # the hook names it
import pytest
from jaxtyping import install_import_hook

# Shapes and dtypes in the signatures of these modules are checked at run time, except those of Splats, Camera and
# encode, which have error messages of their own for users, and of compiled kernels.
ROOT = Path(__file__).parents[1]
CHECKED = [
    "cameras",
    "core/sensitivity",
    "core/signed_log",
    "core/spherical_harmonics",
    "evaluation",
    "io",
    "planning/kmeans",
    "planning/layout",
    "planning/plas",
    "planning/quantize",
    "planning/rate_distortion",
    "planning/rd_model",
    "planning/rdo_quantize",
    "planning/rotation_forms",
    "planning/sh_codebook",
    "planning/uniform",
    "rendering/color_refit",
    "rendering/coverage",
    "rendering/cpu/frame",
    "rendering/differentiable",
    "rendering/local_scale",
    "rendering/losses",
    "rendering/lpips",
    "rendering/metrics",
    "rendering/rasterizer",
    "rendering/sensitivity",
    "sog",
    "sogxt/decode",
    "synthetic/scene",
]

for name in CHECKED:  # a module that has moved must stay checked
    assert (ROOT / "kissgs" / name).is_dir() or (ROOT / "kissgs" / f"{name}.py").is_file(), name
install_import_hook([f"kissgs.{name.replace('/', '.')}" for name in CHECKED], "helpers.shape_checks.typechecker")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Return the folder of real scenes beside this repository, which their licences keep out of it."""
    folder = Path(__file__).parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("the real scenes (shared/data beside the repository) are not here")
    return folder
