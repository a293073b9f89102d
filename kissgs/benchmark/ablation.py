"""Ablation of the codec on a scene of the user: bytes and PSNR with one part left out or one setting changed.

Three tables. The first repeats the ablation table of the KISS-GS paper (bicycle, 262,144 Gaussians): its codec with one
part left out, also where no valid container results. The second changes one setting of the preset ``paper`` to the
value of the other presets; the third changes one setting of ``balanced`` or ``small`` back. Both make valid containers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from kissgs.benchmark import paper_ablation
from kissgs.benchmark.bd_rate import RateCurve, at_quality_offset
from kissgs.benchmark.roundtrip import RoundTrip, isolated_roundtrip
from kissgs.cameras.views import Views
from kissgs.core.errors import InvalidSceneError, UnsupportedError
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import clean
from kissgs.evaluation.cameras import evaluation_views
from kissgs.evaluation.capture_fit import in_scene_frame
from kissgs.evaluation.evaluate import compare_images
from kissgs.evaluation.results import Comparison
from kissgs.pipeline.scene_files import load
from kissgs.settings import EncodeSettings, Preset, Settings

PUBLISHED_BYTES = 3_877_944
"""Bytes of the paper's container of bicycle with all parts."""

CURVE_OFFSET_DB = 2.5
"""Distance of the two outer points of a preset's rate curve from its own quality offset, decibels."""

MAX_OFFSET_DB = 30.0
"""Largest absolute value of ``quality_offset_db``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """A part of the codec of the KISS-GS paper.

    Attributes:
        name: name in tables.
        leave_out: function that leaves it out.
        bytes: published growth of bicycle's container without it, bytes.
        psnr: published change of the PSNR to photographs, decibels; None if not published.
        needs_sh: whether it exists only in scenes with SH degree 1 or more.
    """

    name: str
    leave_out: paper_ablation.LeaveOut
    bytes: int
    psnr: float | None = None
    needs_sh: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Variant:
    """A change of encoder settings.

    Attributes:
        changes: new values by setting name.
        needs_capture: whether it has an effect only with a capture.
    """

    changes: Mapping[str, Any]
    needs_capture: bool = False

    @property
    def name(self) -> str:
        """The changes in the notation of ``--set``: ``NAME=VALUE``, separated by commas."""
        return ", ".join(f"{name}={_format_value(value)}" for name, value in self.changes.items())

    def apply(self, settings: Settings) -> Settings:
        """Return ``settings`` with these changes."""
        encode = EncodeSettings(**{**settings.encode.model_dump(), **self.changes})
        return settings.model_copy(update={"encode": encode})


PARTS = (
    Part(name="levels of the SH codebook", leave_out=paper_ablation.codebook_levels, needs_sh=True, bytes=4_042_523),
    Part(name="SH codebook", leave_out=paper_ablation.sh_codebook, needs_sh=True, bytes=3_434_816, psnr=0.23),
    Part(name="WebP", leave_out=paper_ablation.webp, bytes=3_030_148),
    Part(name="levels of rotations", leave_out=paper_ablation.as_floats("quats", "quaternions"), bytes=2_548_718),
    Part(name="levels of base colours", leave_out=paper_ablation.as_floats("sh0", "f_dc"), bytes=2_084_291),
    Part(name="levels of sizes", leave_out=paper_ablation.as_floats("scales", "scales"), bytes=1_966_415),
    Part(
        name="levels of positions",
        leave_out=paper_ablation.as_floats("means", "means_bytes_0", "means_bytes_1"),
        bytes=1_392_843,
    ),
    Part(name="order (PLAS)", leave_out=paper_ablation.scene_order, bytes=614_851),
    Part(name="levels of opacities", leave_out=paper_ablation.as_floats("opacities", "opacities"), bytes=609_117),
    Part(name="forms (PRAS), 256 levels", leave_out=paper_ablation.rotation_forms(255), bytes=161_748, psnr=0.01),
    Part(name="order of the codebook", leave_out=paper_ablation.codebook_order, needs_sh=True, bytes=42_416),
    Part(name="labels as column and row", leave_out=paper_ablation.label_pairs, needs_sh=True, bytes=12_142),
    Part(name="mask: pruned to a square", leave_out=paper_ablation.mask, bytes=3_344, psnr=-0.115),
    Part(name="forms (PRAS), 100 levels", leave_out=paper_ablation.rotation_forms(99), bytes=-11_810, psnr=-0.110),
    Part(name="logarithm of positions", leave_out=paper_ablation.signed_log, bytes=-519_272, psnr=-7.55),
)

PAPER_VARIANTS = (
    Variant(changes={"order": "hilbert"}),
    Variant(changes={"rotation_form": "canonical"}),
    Variant(changes={"shared_step_size": True}),
    Variant(changes={"sh_weight_power": 0.35}),
    Variant(changes={"prune_invisible": True}),
    Variant(changes={"plas_radius_decay": 0.8}),
    Variant(changes={"webp_quality": 50, "webp_method": 2}),
)
"""Changes of ``paper`` to choices of the other presets."""

RATE_DISTORTION_VARIANTS = (
    Variant(changes={"rate_distortion": False}),
    Variant(changes={"rdo_quantization": False}),
    Variant(changes={"step_classes": 1}),
    Variant(changes={"prune_threshold_bits": 0.0}),
    Variant(changes={"color_refit_iterations": 0}, needs_capture=True),
    Variant(changes={"view_uncertainty": 0.0}),
    Variant(changes={"sensitivity_views": 12}),
    Variant(changes={"order": "hilbert"}),
    Variant(changes={"order": "plas"}),
    Variant(changes={"rotation_form": "pras"}),
    Variant(changes={"sh_kmeans_iterations": 1, "sh_neighbors": 32}),
    Variant(changes={"codebook_max_effort": False}),
    Variant(changes={"webp_quality": 50, "webp_method": 2}),
)
"""Changes of presets with rate-distortion planning, each of which leaves out one of their choices."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AblationRow:
    """A row of an ablation table; changes are relative to the first row of the same table.

    Attributes:
        table: "KISS-GS", or the preset whose settings are changed.
        name: the part left out or the changed settings; "nothing" in the first row of each table.
        bytes: container size, bytes.
        bytes_change: relative change of ``bytes``; 0.1 means 10 % more.
        psnr: PSNR to renderings of the scene, decibels, mean over views.
        psnr_change: change of ``psnr``, decibels.
        photo_psnr: PSNR to photographs, decibels, mean over views; None without photographs.
        photo_psnr_change: change of ``photo_psnr``, decibels; None without photographs.
        equal_psnr_change: relative change of bytes at equal ``psnr``; None if unknown.
        cpu_seconds: CPU time of encoding, seconds; None in the table "KISS-GS", which has no real encoder.
        published_bytes_change: relative change of bytes that the paper reports for its scene; None if not published.
        published_psnr_change: change of the PSNR to photographs that the paper reports, decibels; None if not
            published.
    """

    table: str
    name: str
    bytes: int
    bytes_change: float
    psnr: float
    psnr_change: float
    photo_psnr: float | None
    photo_psnr_change: float | None
    equal_psnr_change: float | None = None
    cpu_seconds: float | None = None
    published_bytes_change: float | None = None
    published_psnr_change: float | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return all attributes by name, for JSON."""
        return asdict(self)


def ablate(
    scene: Path,
    presets: Sequence[Settings],
    views: Views | None = None,
    *,
    threads: int = 0,
    progress: Progress = silent,
) -> list[AblationRow]:
    """Measure these presets with one part left out or one setting changed at a time.

    Args:
        scene: a ``.ply`` file.
        presets: settings of ``paper`` or of presets with rate-distortion planning.
        views: capture for rate-distortion planning and, by its held-out views, for the evaluation; None to evaluate
            with cameras drawn over the whole scene.
        threads: number of threads; 0 means one per processor.
        progress: receives the stage "measure" with the part or the change as a note.

    Raises:
        InvalidSceneError: the scene cannot be read or has no Gaussian.
        UnsupportedError: other presets, or a measurement was killed.
    """
    for settings in presets:
        if settings.preset != Preset.PAPER and not settings.encode.rate_distortion:
            raise UnsupportedError(f"an ablation needs the preset paper, balanced or small, not {settings.preset}")
    study = _Ablation(scene, views, threads, progress)
    for settings in presets:
        if settings.encode.rate_distortion:
            study.add_rate_distortion_table(settings)
        else:
            study.add_published_table(settings)
            study.add_variants(settings, PAPER_VARIANTS)
    return study.rows


@dataclass
class _Ablation:
    """The rows so far and the arguments of :func:`ablate`."""

    scene: Path
    views: Views | None
    threads: int
    progress: Progress
    rows: list[AblationRow] = field(default_factory=list)

    def add_published_table(self, settings: Settings) -> None:
        """Add the ablation table of the paper, measured on this scene."""
        splats, _ = clean(load(self.scene, threads=self.threads, progress=self.progress))
        if not len(splats):
            raise InvalidSceneError(f"{self.scene} has no usable Gaussian")
        views = self.views or evaluation_views(splats, threads=self.threads, progress=self.progress)
        views = in_scene_frame(splats, views, threads=self.threads)

        def row(name: str, parts: paper_ablation.EncodedParts, **published: float | None) -> AblationRow:
            mean = compare_images(splats, parts.decoded, views, threads=self.threads).mean
            return _row("KISS-GS", name, parts.size(settings.encode, self.threads), mean, base, **published)

        self.progress("measure", 0.0, "KISS-GS")
        base = None
        whole = paper_ablation.encode_parts(splats, settings.encode, self.threads)
        base = row("nothing", whole)
        self.rows.append(base)
        parts = [part for part in PARTS if splats.sh_degree or not part.needs_sh]
        for number, part in enumerate(parts):
            self.progress("measure", number / len(parts), part.name)
            without = part.leave_out(whole, settings.encode, self.threads)
            published = {
                "published_bytes_change": part.bytes / PUBLISHED_BYTES,
                "published_psnr_change": part.psnr,
            }
            self.rows.append(row(part.name, without, **published))

    def add_rate_distortion_table(self, settings: Settings) -> None:
        """Add a table of :data:`RATE_DISTORTION_VARIANTS` with bytes at equal PSNR, from the preset's rate curve."""
        points = []
        for step in (-CURVE_OFFSET_DB, CURVE_OFFSET_DB):
            offset = min(max(settings.encode.quality_offset_db + step, -MAX_OFFSET_DB), MAX_OFFSET_DB)
            outer = at_quality_offset(settings, offset)
            result, mean = self.measure(outer, f"{settings.preset} at {outer.encode.quality_offset_db:g}")
            points.append((mean.candidate_vs_reference.psnr, float(result.report.container_bytes)))
        self.add_variants(settings, RATE_DISTORTION_VARIANTS, points)

    def add_variants(
        self, settings: Settings, variants: Sequence[Variant], points: Sequence[tuple[float, float]] | None = None
    ) -> None:
        """Add a table of a preset and its variants; ``points`` are outer points (PSNR, bytes) of its rate curve."""
        base, curve = None, None
        possible = (variant for variant in variants if self.views is not None or not variant.needs_capture)
        for variant in (Variant(changes={}), *possible):
            name = variant.name or "nothing"
            result, mean = self.measure(variant.apply(settings), f"{settings.preset}: {name}")
            psnr, size = mean.candidate_vs_reference.psnr, result.report.container_bytes
            if base is None and points is not None:
                curve = RateCurve.of([*points, (psnr, size)])
            curve_bytes = None if curve is None else curve.bytes_at(psnr)
            row = _row(
                str(settings.preset),
                name,
                size,
                mean,
                base,
                equal_psnr_change=None if curve_bytes is None else size / curve_bytes - 1,
                cpu_seconds=result.report.cpu_seconds,
            )
            base = base or row
            self.rows.append(row)

    def measure(self, settings: Settings, note: str) -> tuple[RoundTrip, Comparison]:
        """Compress, decompress and evaluate in a separate process; return the measurement and its mean over views."""
        self.progress("measure", 0.0, note)
        result = isolated_roundtrip(self.scene, settings, evaluate=True, views=self.views, threads=self.threads)
        if result.evaluation is None:
            raise InvalidSceneError(f"{self.scene} has no images to evaluate")
        return result, result.evaluation.mean


def _row(
    table: str, name: str, size: int, mean: Comparison, base: AblationRow | None, **others: float | None
) -> AblationRow:
    """Return a row with its changes from ``base``, the first row of its table; None for that row itself."""
    psnr, photo_psnr = mean.candidate_vs_reference.psnr, None if mean.reference is None else mean.candidate.psnr
    base_photo_psnr = None if base is None else base.photo_psnr
    return AblationRow(
        table=table,
        name=name,
        bytes=size,
        bytes_change=0.0 if base is None else size / base.bytes - 1,
        psnr=psnr,
        psnr_change=0.0 if base is None else psnr - base.psnr,
        photo_psnr=photo_psnr,
        photo_psnr_change=(
            None if photo_psnr is None else photo_psnr - (photo_psnr if base_photo_psnr is None else base_photo_psnr)
        ),
        **others,
    )


def _format_value(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else f"{value:g}" if isinstance(value, float) else str(value)
