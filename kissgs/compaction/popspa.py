"""POPSpa: score and prune, fit while opacities are made sparse, score and prune again, fit (KISS-GS, section 3.1)."""

from __future__ import annotations

import hashlib
import itertools
import json
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from kissgs._version import __version__
from kissgs.cameras.captures.files import open_file
from kissgs.cameras.virtual.scene_bounds import scene_bounds
from kissgs.compaction.evaluate import evaluate_scene
from kissgs.compaction.result import Compacted, CompactionReport, CompactionStep
from kissgs.compaction.scoring import prune_by_score
from kissgs.core.array_types import Float32, Int
from kissgs.core.errors import OutputError
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import ATTRIBUTES, Splats
from kissgs.rendering.rasterizer import Device, load_kernels
from kissgs.settings import CompactSettings
from kissgs.training.checkpoint import Checkpoint
from kissgs.training.supervision import SupervisionViews

if TYPE_CHECKING:
    from kissgs.training.loop import LrSchedule
    from kissgs.training.model import GaussianModel
    from kissgs.training.targets import TrainingTargets

MEANS_RATE = 1.6e-4
RATES = {"scales": 5e-3, "opacities": 5e-2, "quats": 1e-3, "sh0": 2.5e-3, "shN": 1.25e-4}
"""Learning rates of 3DGS; that of a mean is in units of the extent of the cameras about it."""

ONE_PLACE = 1e-4
"""Extent of cameras, in radii of the scene, that tells of rounding, or of a camera that only turned."""

UNSEEN = {True: 0.05, False: 0.3}
"""Least score, in units of what a camera nearby would find: where a capture says who looks from where, and where none
does."""

State = Mapping[str, np.ndarray]


def popspa(
    splats: Splats,
    count: int,
    settings: CompactSettings,
    supervision: SupervisionViews,
    *,
    reference: Splats | None = None,
    targets: TrainingTargets | None = None,
    judges: bool = False,
    checkpoint: Path | None = None,
    threads: int = 0,
    device: Device = "cpu",
    progress: Progress = silent,
) -> Compacted:
    """Bring a clean scene down to exactly ``count`` Gaussians.

    Args:
        splats: the scene.
        count: at least 1, and no more than it has.
        settings: of the recipe; their budget is not looked at.
        supervision: views to score by, to learn from and to judge by.
        reference: what the pictures should show where there are no photographs; by default the scene itself.
        targets: pictures from the school's views for training, if they are at hand.
        judges: measure PSNR, SSIM and bytes after every step.
        checkpoint: file to keep the state in, every half minute of training. If there is one of this very work, it is
            taken up where it was left, and ends (on the processor) as if it had never been interrupted. It stays when
            all is done: whoever has written the result elsewhere may delete it.
        threads: 0 means one per processor; the result does not depend on it.
        device: where it is trained; ``"cuda"`` needs the extra ``kissgs[cuda]``, and adds up in an order of chance: no
            two results are quite the same. Scores are always the processor's.
        progress: receives "kernels", "score", "targets", "sparsify", "refine" and "evaluate".

    Raises:
        InvalidViewsError: a photograph cannot be read.
        OutputError: ``checkpoint`` is of other work, or cannot be written.
        UnsupportedError: there is no torch to train with; a picture would take too much memory.
    """
    reference = reference or splats
    key = "" if checkpoint is None else _key((splats, reference), count, settings, supervision, judges, device)
    kept = Checkpoint(checkpoint, key)
    found = _Recipe(
        splats, count, settings, supervision, reference, targets, judges, kept, threads, device, progress
    ).run()
    return replace(found, checkpoint=checkpoint) if settings.trains else found


def _key(
    scenes: Sequence[Splats],
    count: int,
    settings: CompactSettings,
    supervision: SupervisionViews,
    judges: bool,
    device: Device,
) -> str:
    """Of the work: equal only where the result is equal."""
    told = f"{__version__} {count} {judges} {device} {settings.model_dump_json()} {supervision.background}"
    key = hashlib.sha256(told.encode())
    for view in (*supervision.train, *supervision.score, *supervision.test):
        camera = view.camera
        key.update(camera.viewmat.tobytes() + camera.K.tobytes() + f"{camera.width} {camera.height}".encode())
        key.update(f"{view.background} {view.undistortion}".encode())
        if view.photo is not None:
            with open_file(view.photo) as (file, _):
                key.update(file.read())
    for scene, name in itertools.product(scenes, ATTRIBUTES):
        key.update(getattr(scene, name).tobytes())
    return key.hexdigest()


@dataclass(frozen=True, slots=True)
class _Phase:
    """Of training: so many steps, after which all but ``count`` Gaussians go."""

    name: str
    steps: int
    count: int


@dataclass(slots=True, eq=False)
class _Recipe:
    """One compaction: where it stands is in ``model``, ``index`` and ``steps``."""

    splats: Splats
    count: int
    settings: CompactSettings
    supervision: SupervisionViews
    reference: Splats
    targets: TrainingTargets | None
    judges: bool
    checkpoint: Checkpoint
    threads: int
    device: Device
    progress: Progress
    index: Int[np.ndarray, " M"] = field(init=False)
    model: GaussianModel = field(init=False)
    steps: list[CompactionStep] = field(init=False, default_factory=list)
    since: float = field(init=False, default_factory=time.perf_counter)
    note: str = field(init=False, default="")

    def __post_init__(self) -> None:
        self.index = np.arange(len(self.splats))

    def run(self) -> Compacted:
        """All steps, or those that a checkpoint has left."""
        load_kernels(self.progress)
        phases = list(self._phases())
        if not phases:
            self._done("input", self.splats)
            scene = self.splats.select(self._prune(self.splats, self.count, self.progress))
            self._done("prune", scene)
            return self._result(scene, "nothing")
        targets = self.targets or self._look()
        begun, done, state = self._begin(targets)
        for number in range(begun, len(phases)):
            self._train(phases, number, done, state, targets)
            done, state = 0, {}
        self._save(len(phases), 0, {})
        return self._result(self.model.splats(), targets.target_source)

    def _phases(self) -> Iterator[_Phase]:
        chosen = self.settings
        if chosen.sparsify_steps:
            rounds = min(chosen.prune_rounds, chosen.sparsify_steps)
            first, shares = self._first_count(), np.arange(1, rounds + 1) / rounds
            counts = np.rint(first * (self.count / first) ** shares).astype(int)
            edges = np.rint(chosen.sparsify_steps * np.concatenate([[0], shares])).astype(int)
            for steps, count in zip(np.diff(edges), counts, strict=True):
                yield _Phase("sparsify", int(steps), int(count))
        if chosen.refine_steps:
            yield _Phase("refine", chosen.refine_steps, self.count)

    def _first_count(self) -> int:
        """How many the first pruning leaves."""
        share = self.settings.initial_prune_fraction if self.settings.sparsify_steps else 1.0
        return round(len(self.splats) * (self.count / len(self.splats)) ** share)

    def _look(self) -> TrainingTargets:
        from kissgs.training.targets import training_targets

        supervision = self.supervision
        return training_targets(
            *(self.reference, supervision.train, supervision.background),
            threads=self.threads,
            device=self.device,
            progress=self.progress,
        )

    def _begin(self, targets: TrainingTargets) -> tuple[int, int, State]:
        """Prune for a start, or take up what was left: number of the phase, steps of it that are done, its state."""
        from kissgs.training.model import GaussianModel

        state = self.checkpoint.load()
        if state is not None:
            told = json.loads(state["told"].tobytes())
            self.index = state["index"]
            self.model = GaussianModel.restored(state, self.device, self._reach(targets))
            self.steps = [CompactionStep(**step) for step in told["steps"]]
            self.since -= told["seconds"]
            return told["phase"], told["done"], state
        self._done("input", self.splats)
        scene = self.splats.select(self._prune(self.splats, self._first_count(), self.progress))
        self._done("prune", scene)
        self.model = GaussianModel(scene, self.device, self._reach(targets))
        self._save(0, 0, {})  # if that cannot be, it is better known before the work than after
        return 0, 0, {}

    def _prune(self, scene: Splats, count: int, progress: Progress) -> Int[np.ndarray, " M"]:
        """Which to keep."""
        chosen = prune_by_score(
            scene,
            self.supervision.score,
            self.supervision.background,
            count,
            min_keep_per_scoring=self.settings.min_keep_per_scoring,
            min_score=UNSEEN[self.supervision.captured],
            threads=self.threads,
            progress=progress,
        )
        self.index = self.index[chosen]
        return chosen

    def _train(self, phases: list[_Phase], number: int, done: int, state: State, targets: TrainingTargets) -> None:
        """One phase from a step of it on, and the pruning after it."""
        from kissgs.compaction.regularizers import ShapeRegularizer
        from kissgs.compaction.sparsify import AdmmSparsifier
        from kissgs.training.loop import Regularizer, TrainingPlan, train

        phase, chosen, wishes = phases[number], self.settings, list[Regularizer]()
        progress = self._within(phases, number)
        if chosen.erank_weight or chosen.min_scale_weight:
            wishes.append(ShapeRegularizer(chosen.erank_weight, chosen.min_scale_weight, self._extent(targets)))
        sparsity = None
        if phase.name == "sparsify" and chosen.admm_rho:
            sparsity = AdmmSparsifier(self.model.parameters["opacities"], phase.count, chosen.admm_rho, chosen.admm_interval)
            wishes.append(sparsity)
            if "z" in state:  # not where the phase had not begun
                sparsity.restore(state)

        def after(step: int) -> None:
            if self.checkpoint.due:
                self._save(number, step, {} if sparsity is None else sparsity.state())

        plan = TrainingPlan(
            stage=phase.name,
            steps=phase.steps,
            rates=self._rates(phase, targets),
            ssim_weight=chosen.ssim_weight,
            seed=(chosen.seed, number),
            regularizers=tuple(wishes),
        )
        train(self.model, targets, plan, first=done, after=after, threads=self.threads, progress=progress)
        scene = self.model.splats()
        self._done(phase.name, scene)
        if len(scene) > phase.count:
            self.model.keep(self._prune(scene, phase.count, progress))
            self._done("prune", self.model.splats())

    def _extent(self, targets: TrainingTargets) -> float:
        """By which lengths are measured: the cameras', or the scene's where all cameras stand in one place, about."""
        radius = scene_bounds(self.splats).radius
        return targets.extent if targets.extent > ONE_PLACE * radius else radius

    def _reach(self, targets: TrainingTargets) -> Float32[np.ndarray, " M"]:
        """How far apart the cameras about each Gaussian that is left stand, by where the scene has it."""
        return targets.local_extents(self.splats.means[self.index], self._extent(targets))

    def _within(self, phases: list[_Phase], number: int) -> Progress:
        """Tells of all phases of one name as of one stage, with the prunings between them."""
        name = phases[number].name
        before = sum(phase.steps for phase in phases[:number] if phase.name == name)
        total = sum(phase.steps for phase in phases if phase.name == name)

        def receive(stage: str, fraction: float, note: str = "") -> None:
            done = phases[number].steps * (fraction if stage == name else 1.0)
            self.progress(name, (before + done) / total, note)

        return receive

    def _rates(self, phase: _Phase, targets: TrainingTargets) -> LrSchedule:
        """Rates stay while Gaussians go, and fall exponentially, as 3DGS has it for the means, in the refinement."""
        from kissgs.training.loop import exponential_lr

        chosen = self.settings
        base = {"means": MEANS_RATE, **RATES}
        if targets.target_source == "renderings":
            base = {name: rate * chosen.synthetic_lr_scale for name, rate in base.items()}
        begin = {name: chosen.means_lr_scale if name == "means" else chosen.lr_scale for name in base}
        end = {name: chosen.final_means_lr_scale if name == "means" else chosen.final_lr_scale for name in base}
        return exponential_lr(base, begin, end if phase.name == "refine" else begin)

    def _save(self, number: int, done: int, extra: State) -> None:
        told = {
            "phase": number,
            "done": done,
            "seconds": time.perf_counter() - self.since,
            "steps": [asdict(step) for step in self.steps],
        }
        words = np.frombuffer(json.dumps(told).encode(), np.uint8)
        state = {**self.model.state(), **extra, "index": self.index, "told": words}
        try:
            self.checkpoint.save(state)
        except OutputError as error:
            if not (number or done):
                raise
            self.note = f"the work went on without a checkpoint: {error}"

    def _done(self, name: str, scene: Splats) -> None:
        """Note a step: what it took, and if asked for, what it gave."""
        seconds = time.perf_counter() - self.since
        likeness, size = None, None
        if self.judges:
            likeness, size = evaluate_scene(scene, self.reference, self.supervision, self.threads, self.progress)
        self.steps.append(
            CompactionStep(
                name=name,
                count=len(scene),
                seconds=seconds,
                psnr=None if likeness is None else likeness.psnr,
                ssim=None if likeness is None else likeness.ssim,
                bytes=size,
            )
        )
        self.since = time.perf_counter()

    def _result(self, scene: Splats, target_source: str) -> Compacted:
        report = CompactionReport(
            source_count=len(self.splats),
            count=len(scene),
            target_source=target_source,
            source=self.supervision.source,
            steps=tuple(self.steps),
            note="; ".join(filter(None, [self.supervision.note, self.note])),
        )
        return Compacted(scene, self.index, report)
