"""A scene through the codec and back: what it took, what it weighs, what it lost."""

from __future__ import annotations

import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, replace
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
from kissgs.pipeline.pipeline import compress, decompress
from kissgs.pipeline.report import Report
from kissgs.pipeline.scene_files import load
from kissgs.settings import Settings


@dataclass(frozen=True, slots=True, kw_only=True)
class RoundTrip:
    """One scene, compressed and decompressed.

    Attributes:
        report: of the compression.
        decode_seconds: wall time of decoding, from the zip's bytes to arrays.
        decode_cpu_seconds: processor time of that, over all threads.
        peak_memory: bytes, the largest the process had resident before errors were computed.
        errors: of the Gaussians that are in the container.
        pictures: what became of the scene's pictures, if asked for.
    """

    report: Report
    decode_seconds: float
    decode_cpu_seconds: float
    peak_memory: int
    errors: AttributeErrors
    pictures: Evaluation | None = None

    def as_dict(self) -> dict[str, Any]:
        """For machines."""
        pictures = None if self.pictures is None else self.pictures.as_dict()
        told = replace(self, pictures=None)
        return {**asdict(told), "report": self.report.as_dict(), "errors": self.errors.as_dict(), "pictures": pictures}


def roundtrip(
    source: Splats | Path,
    settings: Settings,
    *,
    pictures: bool = False,
    views: Views | None = None,
    threads: int = 0,
    progress: Progress = silent,
) -> RoundTrip:
    """Compress a scene, decompress it, and compare.

    Args:
        source: a scene, or the path of a ``.ply``.
        settings: of the compression.
        pictures: compare pictures too (:func:`kissgs.evaluation.evaluate.compare_images`); no part of the times.
        views: a capture of the scene: weighs the bits, and its held-out views are compared; by default cameras drawn
            over the whole scene are.
        threads: 0 means one per processor.
        progress: receives the events of both directions.
    """
    result = compress(source, settings=settings, views=views, threads=threads, progress=progress)
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
        pictures=_compared(clean(scene)[0], decoded, views, threads, progress) if pictures else None,
    )


def _compared(scene: Splats, decoded: Splats, views: Views | None, threads: int, progress: Progress) -> Evaluation:
    judges = views or evaluation_views(scene, threads=threads, progress=progress)
    return compare_images(scene, decoded, judges, threads=threads, progress=progress)


def isolated_roundtrip(
    source: Path, settings: Settings, *, pictures: bool = False, views: Views | None = None, threads: int = 0
) -> RoundTrip:
    """:func:`roundtrip` in a process of its own, so that times and peak memory are those of this scene alone.

    Raises:
        UnsupportedError: the process was killed, most likely for want of memory.
    """
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        try:
            work = pool.submit(roundtrip, source, settings, pictures=pictures, views=views, threads=threads)
            return work.result()
        except BrokenProcessPool as error:
            raise UnsupportedError(f"{source}: the measurement was killed, most likely for want of memory") from error
