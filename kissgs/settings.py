"""``Settings`` of the encoder, compaction and fine-tuning, one group per stage, filled from a preset."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated, Any, Literal, NamedTuple, Self

import pydantic
from pydantic import BaseModel, BeforeValidator, ByteSize, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import CoreSchema, PydanticCustomError

from kissgs.core.errors import UnsupportedError
from kissgs.core.splats import MAX_GRID_SIDE

# ``StageSettings``: the values of one stage, few of which are settings; the others belong to the preset.

Share = Annotated[float, Field(ge=0, le=1)]
Shares = Annotated[
    list[Share], BeforeValidator(lambda given: re.findall("[^,]+", given) if isinstance(given, str) else given)
]
Weight = Annotated[float, Field(ge=0, le=1000)]
Rate = Annotated[float, Field(gt=0, le=100)]
Steps = Annotated[int, Field(ge=0, le=1_000_000)]
Count = Annotated[int, Field(ge=1, le=1000)]
Pixels = Annotated[int, Field(ge=16, le=8192)]
Seed = Annotated[int, Field(ge=0, lt=2**31)]

_OF_PRESET = {"of_preset": True}


def of_preset(default: object, meaning: str) -> Any:  # noqa: ANN401  as Field
    """Declare a value that belongs to the preset: only :meth:`kissgs.Settings.research` changes it."""
    return Field(default, description=meaning, json_schema_extra=dict(_OF_PRESET))


def setting(default: object, meaning: str) -> Any:  # noqa: ANN401  as Field
    """Declare a setting that users may change."""
    return Field(default, description=meaning)


class StageSettings(BaseModel):
    """Base class of the groups of settings, and of all of them together."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @classmethod
    def public(cls) -> list[str]:
        """Return the names of the settings: fields that do not belong to the preset."""
        return [name for name, field in cls.model_fields.items() if field.json_schema_extra != _OF_PRESET]

    @classmethod
    def __get_pydantic_json_schema__(
        cls, core_schema: CoreSchema, handler: pydantic.GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Leave out what belongs to the preset; answers of the service contain it, so that other names are open."""
        reference = handler(core_schema)
        schema, names = handler.resolve_ref_schema(reference), cls.public()
        if len(names) < len(cls.model_fields):
            schema["properties"] = {name: schema["properties"][name] for name in names}
            del schema["additionalProperties"]
        return reference


# ``TrainingViewSettings``: the loss, the views and the seed of compaction and fine-tuning.

SSIM_WEIGHT, SSIM_GOAL_WEIGHT = 0.3, 0.4
"""Usual weight of 1 - SSIM in the loss, and that where a goal limits the loss of SSIM; 3DGS has 0.2, without the
squared error."""


class TrainingViewSettings(StageSettings):
    """Values that compaction and fine-tuning share: loss, training views and seed."""

    ssim_weight: Share = of_preset(
        SSIM_WEIGHT, f"Weight of 1 - SSIM in the loss; {SSIM_GOAL_WEIGHT} with max_ssim_drop or quality."
    )
    mse_weight: Weight = of_preset(5.0, "Weight of the mean squared error; L1 has the rest of 1 beside SSIM.")
    synthetic_view_share: Annotated[float, Field(ge=0, le=0.9)] = of_preset(
        0.05, "With a capture: share of steps by renderings of the original scene from virtual cameras."
    )
    views: Annotated[int, Field(ge=1, le=10_000)] = of_preset(
        384, "Virtual views without a capture, up to four times as many for several objects; an eighth is held out."
    )
    view_size: Pixels = of_preset(640, "Virtual training views have three fifths of so many pixels in a row.")
    photo_size: Annotated[int, Field(ge=16, le=65_536)] = of_preset(
        960, "Longer side, pixels, up to which photographs train whole; of larger ones every n-th pixel and row."
    )
    lr_offset: Steps | None = of_preset(
        None, "Learning rates of 3DGS as after so many of its steps; auto: falling ones."
    )
    seed: Seed = of_preset(0, "Seed of the order of images and of virtual cameras: that of encode.")


# ``CompactSettings``: how many Gaussians compaction keeps, and how it prunes and trains.

BUDGETS = ("count", "ratio", "max_psnr_drop", "auto_count")


class CompactSettings(TrainingViewSettings):
    """Settings of compaction: the number of Gaussians to keep, the pruning schedule and the training."""

    count: Annotated[int, Field(ge=1)] | None = setting(None, "Number of Gaussians to keep, if there are more.")
    ratio: Annotated[float, Field(gt=0, le=1)] | None = setting(None, "Share of the Gaussians to keep.")
    max_psnr_drop: Annotated[float, Field(gt=0, le=20)] | None = setting(
        None, "Keep as few Gaussians as lose at most this PSNR, decibels, measured as for that of encode."
    )
    auto_count: bool | None = setting(
        None,
        "Choose the number of Gaussians that serves the goal of encode best. auto: with a goal other than psnr, "
        "held-out photographs or fine-tuning without a capture, and torch, unless another budget is given.",
    )
    method: Literal["prune", "merge"] = setting(
        "prune",
        "prune: remove the Gaussians that images miss least, and train the rest. merge: replace neighbours "
        "by one Gaussian with their mean, covariance, colour and opacity; no images, no cameras, no training.",
    )
    max_compactions: Annotated[int, Field(ge=1, le=20)] = setting(
        3, "With auto_count: largest number of containers that are made of trained scenes."
    )
    min_keep_per_scoring: Annotated[float, Field(ge=0, le=0.99)] = of_preset(
        0.8, "Smallest share that pruning by one scoring may leave; deeper pruning scores again. 0: score once."
    )
    score_floor: Share = of_preset(1.0, "Factor on the lowest score (compaction.md).")
    trains_all: bool = of_preset(False, "Train a scene of no more Gaussians than requested too.")
    initial_prune_fraction: Share = of_preset(0.43, "Share of the first pruning in the logarithm of all pruning.")
    sparsify_steps: Steps = of_preset(1500, "Training steps during gradual pruning; 0: prune all at once.")
    prune_rounds: Count = of_preset(5, "Prunings during sparsify_steps, by equal factors; the paper has one.")
    refine_steps: Steps = of_preset(1500, "Training steps after the last pruning.")
    admm_rho: Weight = of_preset(0.0, "Penalty of ADMM, which pulls opacities of candidates for pruning towards 0.")
    admm_interval: Annotated[int, Field(ge=1)] = of_preset(50, "Steps between two updates of ADMM.")
    erank_weight: Weight = of_preset(0.0, "Weight of the effective rank: keeps Gaussians from becoming needles.")
    min_scale_weight: Weight = of_preset(0.0, "Weight of the smallest scales, world units.")

    @property
    def enabled(self) -> bool:
        """Whether a budget is given; without one, all Gaussians are kept."""
        return bool(self._given)

    @property
    def steps(self) -> int:
        """Total number of training steps; 0 where Gaussians merge."""
        return 0 if self.method == "merge" else self.sparsify_steps + self.refine_steps

    @property
    def trains(self) -> bool:
        """Whether the scene is trained."""
        return self.steps > 0

    @model_validator(mode="after")
    def _one_budget(self) -> Self:
        given = self._given
        if len(given) > 1:
            raise ValueError(f"{given[0]} and {given[1]} cannot both be met; give one")
        return self

    @property
    def _given(self) -> list[str]:
        return [name for name in BUDGETS if getattr(self, name)]


# ``EncodeSettings``: how a scene is encoded.

Step = Annotated[float, Field(ge=1e-4, le=10)]
Bits = Annotated[float, Field(ge=0, le=200)]

_SIZE = re.compile(r"(\d+|\d{1,3}(?:,\d{3})+|\d*\.\d+)\s*([kmgt]i?)?b?", re.IGNORECASE)


def _normalize_size(size: object) -> object:
    """Rewrite a size for pydantic; refuse "3,5MB" and unknown units, which pydantic would misread."""
    if not isinstance(size, str):
        return size
    found = _SIZE.fullmatch(size.strip())
    if found is None or ("." in found[1] and not found[2]):
        raise PydanticCustomError("size", "Write 800kB, 2.5MB or 2,500,000")
    return found[1].replace(",", "") + (f"{found[2]}B" if found[2] else "")


Size = Annotated[ByteSize, BeforeValidator(_normalize_size)]

GOALS = ("psnr", "target_size", "max_psnr_drop", "max_ssim_drop", "quality")


class QualityLimits(NamedTuple):
    """Largest losses of a container that has a quality, by the metrics of :class:`kissgs.Evaluation`."""

    psnr: float  # decibels
    ssim: float
    detail: float  # of SSIM in patches, mean of the worst 1 %
    patch: float  # of SSIM in the worst patch


QUALITIES = {
    "same": QualityLimits(0.1, 0.003, 0.05, 0.09),
    "high": QualityLimits(0.25, 0.0075, 0.1, 0.18),
    "good": QualityLimits(0.5, 0.015, 0.15, 0.27),
}
"""Limits of each value of the setting ``quality``."""

UNIFORM_ONLY = (
    *("shared_step_size", "means_bits", "means_tolerance", "opacity_step", "scale_step", "quat_step", "sh0_step"),
    *("quat_levels", "gaussians_per_codebook_entry", "sh_weight_power"),
)
"""Values of uniform planning; with rate_distortion, lambda and sensitivity decide instead."""


class EncodeSettings(StageSettings):
    """Settings of the encoder. A decoder needs none of them."""

    rate_distortion: bool = of_preset(True, "Choose by squared image error plus lambda times bits, not uniform steps.")
    quality_offset_db: Annotated[float, Field(ge=-30, le=30)] = setting(
        0.0, "PSNR to aim at, decibels above that of preset paper or fast, whichever is better here."
    )
    rd_lambda: Annotated[float, Field(gt=0, lt=1)] | None = setting(
        None, "Lambda, squared image error per bit; auto: from quality_offset_db."
    )
    psnr: Annotated[float, Field(gt=0, le=200)] | None = setting(
        None,
        "Search for the smallest container with at least this PSNR to renderings of the scene, decibels; a "
        "view counts for at most 60.",
    )
    target_size: Annotated[Size, Field(ge=1)] | None = setting(
        None,
        "Search for the best container of at most this size, bytes, such as 800kB or 2.5MB; with a limit "
        "of quality, for the smallest container of that quality, which then must not be larger.",
    )
    max_psnr_drop: Annotated[float, Field(gt=0, le=20)] | None = setting(
        None,
        "Search for the smallest container that loses at most this PSNR to held-out photographs, decibels; "
        "without a capture at poses from which they might have been taken, as if the scene had 30 dB to them.",
    )
    max_ssim_drop: Annotated[float, Field(gt=0, le=1)] | None = setting(
        None,
        "Search for the smallest container that loses at most this SSIM to held-out photographs; without a "
        "capture to renderings of the scene, at poses from which they might have been taken.",
    )
    quality: Literal["same", "high", "good"] | None = setting(
        None,
        "Search for the smallest container of this quality: limits on the losses of PSNR, of SSIM, and of SSIM in "
        "patches of 32x32 pixels, where lettering is lost first; max_psnr_drop and max_ssim_drop replace those two.",
    )
    max_encodes: Annotated[int, Field(ge=1, le=100)] = setting(
        10, "With a goal: largest number of containers made of one scene; at most 6 before fine-tuned ones."
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
    quat_levels: Annotated[int, Field(ge=2, le=256)] = of_preset(100, "Levels of quaternions without shared_step_size.")
    sh0_step: Step = of_preset(0.055, "Quantisation step of the base colour: 0.055 is an error of at most 2 of 255.")
    gaussians_per_codebook_entry: Annotated[float, Field(ge=1, le=4096)] = of_preset(
        7.0, "Gaussians per codebook entry."
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
    seed: Seed = setting(
        0,
        "Seed of all random choices, those of training included. Equal input, settings, seed and kind of "
        "processor give equal bytes.",
    )

    @property
    def has_goal(self) -> bool:
        """Whether a size, a PSNR, a quality or a maximum loss of PSNR or SSIM is to be met."""
        return any(getattr(self, name) is not None for name in GOALS)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        fields = type(self).model_fields
        unused = [name for name in UNIFORM_ONLY if getattr(self, name) != fields[name].default]
        if self.rate_distortion and unused:
            raise ValueError(
                f"{unused[0]} has no effect with rate_distortion: set quality_offset_db or rd_lambda instead, or "
                "rate_distortion=false with it"
            )
        goals = [name for name in ("rd_lambda", *GOALS) if getattr(self, name) is not None]
        if len(goals) > 1 and goals[0] == "rd_lambda":
            raise ValueError(f"{goals[0]} and {goals[1]} cannot both be met; give one")
        if goals and not self.rate_distortion:
            raise ValueError(f"{goals[0]} needs rate_distortion: choose preset balanced")
        return self


# ``FinetuneSettings``: training of the quantised levels through the decoder.


class FinetuneSettings(TrainingViewSettings):
    """Settings of fine-tuning: training of the levels, so that the decoded scene renders closer to the targets."""

    enabled: bool | None = setting(
        None,
        "Fine-tune, against photographs if there are any, else renderings. auto: with a goal other than "
        "psnr and held-out photographs or no capture, where torch is installed.",
    )
    steps: Annotated[int, Field(ge=1, le=1_000_000)] = setting(
        1000, "Number of training steps; a fifth more where auto_count of compact leaves training to complete."
    )
    batch: Annotated[int, Field(ge=1, le=64)] = of_preset(1, "Images per training step.")
    prune_threshold_bits: Annotated[float, Field(ge=0, le=200)] = of_preset(
        100.0, "As that of encode, if that is not 0, before training, which closes the holes."
    )
    lr: Rate = of_preset(0.06, "Initial learning rate of all but the SH codebook, in quantisation steps.")
    codebook_lr: Rate = of_preset(0.2, "Initial learning rate of the SH codebook, in quantisation steps.")
    synthetic_lr_scale: Rate = of_preset(0.3, "Factor on both where targets are renderings, which leave less error.")
    final_lr_scale: Annotated[float, Field(gt=0, le=1)] = of_preset(0.05, "Factor on both at the last step.")
    attraction: Weight = of_preset(1.0, "Weight of the attraction to levels.")
    pras_at: Shares = of_preset([], "Fractions of the steps at which PRAS chooses forms anew; needs rate_weight 0.")
    keeps_better: bool = of_preset(True, "Keep the container from before if it is better.")
    rate_weight: Weight = of_preset(
        2.0, "Weight of the estimated rate, in units of rd_lambda, against the image error."
    )
    tv_weight: Weight = of_preset(0.0, "Weight of the total variation of the planes, in units of the paper's.")


# ``Duration``: a time in seconds, which may be written with a unit.

_UNITS = {"": 1.0, "s": 1.0, "sec": 1.0, "min": 60.0, "m": 60.0, "h": 3600.0}


def _in_seconds(duration: object) -> object:
    if not isinstance(duration, str):
        return duration
    found = re.fullmatch(r"(\d+|\d*\.\d+)\s*([a-z]*)", duration.strip(), re.IGNORECASE)
    if found is None or found[2].lower() not in _UNITS:
        raise PydanticCustomError("duration", "Write 30s, 2min, 1h or a number of seconds")
    return float(found[1]) * _UNITS[found[2].lower()]


Duration = Annotated[float, Field(gt=0, le=1e6), BeforeValidator(_in_seconds)]


# Presets, as differences from the defaults.


class Preset(StrEnum):
    """Named trade-offs between speed, size and quality."""

    FAST = "fast"
    BALANCED = "balanced"
    PAPER = "paper"


_PAPER_LOSS = {"ssim_weight": 0.2, "mse_weight": 0.0, "synthetic_view_share": 0.0, "photo_size": 65_536}

PRESETS: dict[Preset, dict[str, dict[str, Any]]] = {
    Preset.FAST: {
        "compact": {"method": "merge", "sparsify_steps": 0, "refine_steps": 0},
        "encode": {
            "rate_distortion": False,
            "order": "hilbert",
            "codebook_order": "axes",
            "sh_kmeans_iterations": 1,
            "sh_neighbors": 32,
            "codebook_max_effort": False,
            "high_effort_pixels": 0,
            "webp_quality": 50,
            "webp_method": 2,
        },
        "finetune": {"steps": 200},
    },
    Preset.BALANCED: {"compact": {}, "encode": {}, "finetune": {}},
    Preset.PAPER: {
        "compact": {
            "min_keep_per_scoring": 0.0,
            "score_floor": 0.0,
            "trains_all": True,
            "sparsify_steps": 5000,
            "prune_rounds": 1,
            "refine_steps": 5000,
            "admm_rho": 5e-4,
            "erank_weight": 0.01,
            "min_scale_weight": 1.0,
            **_PAPER_LOSS,
            "lr_offset": 30_000,
        },
        "encode": {
            "rate_distortion": False,
            "order": "plas",
            "rotation_form": "pras",
            "shared_step_size": False,
            "means_bits": 16,
            "gaussians_per_codebook_entry": 8,
            "sh_weight_power": 0,
            "sh_tolerance": 0,
            "sh_kmeans_iterations": 8,
            "sh_neighbors": 128,
            "codebook_order": "plas",
            "plas_radius_decay": 0.95,
            "prune_invisible": False,
            "codebook_max_effort": False,
            "high_effort_pixels": 0,
        },
        "finetune": {
            "steps": 4000,
            "batch": 8,
            **_PAPER_LOSS,
            "lr_offset": 40_000,
            "attraction": 0.0,
            "pras_at": [0.6, 0.8],
            "keeps_better": False,
            "rate_weight": 0.0,
            "tv_weight": 1.0,
        },
    },
}
"""Differences from the defaults, by preset and group."""


# ``Settings``: one group per stage, filled from a preset.

GROUPS: dict[str, type[StageSettings]] = {
    "compact": CompactSettings,
    "encode": EncodeSettings,
    "finetune": FinetuneSettings,
}

TIME_ONLY_DROP = 0.1
"""Loss of PSNR, decibels, that a container may have where only the time is limited: few people see it."""


class Settings(StageSettings):
    """All settings of a compression: one group per stage."""

    preset: Preset = setting(Preset.BALANCED, "Preset that settings which are not given come from.")
    time_limit: Duration | None = setting(
        None,
        "Seconds that a compression may take, or 30s, 2min, 1h. A goal comes first: then time bounds the "
        "search. Without a goal: with photographs and torch, the smallest container found that loses at most 0.1 dB; "
        "else the preset, or fast if that takes too long. Equal bytes need equally fast machines.",
    )
    compact: CompactSettings = Field(default_factory=CompactSettings)
    encode: EncodeSettings = Field(default_factory=EncodeSettings)
    finetune: FinetuneSettings = Field(default_factory=FinetuneSettings)
    for_research: bool = of_preset(False, "Whether values that belong to the preset may differ from it.")

    @property
    def searches(self) -> bool:
        """Whether several scenes or containers are made to find one that meets a goal."""
        return self.encode.has_goal or self.compact.max_psnr_drop is not None

    @property
    def time_only(self) -> bool:
        """Whether only the time is limited, so that training may choose the quality."""
        encode = self.encode
        return self.time_limit is not None and encode.rate_distortion and not encode.has_goal and not encode.rd_lambda

    def resolved(self, *, photographs: bool | None, torch: bool) -> Self:
        """Return settings with what they leave open resolved: whether training serves the goal.

        A size or a loss is served best by fewer Gaussians and by training, on photographs or without a capture on
        renderings of the scene, and so is a time limit alone with photographs. A PSNR to the scene's own renderings
        falls by training. A capture that holds no photographs out cannot tell whether others are met, so that nothing
        is trained. Without photographs and fine-tuning, pruning loses more than it saves. With a time limit alone,
        ``finetune.enabled`` stays open without photographs: it depends on the time.

        Args:
            photographs: whether a capture has photographs to train on, and others to evaluate the result; None for no
                capture.
            torch: whether torch is installed, which training needs.
        """
        serves_goal = self.encode.has_goal and photographs is not False
        trains = torch and self.encode.psnr is None and (serves_goal or (self.time_only and bool(photographs)))
        compact, finetune = self.compact, self.finetune
        if compact.auto_count is None or self.time_only:
            keeps_all = not compact.trains or (photographs is None and finetune.enabled is False)
            wanted = trains and not keeps_all and (compact.auto_count or not compact.enabled)
            compact = compact.model_copy(update={"auto_count": wanted})
        if finetune.enabled is None and (trains or not self.time_only):
            finetune = finetune.model_copy(update={"enabled": trains})
        encode = self.encode
        if self.time_only and compact.auto_count:
            encode = encode.model_copy(update={"max_psnr_drop": TIME_ONLY_DROP})
        return self.model_copy(update={"compact": compact, "encode": encode, "finetune": finetune})

    def as_json(self) -> dict[str, Any]:
        """Return the settings as JSON that is valid again, also where a search has changed values of the preset."""
        values = self.model_dump(mode="json")
        try:
            type(self).model_validate(values)
        except ValidationError:
            values["for_research"] = True
        return values

    @model_validator(mode="after")
    def _a_goal_to_go_by(self) -> Self:
        compact = self.compact
        if compact.auto_count and compact.method == "merge":
            raise ValueError("auto_count prunes; give count or ratio with method merge")
        if self.time_limit is not None and (compact.count or compact.max_psnr_drop or (compact.ratio or 1.0) < 1):
            raise ValueError(
                "time_limit does not apply to compaction by a given budget: leave out count, ratio and max_psnr_drop "
                "of compact, or the time limit"
            )
        if compact.auto_count and not (self.encode.has_goal or self.time_only):
            raise ValueError(
                "auto_count needs a goal: give quality, target_size, max_psnr_drop, max_ssim_drop, psnr or a time "
                "limit, or the number of Gaussians to keep"
            )
        return self

    @model_validator(mode="before")
    @classmethod
    def _fill_from_preset(cls, given: Any) -> Any:  # noqa: ANN401
        if not isinstance(given, dict) or given.get("preset", Preset.BALANCED) not in list(Preset):
            return given  # validation reports the error
        groups = {name: _given_values(given.get(name, {})) for name in GROUPS}
        shared = _shared_by_trainings(groups["encode"])
        for name, of_preset in PRESETS[Preset(given.get("preset", Preset.BALANCED))].items():
            if isinstance(groups[name], dict):
                defaults = of_preset if name == "encode" else {**shared, **of_preset}
                if not given.get("for_research"):
                    _refuse_values_of_preset(name, groups[name], defaults)
                groups[name] = {**defaults, **groups[name]}
        return {**given, **groups}

    @classmethod
    def from_preset(
        cls,
        preset: Preset | str = Preset.BALANCED,
        *,
        compact: Mapping[str, Any] | CompactSettings | None = None,
        finetune: Mapping[str, Any] | FinetuneSettings | None = None,
        time_limit: float | str | None = None,
        **encode: Any,  # noqa: ANN401
    ) -> Settings:
        """Return the settings of a preset, with those that are given replaced.

        Args:
            preset: name of the preset.
            compact: settings of compaction to replace.
            finetune: settings of fine-tuning to replace.
            time_limit: seconds that a compression may take, or 30s, 2min, 1h; None for no limit.
            encode: settings of the encoder to replace.

        Raises:
            UnsupportedError: an unknown preset or setting, or a value out of range.
        """
        return _validated(preset, {}, compact=compact, finetune=finetune, time_limit=time_limit, **encode)

    @classmethod
    def research(cls, preset: Preset | str = Preset.BALANCED, **changes: Any) -> Settings:  # noqa: ANN401
        """Return settings as :meth:`from_preset` does, where values that belong to the preset may be replaced too.

        docs/reference/research.md lists them. They may change with any version.
        """
        return _validated(preset, {"for_research": True}, **changes)


def _validated(
    preset: Preset | str,
    marks: Mapping[str, bool],
    /,
    *,
    compact: Any = None,  # noqa: ANN401
    finetune: Any = None,  # noqa: ANN401
    time_limit: float | str | None = None,
    **encode: Any,  # noqa: ANN401
) -> Settings:
    """Validate settings; an error becomes one sentence."""
    if preset not in list(Preset):
        raise UnsupportedError(f"there is no preset {preset!r}; choose one of {', '.join(Preset)}")
    groups = {"compact": compact or {}, "finetune": finetune or {}, "encode": encode}
    try:
        return Settings.model_validate({"preset": preset, "time_limit": time_limit, **groups, **marks})
    except ValidationError as error:
        problem = error.errors()[0]
        if problem["type"] == "value_error":
            raise UnsupportedError(str(problem["ctx"]["error"])) from error
        group, name = str(problem["loc"][0]), str(problem["loc"][-1])
        if problem["type"] == "extra_forbidden":
            known = ", ".join(GROUPS[group].public())
            raise UnsupportedError(f"there is no setting {name!r} of {group}; there are {known}") from error
        reason = problem["msg"][:1].lower() + problem["msg"][1:]
        raise UnsupportedError(f"setting {name}: {reason}, not {problem['input']!r}") from error


def _given_values(group: Any) -> Any:  # noqa: ANN401
    """Return the values that are given for a group; validation reports what is no group."""
    if isinstance(group, BaseModel):
        return group.model_dump(exclude_unset=True)
    return dict(group) if isinstance(group, Mapping) else group


def _shared_by_trainings(encode: Any) -> dict[str, Any]:  # noqa: ANN401
    """Return values of compaction and fine-tuning that settings of the encoder decide: the seed and the loss."""
    shared = dict[str, Any]()
    if isinstance(encode, dict):
        with contextlib.suppress(ValidationError):  # reported once, for the encoder
            shared["seed"] = pydantic.TypeAdapter(Seed).validate_python(encode.get("seed", 0))
        if encode.get("max_ssim_drop") is not None or encode.get("quality") is not None:
            shared["ssim_weight"] = SSIM_GOAL_WEIGHT
    return shared


def _refuse_values_of_preset(group: str, values: Mapping[str, Any], defaults: Mapping[str, Any]) -> None:
    """Raise ValueError for a value that belongs to the preset and differs from it; settings as JSON repeat them."""
    fields, public = GROUPS[group].model_fields, GROUPS[group].public()
    for name, value in values.items():
        if name in fields and name not in public and value != defaults.get(name, fields[name].default):
            raise ValueError(
                f"{name} of {group} belongs to the preset; choose another preset, or change it for research "
                "(Settings.research, docs/reference/research.md)"
            )
