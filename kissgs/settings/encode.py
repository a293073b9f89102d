"""``EncodeSettings``: how Gaussians become images."""

from __future__ import annotations

import re
from typing import Annotated, Literal, Self

from pydantic import BaseModel, BeforeValidator, ByteSize, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

Step = Annotated[float, Field(ge=1e-4, le=10)]

SIZE = re.compile(r"(\d+|\d{1,3}(?:,\d{3})+|\d*\.\d+)\s*([kmgt]i?)?b?", re.IGNORECASE)


def _spelled(size: object) -> object:
    """A size as pydantic reads it, which would take 3,5MB for 3 bytes, and leave out what it does not know."""
    if not isinstance(size, str):
        return size
    found = SIZE.fullmatch(size.strip())
    if found is None or ("." in found[1] and not found[2]):
        raise PydanticCustomError("size", "Write 800kB, 2.5MB or 2,500,000")
    return found[1].replace(",", "") + (f"{found[2]}B" if found[2] else "")


Size = Annotated[ByteSize, BeforeValidator(_spelled)]


class EncodeSettings(BaseModel):
    """How Gaussians become images. A decoder needs none of this."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    rate_distortion: bool = Field(
        True,
        description="Take pictures of the scene, and weigh every bit against the error it saves in them. Steps, "
        "codebook size and precision then follow from quality_offset_db, and settings of even steps are refused.",
    )
    quality_offset_db: Annotated[float, Field(ge=-30, le=30)] = Field(
        0.0, description="Where bits are weighed: decibels above the paper's own settings on the same scene, about."
    )
    rd_lambda: float | None = Field(
        None,
        gt=0,
        lt=1,
        description="Where bits are weighed: squared error per bit, in place of quality_offset_db; auto: found for the "
        "scene.",
    )
    psnr: float | None = Field(
        None,
        gt=0,
        le=200,
        description="Where bits are weighed: search for the smallest container whose pictures have at least this PSNR, "
        "decibels, to those of the scene: from held-out views, or from cameras drawn as for 'evaluate', but others. A "
        "view counts for at most 60: only equal pictures have more. Takes a few encodings.",
    )
    target_size: Size | None = Field(
        None,
        ge=1,
        description="Where bits are weighed: search for the best container of at most so many bytes, such as 800kB or "
        "2.5MB; hardly smaller where that can be. Takes a few encodings.",
    )
    max_psnr_drop: float | None = Field(
        None,
        gt=0,
        le=20,
        description="Where bits are weighed: search for the smallest container whose pictures from held-out views lose "
        "at most so many decibels. Takes a few encodings. Without photographs, from cameras drawn as for 'evaluate', "
        "but others, and as if the scene were 30 dB from them.",
    )
    max_encodes: int = Field(
        10,
        ge=1,
        le=100,
        description="On the way to a goal: containers that are made of one scene, at most; as many fine-tuned ones, no "
        "more than four, come on top, and the finest or coarsest of all where several have missed it.",
    )
    prune_threshold_bits: float = Field(
        18.0,
        ge=0,
        le=200,
        description="Where bits are weighed: leave out Gaussians that show less than so many bits are worth, fewer "
        "bits the larger view_uncertainty is. A Gaussian takes some 60; beyond 30, holes that they leave together "
        "begin to show. At the default quality none is left out that no camera looked at from nearby.",
    )
    step_classes: int = Field(
        3,
        ge=1,
        le=32,
        description="Where bits are weighed: kinds of Gaussians by sensitivity, each with its own steps. More make "
        "steps fit better, and positions cost more.",
    )
    rdo_quantization: bool = Field(
        True, description="Where bits are weighed: prefer levels that many have. False: the nearest level."
    )
    color_refit_iterations: int = Field(
        2,
        ge=0,
        le=20,
        description="Where bits are weighed by a capture's cameras: steps of fitting base colours to its pictures, to "
        "make up for all other losses.",
    )
    sensitivity_views: int = Field(
        48,
        ge=1,
        le=1000,
        description="Where bits are weighed: how many pictures to take of the scene, or of the capture's cameras at "
        "most; to the latter come two thirds as many from virtual cameras.",
    )
    sensitivity_view_size: int = Field(
        480, ge=16, le=4096, description="Longer side of these pictures, pixels, at most."
    )
    view_uncertainty: float | None = Field(
        None,
        ge=0,
        le=1,
        description="Where bits are weighed: how far sensitivity moves towards what a camera nearby would find, 0 to "
        "1: 0 counts these pictures alone. What none of them looked at from nearby moves farther. The larger it is, up "
        "to 0.55, the smaller are the largest changes by rounding. auto: 0.1 with a capture's cameras, 0.55 without.",
    )
    order: Literal["hilbert", "plas"] = Field(
        "hilbert",
        description="Which Gaussian sits where: along a 3D Hilbert curve (fast, smallest) or by PLAS (the paper).",
    )
    plas_start_radius: int | None = Field(
        None,
        ge=1,
        description="Where order is plas: start from the Hilbert curve and sort only within this radius; auto: from "
        "a random order, as the paper.",
    )
    rotation_form: Literal["canonical", "pras"] = Field(
        "canonical",
        description="Which of 48 equivalent rotations is stored: the one nearest to none (fast, smallest), or the one "
        "most like its neighbours (the paper's PRAS). The shape is the same in all.",
    )
    shared_step_size: bool = Field(
        True,
        description="One step for all channels of an attribute, of the size given below. If false, each spreads "
        "the full number of levels over its own range (the paper): the steps below are then ignored.",
    )
    means_bits: int | None = Field(
        None,
        ge=8,
        le=16,
        description="Precision of positions; by default what means_tolerance asks for. A bit is 0.37 bytes a Gaussian.",
    )
    means_tolerance: float = Field(
        0.04,
        gt=0,
        le=1,
        description="Largest error of the scene's median Gaussian's position, as a share of its size; used unless "
        "means_bits is set.",
    )
    opacity_step: Step = Field(0.15, description="Step of opacity logits; half of it is the largest error.")
    scale_step: Step = Field(0.11, description="Step of log-scales: 0.11 means sizes right to within 5.5 %.")
    quat_step: Annotated[float, Field(ge=1e-4, le=0.5)] = Field(
        0.023, description="Step of quaternion components: 0.02 turns a Gaussian by 1 degree on average."
    )
    sh0_step: Step = Field(0.055, description="Step of base colours: 0.055 is an error of up to 2 levels of 255.")
    gaussians_per_codebook_entry: float = Field(
        7.0,
        ge=1,
        le=4096,
        description="Gaussians per codebook entry: fewer entries are fewer bytes and a rougher gloss. Where bits are "
        "weighed: at least so many, if there are more than 8,192 entries.",
    )
    sh_codebook_size: int = Field(65_536, ge=64, le=65_536, description="Entries of the codebook, at most.")
    sh_tolerance: float = Field(
        0.001,
        ge=0,
        le=1,
        description="Error of SH coefficients that nobody sees: the codebook does not grow to get below it.",
    )
    sh_step: Annotated[float, Field(ge=0.01, le=4)] = Field(
        1.15, description="Step of the codebook's entries, in units of the error that the codebook leaves anyway."
    )
    sh_weight_power: float = Field(
        0.35,
        ge=0,
        le=1,
        description="How much the codebook favours what is seen: weights are (opacity x projected area) to this power. "
        "0 treats all alike; 1 gives up on small and faint Gaussians.",
    )
    sh_kmeans_iterations: int = Field(
        6, ge=1, le=50, description="Rounds of codebook refinement: more are slower and a little better."
    )
    sh_nprobe: int = Field(
        24, ge=1, le=512, description="How far a Gaussian may look for its codebook entry; slower, better."
    )
    plas_radius_decay: float = Field(
        0.8, ge=0.5, le=0.99, description="How slowly PLAS and PRAS narrow their filters: 0.95 is slow and smoothest."
    )
    prune_invisible: bool = Field(
        True,
        description="Leave out Gaussians of opacity 1/255 and less: no renderer draws them. The count is reported.",
    )
    webp_quality: int = Field(75, ge=0, le=100, description="Effort of libwebp; always lossless.")
    webp_method: int = Field(4, ge=0, le=6, description="Methods of libwebp; always lossless.")
    codebook_max_effort: bool = Field(
        True, description="Spend libwebp's highest effort on the codebook image: some seconds for 8 % of it."
    )
    seed: int = Field(
        0,
        ge=0,
        lt=2**31,
        description="Seed of all random choices. Same input, settings, seed and kind of processor: same bytes.",
    )

    @property
    def has_goal(self) -> bool:
        """Whether a PSNR, a loss of it or a size is sought."""
        return any(getattr(self, name) is not None for name in GOALS)

    @model_validator(mode="after")
    def _only_what_counts(self) -> Self:
        unused = [name for name in UNWEIGHED if self.rate_distortion and getattr(self, name) != _default(name)]
        if unused:
            raise ValueError(
                f"{unused[0]} has no effect where bits are weighed: set quality_offset_db or rd_lambda, or "
                "rate_distortion=false with it"
            )
        return self

    @model_validator(mode="after")
    def _one_goal(self) -> Self:
        goals = [name for name in ("rd_lambda", *GOALS) if getattr(self, name) is not None]
        if len(goals) > 1:
            raise ValueError(f"{goals[0]} and {goals[1]} cannot both be met; give one")
        if goals and not self.rate_distortion:
            raise ValueError(
                f"{goals[0]} needs bits that are weighed: choose balanced or small, or set rate_distortion=true"
            )
        return self


GOALS = ("psnr", "target_size", "max_psnr_drop")

UNWEIGHED = (
    *("shared_step_size", "means_bits", "means_tolerance", "opacity_step", "scale_step", "quat_step", "sh0_step"),
    "sh_weight_power",
)
"""Settings that price and sensitivity decide about where bits are weighed."""


def _default(name: str) -> object:
    """What a setting of the encoder is if nobody sets it."""
    return EncodeSettings.model_fields[name].default
