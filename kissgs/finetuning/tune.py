"""``Tuner``: fine-tune the levels of an encoding plan, and keep the better container (KISS-GS, appendix)."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch

from kissgs._version import __version__
from kissgs.core.context import Context, Pace
from kissgs.core.errors import OutputError
from kissgs.core.splats import ATTRIBUTES, Splats, clean
from kissgs.evaluation.evaluate import compare_images
from kissgs.evaluation.results import Evaluation, squared_error
from kissgs.finetuning.planes import FIELDS, TABLES
from kissgs.finetuning.quantized_scene import QuantizedScene, RateLoss, TotalVariationLoss, table_name
from kissgs.finetuning.result import FinetuneReport
from kissgs.io.containers import zip_bytes
from kissgs.io.scene_format import ReadOptions
from kissgs.planning.planner import Encoded, EncodingPlan, implied_lambda
from kissgs.planning.quantize import EVEN_LEVELS, ContainerModel
from kissgs.planning.rd_fields import Costs
from kissgs.rendering.sensitivity import WeightedCameras, measure_sensitivity
from kissgs.settings import FinetuneSettings
from kissgs.sogxt.decode import decode as decode_sogxt
from kissgs.training.checkpoint import Checkpoint
from kissgs.training.loop import (
    BASE_LR,
    LrSchedule,
    TrainingPlan,
    continued_lr,
    exponential_lr,
    image_loss,
    torch_threads,
    train,
)
from kissgs.training.supervision import SupervisionViews, TrainingTargets

SENSITIVITY_VIEWS = 64  # approximate number of training cameras from which costs are measured, if the plan has none
VIEW_UNCERTAINTY = 0.1  # view uncertainty of these costs, see Sensitivity
LOSS_VIEWS = 16  # largest number of targets from which the loss before training is estimated
ATTRACTION_START = 0.5  # fraction of the steps after which attraction starts; it grows linearly to 1
ATTRIBUTES_OF_FIELDS = ("means", "opacities", "scales", "quats", "sh0", "shN")  # in the order of FIELDS
PRAS_DECAY = 0.95  # factor from one filter radius to the next where PRAS is repeated
TABLE_LR = 1.0  # of tables, in units of that of levels: an error of a value is one of all that uses it

NOT_KEPT = "fine-tuning did not help; the container is as it was without it"
NO_TIME = "there was no time for fine-tuning; the container is as it was without it"

# Most steps before a deadline, in units of the usual number: more fit photographs that train better, others worse.
MOST_STEPS = {"photos": 1, "renderings": 2}
Write = Callable[[EncodingPlan, int, Context], Encoded]  # writes a plan that was fine-tuned in a number of steps
Decode = Callable[..., Splats]  # decoder of a container: takes its files, ReadOptions and threads


@dataclass(slots=True, eq=False)
class Tuner:
    """Fine-tunes encoding plans of one scene."""

    original: Splats  # the original scene, clean; its renderings are the targets if there are no photographs
    settings: FinetuneSettings
    supervision: SupervisionViews
    targets: TrainingTargets  # of the supervision's training views
    context: Context  # its receiver gets the stage "finetune", and then those of writing
    container: ContainerModel = EVEN_LEVELS
    decode: Decode = decode_sogxt
    ending_seconds: float = 0.0  # expected time of what comes after the training; measured by the first container

    def __call__(
        self,
        plan: EncodingPlan | None,
        start: EncodingPlan,
        scene: Splats,
        write: Write,
        checkpoint: Path | None = None,
    ) -> tuple[Encoded, FinetuneReport]:
        """Fine-tune from ``start``, and return the better container with a report: the tuned one, or that of ``plan``.
        Without ``plan``, the training is part of that of the scene, and no container is made before it. If the file
        ``checkpoint`` exists and belongs to this work, training continues from it."""
        started = time.perf_counter()
        as_finetune = self.context.stage("finetune")
        before, first, rd_lambda = None, None, start.rd_lambda
        if plan is not None:
            before = write(plan, 0, as_finetune)
            first = self._evaluate(before, as_finetune)
            self.ending_seconds = time.perf_counter() - started
            rd_lambda = plan.rd_lambda
        if rd_lambda is None:
            container = before or write(start, 0, as_finetune)
            rd_lambda = implied_lambda(self._coding_error(container, scene, as_finetune), int(start.grid.mask.sum()))
        pace = Pace(self.settings.steps)
        if self.context.deadline is not None:
            most = MOST_STEPS[self.targets.target_source] * self.settings.steps
            pace = Pace(most, self.context.deadline.earlier(self.ending_seconds))
            pace.update(0)
        if before is not None and first is not None and pace.steps == 0:
            return before, self._report(0, first, first, started, kept=False, notes=[NO_TIME])
        tuned, checkpoint_note = self._train(start, scene.sh_degree, start.rd_lambda or rd_lambda, pace, checkpoint)
        trained = time.perf_counter()
        after = write(tuned, pace.steps, self.context)
        images_done = replace(self.context, progress=lambda *event: self.context.progress("images", 1.0))
        second = self._evaluate(after, images_done)
        self.ending_seconds = time.perf_counter() - trained
        kept = not self.settings.keeps_better or first is None or second.cost(rd_lambda) < first.cost(rd_lambda)
        notes = ["" if kept else NOT_KEPT, checkpoint_note]
        report = self._report(pace.steps, first, second, started, kept=kept, notes=notes)
        return (after if kept or before is None else before), report

    def _report(
        self, steps: int, before: _Result | None, after: _Result, started: float, *, kept: bool, notes: list[str]
    ) -> FinetuneReport:
        return FinetuneReport(
            steps=steps,
            target_source=self.targets.target_source,
            source=self.supervision.source,
            psnr_before=None if before is None else before.psnr,
            psnr_after=after.psnr,
            bytes_before=None if before is None else before.bytes,
            bytes_after=after.bytes,
            kept=kept,
            seconds=time.perf_counter() - started,
            note="; ".join(filter(None, [self.supervision.note, *notes])),
        )

    def _evaluate(self, encoded: Encoded, context: Context) -> _Result:
        evaluation = self._compare(self.original, encoded, context)
        return _Result(
            bytes=len(zip_bytes(encoded.files)),
            psnr=evaluation.mean.candidate.psnr,
            error=float(np.mean([squared_error(view.comparison.candidate.psnr) for view in evaluation.views])),
        )

    def _coding_error(self, encoded: Encoded, scene: Splats, context: Context) -> float:
        """Return the mean squared error of a container's renderings relative to those of the encoded scene."""
        views = self._compare(scene, encoded, context).views
        return float(np.mean([squared_error(view.comparison.candidate_vs_reference.psnr) for view in views]))

    def _compare(self, reference: Splats, encoded: Encoded, context: Context) -> Evaluation:
        reading = ReadOptions.allowing(len(reference))
        decoded = self.decode(encoded.files, reading, threads=context.threads)
        return compare_images(reference, decoded, self.supervision.eval_views, context)

    def _train(
        self, plan: EncodingPlan, sh_degree: int, rd_lambda: float, pace: Pace, path: Path | None
    ) -> tuple[EncodingPlan, str]:
        """Return the fine-tuned plan, and a note if the checkpoint could not be saved."""
        settings, scene = self.settings, QuantizedScene(plan, sh_degree, self.context.device, self.container)
        if settings.lr_offset is not None:
            scene.take_rates_of_attributes()
        checkpoint = Checkpoint(path, "" if path is None else self._key(plan, sh_degree))
        done, checkpoint_note = 0, ""
        loss_per_error = self._loss_per_error(scene)
        if settings.attraction:
            scene.set_curvature(plan.costs or self._measure_costs(scene), loss_per_error)
        rate_loss = RateLoss(scene, settings.rate_weight * rd_lambda * loss_per_error)
        state = checkpoint.load()
        if state is not None:
            done = int(state["done"])
            scene.restore(state)
            rate_loss.restore(state)
        repeats = self.container.tables is None and not settings.rate_weight
        fractions = [each for each in sorted(settings.pras_at) if repeats and each * pace.steps > done]

        def after(step: int) -> None:
            nonlocal checkpoint_note
            if fractions and step >= fractions[0] * pace.steps:  # a limited time changes the number on the way
                fractions.pop(0)
                scene.choose_forms(PRAS_DECAY, self.context.threads)
            if checkpoint.due or (path is not None and step == pace.steps):
                try:
                    checkpoint.save({**scene.state(), **rate_loss.state(), "done": np.asarray(step)})
                except OutputError as error:
                    checkpoint_note = f"the work went on without a checkpoint: {error}"

        training = TrainingPlan(
            stage="finetune",
            pace=pace,
            rates=_lr_schedule(settings, self.targets),
            ssim_weight=settings.ssim_weight,
            mse_weight=settings.mse_weight,
            seed=(settings.seed,),
            regularizers=(rate_loss, TotalVariationLoss(scene, settings.tv_weight, pace)),
            batch=settings.batch,
        )
        train(scene, self.targets, training, self.context, first=done, after=after)
        return scene.plan(), checkpoint_note

    def _loss_per_error(self, scene: QuantizedScene) -> float:
        """Estimate the derivative of the loss with respect to the mean squared image error. All of the loss but the
        error itself is taken as proportional to the root of the error, as for errors on top of those to photographs."""
        settings, losses, errors = self.settings, [], []
        with torch.no_grad(), torch_threads(1):  # the sums depend on the number of threads
            parameters = scene.gaussians()
            for n in islice(self.targets.order((settings.seed,)), min(LOSS_VIEWS, len(self.targets))):
                self.context.progress("finetune", 0.0)
                loss, error = image_loss(
                    parameters,
                    self.targets,
                    n,
                    ssim_weight=settings.ssim_weight,
                    mse_weight=0.0,
                    antialiased=scene.antialiased,
                    threads=self.context.threads,
                )
                losses.append(float(loss))
                errors.append(error)
        return float(np.mean(losses)) / (2 * max(float(np.mean(errors)), 1e-10)) + settings.mse_weight

    def _measure_costs(self, scene: QuantizedScene) -> Costs:
        """Measure the costs of errors in the training views, for a plan without costs."""
        with torch.no_grad():
            arrays: dict[str, Any] = {name: value.cpu().numpy() for name, value in scene.gaussians().items()}
            splats = clean(replace(self.original, **arrays))[0]
        targets = self.targets
        stride, others = max(1, len(targets) // SENSITIVITY_VIEWS), len(targets) - targets.synthetic
        weights = [1.0] * others + [targets.synthetic_per_epoch / max(targets.synthetic, 1)] * targets.synthetic
        cameras = WeightedCameras(targets.cameras[::stride], weights[::stride], self.supervision.background)
        threads, progress = self.context.threads, self.context.stage("finetune").progress
        sensitivity = measure_sensitivity(
            splats, cameras, view_uncertainty=VIEW_UNCERTAINTY, threads=threads, progress=progress
        )
        return Costs.of(sensitivity, splats)

    def _key(self, plan: EncodingPlan, sh_degree: int) -> str:
        """Return the key of the work's checkpoint: equal only for equal results."""
        targets, device = self.targets, self.context.device
        settings = f"{__version__} {device} {sh_degree} {self.settings.model_dump_json()} {plan.rd_lambda} "
        key = hashlib.sha256(f"{settings}{targets.synthetic} {targets.synthetic_per_epoch}".encode())
        for name, field in plan.fields.items():
            key.update(f"{name} {field.level_offset} {field.levels.shape} {field.table.shape}".encode())
            for array in (field.levels, field.table, np.asarray(field.level_stride)):
                key.update(array.tobytes())
        for array in (plan.codebook.labels, plan.classes, plan.grid.mask):
            key.update(array.tobytes())
        for name in Costs.__slots__ if plan.costs is not None else ():
            key.update(getattr(plan.costs, name).tobytes())
        if (tables := self.container.tables) is not None:
            key.update(tables.opacity_logits.tobytes() + f"{tables.first_drawn} {tables.last_drawn}".encode())
        for camera, image, level in zip(targets.cameras, targets.images, targets.backgrounds, strict=True):
            key.update(f"{image.shape} {image.dtype} {camera.dilation}".encode())
            key.update(camera.viewmat.tobytes() + camera.K.tobytes() + image.tobytes() + level.tobytes())
        for name in ATTRIBUTES:
            key.update(getattr(self.original, name).tobytes())
        key.update(b"antialiased" * self.original.antialiased)
        return key.hexdigest()


def _lr_schedule(settings: FinetuneSettings, targets: TrainingTargets) -> LrSchedule:
    """Return learning rates, those of 3DGS or exponentially falling ones, and quadratic attraction that grows in the
    second half. A rate of 3DGS for SH is right for codebook entries: Adam makes equal steps of equal gradients, so the
    mean of an entry's Gaussians moves as each of them."""
    if settings.lr_offset is not None:
        base = {name: BASE_LR[attribute] for name, attribute in zip(FIELDS, ATTRIBUTES_OF_FIELDS, strict=True)}
        base |= {"means": targets.extent * base["means"], **{table_name(name): base[name] for name in TABLES}}
        learning_rates = continued_lr(base, settings.lr_offset, settings.steps)
    else:
        scale = 1.0 if targets.target_source == "photos" else settings.synthetic_lr_scale
        base = {name: scale * (settings.codebook_lr if name == "f_rest_centroids" else settings.lr) for name in FIELDS}
        base |= {table_name(name): TABLE_LR * scale * settings.lr for name in TABLES}
        learning_rates = exponential_lr(base, dict.fromkeys(base, 1.0), dict.fromkeys(base, settings.final_lr_scale))

    def rates(done: float) -> dict[str, float]:
        growing = max(done - ATTRACTION_START, 0.0) / (1 - ATTRACTION_START)
        return {**learning_rates(done), "attraction": settings.attraction * growing}

    return rates


@dataclass(frozen=True, slots=True)
class _Result:
    """Bytes of a container as a zip, and PSNR (decibels) and mean squared error of its renderings."""

    bytes: int
    psnr: float
    error: float

    def cost(self, rd_lambda: float) -> float:
        """Return the error plus lambda times bits."""
        return self.error + 8 * self.bytes * rd_lambda
