"""Oracle: curves whose distance is known, and what compress itself says."""

from dataclasses import replace

import pytest
from helpers.training_scenes import around, cloud

import kissgs
from kissgs import Settings, UnsupportedError
from kissgs.benchmark.finetuning_curves import CHOSEN, TUNED, RatePoint, rate_curves, saved
from kissgs.cameras.views import Views, black

POINT = RatePoint(
    way=CHOSEN,
    count=1,
    quality_offset_db=0,
    bytes=1,
    psnr=0,
    ssim=0,
    psnr_to_scene=0,
    seconds=0,
    cpu_seconds=0,
    peak_memory=0,
)
QUICK = {"steps": 5, "views": 16, "view_size": 60}


def curve(way, qualities, share=1.0, each=1.3):
    return [replace(POINT, way=way, psnr=q, bytes=round(1e9 * share * each**q)) for q in qualities]


@pytest.mark.parametrize("share", [0.7, 1.0, 1.25])
@pytest.mark.parametrize("qualities", [(0, 1, 2, 3), (0.5, 2.5), (-1, 0.2, 1.1, 9)])
def test_a_curve_of_a_constant_share_saves_the_rest(share, qualities):
    points = curve(CHOSEN, (0, 1, 2, 3)) + curve(TUNED, qualities, share)
    assert saved(points) == pytest.approx(1 - share, abs=1e-6)


def test_curves_that_do_not_overlap_cannot_be_compared():
    assert saved(curve(CHOSEN, (0, 1)) + curve(TUNED, (2, 3))) is None
    assert saved(curve(CHOSEN, (0, 1))) is None
    assert saved(curve(CHOSEN, (0, 1)) + [replace(point, psnr=float("inf")) for point in curve(TUNED, (0, 1))]) is None


def test_points_are_what_compress_gives():
    scene, views = cloud(300, 1), Views(around(8), around(6)[1:3], black(), "circle")
    settings = Settings.from_preset("balanced", finetune=QUICK, sensitivity_views=4, sensitivity_view_size=60)
    points = rate_curves(scene, settings, views, fidelities=(-6.0, 3.0), threads=1)
    assert [(point.way, point.quality_offset_db) for point in points] == [
        (w, f) for f in (-6.0, 3.0) for w in (CHOSEN, TUNED)
    ]
    for point in points:
        chosen = Settings.from_preset(
            "balanced",
            finetune={**QUICK, "enabled": point.way == TUNED},
            sensitivity_views=4,
            sensitivity_view_size=60,
            quality_offset_db=point.quality_offset_db,
        )
        result = kissgs.compress(scene, settings=chosen, views=views)
        assert point.bytes == result.report.container_bytes
        found = kissgs.evaluate(scene, kissgs.decompress(result.to_zip()), views).mean
        assert (point.psnr, point.psnr_to_scene) == (found.candidate.psnr, found.candidate_vs_reference.psnr)
    with pytest.raises(UnsupportedError, match="knows no quality_offset_db"):
        rate_curves(scene, Settings.from_preset("fast"), views)


def test_a_scene_that_teaches_itself_never_sees_the_capture():
    scene, settings = (
        cloud(200, 0),
        Settings.from_preset("balanced", finetune=QUICK, sensitivity_views=4, sensitivity_view_size=60),
    )
    views = Views(around(8), around(6)[1:3], black(), "circle")
    (chosen, tuned) = rate_curves(scene, settings, views, fidelities=(-3.0,), learn_from="scene", threads=1)
    plain = settings.model_copy(update={"encode": settings.encode.model_copy(update={"quality_offset_db": -3.0})})
    assert chosen.bytes == kissgs.compress(scene, settings=plain).report.container_bytes
    assert tuned.bytes > 0


def test_budgets_are_compacted_first():
    scene, views = cloud(120, 0), Views(around(8), around(6)[1:3], black(), "circle")
    few = {"sparsify_steps": 0, "refine_steps": 0, "min_keep_per_scoring": 0.6}
    settings = Settings.from_preset(
        "balanced", finetune=QUICK, compact=few, sensitivity_views=4, sensitivity_view_size=60
    )
    points = rate_curves(scene, settings, views, ratios=(0.5, 0.25), threads=1)
    assert [(point.way, point.count) for point in points] == [(w, n) for n in (60, 30) for w in (CHOSEN, TUNED)]
    assert {point.quality_offset_db for point in points} == {settings.encode.quality_offset_db}
    half = kissgs.compact(
        scene, settings=Settings.from_preset("balanced", compact={**few, "ratio": 0.5}), views=views
    ).splats
    plain = kissgs.compress(half, settings=settings, views=views)
    assert points[0].bytes == plain.report.container_bytes
    assert points[0].psnr == kissgs.evaluate(scene, kissgs.decompress(plain.files), views).mean.candidate.psnr
