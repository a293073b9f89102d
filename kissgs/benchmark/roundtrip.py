"""Compress and decompress a scene, and measure time, memory, size and errors."""

from __future__ import annotations

import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from kissgs.cameras.views import Views
from kissgs.core.errors import UnsupportedError
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Splats, clean
from kissgs.core.timing import peak_memory
from kissgs.evaluation.attributes import AttributeErrors, attribute_errors
from kissgs.evaluation.cameras import evaluation_views
from kissgs.evaluation.evaluate import compare_images
from kissgs.evaluation.results import Evaluation
from kissgs.io.container_names import ContainerName
from kissgs.pipeline.decompress import decompress
from kissgs.pipeline.pipeline import compress
from kissgs.pipeline.report import Report
from kissgs.pipeline.scene_files import load
from kissgs.settings import Settings


@dataclass(frozen=True, slots=True, kw_only=True)
class RoundTrip:
    """Measurements of a scene that was compressed and decompressed.

    Attributes:
        report: report of the compression.
        decode_seconds: wall time of decoding, from the bytes of the zip to arrays.
        decode_cpu_seconds: CPU time of decoding, all threads.
        peak_memory: largest resident set of the process before errors were computed, bytes.
        errors: errors of the Gaussians that are in the container.
        evaluation: comparison of rendered images; None if not requested.
    """

    report: Report
    decode_seconds: float
    decode_cpu_seconds: float
    peak_memory: int
    errors: AttributeErrors
    evaluation: Evaluation | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return all attributes by name, nested, for JSON."""
        evaluation = None if self.evaluation is None else self.evaluation.as_dict()
        numbers = asdict(replace(self, evaluation=None))
        nested = {"report": self.report.as_dict(), "errors": self.errors.as_dict(), "evaluation": evaluation}
        return {**numbers, **nested}


def roundtrip(
    source: Splats | Path,
    settings: Settings,
    *,
    container: ContainerName = "sogxt",
    evaluate: bool = False,
    views: Views | None = None,
    threads: int = 0,
    progress: Progress = silent,
) -> RoundTrip:
    """Compress a scene, decompress it, and compare the two.

    Args:
        source: a scene, or the path of a ``.ply`` file.
        settings: settings of the compression.
        container: container to write.
        evaluate: whether to compare rendered images too (:func:`kissgs.evaluation.evaluate.compare_images`); the
            times do not include this.
        views: capture for rate-distortion planning and, by its held-out views, for the evaluation; None to evaluate
            with cameras drawn over the whole scene.
        threads: number of threads; 0 means one per processor.
        progress: receives the stages of compression and decompression.
    """
    result = compress(source, settings=settings, container=container, views=views, threads=threads, progress=progress)
    archive = result.to_zip()
    wall, cpu = time.perf_counter(), time.process_time()
    decoded = decompress(archive, threads=threads, progress=progress)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    peak = peak_memory()
    scene = source if isinstance(source, Splats) else load(source)
    return RoundTrip(
        report=result.report,
        decode_seconds=wall,
        decode_cpu_seconds=cpu,
        peak_memory=peak,
        errors=attribute_errors(scene.select(result.order), decoded),
        evaluation=_evaluation(clean(scene)[0], decoded, views, threads, progress) if evaluate else None,
    )


def _evaluation(scene: Splats, decoded: Splats, views: Views | None, threads: int, progress: Progress) -> Evaluation:
    views = views or evaluation_views(scene, threads=threads, progress=progress)
    return compare_images(scene, decoded, views, threads=threads, progress=progress)


def isolated_roundtrip(
    source: Path,
    settings: Settings,
    *,
    container: ContainerName = "sogxt",
    evaluate: bool = False,
    views: Views | None = None,
    threads: int = 0,
) -> RoundTrip:
    """Run :func:`roundtrip` in a separate process, so that times and peak memory are those of this scene alone.

    Raises:
        UnsupportedError: the process was killed, most likely for lack of memory.
    """
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        try:
            work = partial(roundtrip, container=container, evaluate=evaluate, views=views, threads=threads)
            return pool.submit(work, source, settings).result()
        except BrokenProcessPool as error:
            raise UnsupportedError(
                f"{source}: the measurement was killed, most likely for lack of memory; free some or give a "
                "smaller scene"
            ) from error
