"""What each part of the codec is worth: left out, one at a time, on a scene of the user's.

Three tables. The first repeats that of KISS-GS (bicycle, 262,144 Gaussians): its codec with one part left out, whether
a container could be so or not. The second replaces a choice of the preset ``paper`` by one of ours, the third leaves
out one of ours; both are changes of settings, and ordinary containers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from kissgs.benchmark import paper_ablation as recoding
from kissgs.benchmark.bd_rate import RateCurve, at_fidelity
from kissgs.benchmark.roundtrip import RoundTrip, isolated_roundtrip
from kissgs.cameras.views import Views
from kissgs.core.errors import InvalidSceneError, UnsupportedError
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import clean
from kissgs.evaluation.cameras import evaluation_views
from kissgs.evaluation.evaluate import compare_images
from kissgs.evaluation.results import Comparison
from kissgs.pipeline.scene_files import load
from kissgs.settings import EncodeSettings, Preset, Settings

PUBLISHED_BYTES = 3_877_944
"""Of KISS-GS' container of bicycle with all its parts."""

REACH = 2.5
"""Fidelities by which the curve that tells bytes at equal PSNR goes beyond that of the preset, on either side."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """A part of KISS-GS' codec.

    Attributes:
        name: for people.
        leave_out: how it is left out.
        bytes: what leaving it out costs on bicycle, published.
        psnr: the same, decibels to photographs; None where none is published.
        of_sh: whether it means something only where there is SH.
    """

    name: str
    leave_out: recoding.LeaveOut
    bytes: int
    psnr: float | None = None
    of_sh: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Variant:
    """Other settings.

    Attributes:
        changes: of the encoder.
        captured: whether it means something only where there is a capture.
    """

    changes: Mapping[str, Any]
    captured: bool = False

    @property
    def name(self) -> str:
        """As ``--set`` has it."""
        return ", ".join(f"{name}={_spelled(value)}" for name, value in self.changes.items())

    def of(self, settings: Settings) -> Settings:
        """The settings, so changed."""
        encode = EncodeSettings(**{**settings.encode.model_dump(), **self.changes})
        return settings.model_copy(update={"encode": encode})


PARTS = (
    Part(name="levels of the SH codebook", leave_out=recoding.codebook_levels, of_sh=True, bytes=4_042_523),
    Part(name="SH codebook", leave_out=recoding.sh_codebook, of_sh=True, bytes=3_434_816, psnr=0.23),
    Part(name="WebP", leave_out=recoding.webp, bytes=3_030_148),
    Part(name="levels of rotations", leave_out=recoding.as_floats("quats", "quaternions"), bytes=2_548_718),
    Part(name="levels of base colours", leave_out=recoding.as_floats("sh0", "f_dc"), bytes=2_084_291),
    Part(name="levels of sizes", leave_out=recoding.as_floats("scales", "scales"), bytes=1_966_415),
    Part(
        name="levels of positions",
        leave_out=recoding.as_floats("means", "means_bytes_0", "means_bytes_1"),
        bytes=1_392_843,
    ),
    Part(name="order (PLAS)", leave_out=recoding.scene_order, bytes=614_851),
    Part(name="levels of opacities", leave_out=recoding.as_floats("opacities", "opacities"), bytes=609_117),
    Part(name="forms (PRAS), 256 levels", leave_out=recoding.forms(255), bytes=161_748, psnr=0.01),
    Part(name="order of the codebook", leave_out=recoding.codebook_order, of_sh=True, bytes=42_416),
    Part(name="labels as column and row", leave_out=recoding.label_pairs, of_sh=True, bytes=12_142),
    Part(name="mask: pruned to a square", leave_out=recoding.mask, bytes=3_344, psnr=-0.115),
    Part(name="forms (PRAS), 100 levels", leave_out=recoding.forms(99), bytes=-11_810, psnr=-0.110),
    Part(name="logarithm of positions", leave_out=recoding.signed_log, bytes=-519_272, psnr=-7.55),
)

OURS_IN_PAPER = (
    Variant(changes={"order": "hilbert"}),
    Variant(changes={"rotation_form": "canonical"}),
    Variant(changes={"shared_step_size": True}),
    Variant(changes={"sh_weight_power": 0.35}),
    Variant(changes={"prune_invisible": True}),
    Variant(changes={"plas_radius_decay": 0.8}),
    Variant(changes={"webp_quality": 50, "webp_method": 2}),
)

OURS_LEFT_OUT = (
    Variant(changes={"rate_distortion": False}),
    Variant(changes={"rdo_quantization": False}),
    Variant(changes={"step_classes": 1}),
    Variant(changes={"prune_threshold_bits": 0.0}),
    Variant(changes={"color_refit_iterations": 0}, captured=True),
    Variant(changes={"view_uncertainty": 0.0}),
    Variant(changes={"sensitivity_views": 12}),
    Variant(changes={"order": "plas"}),
    Variant(changes={"rotation_form": "pras"}),
    Variant(changes={"sh_kmeans_iterations": 1, "sh_nprobe": 6}),
    Variant(changes={"codebook_max_effort": False}),
    Variant(changes={"webp_quality": 50, "webp_method": 2}),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Ablated:
    """One row.

    Attributes:
        table: "KISS-GS", or the preset that was changed.
        name: what was left out or changed; "nothing" in the first row of each table.
        bytes: of all files.
        change: of bytes, as a share of the first row's.
        psnr: decibels to the scene's own pictures.
        psnr_change: of that.
        photo_psnr: decibels to photographs; None without any.
        photo_change: of that.
        equal_change: of bytes at equal ``psnr``, as a share; None where it is not known.
        cpu_seconds: of encoding; None where there is no such encoder.
        published_change: of bytes, as KISS-GS has it for its own scene; None where it has not.
        published_psnr: of PSNR to photographs, likewise.
    """

    table: str
    name: str
    bytes: int
    change: float
    psnr: float
    psnr_change: float
    photo_psnr: float | None
    photo_change: float | None
    equal_change: float | None = None
    cpu_seconds: float | None = None
    published_change: float | None = None
    published_psnr: float | None = None

    def as_dict(self) -> dict[str, Any]:
        """By name."""
        return asdict(self)


def ablate(
    scene: Path,
    presets: Sequence[Settings],
    views: Views | None = None,
    *,
    threads: int = 0,
    progress: Progress = silent,
) -> list[Ablated]:
    """Leave out, one by one, what these presets have.

    Args:
        scene: a ``.ply``.
        presets: ``paper``, and such as weigh bits.
        views: a capture, whose cameras weigh bits and whose held-out views are compared; by default drawn
            ones are compared.
        threads: 0 means one per processor.
        progress: receives "measure", with what is left out as a note.

    Raises:
        InvalidSceneError: the scene cannot be read, or has no Gaussian.
        UnsupportedError: another preset, or a measurement was killed.
    """
    for settings in presets:
        if settings.preset != Preset.PAPER and not settings.encode.rate_distortion:
            raise UnsupportedError(f"--ablate leaves parts of paper, balanced or small out, not of {settings.preset}")
    study = _Study(scene, views, threads, progress)
    for settings in presets:
        if settings.encode.rate_distortion:
            study.weighed(settings)
        else:
            study.published(settings)
            study.paper(settings)
    return study.rows


@dataclass
class _Study:
    """Rows so far, and what they share."""

    scene: Path
    views: Views | None
    threads: int
    progress: Progress
    rows: list[Ablated] = field(default_factory=list)

    def published(self, settings: Settings) -> None:
        """The table of KISS-GS."""
        splats, _ = clean(load(self.scene, threads=self.threads, progress=self.progress))
        if not len(splats):
            raise InvalidSceneError(f"{self.scene} has no usable Gaussian")
        judges = self.views or evaluation_views(splats, threads=self.threads, progress=self.progress)

        def row(name: str, coded: recoding.Coded, **told: float | None) -> Ablated:
            mean = compare_images(splats, coded.decoded, judges, threads=self.threads).mean
            return _row("KISS-GS", name, coded.size(settings.encode, self.threads), mean, base, **told)

        self.progress("measure", 0.0, "KISS-GS")
        base = None
        whole = recoding.coded(splats, settings.encode, self.threads)
        base = row("nothing", whole)
        self.rows.append(base)
        parts = [part for part in PARTS if splats.sh_degree or not part.of_sh]
        for number, part in enumerate(parts):
            self.progress("measure", number / len(parts), part.name)
            coded = part.leave_out(whole, settings.encode, self.threads)
            told = {"published_change": part.bytes / PUBLISHED_BYTES, "published_psnr": part.psnr}
            self.rows.append(row(part.name, coded, **told))

    def paper(self, settings: Settings) -> None:
        """Ours for theirs."""
        self.vary(settings, OURS_IN_PAPER, None)

    def weighed(self, settings: Settings) -> None:
        """Without ours; bytes at equal PSNR by the preset's own curve."""
        points = []
        for step in (-REACH, REACH):
            at = at_fidelity(settings, min(max(settings.encode.quality_offset_db + step, -30), 30))
            result, mean = self.measure(at, f"{settings.preset} at {at.encode.quality_offset_db:g}")
            points.append((mean.candidate_vs_reference.psnr, float(result.report.container_bytes)))
        self.vary(settings, OURS_LEFT_OUT, points)

    def vary(
        self, settings: Settings, variants: Sequence[Variant], points: Sequence[tuple[float, float]] | None
    ) -> None:
        """A preset, and that with every change."""
        base, curve = None, None
        every = [Variant(changes={}), *(each for each in variants if self.views is not None or not each.captured)]
        for variant in every:
            name = variant.name or "nothing"
            result, mean = self.measure(variant.of(settings), f"{settings.preset}: {name}")
            size, equal = result.report.container_bytes, None
            if base is None and points is not None:
                curve = RateCurve.of([*points, (mean.candidate_vs_reference.psnr, size)])
            at = None if curve is None else curve.bytes_at(mean.candidate_vs_reference.psnr)
            if at is not None:
                equal = size / at - 1
            told = {"equal_change": equal, "cpu_seconds": result.report.cpu_seconds}
            row = _row(str(settings.preset), name, size, mean, base, **told)
            base = base or row
            self.rows.append(row)

    def measure(self, settings: Settings, note: str) -> tuple[RoundTrip, Comparison]:
        """In a process of its own."""
        self.progress("measure", 0.0, note)
        result = isolated_roundtrip(self.scene, settings, pictures=True, views=self.views, threads=self.threads)
        if result.pictures is None:
            raise InvalidSceneError(f"{self.scene} has no pictures to compare")
        return result, result.pictures.mean


def _row(table: str, name: str, size: int, mean: Comparison, base: Ablated | None, **told: float | None) -> Ablated:
    """Beside the first row of its table; None is that row itself."""
    psnr, photo = mean.candidate_vs_reference.psnr, None if mean.reference is None else mean.candidate.psnr
    photo_base = None if base is None else base.photo_psnr
    return Ablated(
        table=table,
        name=name,
        bytes=size,
        change=0.0 if base is None else size / base.bytes - 1,
        psnr=psnr,
        psnr_change=0.0 if base is None else psnr - base.psnr,
        photo_psnr=photo,
        photo_change=None if photo is None else photo - (photo if photo_base is None else photo_base),
        **told,
    )


def _spelled(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else f"{value:g}" if isinstance(value, float) else str(value)
