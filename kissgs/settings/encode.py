"""``EncodeSettings``: how a scene is encoded."""

from __future__ import annotations

import re
from typing import Annotated, Literal, Self

from pydantic import BaseModel, BeforeValidator, ByteSize, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

from kissgs.core.splats import MAX_GRID_SIDE

Step = Annotated[float, Field(ge=1e-4, le=10)]

SIZE = re.compile(r"(\d+|\d{1,3}(?:,\d{3})+|\d*\.\d+)\s*([kmgt]i?)?b?", re.IGNORECASE)


def _normalize_size(size: object) -> object:
    """Rewrite a size for pydantic; refuse "3,5MB" and unknown units, which pydantic would misread."""
    if not isinstance(size, str):
        return size
    found = SIZE.fullmatch(size.strip())
    if found is None or ("." in found[1] and not found[2]):
        raise PydanticCustomError("size", "Write 800kB, 2.5MB or 2,500,000")
    return found[1].replace(",", "") + (f"{found[2]}B" if found[2] else "")


Size = Annotated[ByteSize, BeforeValidator(_normalize_size)]


class EncodeSettings(BaseModel):
    """Settings of the encoder. A decoder needs none of them."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    rate_distortion: bool = Field(
        True,
        description="Render the scene and choose by rate-distortion cost, squared image error plus lambda times bits. "
        "Steps, codebook size and precision then follow from quality_offset_db, and settings of uniform steps are "
        "refused.",
    )
    quality_offset_db: Annotated[float, Field(ge=-30, le=30)] = Field(
        0.0,
        description="With rate_distortion: PSNR to aim at, decibels above the estimated quality of preset paper or "
        "fast on the same scene, whichever is better.",
    )
    rd_lambda: float | None = Field(
        None,
        gt=0,
        lt=1,
        description="With rate_distortion: lambda, squared image error per bit, instead of quality_offset_db; auto: "
        "from quality_offset_db.",
    )
    psnr: float | None = Field(
        None,
        gt=0,
        le=200,
        description="With rate_distortion: search for the smallest container with at least this PSNR to renderings of "
        "the scene, decibels, at held-out views or, without a capture, at random cameras other than those of "
        "'evaluate'. A view counts for at most 60 dB. Takes a few encodings.",
    )
    target_size: Size | None = Field(
        None,
        ge=1,
        description="With rate_distortion: search for the best container of at most this size, bytes, such as 800kB "
        "or 2.5MB; the result is usually within 3 % below it. Takes a few encodings. With psnr, max_psnr_drop or "
        "max_ssim_drop, the smallest container of that quality, which then must have at most this size.",
    )
    max_psnr_drop: float | None = Field(
        None,
        gt=0,
        le=20,
        description="With rate_distortion: search for the smallest container whose renderings of the held-out views "
        "lose at most this PSNR, decibels. Takes a few encodings. Without a capture, the loss is estimated at random "
        "poses from which photographs might have been taken, as if the original scene had 30 dB to photographs.",
    )
    max_ssim_drop: float | None = Field(
        None,
        gt=0,
        le=1,
        description="With rate_distortion: search for the smallest container whose renderings of the held-out views "
        "lose at most this SSIM to the photographs; without a capture, SSIM to renderings of the scene is at least 1 "
        "minus this, at random poses from which photographs might have been taken. Takes a few encodings.",
    )
    max_encodes: int = Field(
        10,
        ge=1,
        le=100,
        description="With a goal: largest number of containers that are made of one scene. With fine-tuning, up to as "
        "many fine-tuned ones, at most three, are added, and one at the finest or coarsest lambda if several missed "
        "the goal.",
    )
    prune_threshold_bits: float = Field(
        18.0,
        ge=0,
        le=200,
        description="With rate_distortion: prune Gaussians whose removal costs less than this many bits are worth; the "
        "threshold is multiplied by 1 - view_uncertainty. A Gaussian takes about 60 bits; beyond 30, the combined "
        "holes become visible. At the default quality, Gaussians that no camera saw from nearby are kept.",
    )
    step_classes: int = Field(
        3,
        ge=1,
        le=32,
        description="With rate_distortion: number of sensitivity classes, each with its own quantisation step. More "
        "classes fit steps better, but make positions cost more.",
    )
    rdo_quantization: bool = Field(
        True, description="With rate_distortion: prefer frequent levels (RDO quantisation). False: the nearest level."
    )
    color_refit_iterations: int = Field(
        3,
        ge=0,
        le=20,
        description="With rate_distortion and a capture: iterations of the fit of base colours to its training images, "
        "which compensates other losses.",
    )
    sensitivity_views: int | None = Field(
        None,
        ge=1,
        le=1000,
        description="With rate_distortion: number of renderings that sensitivity is measured in; with a capture, the "
        "largest number of its cameras, to which two thirds as many virtual cameras are added. auto: 48 for up to "
        "150,000 Gaussians, fewer for more, such as 30 for a million.",
    )
    sensitivity_view_size: int = Field(
        480,
        ge=16,
        le=4096,
        description="Largest longer side of these renderings, pixels; of larger images of a capture, so many samples.",
    )
    view_uncertainty: float | None = Field(
        None,
        ge=0,
        le=1,
        description="With rate_distortion: how strongly sensitivity is shrunk towards the prior of an unobstructed "
        "camera nearby, 0 (only the renderings count) to 1; more for Gaussians that no camera saw from nearby. Larger "
        "values, up to 0.55, bound rounding more tightly. auto: 0.1 with a capture, 0.55 without.",
    )
    order: Literal["hilbert", "refined", "plas"] = Field(
        "refined",
        description="Order of the Gaussians in the grid: along a 3D Hilbert curve (hilbert: fast), this refined by a "
        "local search such that WebP predicts positions and base colours better (refined: smallest), or PLAS (the "
        "paper).",
    )
    plas_start_radius: int | None = Field(
        None,
        ge=1,
        description="With order=plas: start from the Hilbert curve and sort within this radius, cells; auto: start "
        "from a random order, as the paper does.",
    )
    rotation_form: Literal["canonical", "pras"] = Field(
        "canonical",
        description="Which of the 48 equivalent rotation forms is stored: the one nearest to the identity (canonical: "
        "fast, smallest) or the one most like its neighbours (pras: the paper). The covariance is equal in all.",
    )
    shared_step_size: bool = Field(
        True,
        description="One step for all channels of an attribute, as the *_step settings give it. False: each channel "
        "spreads all levels over its own range (the paper), and the *_step settings are ignored.",
    )
    means_bits: int | None = Field(
        None,
        ge=8,
        le=16,
        description="Precision of positions, bits per coordinate; auto: from means_tolerance. One more bit costs 0.37 "
        "bytes per Gaussian.",
    )
    means_tolerance: float = Field(
        0.04,
        gt=0,
        le=1,
        description="Largest position error of the median Gaussian, as a share of its size; used unless means_bits is "
        "set.",
    )
    opacity_step: Step = Field(
        0.15, description="Quantisation step of opacity logits; the largest error is half of it."
    )
    scale_step: Step = Field(0.11, description="Quantisation step of log-scales: 0.11 is an error of at most 5.5 %.")
    quat_step: Annotated[float, Field(ge=1e-4, le=0.5)] = Field(
        0.023, description="Quantisation step of quaternion components: 0.02 is a mean rotation error of 1 degree."
    )
    sh0_step: Step = Field(
        0.055, description="Quantisation step of sh0, the base colour: 0.055 is an error of at most 2 of 255."
    )
    gaussians_per_codebook_entry: float = Field(
        7.0,
        ge=1,
        le=4096,
        description="Gaussians per codebook entry: fewer entries mean fewer bytes and less accurate view-dependent "
        "colour. With rate_distortion: the smallest number, for codebooks of more than 8,192 entries.",
    )
    sh_codebook_size: int = Field(65_536, ge=64, le=65_536, description="Largest number of codebook entries.")
    sh_tolerance: float = Field(
        0.001,
        ge=0,
        le=1,
        description="Invisible root mean square error of SH coefficients: the codebook does not grow to get below it.",
    )
    sh_step: Annotated[float, Field(ge=0.01, le=4)] = Field(
        1.15, description="Quantisation step of the codebook entries, in units of the codebook's RMS error."
    )
    sh_weight_power: float = Field(
        0.35,
        ge=0,
        le=1,
        description="Exponent of the codebook's weights, (opacity x projected area) to this power: 0 weights all "
        "Gaussians equally, 1 neglects small and faint ones.",
    )
    sh_kmeans_iterations: int = Field(
        6, ge=1, le=50, description="Iterations of codebook refinement: more are slower and slightly better."
    )
    sh_neighbors: int = Field(
        96,
        ge=8,
        le=512,
        description="Codebook entries, the nearest to a Gaussian's present one, that an iteration compares: more are "
        "slower and better.",
    )
    codebook_order: Literal["axes", "refined", "plas"] = Field(
        "refined",
        description="Order of the entries in the codebook's image: blocks along their principal axes (axes: fast), "
        "these refined by PLAS within a short radius (refined: smaller), or PLAS from afar over all dimensions (plas: "
        "the paper). A .sog has its entries by frequency.",
    )
    plas_radius_decay: float = Field(
        0.8,
        ge=0.5,
        le=0.99,
        description="Factor from one filter radius of PLAS and PRAS to the next: 0.95 is slow and smoothest.",
    )
    prune_invisible: bool = Field(
        True,
        description="Prune Gaussians of opacity 1/255 and less, which no renderer draws. Their number is reported.",
    )
    webp_quality: int = Field(
        75,
        ge=0,
        le=100,
        description="libwebp's effort, 0 to 100; always lossless. Up to 75, images of half a megapixel or more take "
        "less.",
    )
    webp_method: int = Field(
        4,
        ge=0,
        le=6,
        description="libwebp's method, 0 (fast) to 6 (small); always lossless. Up to 4, images of half a megapixel or "
        "more take 2 at most.",
    )
    codebook_max_effort: bool = Field(
        True, description="Use libwebp's highest effort for the codebook image: saves 8 % of it in some seconds."
    )
    high_effort_pixels: int = Field(
        30_000,
        ge=0,
        le=MAX_GRID_SIDE**2,
        description="Images of opacities, scales, rotations and base colours with up to this many pixels get at least "
        "quality 100 and method 5: 1 to 3 % fewer bytes, for 40 CPU seconds per million Gaussians.",
    )
    seed: int = Field(
        0,
        ge=0,
        lt=2**31,
        description="Seed of all random choices. Equal input, settings, seed and kind of processor give equal bytes.",
    )

    @property
    def has_goal(self) -> bool:
        """Whether a size, a PSNR or a maximum loss of PSNR or SSIM is to be met."""
        return any(getattr(self, name) is not None for name in GOALS)

    @model_validator(mode="after")
    def _no_uniform_settings(self) -> Self:
        unused = [name for name in UNIFORM_ONLY if self.rate_distortion and getattr(self, name) != _default(name)]
        if unused:
            raise ValueError(
                f"{unused[0]} has no effect with rate_distortion: set quality_offset_db or rd_lambda instead, or "
                "rate_distortion=false with it"
            )
        return self

    @model_validator(mode="after")
    def _one_goal(self) -> Self:
        goals = [name for name in ("rd_lambda", *GOALS) if getattr(self, name) is not None]
        if len(goals) > 1 and goals[0] == "rd_lambda":
            raise ValueError(f"{goals[0]} and {goals[1]} cannot both be met; give one")
        if goals and not self.rate_distortion:
            raise ValueError(
                f"{goals[0]} needs rate_distortion: choose preset balanced or small, or set rate_distortion=true"
            )
        return self


GOALS = ("psnr", "target_size", "max_psnr_drop", "max_ssim_drop")

UNIFORM_ONLY = (
    *("shared_step_size", "means_bits", "means_tolerance", "opacity_step", "scale_step", "quat_step", "sh0_step"),
    "sh_weight_power",
)
"""Settings of uniform planning; with rate_distortion, lambda and sensitivity decide instead."""


def _default(name: str) -> object:
    """Return the default of a setting of the encoder."""
    return EncodeSettings.model_fields[name].default
