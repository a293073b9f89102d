"""``EncodeSettings``: how a scene is encoded."""

from __future__ import annotations

import re
from typing import Annotated, Literal, Self

from pydantic import BeforeValidator, ByteSize, Field, model_validator
from pydantic_core import PydanticCustomError

from kissgs.core.splats import MAX_GRID_SIDE
from kissgs.settings.stage import Count, Pixels, Seed, Share, StageSettings, of_preset

Step = Annotated[float, Field(ge=1e-4, le=10)]
Bits = Annotated[float, Field(ge=0, le=200)]

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


class EncodeSettings(StageSettings):
    """Settings of the encoder. A decoder needs none of them."""

    rate_distortion: bool = of_preset(True, "Choose by squared image error plus lambda times bits, not uniform steps.")
    quality_offset_db: Annotated[float, Field(ge=-30, le=30)] = Field(
        0.0, description="PSNR to aim at, decibels above that of preset paper or fast, whichever is better here."
    )
    rd_lambda: Annotated[float, Field(gt=0, lt=1)] | None = Field(
        None, description="Lambda, squared image error per bit; auto: from quality_offset_db."
    )
    psnr: Annotated[float, Field(gt=0, le=200)] | None = Field(
        None,
        description="Search for the smallest container with at least this PSNR to renderings of the scene, decibels; a "
        "view counts for at most 60.",
    )
    target_size: Annotated[Size, Field(ge=1)] | None = Field(
        None,
        description="Search for the best container of at most this size, bytes, such as 800kB or 2.5MB; with a limit "
        "of quality, for the smallest container of that quality, which then must not be larger.",
    )
    max_psnr_drop: Annotated[float, Field(gt=0, le=20)] | None = Field(
        None,
        description="Search for the smallest container that loses at most this PSNR to held-out photographs, decibels; "
        "without a capture at poses from which they might have been taken, as if the scene had 30 dB to them.",
    )
    max_ssim_drop: Annotated[float, Field(gt=0, le=1)] | None = Field(
        None,
        description="Search for the smallest container that loses at most this SSIM to held-out photographs; without a "
        "capture to renderings of the scene, at poses from which they might have been taken.",
    )
    max_encodes: Annotated[int, Field(ge=1, le=100)] = Field(
        10, description="With a goal: largest number of containers made of one scene, beside fine-tuned ones."
    )
    prune_threshold_bits: Bits = of_preset(18.0, "Prune what is worth fewer bits, times 1 - view_uncertainty.")
    step_classes: Annotated[int, Field(ge=1, le=32)] = of_preset(3, "Classes of sensitivity, each with its own steps.")
    rdo_quantization: bool = of_preset(True, "Prefer frequent levels (RDO quantisation); False: the nearest level.")
    color_refit_iterations: Annotated[int, Field(ge=0, le=20)] = of_preset(
        3, "With a capture: iterations of the fit of base colours to its training images."
    )
    sensitivity_views: Count | None = of_preset(
        None,
        "Renderings for the sensitivity; with a capture, its cameras at most, and two thirds as many virtual ones.",
    )
    sensitivity_view_size: Pixels = of_preset(480, "Largest longer side of these renderings, or so many samples of it.")
    view_uncertainty: Share | None = of_preset(
        None, "Weight of the prior of an unobstructed camera nearby; auto: 0.1 with a capture, 0.55 without."
    )
    order: Literal["hilbert", "refined", "plas"] = of_preset(
        "refined", "Grid order: Hilbert curve, this refined for WebP's prediction, or PLAS (the paper)."
    )
    plas_start_radius: Annotated[int, Field(ge=1)] | None = of_preset(
        None, "With order=plas: sort from the Hilbert curve within so many cells; auto: from a random order."
    )
    rotation_form: Literal["canonical", "pras"] = of_preset(
        "canonical", "Stored form of rotations: nearest to the identity, or most like the neighbours' (PRAS)."
    )
    shared_step_size: bool = of_preset(True, "One step for all channels; False: all levels over each one's range.")
    means_bits: Annotated[int, Field(ge=8, le=16)] | None = of_preset(
        None, "Bits per coordinate of positions; auto: from means_tolerance."
    )
    means_tolerance: Annotated[float, Field(gt=0, le=1)] = of_preset(
        0.04, "Largest position error of the median Gaussian, as a share of its size."
    )
    opacity_step: Step = of_preset(0.15, "Quantisation step of opacity logits; the largest error is half of it.")
    scale_step: Step = of_preset(0.11, "Quantisation step of log-scales: 0.11 is an error of at most 5.5 %.")
    quat_step: Annotated[float, Field(ge=1e-4, le=0.5)] = of_preset(
        0.023, "Quantisation step of quaternion components: 0.02 is a mean error of 1 degree."
    )
    sh0_step: Step = of_preset(0.055, "Quantisation step of the base colour: 0.055 is an error of at most 2 of 255.")
    gaussians_per_codebook_entry: Annotated[float, Field(ge=1, le=4096)] = of_preset(
        7.0, "Gaussians per codebook entry; with rate_distortion the smallest number, beyond 8,192 entries."
    )
    sh_codebook_size: Annotated[int, Field(ge=64, le=65_536)] = of_preset(65_536, "Largest number of codebook entries.")
    sh_tolerance: Share = of_preset(0.001, "Invisible RMS error of SH coefficients, below which no codebook grows.")
    sh_step: Annotated[float, Field(ge=0.01, le=4)] = of_preset(1.15, "Step of entries, in units of their RMS error.")
    sh_weight_power: Share = of_preset(0.35, "Exponent of the weights, opacity x projected area; 0: all equal.")
    sh_kmeans_iterations: Annotated[int, Field(ge=1, le=50)] = of_preset(6, "Iterations of codebook refinement.")
    sh_neighbors: Annotated[int, Field(ge=8, le=512)] = of_preset(96, "Nearest entries that an iteration compares.")
    codebook_order: Literal["axes", "refined", "plas"] = of_preset(
        "refined", "Order of entries: blocks along their axes, these refined by PLAS, or PLAS over all dimensions."
    )
    plas_radius_decay: Annotated[float, Field(ge=0.5, le=0.99)] = of_preset(
        0.8, "Factor from one filter radius of PLAS and PRAS to the next: 0.95 is slow and smoothest."
    )
    prune_invisible: bool = of_preset(True, "Prune opacities of 1/255 and less, which no renderer draws.")
    webp_quality: Annotated[int, Field(ge=0, le=100)] = of_preset(75, "libwebp's effort; always lossless.")
    webp_method: Annotated[int, Field(ge=0, le=6)] = of_preset(4, "libwebp's method, 0 (fast) to 6 (small).")
    codebook_max_effort: bool = of_preset(True, "Use libwebp's highest effort for the codebook image.")
    high_effort_pixels: Annotated[int, Field(ge=0, le=MAX_GRID_SIDE**2)] = of_preset(
        30_000, "Images of up to so many pixels get at least quality 100 and method 5, if it pays for their attribute."
    )
    seed: Seed = Field(
        0,
        description="Seed of all random choices, those of training included. Equal input, settings, seed and kind of "
        "processor give equal bytes.",
    )

    @property
    def has_goal(self) -> bool:
        """Whether a size, a PSNR or a maximum loss of PSNR or SSIM is to be met."""
        return any(getattr(self, name) is not None for name in GOALS)

    @model_validator(mode="after")
    def _no_uniform_settings(self) -> Self:
        defaults = {name: type(self).model_fields[name].default for name in UNIFORM_ONLY}
        unused = [name for name, default in defaults.items() if self.rate_distortion and getattr(self, name) != default]
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
            raise ValueError(f"{goals[0]} needs rate_distortion: choose preset balanced or small")
        return self


GOALS = ("psnr", "target_size", "max_psnr_drop", "max_ssim_drop")

UNIFORM_ONLY = (
    *("shared_step_size", "means_bits", "means_tolerance", "opacity_step", "scale_step", "quat_step", "sh0_step"),
    "sh_weight_power",
)
"""Settings of uniform planning; with rate_distortion, lambda and sensitivity decide instead."""
