"""Reference: rate curves of known distance, ``kissgs.compress`` and ``kissgs.evaluate``."""

from dataclasses import replace

import pytest
from helpers.training_scenes import around, cloud

import kissgs
from kissgs import Settings, UnsupportedError
from kissgs.benchmark.finetuning_curves import NOT_TUNED, TUNED, RatePoint, bytes_saved, rate_curves
from kissgs.cameras.views import Views, black

POINT = RatePoint(
    variant=NOT_TUNED,
    count=1,
    quality_offset_db=0,
    bytes=1,
    psnr=0,
    ssim=0,
    ms_ssim=0,
    psnr_to_scene=0,
    seconds=0,
    cpu_seconds=0,
    peak_memory=0,
)
QUICK = {"steps": 5, "views": 16, "view_size": 60}


def curve(variant, qualities, share=1.0, per_db=1.3):
    return [replace(POINT, variant=variant, psnr=q, bytes=round(1e9 * share * per_db**q)) for q in qualities]


@pytest.mark.parametrize("share", [0.7, 1.0, 1.25])
@pytest.mark.parametrize("qualities", [(0, 1, 2, 3), (0.5, 2.5), (-1, 0.2, 1.1, 9)])
def test_a_curve_with_a_constant_share_of_the_bytes_saves_the_rest(share, qualities):
    points = curve(NOT_TUNED, (0, 1, 2, 3)) + curve(TUNED, qualities, share)
    assert bytes_saved(points) == pytest.approx(1 - share, abs=1e-6)


def test_curves_that_do_not_overlap_cannot_be_compared():
    assert bytes_saved(curve(NOT_TUNED, (0, 1)) + curve(TUNED, (2, 3))) is None
    assert bytes_saved(curve(NOT_TUNED, (0, 1))) is None
    assert (
        bytes_saved(curve(NOT_TUNED, (0, 1)) + [replace(point, psnr=float("inf")) for point in curve(TUNED, (0, 1))])
        is None
    )


@pytest.mark.quick(0)
def test_points_agree_with_compress_and_evaluate():
    scene, views = cloud(300, 1), Views(around(8), around(6)[1:3], black(), "circle")
    settings = Settings.from_preset("balanced", finetune=QUICK, sensitivity_views=4, sensitivity_view_size=60)
    points = rate_curves(scene, settings, views, quality_offsets=(-6.0, 3.0), threads=1)
    assert [(point.variant, point.quality_offset_db) for point in points] == [
        (w, f) for f in (-6.0, 3.0) for w in (NOT_TUNED, TUNED)
    ]
    for point in points:
        chosen = Settings.from_preset(
            "balanced",
            finetune={**QUICK, "enabled": point.variant == TUNED},
            sensitivity_views=4,
            sensitivity_view_size=60,
            quality_offset_db=point.quality_offset_db,
        )
        result = kissgs.compress(scene, settings=chosen, views=views)
        assert point.bytes == result.report.container_bytes
        found = kissgs.evaluate(scene, kissgs.decompress(result.to_zip()), views).mean
        assert (point.psnr, point.psnr_to_scene) == (found.candidate.psnr, found.candidate_vs_reference.psnr)
    with pytest.raises(UnsupportedError, match="needs rate-distortion planning"):
        rate_curves(scene, Settings.from_preset("fast"), views)


@pytest.mark.quick(0)
def test_supervision_by_the_scene_does_not_use_the_capture():
    scene, settings = (
        cloud(200, 0),
        Settings.from_preset("balanced", finetune=QUICK, sensitivity_views=4, sensitivity_view_size=60),
    )
    views = Views(around(8), around(6)[1:3], black(), "circle")
    (not_tuned, tuned) = rate_curves(scene, settings, views, quality_offsets=(-3.0,), supervision="scene", threads=1)
    plain = settings.model_copy(update={"encode": settings.encode.model_copy(update={"quality_offset_db": -3.0})})
    assert not_tuned.bytes == kissgs.compress(scene, settings=plain).report.container_bytes
    assert tuned.bytes > 0


@pytest.mark.quick(0)
def test_the_scene_is_compacted_to_each_ratio_first():
    scene, views = cloud(120, 0), Views(around(8), around(6)[1:3], black(), "circle")
    few = {"sparsify_steps": 0, "refine_steps": 0, "min_keep_per_scoring": 0.6}
    settings = Settings.from_preset(
        "balanced", finetune=QUICK, compact=few, sensitivity_views=4, sensitivity_view_size=60
    )
    points = rate_curves(scene, settings, views, ratios=(0.5, 0.25), threads=1)
    assert [(point.variant, point.count) for point in points] == [(w, n) for n in (60, 30) for w in (NOT_TUNED, TUNED)]
    assert {point.quality_offset_db for point in points} == {settings.encode.quality_offset_db}
    half = kissgs.compact(
        scene, settings=Settings.from_preset("balanced", compact={**few, "ratio": 0.5}), views=views
    ).splats
    plain = kissgs.compress(half, settings=settings, views=views)
    assert points[0].bytes == plain.report.container_bytes
    assert points[0].psnr == kissgs.evaluate(scene, kissgs.decompress(plain.files), views).mean.candidate.psnr
