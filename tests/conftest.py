"""What all tests share."""

from pathlib import Path

import pytest
from jaxtyping import install_import_hook

# The shapes and dtypes in signatures are executed. Not those of Splats, Camera and encode, which have their own
# sentences for what users hand them, nor of compiled kernels.
install_import_hook(
    [
        "kissgs.evaluation",
        "kissgs.io",
        "kissgs.sample",
        "kissgs.spherical_harmonics",
        *(f"kissgs.rendering.{name}" for name in ("cpu.frame", "differentiable", "losses", "lpips", "metrics")),
        "kissgs.importance",
        "kissgs.rendering.importance",
        "kissgs.rendering.rasterizer",
        "kissgs.rendering.refit",
        "kissgs.views",
        *(f"kissgs.sogxt.{name}" for name in ("codebook", "decode", "economy", "even", "kmeans")),
        *(f"kissgs.sogxt.{name}" for name in ("order", "planes", "plas", "pras", "quantize", "rounding", "weighed")),
    ],
    "checking.typechecker",
)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real scenes beside this repository. Their licences keep them out of it."""
    folder = Path(__file__).parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("the real scenes (shared/data beside the repository) are not here")
    return folder
