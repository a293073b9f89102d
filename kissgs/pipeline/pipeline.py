"""``compact`` and ``compress``: all stages in order, and the report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from kissgs.core.array_types import Int
from kissgs.core.context import (
    Context,
    Deadline,
    Device,
    JobProgress,
    Progress,
    peak_memory,
    return_free_memory,
    silent,
)
from kissgs.core.errors import UnsupportedError
from kissgs.core.sensitivity import Sensitivity
from kissgs.core.splats import Cleaned, Splats, empty_splats
from kissgs.formats import ContainerName, named_container
from kissgs.io.containers import check_destination, is_packed, stored_sizes, write_container, zip_bytes
from kissgs.io.scene_format import DEFAULT_READ_OPTIONS, ReadOptions
from kissgs.pipeline.encoding import FILES, Container, Work, check_finetuning, encode, make_tuner, measure, plan, write
from kissgs.pipeline.limited_time import Expected, choose, resolved
from kissgs.pipeline.scene_files import (
    AnyPath,
    check_ply,
    open_scene,
    read_scene,
    reading_notes,
    save_ply,
    unused_cameras_note,
)
from kissgs.settings import GOALS, EncodeSettings, Settings

if TYPE_CHECKING:
    from kissgs.cameras.views import Views
    from kissgs.compaction.result import Compacted, CompactionReport
    from kissgs.evaluation.results import Evaluation
    from kissgs.finetuning.result import FinetuneReport
    from kissgs.pipeline.goal import Attempt


# ``Report``: sizes, counts, errors, times and settings of one compression.


@dataclass(frozen=True, slots=True, kw_only=True)
class Report:
    """Sizes, counts, errors, times and settings of one compression.

    Attributes:
        source_count: Gaussians in the scene.
        count: Gaussians in the container.
        sh_degree: 0 to 3.
        source_bytes: size of the scene file; of the arrays if the scene came in memory.
        container_bytes: size of the zip, or of all files in the folder.
        file_bytes: size of each file of the container, as its zip stores it.
        cleaned: defects of the input that were removed or corrected (:class:`kissgs.core.splats.Cleaned`).
        compaction: report of the compaction before encoding; None unless requested.
        finetuning: report of the fine-tuning of the levels; None unless requested, or if the scene is empty.
        invisible: Gaussians left out because no renderer draws them.
        pruned_by_rd: Gaussians left out because their rate cost exceeds the distortion that they save.
        clipped_colors: Gaussians with an outlying base colour, which was clipped to keep the range of all others small.
        form_error: largest relative change of a covariance by the choice of its equivalent rotation form.
        max_quantization_error: largest error of quantisation, per field and channel; half a step where all steps of a
            channel are equal.
        rd_lambda: squared error per bit; None without rate-distortion planning.
        trials: where the settings name a goal: the containers that were made, in order.
        seconds: wall time per stage.
        cpu_seconds: processor time of all stages, over all threads.
        peak_memory: largest resident size of this process so far, bytes.
        settings: all settings, as used.
        note: what the user may not expect: more than a fifth of the Gaussians left out, a target size above the finest
            container of the scene, or a capture that is unlike the scene; empty if there is nothing to say.
        evaluation: comparison of the container's renderings with those of the cleaned input; None unless requested.
    """

    source_count: int
    count: int
    sh_degree: int
    source_bytes: int
    container_bytes: int
    file_bytes: dict[str, int]
    cleaned: Cleaned
    compaction: CompactionReport | None
    finetuning: FinetuneReport | None
    invisible: int
    pruned_by_rd: int
    clipped_colors: int
    form_error: float
    max_quantization_error: dict[str, list[float]]
    rd_lambda: float | None
    trials: tuple[Attempt, ...]
    seconds: dict[str, float]
    cpu_seconds: float
    peak_memory: int
    settings: dict[str, Any]
    evaluation: Evaluation | None = None
    note: str = ""

    @property
    def ratio(self) -> float:
        """How many times smaller the container is than the scene file."""
        return self.source_bytes / self.container_bytes

    @property
    def bytes_per_gaussian(self) -> float:
        """Bytes of the container per Gaussian of the scene file."""
        return self.container_bytes / max(self.source_count, 1)

    @property
    def compacted(self) -> int:
        """Gaussians that compaction left out."""
        return 0 if self.compaction is None else self.compaction.source_count - self.compaction.count

    def as_dict(self) -> dict[str, Any]:
        """Return all fields and derived figures for JSON."""
        derived = {"ratio": self.ratio, "bytes_per_gaussian": self.bytes_per_gaussian}
        evaluation = None if self.evaluation is None else self.evaluation.as_dict()
        compaction = None if self.compaction is None else self.compaction.as_dict()
        finetuning = None if self.finetuning is None else self.finetuning.as_dict()
        trials = [trial.as_dict() for trial in self.trials]
        parts = {"compaction": compaction, "finetuning": finetuning, "evaluation": evaluation, "trials": trials}
        return {**asdict(self), **derived, **parts}


# ``compact`` and ``compress``: all stages in order, and the report.


@dataclass(frozen=True, slots=True)
class Compressed:
    """A container in memory.

    Attributes:
        files: bytes of each file by name.
        order: ``(M,)`` index in the cleaned scene of each Gaussian of the container, in the container's order.
        report: sizes, counts, errors, times and settings.
        checkpoints: files of compaction and fine-tuning that still exist because no destination was given.
        container: "sogxt" or "sog".
    """

    files: Mapping[str, bytes]
    order: Int[np.ndarray, " M"]
    report: Report
    checkpoints: tuple[Path, ...] = ()
    container: ContainerName = "sogxt"

    def to_zip(self) -> bytes:
        """Return the container as the bytes of a zip."""
        return zip_bytes(self.files)

    def save(self, path: AnyPath, *, overwrite: bool = False) -> None:
        """Write a zip (if the name ends in ``.zip`` or ``.sog``) or a folder, atomically.

        Raises:
            OutputError: the path exists and ``overwrite`` is false, or writing fails.
            UnsupportedError: the ending is unknown, or that of another container.
        """
        named_container(self.container, path)
        write_container(self.files, Path(path), overwrite=overwrite, names=FILES)


def compact(
    source: Splats | AnyPath | bytes,
    destination: AnyPath | None = None,
    *,
    settings: Settings,
    reading: ReadOptions = DEFAULT_READ_OPTIONS,
    evaluate: bool = False,
    views: Views | AnyPath | None = None,
    force_views: bool = False,
    checkpoint: AnyPath | None = None,
    overwrite: bool = False,
    threads: int = 0,
    device: Device = "cpu",
    progress: Progress = silent,
) -> Compacted:
    """Reduce the number of Gaussians of a scene while keeping its renderings: score, prune, train.

    Args:
        source: a scene, or the path or the bytes of a file of any format that :func:`kissgs.load` reads.
        destination: ``.ply`` to write; by default nothing is written.
        settings: their group ``compact`` says how many Gaussians to keep, and how: for example
            ``Settings.from_preset("balanced", compact={"ratio": 0.2})``.
        reading: options for a ``source`` that is a file.
        evaluate: measure PSNR, SSIM, MS-SSIM and bytes after every step, for the report.
        views: capture, or its path: its training photographs are the targets, its held-out views are for evaluation; by
            default renderings of the scene from virtual cameras.
        force_views: accept ``views`` whose photographs do not show the scene.
        checkpoint: file in which the state of the training is saved every half minute. An identical call resumes from
            it with an identical result. It is removed once ``destination`` is written.
        overwrite: replace ``destination`` if it exists.
        threads: number of threads; 0 means one per processor. The result does not depend on it.
        device: device of the training; ``"cuda"`` needs the extra ``kissgs[cuda]``.
        progress: receives events; raise :class:`kissgs.Cancelled` from it to stop, and nothing is written.

    Returns:
        The compacted scene and the report.

    Raises:
        KissgsError: one of its subclasses, with a message for the user.
    """
    from kissgs.compaction.budget import compact_scene
    from kissgs.training.checkpoint import delete_checkpoints

    views = _loaded(views, source)
    target = Path(destination) if destination is not None else None
    if target is not None:
        check_ply(target, overwrite=overwrite)
    clock = JobProgress(progress)
    context = Context(threads, device, clock)
    splats, cleaned, _ = open_scene(source, reading, threads, clock)
    views, note = _fitting(splats, views, context, force=force_views)
    clock.expect(Expected.of(splats, settings, views, threads).compaction())
    file = Path(checkpoint) if checkpoint is not None else None
    result = compact_scene(splats, settings.compact, views, context, evaluate=evaluate, checkpoint=file)
    if target is not None:
        clock.stops_search = not settings.searches
        save_ply(result.splats, target, overwrite=overwrite, progress=clock)
        delete_checkpoints(result.checkpoint)
    clock.stop()
    report = replace(
        result.report,
        cleaned=cleaned,
        cpu_seconds=clock.cpu_seconds,
        peak_memory=peak_memory(),
        note="; ".join(filter(None, [*splats.notes, note, result.report.note])),
    )
    return replace(result, report=report)


def compress(
    source: Splats | AnyPath | bytes,
    destination: AnyPath | None = None,
    *,
    settings: Settings | None = None,
    reading: ReadOptions = DEFAULT_READ_OPTIONS,
    container: ContainerName | None = None,
    sensitivity: Sensitivity | None = None,
    cache: AnyPath | None = None,
    evaluate: bool = False,
    views: Views | AnyPath | None = None,
    force_views: bool = False,
    checkpoint: AnyPath | None = None,
    overwrite: bool = False,
    threads: int = 0,
    device: Device = "cpu",
    progress: Progress = silent,
) -> Compressed:
    """Compress a scene into a SOG-XT container, or into SOG.

    Args:
        source: a scene, or the path or the bytes of a file of any format that :func:`kissgs.load` reads (a container is
            decoded and encoded again).
        destination: ``.zip``, ``.sog`` or folder to write; by default nothing is written. A folder exists, or its name
            has a slash at its end; a Path, which keeps no slash, has no ending.
        settings: by default those of the preset ``balanced``. If their group ``compact`` has a budget, the scene is
            compacted first, see :func:`kissgs.compact`; if their group ``finetune`` is ``enabled``, the levels are then
            fine-tuned on the photographs of ``views``, or on renderings of the scene. A goal other than ``psnr`` does
            both by itself, unless there are ``views`` without held-out photographs, see
            :meth:`kissgs.Settings.resolved`.
        reading: options for a ``source`` that is a file.
        container: ``"sogxt"``, or ``"sog"`` for the files of SOG 2, which other viewers open; by default SOG if
            ``destination`` ends in ``.sog``, else SOG-XT.
        sensitivity: sensitivity of a clean ``source`` (:func:`kissgs.measure_sensitivity`), all of whose Gaussians then
            stay; by default it is measured if the settings need it.
        cache: ``.npz`` file for the measured sensitivity. It is read if scene and cameras are unchanged since it was
            written, and replaced otherwise.
        evaluate: decode the result and compare its renderings with those of the cleaned scene, and with the photographs
            of ``views`` if they have any; see :func:`kissgs.evaluate`. The report then has an ``evaluation``.
        views: capture of the scene, or its path: its training views give the sensitivity and the training targets, its
            held-out views are for evaluation; by default virtual cameras. Presets that plan without rate and distortion
            use the held-out views only. Some of the photographs in use are compared with the scene first.
        force_views: accept ``views`` whose photographs do not show the scene.
        checkpoint: checkpoint file of the compaction, see :func:`kissgs.compact`. Fine-tuning has another one beside
            it, with "-finetune" in its name, except in a search for a goal.
        overwrite: replace ``destination`` if it exists.
        threads: number of threads; 0 means one per processor. The bytes do not depend on it.
        device: device of the training in compaction and fine-tuning; ``"cuda"`` needs the extra ``kissgs[cuda]``.
        progress: receives events; raise :class:`kissgs.Cancelled` from it to stop, and nothing is written.

    Returns:
        The container in memory and the report.

    Raises:
        KissgsError: one of its subclasses, with a message for the user.
    """
    views = _loaded(views, source)
    requested, keep_all = settings or Settings(), sensitivity is not None
    settings = resolved(requested, views, keep_all=keep_all)
    target, kind = None if destination is None else Path(destination), named_container(container, destination)
    checkpoint = None if checkpoint is None else Path(checkpoint)
    _check(settings, views, target, checkpoint, overwrite=overwrite, device=device)
    clock = JobProgress(progress)
    deadline = None if settings.time_limit is None else Deadline.after(settings.time_limit)
    context = Context(threads, device, clock, deadline)

    # Read.
    splats, cleaned, source_bytes = open_scene(source, reading, threads, clock)
    notes, source_count, sh_degree = reading_notes(splats), len(splats) + cleaned.removed, splats.sh_degree
    if evaluate or settings.encode.rate_distortion or settings.compact.enabled or settings.finetune.enabled:
        views, views_note = _fitting(splats, views, context, force=force_views)
        notes.append(views_note)
    if views is None and settings.encode.rate_distortion and not isinstance(source, Splats | bytes):
        notes.append(unused_cameras_note(Path(source)))
    choice = choose(requested, views, len(splats), context, keep_all=keep_all)
    settings = choice.settings
    clock.expect(Expected.of(splats, settings, views, threads).steps(evaluate=evaluate), deadline)
    work = Work(
        splats=splats,
        original=splats,
        settings=settings,
        sensitivity=sensitivity,
        cache=None if cache is None else Path(cache),
        views=views,
        cleaned=cleaned,
        container=kind,
        packed=target is None or is_packed(target),
        context=context,
        time=choice.time,
    )
    del splats

    # Compact, plan, tune and write the files: once, or several times towards a goal.
    compacted = _compact_first(work, checkpoint)
    if settings.encode.has_goal:
        made, trials, note = _search(work, clock, evaluates=evaluate, time_only=requested.time_only)
        clock.stops_search = False
    else:
        clock.stops_search = not settings.searches
        trials, note = (), ""
        made = _encode_once(work, checkpoint, disposable=not (evaluate or isinstance(source, Splats)))
    compacted, encoded = compacted or made.compacted, made.encoded

    # Evaluate, store, report.
    evaluation = _evaluate(work.original, encoded.files, views, context) if evaluate else None
    own = [None if compacted is None else compacted.checkpoint, made.checkpoint]
    checkpoints = tuple(path for path in own if path is not None)
    if target is not None:
        clock("write", 0.0)
        write_container(encoded.files, target, overwrite=overwrite, names=FILES)
        if checkpoints:
            from kissgs.training.checkpoint import delete_checkpoints

            delete_checkpoints(*checkpoints)
    clock.stop()
    container_bytes, file_bytes = stored_sizes(encoded.files, packed=work.packed)
    report = Report(
        source_count=source_count,
        count=len(encoded.order),
        sh_degree=sh_degree,
        source_bytes=source_bytes,
        container_bytes=container_bytes,
        file_bytes=file_bytes,
        cleaned=cleaned,
        compaction=None if compacted is None else compacted.report,
        finetuning=made.finetuning,
        invisible=encoded.invisible,
        pruned_by_rd=encoded.pruned_by_rd,
        clipped_colors=encoded.clipped_colors,
        form_error=encoded.form_error,
        rd_lambda=encoded.rd_lambda,
        note="; ".join(filter(None, [*notes, encoded.coarse, encoded.note, note, choice.note])),
        max_quantization_error=encoded.errors,
        trials=trials,
        seconds=clock.seconds,
        cpu_seconds=clock.cpu_seconds,
        peak_memory=peak_memory(),
        settings=_settings_as_used(settings, made.settings, requested),
        evaluation=evaluation,
    )
    order = encoded.order if compacted is None else compacted.index[encoded.order]
    return Compressed(encoded.files, order, report, checkpoints if target is None else (), kind)


def _loaded(views: Views | AnyPath | None, source: Splats | AnyPath | bytes) -> Views | None:
    """Return the views, loaded for the scene if they are the path of a capture."""
    if views is None:
        return None
    from kissgs.cameras.captures.load import as_views

    return as_views(views, None if isinstance(source, Splats | bytes) else Path(source))


def _fitting(splats: Splats, views: Views | None, context: Context, *, force: bool) -> tuple[Views | None, str]:
    """Return the views in the coordinates of the scene and a note; raise InvalidViewsError if they do not show it."""
    if views is None:
        return None, ""
    from kissgs.evaluation.evaluate import fitting_views

    return fitting_views(splats, views, context, force=force)


def _check(
    settings: Settings,
    views: Views | None,
    target: Path | None,
    checkpoint: Path | None,
    *,
    overwrite: bool,
    device: Device,
) -> None:
    """Refuse what cannot be done, before any work."""
    if target is not None:
        check_destination(target, overwrite=overwrite, names=FILES)
    if checkpoint is not None and settings.time_limit is not None:
        raise UnsupportedError("no checkpoint is kept with a time limit; leave out one of them")
    if settings.finetune.enabled:
        check_finetuning(settings, views, device)


def _compact_first(work: Work, checkpoint: Path | None) -> Compacted | None:
    """Compact the scene of the work to the budget of its settings, unless a goal chooses the number of Gaussians."""
    settings = work.settings.compact
    if not settings.enabled:
        return None
    from kissgs.compaction.budget import NO_CHECKPOINT, compact_scene, unchanged

    if work.sensitivity is not None:
        raise UnsupportedError("this sensitivity is of the scene before compaction; compact first, then measure it")
    if settings.auto_count:
        if checkpoint is not None:
            raise UnsupportedError(NO_CHECKPOINT.format("goal"))
        return unchanged(work.splats, "too few to remove any") if len(work.splats) < 2 else None
    compacted = compact_scene(work.splats, settings, work.views, work.context, checkpoint=checkpoint)
    work.splats = compacted.splats
    return compacted


def _search(
    work: Work, job: JobProgress, *, evaluates: bool, time_only: bool
) -> tuple[Container, tuple[Attempt, ...], str]:
    """Make containers until one meets the goal; return the best one, all attempts and a note."""
    from kissgs.pipeline.search import Search

    search = Search(work, job, evaluates, time_only)
    best = search.run()
    made = replace(best.made, compacted=search.compacted(best), finetuning=search.finetuning(best))
    return made, tuple(search.attempts), search.note(best)


def _encode_once(work: Work, checkpoint: Path | None, *, disposable: bool) -> Container:
    """Plan, fine-tune if the settings say so, and write the files. A disposable scene that is not fine-tuned is
    forgotten once it is planned, so that its memory is free for the files."""
    settings, compacted = work.settings.encode, len(work.original) - len(work.splats)
    if work.settings.finetune.enabled and len(work.splats) > 0:
        from kissgs.training.checkpoint import finetune_checkpoint_path

        file = None if checkpoint is None else finetune_checkpoint_path(checkpoint)
        return encode(work, measure(work, work.splats, settings), settings, make_tuner(work), checkpoint=file)
    chosen = plan(work, measure(work, work.splats, settings), settings, work.context)
    if disposable:
        work.splats = work.original = empty_splats(0, 0)
        work.sensitivity = None
    return_free_memory()
    return Container(encoded=write(work, chosen, settings, compacted, work.context), settings=settings)


def _settings_as_used(resolved: Settings, used: EncodeSettings, requested: Settings) -> dict[str, Any]:
    """Return the settings with the changes by a search for a goal and by fine-tuning, and the goals as requested."""
    kept = ["rd_lambda", "quality_offset_db", "color_refit_iterations", "max_encodes"]
    if resolved.encode.has_goal:
        kept.append("prune_threshold_bits")  # fine-tuned containers have another one
    changes = {name: getattr(resolved.encode, name) for name in kept}  # the same request gives the same bytes
    changes |= {name: getattr(requested.encode, name) for name in GOALS}
    groups: dict[str, Any] = {"encode": used.model_copy(update=changes)}
    if requested.time_only:  # what the time decides
        auto_count, tuned = requested.compact.auto_count, requested.finetune.enabled
        groups["compact"] = resolved.compact.model_copy(update={"auto_count": auto_count})
        groups["finetune"] = resolved.finetune.model_copy(update={"enabled": tuned})
    return resolved.model_copy(update=groups).as_json()


def _evaluate(splats: Splats, container: Mapping[str, bytes], views: Views | None, context: Context) -> Evaluation:
    """Evaluate a container, and report decoding, kernels and rendering as the one stage "evaluate"."""
    from kissgs.evaluation.evaluate import evaluate

    context.progress("evaluate", 0.0)
    most = ReadOptions.allowing(len(splats))
    decoded = read_scene(container, most, threads=context.threads)
    return evaluate(splats, decoded, views, threads=context.threads, progress=context.stage("evaluate").progress)
