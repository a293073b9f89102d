"""Encode a scene into a container: measure sensitivity, plan, fine-tune, write, towards a goal if there is one."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from kissgs._version import __version__
from kissgs.cameras.views import Views
from kissgs.core.array_types import Float32, Int
from kissgs.core.errors import StopSearch, UnsupportedError
from kissgs.core.progress import Deadline, Progress, SearchNote, as_stage, load_kernels
from kissgs.core.resources import blas_workers, return_free_memory
from kissgs.core.sensitivity import Sensitivity
from kissgs.core.splats import ATTRIBUTES, Cleaned, Splats, empty_splats
from kissgs.formats import ContainerName
from kissgs.io.sensitivity_file import read_sensitivity, write_sensitivity
from kissgs.pipeline.containers import DECODERS, MODELS, write_files
from kissgs.pipeline.goal import Trial
from kissgs.pipeline.rate_control import Container, Encoder, RateControl
from kissgs.planning.encoding_plan import Encoded, EncodingPlan
from kissgs.planning.planner import plan_encoding, refine_order
from kissgs.planning.rate_distortion import ColorRefit
from kissgs.rendering.rasterizer import Device, need_cuda
from kissgs.settings import EncodeSettings, Settings

if TYPE_CHECKING:
    from kissgs.compaction.budget import SearchEvaluation
    from kissgs.finetuning.tune import Tuner
    from kissgs.rendering.sensitivity import WeightedCameras
    from kissgs.training.supervision import SupervisionViews, TrainingTargets

VIEW_UNCERTAINTY = {True: 0.1, False: 0.55}
"""Default of the setting ``view_uncertainty``: True with the cameras of a capture, False with virtual cameras only."""

SENSITIVITY_VERSION = 5
"""Version of the measurement of sensitivity; a cache file of another version is measured again and replaced."""

MAX_FINETUNED_ENCODES = 3
"""Largest number of containers that a search for a goal fine-tunes; each takes a training."""

MAX_OFFSET_DB = 30.0
"""Largest value of the setting ``quality_offset_db``."""

REFIT_SIZE = 320
"""Largest longer side of the images that colours are refitted to, pixels."""

Planner = Callable[[EncodeSettings, Progress], EncodingPlan]


@dataclass(frozen=True, slots=True)
class FinetuneFactors:
    """Factors on settings of fine-tuning.

    Attributes:
        steps: factor on the number of steps.
        lr: factor on the learning rate of all attributes but the SH codebook.
        codebook_lr: factor on that of the SH codebook.
    """

    steps: float
    lr: float
    codebook_lr: float


@dataclass(slots=True, eq=False, kw_only=True)
class Encoding:
    """The inputs of one encoding: a scene, settings, and where to work.

    Attributes:
        splats: clean scene to encode; see ``disposable``.
        original: scene before compaction, or ``splats`` itself. Its renderings are the reference of a goal's PSNR, and
            the targets of fine-tuning where there are no photographs.
        settings: settings of all stages.
        sensitivity: sensitivity of ``splats`` if measured before; None to measure it if the settings need it.
        cache: file in which a measured sensitivity is kept; None for no file.
        views: capture of the scene; None for virtual cameras.
        cleaned: defects of the input that were corrected, for the metadata.
        checkpoint: file for the state of fine-tuning; unused in a search for a goal.
        device: device of fine-tuning.
        container: the container to write.
        packed: whether the files become a zip, whose size then counts; False for a folder.
        threads: number of threads; 0 means one per processor.
        progress: receives the events of all stages; its note says how far a search has come.
        compare: compares containers of a search with ``original``; by default in the views that fit ``views``.
        deadline: time until which the container shall be finished; None for no limit.
        disposable: whether nobody needs the scene after the encoding. If so, and it is planned only once, it is
            replaced by an empty one before the images are compressed, so that its memory is free.
    """

    splats: Splats
    original: Splats
    settings: Settings
    sensitivity: Sensitivity | None
    cache: Path | None
    views: Views | None
    cleaned: Cleaned
    checkpoint: Path | None
    device: Device
    container: ContainerName
    packed: bool
    threads: int
    progress: SearchNote
    compare: SearchEvaluation | None = None
    deadline: Deadline | None = None
    disposable: bool = False

    def run(
        self, search: RateControl | None = None, trained: Sequence[Trial] = ()
    ) -> tuple[Container, tuple[Trial, ...]]:
        """Encode the scene; return the container, and the trials of the search if the settings name a goal.

        Args:
            search: search for that goal if it was made before; its trials are not returned again.
            trained: trials of other numbers of Gaussians, for the error.

        Raises:
            InvalidViewsError: a photograph cannot be read.
            OutputError: ``cache`` or ``checkpoint`` is another kind of file, or ``cache`` cannot be written.
            UnsupportedError: the goal cannot be met; the scene is too large for one container.
        """
        encode, returned = self.settings.encode, 0 if search is None else len(search.trials)
        if not encode.has_goal and not self.settings.finetune.enabled:
            return self._encode_once(encode), ()
        if not encode.has_goal:
            return self._encoder(self._planner(), self.tuner(), self.checkpoint)(encode), ()
        planner = None
        if search is None:
            planner = self._planner()
            search = self.search(planner)
        tunes = self.settings.finetune.enabled and len(self.splats) > 0
        late = self.deadline is not None and self.deadline.seconds <= 0
        if tunes and not (search.stopped or search.finetuned or late):
            rd_lambda = search.trials[-1].rd_lambda if search.best is None else search.best.encoded.rd_lambda
            try:
                encoder = self._encoder(planner or self._planner(), self.tuner(), None)
                search.run(encoder, rd_lambda, min(MAX_FINETUNED_ENCODES, encode.max_encodes))
            except StopSearch:  # raised while sensitivity was measured or targets were rendered
                if search.best is None:
                    raise
        container = search.result(trained=trained, suggest_compaction=not self.settings.compact.auto_count)
        return container, tuple(search.trials[returned:])

    def _encode_once(self, settings: EncodeSettings) -> Container:
        """Plan, forget a disposable scene, and write the files."""
        plan, compacted = self._planner()(settings, self.progress), len(self.original) - len(self.splats)
        if self.disposable:
            self.splats = self.original = empty_splats(0, 0)
            self.sensitivity = None
        return_free_memory()
        return Container(self._write(plan, settings, compacted, 0, self.progress), settings)

    def _write(
        self, plan: EncodingPlan, settings: EncodeSettings, compacted: int, finetune_steps: int, progress: Progress
    ) -> Encoded:
        return write_files(
            self.container,
            plan,
            settings,
            cleaned=self.cleaned,
            compacted=compacted,
            finetune_steps=finetune_steps,
            threads=self.threads,
            progress=progress,
        )

    def search(self, planner: Planner | None = None, byte_limit: float = math.inf) -> RateControl:
        """Search for the goal of the settings without fine-tuning; see :class:`RateControl` for ``byte_limit``."""
        search = self.rate_control(byte_limit=byte_limit)
        search.search_all(self._encoder(planner or self._planner(), None, None))
        return search

    def rate_control(
        self, *, offset_db: float = 0.0, byte_limit: float = math.inf, trained: bool = False
    ) -> RateControl:
        """Return a search that has no container yet.

        Args:
            offset_db: added to ``quality_offset_db`` of the settings, for the first container.
            byte_limit: see :class:`RateControl`.
            trained: likewise.
        """
        from kissgs.compaction.budget import SearchEvaluation

        settings = self.settings.encode
        return RateControl(
            self.original,
            settings.model_copy(
                update={"quality_offset_db": min(settings.quality_offset_db + offset_db, MAX_OFFSET_DB)}
            ),
            self.compare or SearchEvaluation(self.original, self.views, self.threads),
            self.threads,
            self.progress,
            count=len(self.splats),
            packed=self.packed,
            byte_limit=byte_limit,
            deadline=None if trained else self.deadline,  # a training has a deadline of its own
            trained=trained,
        )

    def with_encode_settings(self, **changes: float) -> Encoding:
        """Return a copy with other settings of the encoder."""
        encode = self.settings.encode.model_copy(update=changes)
        return replace(self, settings=self.settings.model_copy(update={"encode": encode}))

    def encoder(self, tuner: Tuner | None) -> Encoder:
        """Return a function that plans, fine-tunes as a part of training if there is a tuner, and writes the files."""
        return self._encoder(self._planner(), tuner, None, completes=True)

    def _encoder(
        self, planner: Planner, tuner: Tuner | None, checkpoint: Path | None, *, completes: bool = False
    ) -> Encoder:
        """Return a function that plans, fine-tunes if there is a tuner, and writes the files.

        If fine-tuning ``completes`` the training of the scene, no container is made without it.
        """

        def encoder(settings: EncodeSettings) -> Container:
            pruned = self._pruned_for_finetune(settings)

            def files(plan: EncodingPlan, finetune_steps: int, progress: Progress) -> Encoded:
                compacted = len(self.original) - len(self.splats)
                if finetune_steps and settings.order == "refined":  # training has changed the levels
                    with blas_workers(self.threads) as pool:
                        plan = refine_order(plan, None, pool, progress)
                used = pruned if finetune_steps or (completes and tuner is not None) else settings
                return self._write(plan, used, compacted, finetune_steps, progress)

            plan = planner(pruned if completes and tuner is not None else settings, self.progress)
            if tuner is None or not plan.grid.mask.any():
                return Container(files(plan, 0, self.progress), settings)
            start = plan
            if not completes and pruned != settings:
                start = planner(pruned, as_stage("finetune", self.progress))
            encoded, report = tuner(None if completes else plan, start, self.splats, files, checkpoint)
            return Container(encoded, pruned if report.kept else settings, report)

        return encoder

    def _pruned_for_finetune(self, settings: EncodeSettings) -> EncodeSettings:
        """Return settings that prune more Gaussians: training closes the holes that they leave."""
        if not settings.rate_distortion or settings.prune_threshold_bits == 0:
            return settings
        threshold = max(settings.prune_threshold_bits, self.settings.finetune.prune_threshold_bits)
        return settings.model_copy(update={"prune_threshold_bits": threshold})

    def tuner(
        self,
        factors: FinetuneFactors | None = None,
        prepared: tuple[SupervisionViews, TrainingTargets] | None = None,
    ) -> Tuner | None:
        """Return what fine-tunes the container, if the settings ask for it.

        Args:
            factors: change its settings.
            prepared: views and targets of compaction, which are used if those of fine-tuning are the same.
        """
        settings = self.settings.finetune
        if not settings.enabled or len(self.splats) == 0:
            return None
        from kissgs.finetuning.tune import Tuner

        if factors is not None:
            changes = {"steps": max(1, round(factors.steps * settings.steps)), "lr": factors.lr * settings.lr}
            changes["codebook_lr"] = factors.codebook_lr * settings.codebook_lr
            settings = settings.model_copy(update=changes)
        return Tuner.of(
            self.original,
            settings,
            self.views,
            device=self.device,
            threads=self.threads,
            progress=self.progress,
            container=MODELS[self.container],
            decode=DECODERS[self.container],
            deadline=self.deadline,
            prepared=prepared if _same_views(self.settings) else None,
        )

    def _planner(self) -> Planner:
        rate_distortion = self.settings.encode.rate_distortion and len(self.splats) > 0
        return self._rd_planner() if rate_distortion else self._plan_without_sensitivity

    def _plan_without_sensitivity(self, settings: EncodeSettings, progress: Progress) -> EncodingPlan:
        return plan_encoding(
            self.splats, settings, container=MODELS[self.container], threads=self.threads, progress=progress
        )

    def _rd_planner(self) -> Planner:
        """Measure the sensitivity once; return a planner that uses it for every plan."""
        from kissgs.cameras.virtual.samples import default_view_count, sensitivity_cameras

        splats, views, settings = self.splats, self.views, self.settings.encode
        sensitivity, common = self.sensitivity, (self.threads, self.progress)
        if sensitivity is not None:
            sensitivity.check(splats)
        load_kernels(self.progress)
        captured = views is not None and len(views.train) > 0
        recolor = None
        if sensitivity is None or (captured and settings.color_refit_iterations):
            size = settings.sensitivity_view_size
            cameras = sensitivity_cameras(
                splats,
                views,
                count=settings.sensitivity_views or default_view_count(len(splats)),
                size=size,
                threads=self.threads,
                progress=self.progress,
            )
            if sensitivity is None:
                view_uncertainty = settings.view_uncertainty
                if view_uncertainty is None:
                    view_uncertainty = VIEW_UNCERTAINTY[captured]
                sensitivity = _sensitivity(splats, cameras, view_uncertainty, self.cache, *common)
                return_free_memory()
            if captured and settings.color_refit_iterations:  # a refit to virtual cameras is worse than none
                recolor = _recolor(splats, cameras, sensitivity, settings.color_refit_iterations, *common)

        def planner(chosen: EncodeSettings, progress: Progress) -> EncodingPlan:
            def without_kernels(stage: str, fraction: float, note: str = "") -> None:
                if stage != "kernels":  # they are loaded already
                    progress(stage, fraction)

            return plan_encoding(
                splats,
                chosen,
                sensitivity=sensitivity,
                recolor=recolor,
                container=MODELS[self.container],
                keep_costs=bool(self.settings.finetune.enabled),
                threads=self.threads,
                progress=without_kernels,
            )

        return planner


def _same_views(settings: Settings) -> bool:
    """Return whether compaction and fine-tuning train on the same images."""
    names = ("synthetic_view_share", "views", "view_size", "seed")
    return all(getattr(settings.compact, name) == getattr(settings.finetune, name) for name in names)


def check_finetuning(settings: Settings, views: Views | None, device: Device) -> None:
    """Check that fine-tuning is possible, before any other work.

    Raises:
        UnsupportedError: torch or a GPU is missing; the goal is one that fine-tuning would miss.
    """
    if find_spec("torch") is None:
        raise UnsupportedError(
            "fine-tuning needs torch, which is missing: pip install 'kissgs[train]' (a CPU build is enough)"
        )
    if device == "cuda":
        need_cuda()
    if settings.encode.psnr is not None and views is not None and any(view.photo for view in views.train):
        raise UnsupportedError(
            "psnr is measured against the scene's own renderings, from which fine-tuning on photographs moves away; "
            "give a target size (--target-size), or fine-tune without photographs"
        )


def _sensitivity(
    splats: Splats,
    cameras: WeightedCameras,
    view_uncertainty: float,
    cache: Path | None,
    threads: int,
    progress: Progress,
) -> Sensitivity:
    """Measure the sensitivity, or read it from the file ``cache`` if that was made for this scene and these cameras."""
    from kissgs.rendering.sensitivity import measure_sensitivity

    if cache is None:
        return measure_sensitivity(
            splats, cameras, view_uncertainty=view_uncertainty, threads=threads, progress=progress
        )
    key = hashlib.sha256(
        f"{SENSITIVITY_VERSION} {__version__} {view_uncertainty} {splats.sh_degree} "
        f"{cameras.weights} {cameras.spread} {cameras.captured}{' antialiased' * splats.antialiased}".encode()
    )
    for camera in cameras.cameras:
        key.update(camera.viewmat.tobytes() + camera.K.tobytes())
        key.update(f"{camera.width} {camera.height} {camera.dilation} ".encode())
    for values in (cameras.background, *(getattr(splats, name) for name in ATTRIBUTES)):
        key.update(values.tobytes())
    sensitivity = read_sensitivity(cache, key.hexdigest())
    if sensitivity is None:
        sensitivity = measure_sensitivity(
            splats, cameras, view_uncertainty=view_uncertainty, threads=threads, progress=progress
        )
        write_sensitivity(cache, sensitivity, key.hexdigest())
    return sensitivity


def _recolor(
    splats: Splats, cameras: WeightedCameras, sensitivity: Sensitivity, steps: int, threads: int, progress: Progress
) -> ColorRefit:
    """Return a function that refits base colours to renderings of the scene from the capture's cameras."""
    from kissgs.rendering.sensitivity import refit_colors

    cameras = _refit_cameras(cameras)

    def recolor(decoded: Splats, order: Int[np.ndarray, " M"]) -> Float32[np.ndarray, "M 3"]:
        weights = sensitivity.color_weight[order], sensitivity.prior[order]
        decoded = replace(decoded, antialiased=splats.antialiased)
        return refit_colors(decoded, splats, cameras, *weights, steps=steps, threads=threads, progress=progress)

    return recolor


def _refit_cameras(cameras: WeightedCameras) -> WeightedCameras:
    """Return the capture's cameras with fewer samples, and every other virtual one, smaller and of twice its weight."""
    chosen = np.arange(len(cameras.cameras))
    chosen = chosen[(chosen < cameras.captured) | ((chosen - cameras.captured) % 2 == 0)]
    virtual = chosen >= cameras.captured
    return replace(
        cameras,
        cameras=[
            cameras.cameras[n].at_most(REFIT_SIZE) if other else cameras.cameras[n].sampled_at_most(REFIT_SIZE)
            for n, other in zip(chosen, virtual, strict=True)
        ],
        weights=[cameras.weights[n] * (2.0 if other else 1.0) for n, other in zip(chosen, virtual, strict=True)],
    )
