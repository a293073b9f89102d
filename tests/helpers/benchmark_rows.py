"""Synthetic measurements of codecs, for tests of tables and plots."""

from helpers.captured_scene import cameras
from kissgs.benchmark.results import Measurement, Run
from kissgs.cameras.views import black
from kissgs.core.splats import float32_bytes
from kissgs.evaluation.attributes import attribute_errors
from kissgs.evaluation.evaluate import Comparison
from kissgs.evaluation.results import Evaluation, ImageMetrics, ViewComparison
from kissgs.synthetic.scene import sample_scene

SCENE = sample_scene(30, sh_degree=1)
VIEW = cameras().all[0]
ERRORS = attribute_errors(SCENE, SCENE)
FILES = ("container_meta.yaml", "means_bytes_0.webp", "scales.webp", "f_dc.webp")


def run(seconds=1.0, size=1000, memory=10**8, stages=None):
    stages = stages or {"order": seconds / 4, "images": 3 * seconds / 4}
    return Run(
        bytes=size,
        encode_seconds=seconds,
        encode_cpu_seconds=2 * seconds,
        decode_seconds=seconds / 100,
        decode_cpu_seconds=seconds / 50,
        stage_seconds=stages,
        stage_cpu_seconds={name: 2 * each for name, each in stages.items()},
        stage_peak_memory={**dict.fromkeys(stages, memory // 2), "decode": memory},
        peak_memory=memory,
    )


def image_metrics(psnr):
    return ImageMetrics(psnr=psnr, ssim=0.9, ms_ssim=0.95)


def evaluation(psnr, photo=None):
    reference = None if photo is None else image_metrics(32.0)
    seen = Comparison(
        reference=reference, candidate=image_metrics(photo or psnr), candidate_vs_reference=image_metrics(psnr)
    )
    view = ViewComparison(view=VIEW, comparison=seen)
    about = {"against": "renderings", "split": "test", "source": "test", "background": black()}
    return Evaluation(**about, reference_count=30, candidate_count=30, views=(view,))


def measured(
    codec,
    size,
    psnr,
    *,
    photo=None,
    quality_offset_db=None,
    container="sogxt",
    external=False,
    runs=None,
    gaussians=30,
    seconds=1.0,
    memory=10**6,
):
    files = {codec: size} if external else dict.fromkeys(FILES, size // len(FILES))
    return Measurement(
        scene="scene.ply",
        codec=codec,
        container=None if external else container,
        quality_offset_db=quality_offset_db,
        gaussians=gaussians,
        float32_bytes=float32_bytes(gaussians, 1),
        file_bytes=files,
        runs=runs or (run(seconds, size, memory),),
        errors=ERRORS,
        evaluation=evaluation(psnr, photo),
    )


def many(photo=False):
    """Return rows of the presets, a quality curve and two external codecs."""

    def photo_psnr(psnr):
        return psnr - 10 if photo else None

    return [
        measured("fast", 1000, 36.0, photo=photo_psnr(36.0), seconds=0.5),
        measured("balanced", 700, 40.0, photo=photo_psnr(40.0), seconds=5.0),
        measured("small", 690, 39.9, photo=photo_psnr(39.9), seconds=6.0),
        measured("balanced", 400, 34.0, photo=photo_psnr(34.0), quality_offset_db=-6.0),
        measured("balanced", 1600, 46.0, photo=photo_psnr(46.0), quality_offset_db=6.0),
        measured("sog", 2000, 43.0, photo=photo_psnr(43.0), external=True, seconds=99.0),
        measured("spz", 1500, 30.0, photo=photo_psnr(30.0), external=True, seconds=0.2),
    ]
