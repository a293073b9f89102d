"""Oracle: curves whose distance is known, and what compress itself says."""

from dataclasses import replace

import pytest
from training_scenes import around, cloud

import kissgs
from kissgs import Settings, UnsupportedError
from kissgs.curves import CHOSEN, TUNED, RatePoint, rate_curves, saved
from kissgs.views.view import Views, black

POINT = RatePoint(
    way=CHOSEN, count=1, fidelity=0, bytes=1, psnr=0, ssim=0, between=0, seconds=0, cpu_seconds=0, peak_memory=0
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
    settings = Settings.from_preset("balanced", finetune=QUICK, views=4, view_size=60)
    points = rate_curves(scene, settings, views, fidelities=(-6.0, 3.0), threads=1)
    assert [(point.way, point.fidelity) for point in points] == [(w, f) for f in (-6.0, 3.0) for w in (CHOSEN, TUNED)]
    for point in points:
        chosen = Settings.from_preset(
            "balanced", finetune={**QUICK, "wanted": point.way == TUNED}, views=4, view_size=60, fidelity=point.fidelity
        )
        result = kissgs.compress(scene, settings=chosen, views=views)
        assert point.bytes == result.report.container_bytes
        found = kissgs.evaluate(scene, kissgs.decompress(result.to_zip()), views).mean
        assert (point.psnr, point.between) == (found.candidate.psnr, found.between.psnr)
    with pytest.raises(UnsupportedError, match="knows no fidelity"):
        rate_curves(scene, Settings.from_preset("fast"), views)


def test_a_scene_that_teaches_itself_never_sees_the_capture():
    scene, settings = cloud(200, 0), Settings.from_preset("balanced", finetune=QUICK, views=4, view_size=60)
    views = Views(around(8), around(6)[1:3], black(), "circle")
    (chosen, tuned) = rate_curves(scene, settings, views, fidelities=(-3.0,), learn_from="scene", threads=1)
    plain = settings.model_copy(update={"encode": settings.encode.model_copy(update={"fidelity": -3.0})})
    assert chosen.bytes == kissgs.compress(scene, settings=plain).report.container_bytes
    assert tuned.bytes > 0


def test_budgets_are_compacted_first():
    scene, views = cloud(120, 0), Views(around(8), around(6)[1:3], black(), "circle")
    few = {"sparsify_steps": 0, "refine_steps": 0, "score_share": 0.6}
    settings = Settings.from_preset("balanced", finetune=QUICK, compact=few, views=4, view_size=60)
    points = rate_curves(scene, settings, views, ratios=(0.5, 0.25), threads=1)
    assert [(point.way, point.count) for point in points] == [(w, n) for n in (60, 30) for w in (CHOSEN, TUNED)]
    assert {point.fidelity for point in points} == {settings.encode.fidelity}
    half = kissgs.compact(
        scene, settings=Settings.from_preset("balanced", compact={**few, "ratio": 0.5}), views=views
    ).splats
    plain = kissgs.compress(half, settings=settings, views=views)
    assert points[0].bytes == plain.report.container_bytes
    assert points[0].psnr == kissgs.evaluate(scene, kissgs.decompress(plain.files), views).mean.candidate.psnr
