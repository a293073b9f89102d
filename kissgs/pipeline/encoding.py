"""One encoding of a scene: measure sensitivity or read it from a file, plan, fine-tune, write."""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from kissgs._version import __version__
from kissgs.cameras.views import Views
from kissgs.core.array_types import Float32, Int
from kissgs.core.context import (
    DEFAULT_CONTEXT,
    TORCH_MISSING,
    Context,
    Device,
    blas_workers,
    has_torch,
    load_kernels,
    return_free_memory,
)
from kissgs.core.errors import OutputError, UnsupportedError
from kissgs.core.sensitivity import Sensitivity
from kissgs.core.splats import ATTRIBUTES, NOTHING_CLEANED, Cleaned, Splats
from kissgs.formats import ContainerName
from kissgs.io.files import atomic_file, reason_of, refuse_existing
from kissgs.planning.planner import ColorRefit, Encoded, EncodingPlan, plan_encoding, refine_order
from kissgs.planning.quantize import EVEN_LEVELS, ContainerModel
from kissgs.rendering.rasterizer import need_cuda
from kissgs.settings import EncodeSettings, FinetuneSettings, Settings
from kissgs.sog import FILES as SOG_FILES
from kissgs.sogxt import FILES as SOGXT_FILES
from kissgs.sogxt import encode as sogxt

if TYPE_CHECKING:
    from kissgs.compaction.popspa import Popspa
    from kissgs.compaction.result import Compacted
    from kissgs.finetuning.result import FinetuneReport
    from kissgs.finetuning.tune import Tuner
    from kissgs.pipeline.limited_time import SearchTime
    from kissgs.rendering.sensitivity import WeightedCameras


# The containers that ``compress`` writes: what each can hold, and how its files are made.

FILES = frozenset({*SOGXT_FILES, *SOG_FILES})  # a folder with no others may be replaced by a container


def model_of(container: ContainerName) -> ContainerModel:
    """Return what a container can hold, for the planner."""
    if container == "sogxt":
        return EVEN_LEVELS
    from kissgs.sog.encode import SOG

    return SOG


def write_files(
    container: ContainerName,
    plan: EncodingPlan,
    settings: EncodeSettings,
    context: Context = DEFAULT_CONTEXT,
    *,
    cleaned: Cleaned = NOTHING_CLEANED,
    compacted: int = 0,
    finetune_steps: int = 0,
) -> Encoded:
    """Make the files of a plan for a container; the counts are for the metadata of SOG-XT."""
    if container == "sog":
        from kissgs.sog import encode as sog

        return sog.write_files(plan, settings, context)
    return sogxt.write_files(
        plan, settings, context, cleaned=cleaned, compacted=compacted, finetune_steps=finetune_steps
    )


# Sensitivity in a file.


def read_sensitivity(path: Path, key: str) -> Sensitivity | None:
    """Read what :func:`write_sensitivity` has written with ``key``; None if the file is missing or has another key. Any
    other file is refused, because it would be replaced."""
    refuse_existing(path, overwrite=True)  # before the measurement, whose result is written there
    try:
        if not path.exists():
            return None
        with path.open("rb") as file, np.load(file, allow_pickle=False) as kept:
            if str(kept["key"]) != key:
                return None
            arrays = {field.name: kept[field.name] for field in fields(Sensitivity)}
    except OSError as error:
        raise OutputError(f"cannot read {path}: {reason_of(error)}") from error
    except (ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise OutputError(
            f"{path} is not a sensitivity file of kissgs; move it away, delete it or choose another path"
        ) from error
    return Sensitivity(**{**arrays, "view_uncertainty": float(arrays["view_uncertainty"])})


def write_sensitivity(path: Path, sensitivity: Sensitivity, key: str) -> None:
    """Write sensitivity and ``key`` to an ``.npz``, atomically; an existing file is replaced."""
    arrays: dict[str, Any] = {field.name: getattr(sensitivity, field.name) for field in fields(Sensitivity)}
    with atomic_file(path, overwrite=True) as file:
        np.savez(file, key=np.asarray(key), **arrays)


# One encoding of a scene: measure sensitivity, plan, fine-tune, write.

VIEW_UNCERTAINTY = {True: 0.1, False: 0.55}  # by default: True with a capture's cameras
SENSITIVITY_VERSION = 5  # of its measurement; a cache file of another version is measured again
REFIT_SIZE = 320  # largest longer side of the images that colours are refitted to, pixels


@dataclass(slots=True, eq=False, kw_only=True)
class Work:
    """Scene, settings and context that all encodings of one compression share."""

    splats: Splats  # clean scene to encode
    original: Splats  # scene before compaction, or splats: the reference of a PSNR, and targets without photographs
    settings: Settings
    sensitivity: Sensitivity | None  # of splats if measured before; None to measure it if the settings need it
    cache: Path | None  # file in which the measured sensitivity of splats is kept
    views: Views | None
    cleaned: Cleaned  # for the metadata
    container: ContainerName
    packed: bool  # whether the files become a zip, whose size then counts
    context: Context
    time: SearchTime | None  # how a limited time is divided; None for no limit


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """A scene, ready to be planned for any lambda: without sensitivity where the settings need none."""

    splats: Splats
    sensitivity: Sensitivity | None = None
    recolor: ColorRefit | None = None
    first_view: Mapping[str, Any] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Container:
    """A container in memory: its files with the report of the encoder, and how they were made."""

    encoded: Encoded
    settings: EncodeSettings
    finetuning: FinetuneReport | None = None
    compacted: Compacted | None = None
    checkpoint: Path | None = None  # with the final state of its fine-tuning


def measure(work: Work, splats: Splats, settings: EncodeSettings) -> Measured:
    """Measure the sensitivity of the work's scene, or of one with fewer Gaussians, if the settings need it."""
    load_kernels(work.context.progress)
    if not settings.rate_distortion or len(splats) == 0:
        return Measured(splats)
    from kissgs.cameras.virtual.samples import default_view_count, sensitivity_cameras

    whole = splats is work.splats
    sensitivity = work.sensitivity if whole else None
    if sensitivity is not None:
        sensitivity.check(splats)
    captured = work.views is not None and len(work.views.train) > 0
    refits = captured and settings.color_refit_iterations > 0  # a refit to virtual cameras is worse than none
    if sensitivity is not None and not refits:
        return Measured(splats, sensitivity)
    count = settings.sensitivity_views or default_view_count(len(splats), captured=captured)
    size = settings.sensitivity_view_size
    cameras, first_view = sensitivity_cameras(splats, work.views, work.context, count=count, size=size)
    if sensitivity is None:
        uncertainty = VIEW_UNCERTAINTY[captured] if settings.view_uncertainty is None else settings.view_uncertainty
        sensitivity = _sensitivity(splats, cameras, uncertainty, work.cache if whole else None, work.context)
        return_free_memory()
    steps = settings.color_refit_iterations
    recolor = _recolor(splats, cameras, sensitivity, steps, work.context) if refits else None
    return Measured(splats, sensitivity, recolor, first_view)


def plan(work: Work, scene: Measured, settings: EncodeSettings, context: Context) -> EncodingPlan:
    """Decide all levels of a scene."""
    chosen = plan_encoding(
        scene.splats,
        settings,
        context,
        sensitivity=scene.sensitivity,
        recolor=scene.recolor,
        container=model_of(work.container),
        keep_costs=bool(work.settings.finetune.enabled),
    )
    return replace(chosen, scene=replace(chosen.scene, first_view=scene.first_view))


def write(
    work: Work, chosen: EncodingPlan, settings: EncodeSettings, compacted: int, context: Context, steps: int = 0
) -> Encoded:
    """Make the files of a plan, of a scene from which ``compacted`` Gaussians are gone, fine-tuned in ``steps``."""
    if steps and settings.order == "refined":  # training has changed the levels
        with blas_workers(context.threads) as pool:
            chosen = refine_order(chosen, None, pool, context.progress)
    return write_files(
        work.container, chosen, settings, context, cleaned=work.cleaned, compacted=compacted, finetune_steps=steps
    )


def encode(
    work: Work,
    scene: Measured,
    settings: EncodeSettings,
    tuner: Tuner | None = None,
    *,
    checkpoint: Path | None = None,
    completes: bool = False,
) -> Container:
    """Plan a scene, fine-tune its levels if there is a tuner, and write the files. If fine-tuning ``completes`` the
    training of the scene, no container is made without it."""
    compacted = len(work.original) - len(scene.splats)
    pruned = settings if tuner is None else _pruned_for_finetune(settings, work.settings.finetune)
    chosen = plan(work, scene, pruned if completes else settings, work.context)
    if tuner is None or not chosen.grid.mask.any():
        return Container(encoded=write(work, chosen, settings, compacted, work.context), settings=settings)

    def files(tuned: EncodingPlan, steps: int, context: Context) -> Encoded:
        return write(work, tuned, pruned if steps or completes else settings, compacted, context, steps)

    start = chosen
    if not completes and pruned != settings:
        start = plan(work, scene, pruned, work.context.stage("finetune"))
    encoded, report = tuner(None if completes else chosen, start, scene.splats, files, checkpoint)
    used = pruned if report.kept else settings
    return Container(encoded=encoded, settings=used, finetuning=report, checkpoint=checkpoint)


def _pruned_for_finetune(settings: EncodeSettings, finetune: FinetuneSettings) -> EncodeSettings:
    """Return settings that prune more Gaussians: training closes the holes that they leave."""
    if not settings.rate_distortion or settings.prune_threshold_bits == 0:
        return settings
    threshold = max(settings.prune_threshold_bits, finetune.prune_threshold_bits)
    return settings.model_copy(update={"prune_threshold_bits": threshold})


def make_tuner(work: Work, settings: FinetuneSettings | None = None, compactor: Popspa | None = None) -> Tuner:
    """Return what fine-tunes the levels, with the images of a compaction if the settings would choose the same."""
    from kissgs.finetuning.tune import Tuner
    from kissgs.sog.decode import decode as decode_sog
    from kissgs.sogxt.decode import decode as decode_sogxt
    from kissgs.training.supervision import supervision_views, training_targets

    settings = settings or work.settings.finetune
    names = ("synthetic_view_share", "views", "view_size", "photo_size", "seed")
    same_views = all(getattr(work.settings.compact, name) == getattr(work.settings.finetune, name) for name in names)
    if compactor is not None and compactor.settings.trains and same_views:
        supervision, targets = compactor.supervision, compactor.load_targets()
    else:
        supervision = supervision_views(work.original, work.views, settings, work.context, scoring_stride=0)
        targets = training_targets(work.original, supervision, work.context)
    model, decode = model_of(work.container), decode_sog if work.container == "sog" else decode_sogxt
    return Tuner(work.original, settings, supervision, targets, work.context, model, decode)


def check_finetuning(settings: Settings, views: Views | None, device: Device) -> None:
    """Refuse fine-tuning that is impossible, or that would miss the goal, before any other work."""
    if not has_torch():
        raise UnsupportedError(f"fine-tuning needs {TORCH_MISSING}")
    if device == "cuda":
        need_cuda()
    if settings.encode.psnr is not None and views is not None and any(view.photo for view in views.train):
        raise UnsupportedError(
            "psnr is measured against the scene's own renderings, from which fine-tuning on photographs moves away; "
            "give a target size (--target-size), or fine-tune without photographs"
        )


def _sensitivity(
    splats: Splats, cameras: WeightedCameras, view_uncertainty: float, cache: Path | None, context: Context
) -> Sensitivity:
    """Measure the sensitivity, or read it from the file ``cache`` if that was made for this scene and these cameras."""
    from kissgs.rendering.sensitivity import measure_sensitivity

    key = "" if cache is None else _key(splats, cameras, view_uncertainty)
    found = None if cache is None else read_sensitivity(cache, key)
    if found is None:
        threads, progress = context.threads, context.progress
        found = measure_sensitivity(
            splats, cameras, view_uncertainty=view_uncertainty, threads=threads, progress=progress
        )
        if cache is not None:
            write_sensitivity(cache, found, key)
    return found


def _key(splats: Splats, cameras: WeightedCameras, view_uncertainty: float) -> str:
    """Return the key of a sensitivity: equal only for equal results."""
    key = hashlib.sha256(
        f"{SENSITIVITY_VERSION} {__version__} {view_uncertainty} {splats.sh_degree} "
        f"{cameras.weights} {cameras.spread} {cameras.captured}{' antialiased' * splats.antialiased}".encode()
    )
    for camera in cameras.cameras:
        key.update(camera.viewmat.tobytes() + camera.K.tobytes())
        key.update(f"{camera.width} {camera.height} {camera.dilation} ".encode())
    for values in (cameras.background, *(getattr(splats, name) for name in ATTRIBUTES)):
        key.update(values.tobytes())
    return key.hexdigest()


def _recolor(
    splats: Splats, cameras: WeightedCameras, sensitivity: Sensitivity, steps: int, context: Context
) -> ColorRefit:
    """Return a function that refits base colours to renderings of the scene from the capture's cameras."""
    from kissgs.rendering.sensitivity import refit_colors

    cameras = _refit_cameras(cameras)

    def recolor(decoded: Splats, order: Int[np.ndarray, " M"]) -> Float32[np.ndarray, "M 3"]:
        weights = sensitivity.color_weight[order], sensitivity.prior[order]
        decoded = replace(decoded, antialiased=splats.antialiased)
        return refit_colors(decoded, splats, cameras, *weights, context, steps=steps)

    return recolor


def _refit_cameras(cameras: WeightedCameras) -> WeightedCameras:
    """Return the capture's cameras with fewer samples, and every other virtual one, smaller and of twice its weight."""
    own = list(zip(cameras.cameras, cameras.weights, strict=True))
    kept = [(camera.sampled_at_most(REFIT_SIZE), weight) for camera, weight in own[: cameras.captured]]
    kept += [(camera.at_most(REFIT_SIZE), 2.0 * weight) for camera, weight in own[cameras.captured :: 2]]
    return replace(cameras, cameras=[camera for camera, _ in kept], weights=[weight for _, weight in kept])
