"""Fine-tuning: from a container as it was chosen to a better one of the same layout (KISS-GS, appendix)."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
import torch

from kissgs._version import __version__
from kissgs.cameras.views import Views
from kissgs.core.errors import OutputError
from kissgs.core.progress import Progress, as_stage, silent
from kissgs.core.splats import ATTRIBUTES, Splats, clean
from kissgs.evaluation.evaluate import evaluate
from kissgs.finetuning.losses import CodeLength, Smoothness
from kissgs.finetuning.quantized_scene import FIELDS, QuantizedScene
from kissgs.finetuning.result import FinetuneReport
from kissgs.planning.encoding_plan import EncodingPlan
from kissgs.planning.rd_model import Costs, implied_lambda
from kissgs.rendering.differentiable import rasterize
from kissgs.rendering.losses import photometric_loss
from kissgs.rendering.rasterizer import Device
from kissgs.rendering.sensitivity import WeightedCameras, measure_sensitivity
from kissgs.settings import FinetuneSettings
from kissgs.sogxt.container import zip_bytes
from kissgs.sogxt.decode import MAX_GAUSSIANS, decode
from kissgs.sogxt.encode import Encoded
from kissgs.training.checkpoint import Checkpoint
from kissgs.training.loop import Plan, Rates, exponential_lr, threads_of_torch, train
from kissgs.training.supervision import SupervisionViews, supervision_views
from kissgs.training.targets import TrainingTargets, training_targets

WATCHED = 64
"""TrainingTargets from which costs of errors are told, about."""

HEDGE = 0.1
"""How little they say of other places, see :class:`kissgs.Sensitivity`."""

LOOKS = 16
"""TrainingTargets from which the loss at the beginning is told."""

SETTLE = 0.5
"""Share of the steps after which levels begin to settle."""

NO_HELP = "fine-tuning did not help; the container is as it was without it"

Write = Callable[[EncodingPlan, int, Progress], Encoded]
"""The files that show a choice, which became better in so many steps; and who is told of it."""


@dataclass(frozen=True, slots=True, eq=False)
class Tuner:
    """Improves choices for one scene.

    Attributes:
        original: the scene as it was, clean: the teacher where there are no photographs.
        settings: how.
        supervision: views to learn from, and to judge by.
        targets: what they should show.
        device: where it is trained.
        threads: 0 means one per processor; the result does not depend on it.
        progress: receives "finetune", and then what writing tells.
    """

    original: Splats
    settings: FinetuneSettings
    supervision: SupervisionViews
    targets: TrainingTargets
    device: Device
    threads: int
    progress: Progress

    @classmethod
    def of(
        cls,
        original: Splats,
        settings: FinetuneSettings,
        views: Views | None,
        *,
        device: Device = "cpu",
        threads: int = 0,
        progress: Progress = silent,
    ) -> Tuner:
        """With the photographs of ``views``, or with pictures of the original from virtual cameras.

        Raises:
            InvalidViewsError: a photograph cannot be read.
            UnsupportedError: a picture would take too much memory.
        """
        found = supervision_views(original, views, settings, scored=0, threads=threads, progress=progress)
        taught = training_targets(
            *(original, found.train, found.background), threads=threads, device=device, progress=progress
        )
        return cls(original, settings, found, taught, device, threads, progress)

    def __call__(
        self, choice: EncodingPlan, start: EncodingPlan, scene: Splats, write: Write, checkpoint: Path | None = None
    ) -> tuple[Encoded, FinetuneReport]:
        """Fine-tune, and keep what is better: the container as it was chosen, or the new one.

        Args:
            choice: of at least one Gaussian.
            start: what is trained: the same, or one of fewer Gaussians, of at least one.
            scene: for which they were made.
            write: makes the files, and tells of it.
            checkpoint: file to keep the state in, every half minute. If there is one of this very work, it is taken up
                where it was left.

        Raises:
            InvalidViewsError: a photograph cannot be read.
            OutputError: ``checkpoint`` is of other work.
        """
        begun = time.perf_counter()
        at_first = as_stage("finetune", self.progress)
        before = write(choice, 0, at_first)
        first = self._judge(before, at_first)
        rd_lambda = choice.rd_lambda or implied_lambda(
            self._rounding(before, scene, at_first), int(choice.grid.mask.sum())
        )
        better, trouble = self._train(start, scene.sh_degree, start.rd_lambda or rd_lambda, checkpoint)
        after = write(better, self.settings.steps, self.progress)
        second = self._judge(after, self._at_last)
        cost, new_cost = (told.error + 8 * told.bytes * rd_lambda for told in (first, second))
        kept = new_cost < cost
        report = FinetuneReport(
            steps=self.settings.steps,
            target_source=self.targets.target_source,
            source=self.supervision.source,
            psnr_before=first.psnr,
            psnr_after=second.psnr,
            bytes_before=first.bytes,
            bytes_after=second.bytes,
            kept=kept,
            seconds=time.perf_counter() - begun,
            note="; ".join(filter(None, [self.supervision.note, "" if kept else NO_HELP, trouble])),
        )
        return (after if kept else before), report

    def _at_last(self, stage: str, fraction: float, note: str = "") -> None:
        self.progress("images", 1.0)

    def _judge(self, encoded: Encoded, progress: Progress) -> _Mark:
        decoded = decode(encoded.files, max_gaussians=max(len(self.original), MAX_GAUSSIANS), threads=self.threads)
        compared = evaluate(
            *(self.original, decoded, self.supervision.eval_views),
            device=self.device,
            threads=self.threads,
            progress=progress,
        )
        return _Mark(
            bytes=len(zip_bytes(encoded.files)),
            psnr=compared.mean.candidate.psnr,
            error=float(np.mean([_squared(view.comparison.candidate.psnr) for view in compared.views])),
        )

    def _rounding(self, encoded: Encoded, scene: Splats, progress: Progress) -> float:
        """Squared error by which pictures of a container differ from those of the scene that it was made of."""
        decoded = decode(encoded.files, max_gaussians=max(len(scene), MAX_GAUSSIANS), threads=self.threads)
        compared = evaluate(
            *(scene, decoded, self.supervision.eval_views), device=self.device, threads=self.threads, progress=progress
        )
        return float(np.mean([_squared(view.comparison.candidate_vs_reference.psnr) for view in compared.views]))

    def _train(
        self, choice: EncodingPlan, sh_degree: int, rd_lambda: float, path: Path | None
    ) -> tuple[EncodingPlan, str]:
        """A better choice, and what went wrong with the checkpoint on the way to it."""
        chosen, work = self.settings, QuantizedScene(choice, sh_degree, self.device)
        kept, done, trouble = Checkpoint(path, "" if path is None else self._key(choice, sh_degree)), 0, ""
        steepness = self._steepness(work)
        work.hang(choice.costs or self._costs(work), steepness)
        lengths = CodeLength(work, chosen.rate_weight * rd_lambda * steepness)
        state = kept.load()
        if state is not None:
            done = int(state["done"])
            work.restore(state)
            lengths.restore(state)

        def after(step: int) -> None:
            nonlocal trouble
            if kept.due or (path is not None and step == chosen.steps):
                try:
                    kept.save(_state(work, lengths, step))
                except OutputError as error:
                    trouble = f"the work went on without a checkpoint: {error}"

        plan = Plan(
            stage="finetune",
            steps=chosen.steps,
            rates=_rates(chosen, self.targets),
            ssim_weight=chosen.ssim_weight,
            seed=(chosen.seed,),
            regularizers=(lengths, Smoothness(work, chosen.tv_weight, chosen.steps)),
            batch=chosen.batch,
        )
        train(work, self.targets, plan, first=done, after=after, threads=self.threads, progress=self.progress)
        return work.choice(), trouble

    def _steepness(self, work: QuantizedScene) -> float:
        """How much the loss grows with the mean squared error of pictures.

        As if it were proportional to its root, which holds for errors that come on top of those of photographs.
        """
        losses, errors = [], []
        with torch.no_grad(), threads_of_torch(1):  # its sums depend on them
            shown = work.gaussians()
            for n in islice(self.targets.order((self.settings.seed,)), min(LOOKS, len(self.targets))):
                self.progress("finetune", 0.0)
                camera = self.targets.cameras[n]
                target = torch.from_numpy(self.targets.picture(n))[None].to(shown["means"].device)
                image, _ = rasterize(
                    **shown,
                    viewmats=torch.from_numpy(camera.viewmat)[None],
                    Ks=torch.from_numpy(camera.K)[None],
                    width=camera.width,
                    height=camera.height,
                    backgrounds=torch.from_numpy(self.targets.background)[None],
                    threads=self.threads,
                )
                loss = photometric_loss(image, target, ssim_weight=self.settings.ssim_weight, threads=self.threads)
                losses.append(float(loss))
                errors.append(float((image - target).square().mean()))
        return float(np.mean(losses)) / (2 * max(float(np.mean(errors)), 1e-10))

    def _costs(self, work: QuantizedScene) -> Costs:
        """What errors of the Gaussians cost in the pictures that are learned from, where nobody has looked before."""
        with torch.no_grad():
            scene = clean(Splats(**{name: value.cpu().numpy() for name, value in work.gaussians().items()}))[0]
        cameras = self.targets.cameras[:: max(1, len(self.targets) // WATCHED)]
        watch = WeightedCameras(cameras, [1.0] * len(cameras), self.targets.background)
        progress = as_stage("finetune", self.progress)
        return Costs.of(
            measure_sensitivity(scene, watch, view_uncertainty=HEDGE, threads=self.threads, progress=progress), scene
        )

    def _key(self, choice: EncodingPlan, sh_degree: int) -> str:
        """Of the work: equal only where the result is equal."""
        taught = self.targets
        told = f"{__version__} {self.device} {sh_degree} {self.settings.model_dump_json()} {choice.rd_lambda} "
        key = hashlib.sha256(f"{told}{taught.background}".encode())
        for name, field in choice.fields.items():
            key.update(f"{name} {field.top} {field.level_offset} {field.levels.shape}".encode())
            for array in (field.levels, field.low, field.high, np.asarray(field.level_stride)):
                key.update(array.tobytes())
        for array in (choice.codebook.labels, choice.classes, choice.grid.mask):
            key.update(array.tobytes())
        for name in Costs.__slots__ if choice.costs is not None else ():
            key.update(getattr(choice.costs, name).tobytes())
        for camera, picture in zip(taught.cameras, taught.pictures, strict=True):
            key.update(f"{picture.shape} {picture.dtype}".encode())
            key.update(camera.viewmat.tobytes() + camera.K.tobytes() + picture.tobytes())
        for name in ATTRIBUTES:
            key.update(getattr(self.original, name).tobytes())
        return key.hexdigest()


def _rates(chosen: FinetuneSettings, targets: TrainingTargets) -> Rates:
    """Learning rates that fall exponentially, and springs that grow from nothing once most is learned."""
    share = 1.0 if targets.target_source == "photos" else chosen.synthetic_lr_scale
    base = {name: share * (chosen.codebook_lr if name == "f_rest_centroids" else chosen.lr) for name in FIELDS}
    learning = exponential_lr(base, dict.fromkeys(FIELDS, 1.0), dict.fromkeys(FIELDS, chosen.final_lr_scale))

    def rates(done: float) -> dict[str, float]:
        return {**learning(done), "spring": max(done - SETTLE, 0.0) / (1 - SETTLE)}

    return rates


def _state(work: QuantizedScene, lengths: CodeLength, done: int) -> dict[str, np.ndarray]:
    return {**work.state(), **lengths.state(), "done": np.asarray(done)}


@dataclass(frozen=True, slots=True)
class _Mark:
    """Of one container: bytes of its zip; PSNR and squared error of its pictures."""

    bytes: int
    psnr: float
    error: float


def _squared(psnr: float) -> float:
    return float(10 ** (-psnr / 10))
