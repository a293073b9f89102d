"""From a scene to a container, as the settings ask: look at it where bits are weighed, choose, fine-tune, write."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from kissgs._version import __version__
from kissgs.cameras.views import Views
from kissgs.core.array_types import Float32, Int
from kissgs.core.errors import StopSearch, UnsupportedError
from kissgs.core.progress import Annotated, Progress, as_stage
from kissgs.core.sensitivity import Sensitivity
from kissgs.core.splats import ATTRIBUTES, Cleaned, Splats
from kissgs.io.sensitivity_file import read_sensitivity, write_sensitivity
from kissgs.pipeline.rate_control import Container, Encoder, RateControl
from kissgs.pipeline.trial import Trial
from kissgs.planning.encoding_plan import EncodingPlan
from kissgs.planning.planner import load_kernels as load_encoder
from kissgs.planning.planner import plan_encoding
from kissgs.planning.rate_distortion import ColorRefit
from kissgs.rendering.gsplat_backend import need_cuda
from kissgs.rendering.rasterizer import Device
from kissgs.settings import EncodeSettings, Settings
from kissgs.sogxt.encode import Encoded, write_files

if TYPE_CHECKING:
    from kissgs.finetuning.tune import Tuner
    from kissgs.rendering.sensitivity import WeightedCameras

HEDGE = {True: 0.1, False: 0.55}
"""How little pictures say of others: those from a capture's cameras, and those from virtual ones."""

MEASURE = 3
"""Version of how sensitivity is measured: what an earlier one has kept in a file is measured anew."""

TUNED_ATTEMPTS = 4
"""Containers that are fine-tuned on the way to a goal, at most: each takes a training."""

Chooser = Callable[[EncodeSettings, Progress], EncodingPlan]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Encoding:
    """A scene that shall become a container.

    Attributes:
        splats: clean.
        original: from which it was compacted, or the same: pictures of it are what a goal's PSNR is told by, and what
            fine-tuning learns from where there are no photographs.
        settings: of all stages.
        sensitivity: of ``splats``, if it was measured before.
        cache: file to keep it in.
        views: a capture.
        cleaned: what was mended, for the metadata.
        checkpoint: file for the state of fine-tuning; a search for a goal keeps none.
        device: where fine-tuning trains.
        packed: whether the files become a zip; a size is then that of the zip.
        threads: 0 means one per processor.
        progress: receives the stages of all that is done; its note tells where a search stands.
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
    packed: bool
    threads: int
    progress: Annotated

    def run(self, search: RateControl | None = None) -> tuple[Container, tuple[Trial, ...]]:
        """The container, and what was tried on the way to it if the settings name a goal.

        Args:
            search: for that goal, if it was made before; attempts that it made are not told again.

        Raises:
            InvalidViewsError: a photograph cannot be read.
            OutputError: ``cache`` or ``checkpoint`` is something else, or ``cache`` cannot be written.
            UnsupportedError: the goal cannot be met; the scene is too large for one container.
        """
        wanted, told = self.settings.encode, 0 if search is None else len(search.trials)
        if not wanted.has_goal:
            return self._encoder(self._chooser(), self._tuner(), self.checkpoint)(wanted), ()
        chooser = None
        if search is None:
            chooser = self._chooser()
            search = self.search(chooser)
        if self.settings.finetune.enabled and len(self.splats) > 0 and not search.stopped:
            rd_lambda = search.trials[-1].rd_lambda if search.best is None else search.best.encoded.rd_lambda
            try:
                encoder = self._encoder(chooser or self._chooser(), self._tuner(), None)
                search.run(encoder, rd_lambda, min(TUNED_ATTEMPTS, wanted.max_encodes))
            except StopSearch:  # while it looked
                if search.best is None:
                    raise
        found = search.found(all_stay=not self.settings.compact.auto_count)
        return found, tuple(search.trials[told:])

    def search(self, chooser: Chooser | None = None, limit: float = math.inf) -> RateControl:
        """For the goal of the settings, without fine-tuning; see :class:`RateControl` for ``limit``."""
        search = RateControl(
            *(self.original, self.settings.encode, self.views, self.threads, self.progress),
            count=len(self.splats),
            packed=self.packed,
            limit=limit,
        )
        search.search_all(self._encoder(chooser or self._chooser(), None, None))
        return search

    def _encoder(self, chooser: Chooser, tuner: Tuner | None, checkpoint: Path | None) -> Encoder:
        """Chooses, fine-tunes if there is a tuner, and writes."""

        def encoder(chosen: EncodeSettings) -> Container:
            bold = self._bold(chosen)

            def files(choice: EncodingPlan, finetune_steps: int, progress: Progress) -> Encoded:
                return write_files(
                    *(choice, self.splats, bold if finetune_steps else chosen),
                    cleaned=self.cleaned,
                    compacted=len(self.original) - len(self.splats),
                    finetune_steps=finetune_steps,
                    threads=self.threads,
                    progress=progress,
                )

            choice = chooser(chosen, self.progress)
            if tuner is None or not choice.grid.mask.any():
                return Container(files(choice, 0, self.progress), chosen)
            start = choice if bold == chosen else chooser(bold, as_stage("finetune", self.progress))
            encoded, report = tuner(choice, start, self.splats, files, checkpoint)
            return Container(encoded, bold if report.kept else chosen, report)

        return encoder

    def _bold(self, chosen: EncodeSettings) -> EncodeSettings:
        """What training starts from: it closes holes, so more Gaussians may go."""
        if not chosen.rate_distortion or chosen.prune_threshold_bits == 0:
            return chosen
        return chosen.model_copy(
            update={
                "prune_threshold_bits": max(chosen.prune_threshold_bits, self.settings.finetune.prune_threshold_bits)
            }
        )

    def _tuner(self) -> Tuner | None:
        if not self.settings.finetune.enabled or len(self.splats) == 0:
            return None
        from kissgs.finetuning.tune import Tuner

        return Tuner.of(
            *(self.original, self.settings.finetune, self.views),
            device=self.device,
            threads=self.threads,
            progress=self.progress,
        )

    def _chooser(self) -> Chooser:
        return self._looking() if self.settings.encode.rate_distortion and len(self.splats) > 0 else self._blind

    def _blind(self, chosen: EncodeSettings, progress: Progress) -> EncodingPlan:
        return plan_encoding(self.splats, chosen, threads=self.threads, progress=progress)

    def _looking(self) -> Chooser:
        """Weighs by pictures of the scene, which are taken once."""
        from kissgs.cameras.virtual.sensitivity_cameras import sensitivity_cameras
        from kissgs.rendering.rasterizer import load_kernels as load_rasterizer

        splats, views, settings = self.splats, self.views, self.settings.encode
        sensitivity, common = self.sensitivity, (self.threads, self.progress)
        if sensitivity is not None:
            sensitivity.check(splats)
        load_encoder(self.progress)
        load_rasterizer()
        captured = views is not None and len(views.train) > 0
        recolor = None
        if sensitivity is None or (captured and settings.color_refit_iterations):
            size = settings.sensitivity_view_size
            watched = sensitivity_cameras(
                *(splats, views),
                count=settings.sensitivity_views,
                size=size,
                threads=self.threads,
                progress=self.progress,
            )
            if sensitivity is None:
                view_uncertainty = (
                    settings.view_uncertainty if settings.view_uncertainty is not None else HEDGE[captured]
                )
                sensitivity = _sensitivity(splats, watched, view_uncertainty, self.cache, *common)
            if captured and settings.color_refit_iterations:  # virtual pictures would mislead it
                recolor = _recolor(splats, watched, sensitivity, settings.color_refit_iterations, *common)

        def chooser(chosen: EncodeSettings, progress: Progress) -> EncodingPlan:
            def ready(stage: str, fraction: float, note: str = "") -> None:
                if stage != "kernels":  # that was before
                    progress(stage, fraction)

            return plan_encoding(
                *(splats, chosen), sensitivity=sensitivity, recolor=recolor, threads=self.threads, progress=ready
            )

        return chooser


def check_finetuning(settings: Settings, views: Views | None, device: Device) -> None:
    """See that levels can be fine-tuned here, before the work that comes before.

    Raises:
        UnsupportedError: no torch or no GPU; a goal that it would miss.
    """
    if find_spec("torch") is None:
        raise UnsupportedError(
            "fine-tuning is done with torch, which is missing: pip install 'kissgs[train]' (a CPU build will do)"
        )
    if device == "cuda":
        need_cuda()
    if settings.encode.psnr is not None and views is not None and any(view.photo for view in views.train):
        raise UnsupportedError(
            "psnr is that to the scene's own pictures, and fine-tuning by photographs leaves these for better ones; "
            "ask for a size (--target-size), or fine-tune without photographs"
        )


def _sensitivity(
    splats: Splats,
    watched: WeightedCameras,
    view_uncertainty: float,
    cache: Path | None,
    threads: int,
    progress: Progress,
) -> Sensitivity:
    """Measured, or as it was kept in the file ``cache`` when it was measured before."""
    from kissgs.rendering.sensitivity import measure_sensitivity

    if cache is None:
        return measure_sensitivity(
            splats, watched, view_uncertainty=view_uncertainty, threads=threads, progress=progress
        )
    key = hashlib.sha256(
        f"{MEASURE} {__version__} {view_uncertainty} {splats.sh_degree} "
        f"{watched.weights} {watched.spread} {watched.captured}".encode()
    )
    for camera in watched.cameras:
        key.update(camera.viewmat.tobytes() + camera.K.tobytes() + f"{camera.width} {camera.height} ".encode())
    for values in (watched.background, *(getattr(splats, name) for name in ATTRIBUTES)):
        key.update(values.tobytes())
    found = read_sensitivity(cache, key.hexdigest())
    if found is None:
        found = measure_sensitivity(
            splats, watched, view_uncertainty=view_uncertainty, threads=threads, progress=progress
        )
        write_sensitivity(cache, found, key.hexdigest())
    return found


def _recolor(
    splats: Splats, watched: WeightedCameras, sensitivity: Sensitivity, steps: int, threads: int, progress: Progress
) -> ColorRefit:
    """Refits base colours to pictures of the scene."""
    from kissgs.rendering.color_refit import refit_colors

    def recolor(decoded: Splats, order: Int[np.ndarray, " M"]) -> Float32[np.ndarray, "M 3"]:
        weights = sensitivity.color_weight[order], sensitivity.prior[order]
        return refit_colors(decoded, splats, watched, *weights, steps=steps, threads=threads, progress=progress)

    return recolor
