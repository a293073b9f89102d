"""What the README promises of real scenes; oracle: figures of splat-transform 3.7 on the same files."""

from pathlib import Path

import numpy as np

import kissgs

SPZ_SHN_RMSE = 0.0247038
"""Root mean square error of fox' SH after a round trip through .spz, version 4, default bits."""


def test_fox_is_small_and_keeps_its_gloss(shared_data: Path) -> None:
    scene = kissgs.load(shared_data / "fox" / "point_cloud.ply")
    result = kissgs.compress(scene)
    assert result.report.bytes_per_gaussian <= 13.0
    errors = kissgs.decompress(result.files).shN.astype(np.float64) - scene.shN[result.order]
    assert np.sqrt(np.mean(errors**2)) < 0.62 * SPZ_SHN_RMSE


def test_guitar_is_smaller_than_a_sog_file(shared_data: Path) -> None:
    result = kissgs.compress(shared_data / "guitar" / "guitar.ply")
    assert result.report.bytes_per_gaussian <= 0.95 * 13.17
    assert result.report.cleaned.infinite_opacities == 667
