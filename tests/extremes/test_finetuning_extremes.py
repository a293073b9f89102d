"""Oracle: finite numbers, and a container that decoders read, for degenerate Gaussians."""

import numpy as np
import pytest
from helpers.degenerate_scenes import SCENES, changed
from helpers.training_scenes import around, cloud

import kissgs
from kissgs import Settings
from kissgs.cameras.views import Views, black
from kissgs.core.splats import ATTRIBUTES

QUICK = {"enabled": True, "steps": 10, "lr": 0.1, "views": 8, "view_size": 48}


def check(scene, preset="balanced", container="sogxt", **changes):
    finetune = {**QUICK, **changes}
    settings = Settings.research(preset, finetune=finetune, sensitivity_views=4, sensitivity_view_size=48)
    views = Views(around(5), around(3), black(), "circle")
    result = kissgs.compress(scene, settings=settings, views=views, container=container)
    found = kissgs.decompress(result.to_zip())
    for name in ATTRIBUTES:
        assert np.isfinite(getattr(found, name)).all(), name
    report = result.report.finetuning
    assert (report is None) == (len(found) == 0)
    assert report is None or not np.isnan([report.psnr_before, report.psnr_after]).any()
    return result


@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.__name__)
@pytest.mark.quick(1)
def test_degenerate_scenes_are_tuned_without_nan(scene):
    """Every other one as SOG, which holds no scene without visible Gaussians."""
    as_sog = SCENES.index(scene) % 2 and scene.__name__ != "transparent"
    check(scene(), container="sog" if as_sog else "sogxt")


def test_needles_with_the_papers_settings():
    check(changed(cloud(60), scales=np.tile([0.5, -30, -30], (60, 1))), "paper", batch=2)


@pytest.mark.parametrize("size", [1e-6, 1e6])
@pytest.mark.quick(0)
def test_worlds_of_any_size(size):
    scene = cloud(60)
    check(changed(scene, means=scene.means * size, scales=scene.scales + np.log(size)))


@pytest.mark.parametrize(
    ("count", "degree", "container"),
    [(1, 0, "sog"), (0, 2, "sogxt"), (1, 3, "sogxt"), (2, 1, "sog"), (7, 1, "sogxt"), (8, 2, "sog"), (9, 3, "sogxt")],
)
@pytest.mark.quick(1)
def test_few_gaussians_of_any_degree(count, degree, container):
    result = check(cloud(9, degree, seed=count).select(np.arange(count)), container=container, steps=5)
    assert len(result.order) <= count


def test_saturated_opacities_and_constant_channels():
    scene = cloud(60)
    check(changed(scene, opacities=np.where(np.arange(60) % 2, np.inf, -np.inf), sh0=np.zeros((60, 3))))
    check(changed(scene, quats=np.tile([1, 0, 0, 0], (60, 1)), scales=np.full((60, 3), -2.0)), "fast")
