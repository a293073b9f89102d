"""``compact``, ``compress`` and ``decompress``: the stages put together, and the report of what each took and gave."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np

from kissgs.compaction.result import Compacted
from kissgs.core.array_types import Int
from kissgs.core.errors import UnsupportedError
from kissgs.core.progress import Annotated, Progress, as_stage, silent, until_the_end
from kissgs.core.sensitivity import Sensitivity
from kissgs.core.splats import Splats
from kissgs.core.timing import Clock, peak_memory
from kissgs.pipeline.report import Report
from kissgs.pipeline.scene_files import AnyPath, check_ply, open_scene, save
from kissgs.rendering.rasterizer import Device
from kissgs.settings import EncodeSettings, Settings
from kissgs.settings.encode import GOALS
from kissgs.sogxt.container import check_destination, is_packed, stored_sizes, write_container, zip_bytes
from kissgs.sogxt.decode import MAX_GAUSSIANS, decode
from kissgs.training.checkpoint import beside, forget

if TYPE_CHECKING:
    from kissgs.cameras.views import Views
    from kissgs.evaluation.results import Evaluation
    from kissgs.pipeline.encoding import Encoding
    from kissgs.pipeline.rate_control import RateControl
    from kissgs.pipeline.trial import Trial


@dataclass(frozen=True, slots=True)
class Compressed:
    """A container in memory.

    Attributes:
        files: name -> bytes.
        order: ``(M,)`` for every Gaussian of the container, in its order, the index it has in the cleaned scene.
        report: what it took and gave.
        checkpoints: of compaction and fine-tuning, if they are still there because nothing was written.
    """

    files: Mapping[str, bytes]
    order: Int[np.ndarray, " M"]
    report: Report
    checkpoints: tuple[Path, ...] = ()

    def to_zip(self) -> bytes:
        """The container as one zip."""
        return zip_bytes(self.files)

    def save(self, path: AnyPath, *, overwrite: bool = False) -> None:
        """Write a zip (if the name ends in ``.zip``) or a folder, whole or not at all.

        Raises:
            OutputError: it exists and ``overwrite`` is false, or the file system refuses.
        """
        write_container(self.files, Path(path), overwrite=overwrite)


def compact(
    source: Splats | AnyPath | bytes,
    destination: AnyPath | None = None,
    *,
    settings: Settings,
    evaluate: bool = False,
    views: Views | None = None,
    checkpoint: AnyPath | None = None,
    overwrite: bool = False,
    threads: int = 0,
    device: Device = "cpu",
    progress: Progress = silent,
) -> Compacted:
    """Bring a scene down to fewer Gaussians that show the same.

    Args:
        source: a scene, or the path or the bytes of a ``.ply``, or a container.
        destination: ``.ply`` to write; by default nothing is written.
        settings: their group ``compact`` says how many Gaussians to keep, and how: for example
            ``Settings.from_preset("balanced", compact={"ratio": 0.2})``.
        evaluate: measure PSNR, SSIM and bytes after every step, for the report.
        views: a capture of the scene to learn from, and its held-out views to judge by; by default virtual cameras, and
            the scene itself is the teacher.
        checkpoint: file in which the state of the training is kept every half minute. If the same call is made again,
            it goes on from there and ends as if nothing had been. When ``destination`` is written it is removed.
        overwrite: replace ``destination`` if it exists.
        threads: 0 means one per processor; the result does not depend on it.
        device: where to train; ``"cuda"`` needs the extra ``kissgs[cuda]``.
        progress: receives events; raise :class:`kissgs.Cancelled` from it to stop. Nothing is written then.

    Returns:
        The smaller scene, and the report.

    Raises:
        KissgsError: one of its children, with a sentence for the user.
    """
    from kissgs.compaction.budget import compact_scene

    target = Path(destination) if destination is not None else None
    if target is not None:
        check_ply(target, overwrite=overwrite)
    clock = Clock(progress)
    splats, cleaned, _ = open_scene(source, threads, clock)
    result = compact_scene(
        *(splats, settings.compact, views),
        judges=evaluate,
        checkpoint=Path(checkpoint) if checkpoint is not None else None,
        threads=threads,
        device=device,
        progress=clock,
    )
    if target is not None:
        save(result.splats, target, overwrite=overwrite, progress=until_the_end(clock) if settings.searches else clock)
        forget(result.checkpoint)
    clock.stop()
    report = replace(result.report, cleaned=cleaned, cpu_seconds=clock.cpu_seconds, peak_memory=peak_memory())
    return replace(result, report=report)


def compress(
    source: Splats | AnyPath | bytes,
    destination: AnyPath | None = None,
    *,
    settings: Settings | None = None,
    sensitivity: Sensitivity | None = None,
    cache: AnyPath | None = None,
    evaluate: bool = False,
    views: Views | None = None,
    checkpoint: AnyPath | None = None,
    overwrite: bool = False,
    threads: int = 0,
    device: Device = "cpu",
    progress: Progress = silent,
) -> Compressed:
    """Compress a scene into a SOG-XT container.

    Args:
        source: a scene, or the path or the bytes of a ``.ply`` (a container is decoded and encoded anew).
        destination: ``.zip`` or folder to write; by default nothing is written.
        settings: by default those of the preset ``balanced``. If their group ``compact`` has a budget, the scene is
            compacted first, see :func:`kissgs.compact`; if their group ``finetune`` is ``wanted``, the levels are then
            fitted to photographs, or to pictures of the scene.
        sensitivity: of a clean ``source``, measured before (:func:`kissgs.measure_sensitivity`); by default it is
            measured if the settings ask for it.
        cache: ``.npz`` in which to keep the sensitivity that was measured. Next time it is taken from there, if neither
            the scene nor the cameras have changed, and replaced otherwise.
        evaluate: decode the result and compare its pictures with those of the cleaned scene, and with the photographs
            of ``views`` if they have any; see :func:`kissgs.evaluate`. The report then has an ``evaluation``.
        views: a capture of the scene: its views for training are learned from and weigh the bits, those held out are
            for evaluation; by default virtual cameras for all. Settings that take no pictures use the latter alone.
        checkpoint: of the compaction, see :func:`kissgs.compact`. Fine-tuning has one of its own beside it, with
            "-finetune" in its name; a search for a goal keeps none of that.
        overwrite: replace ``destination`` if it exists.
        threads: 0 means one per processor; the bytes do not depend on it.
        device: of compaction's and fine-tuning's training, likewise.
        progress: receives events; raise :class:`kissgs.Cancelled` from it to stop. Nothing is written then.

    Returns:
        The container in memory, and the report.

    Raises:
        KissgsError: one of its children, with a sentence for the user.
    """
    from kissgs.pipeline.encoding import Encoding, check_finetuning

    settings = settings or Settings()
    target = Path(destination) if destination is not None else None
    if target is not None:
        check_destination(target, overwrite=overwrite)
    kept = None
    if settings.finetune.enabled:
        check_finetuning(settings, views, device)
        if checkpoint is not None and not settings.encode.has_goal:
            kept = beside(Path(checkpoint))
    clock = Clock(progress)
    original, cleaned, source_bytes = open_scene(source, threads, clock)
    encoding = Encoding(
        splats=original,
        original=original,
        settings=settings,
        sensitivity=sensitivity,
        cache=Path(cache) if cache is not None else None,
        views=views,
        cleaned=cleaned,
        checkpoint=kept,
        device=device,
        packed=target is None or is_packed(target),
        threads=threads,
        progress=Annotated(clock),
    )
    compacted, search, trials = _compacted(encoding, checkpoint)
    chosen = encoding if compacted is None else replace(encoding, splats=compacted.splats)
    onwards = until_the_end(clock) if settings.searches else clock
    if not settings.encode.has_goal:
        chosen = replace(chosen, progress=Annotated(onwards))
    container, more = chosen.run(search)
    encoded = container.encoded
    container_bytes, file_bytes = stored_sizes(encoded.files, packed=encoding.packed)
    evaluation = _evaluate(original, encoded.files, views, threads, onwards) if evaluate else None
    checkpoints = (None if compacted is None else compacted.checkpoint, kept)
    if target is not None:
        onwards("write", 0.0)
        write_container(encoded.files, target, overwrite=overwrite)
        forget(*checkpoints)
    clock.stop()
    report = Report(
        source_count=len(original) + cleaned.removed,
        count=len(encoded.order),
        sh_degree=original.sh_degree,
        source_bytes=source_bytes,
        container_bytes=container_bytes,
        file_bytes=file_bytes,
        cleaned=cleaned,
        compaction=None if compacted is None else compacted.report,
        finetuning=container.finetuning,
        invisible=encoded.invisible,
        pruned_by_rd=encoded.pruned_by_rd,
        note=encoded.note,
        clipped_colors=encoded.clipped_colors,
        form_error=encoded.form_error,
        half_steps=encoded.errors,
        rd_lambda=encoded.rd_lambda,
        trials=trials + more,
        seconds=clock.seconds,
        cpu_seconds=clock.cpu_seconds,
        peak_memory=peak_memory(),
        settings=_as_made(settings, container.settings),
        evaluation=evaluation,
    )
    order = encoded.order if compacted is None else compacted.index[encoded.order]
    left = () if target is not None else tuple(path for path in checkpoints if path is not None)
    return Compressed(encoded.files, order, report, left)


def _as_made(asked: Settings, made: EncodeSettings) -> dict[str, Any]:
    """What was asked for, with what a search for a goal and fine-tuning have changed of it."""
    goals = {name: getattr(asked.encode, name) for name in (*GOALS, "rd_lambda")}
    return asked.model_copy(update={"encode": made.model_copy(update=goals)}).model_dump(mode="json")


def decompress(
    source: AnyPath | bytes | Mapping[str, bytes],
    destination: AnyPath | None = None,
    *,
    max_gaussians: int = MAX_GAUSSIANS,
    overwrite: bool = False,
    threads: int = 0,
    progress: Progress = silent,
) -> Splats:
    """Decode a SOG-XT container.

    Args:
        source: path of a zip or a folder, the bytes of a zip, or the files in memory.
        destination: ``.ply`` to write; by default nothing is written.
        max_gaussians: refuse a container that holds more, before memory is taken for them.
        overwrite: replace ``destination`` if it exists.
        threads: 0 means one per processor.
        progress: receives events.

    Returns:
        The scene exactly as stored: quaternions as quantised, their length only about 1.

    Raises:
        InvalidContainerError: the container is damaged.
        UnsupportedError: it has a feature that kissgs does not read.
        OutputError: ``destination`` cannot be written.
    """
    if destination is not None:
        check_ply(Path(destination), overwrite=overwrite)
    scene = source if isinstance(source, bytes | Mapping) else Path(source)
    splats = decode(scene, max_gaussians=max_gaussians, threads=threads, progress=progress)
    if destination is not None:
        save(splats, destination, overwrite=overwrite, progress=progress)
    return splats


class _Common(TypedDict):
    threads: int
    device: Device
    progress: Progress


def _compacted(
    encoding: Encoding, checkpoint: AnyPath | None
) -> tuple[Compacted | None, RateControl | None, tuple[Trial, ...]]:
    """What compaction leaves, if it is asked for; the search that was made on the way, and all attempts."""
    splats, chosen, kept = encoding.splats, encoding.settings.compact, Path(checkpoint) if checkpoint else None
    if not chosen.enabled:
        return None, None, ()
    from kissgs.compaction.budget import NO_CHECKPOINT, Compactor, compact_scene, unchanged
    from kissgs.pipeline.count_search import CountSearch

    if encoding.sensitivity is not None:
        raise UnsupportedError("sensitivity is that of a scene before its compaction; compact first, then measure")
    common: _Common = {"threads": encoding.threads, "device": encoding.device, "progress": encoding.progress}
    if not chosen.auto_count:
        return compact_scene(splats, chosen, encoding.views, checkpoint=kept, **common), None, ()
    if kept is not None:
        raise UnsupportedError(NO_CHECKPOINT.format("goal"))
    if len(splats) < 2:
        return unchanged(splats, "and none to spare"), None, ()
    return CountSearch(encoding, Compactor.of(splats, chosen, encoding.views, **common)).run()


def _evaluate(
    splats: Splats, container: Mapping[str, bytes], views: Views | None, threads: int, progress: Progress
) -> Evaluation:
    """One stage of compression, whatever stages of its own it has: decoding, kernels, pictures."""
    from kissgs.evaluation.evaluate import evaluate

    progress("evaluate", 0.0)
    decoded = decode(container, max_gaussians=max(len(splats), MAX_GAUSSIANS), threads=threads)

    return evaluate(splats, decoded, views, threads=threads, progress=as_stage("evaluate", progress))
