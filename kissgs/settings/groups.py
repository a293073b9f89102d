"""``Settings``: one group per stage, filled from a preset."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from kissgs.core.errors import UnsupportedError
from kissgs.settings.compact import CompactSettings
from kissgs.settings.duration import Duration
from kissgs.settings.encode import EncodeSettings
from kissgs.settings.finetune import FinetuneSettings
from kissgs.settings.presets import PRESETS, Preset
from kissgs.settings.training import SSIM_GOAL_WEIGHT, SSIM_WEIGHT

GROUPS: dict[str, type[BaseModel]] = {
    "compact": CompactSettings,
    "encode": EncodeSettings,
    "finetune": FinetuneSettings,
}


AIMED_DROP = 0.1
"""Loss of PSNR, decibels, that a search aims at where only its time is limited: few people see it."""


class Settings(BaseModel):
    """All settings of a compression: one group per stage."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    preset: Preset = Field(Preset.BALANCED, description="Preset that settings which are not given come from.")
    time_limit: Duration | None = Field(
        None,
        gt=0,
        le=1e6,
        description="Seconds that a compression may take, or 30s, 2min, 1h. A goal comes first: then time bounds the "
        "search. Without a goal: with photographs and torch, the smallest container found that loses at most 0.1 dB, "
        "or as little as time allows; else the preset, or fast if that takes too long. The same bytes are made again "
        "only where the machine is equally fast.",
    )
    compact: CompactSettings = CompactSettings()
    encode: EncodeSettings = EncodeSettings()
    finetune: FinetuneSettings = FinetuneSettings()

    @property
    def searches(self) -> bool:
        """Whether several scenes or containers are made to find one that meets a goal."""
        return self.encode.has_goal or self.compact.max_psnr_drop is not None

    @property
    def aims(self) -> bool:
        """Whether only the time is limited, so that training may choose the quality."""
        encode = self.encode
        return self.time_limit is not None and encode.rate_distortion and not encode.has_goal and not encode.rd_lambda

    def decided(self, *, photographs: bool | None, torch: bool) -> Self:
        """Return settings with what they leave open decided: whether training serves the goal, and by which loss.

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
        trains = torch and self.encode.psnr is None and (serves_goal or (self.aims and bool(photographs)))
        compact, finetune = self.compact, self.finetune
        ssim_weight = SSIM_WEIGHT if self.encode.max_ssim_drop is None else SSIM_GOAL_WEIGHT
        compact, finetune = compact.with_ssim_weight(ssim_weight), finetune.with_ssim_weight(ssim_weight)
        if compact.auto_count is None or self.aims:
            keeps_all = not compact.trains or (photographs is None and finetune.enabled is False)
            wanted = trains and not keeps_all and (compact.auto_count or not compact.enabled)
            compact = compact.model_copy(update={"auto_count": wanted})
        if finetune.enabled is None and (trains or not self.aims):
            finetune = finetune.model_copy(update={"enabled": trains})
        encode = self.encode
        if self.aims and compact.auto_count:
            encode = encode.model_copy(update={"max_psnr_drop": AIMED_DROP})
        return self.model_copy(update={"compact": compact, "encode": encode, "finetune": finetune})

    @model_validator(mode="after")
    def _a_goal_to_go_by(self) -> Self:
        if self.compact.auto_count and self.compact.method == "merge":
            raise ValueError("auto_count prunes; give count or ratio with method merge")
        compact = self.compact
        if self.time_limit is not None and (compact.count or compact.max_psnr_drop or (compact.ratio or 1.0) < 1):
            raise ValueError(
                "time_limit does not apply to compaction by a given budget: leave out count, ratio and max_psnr_drop "
                "of compact, or the time limit"
            )
        if self.compact.auto_count and not (self.encode.has_goal or self.aims):
            raise ValueError(
                "auto_count needs a goal: give target_size, max_psnr_drop, max_ssim_drop, psnr or a time limit, or the "
                "number of Gaussians to keep"
            )
        return self

    @model_validator(mode="before")
    @classmethod
    def _fill_from_preset(cls, given: Any) -> Any:  # noqa: ANN401
        if not isinstance(given, dict) or given.get("preset", Preset.BALANCED) not in list(Preset):
            return given  # validation reports the error
        chosen = PRESETS[Preset(given.get("preset", Preset.BALANCED))]
        return {**given, **{name: _filled(given.get(name, {}), chosen[name]) for name in GROUPS}}

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
        if preset not in list(Preset):
            raise UnsupportedError(f"there is no preset {preset!r}; choose one of {', '.join(Preset)}")
        try:
            return cls.model_validate(
                {
                    "preset": preset,
                    "time_limit": time_limit,
                    "compact": compact if isinstance(compact, CompactSettings) else dict(compact or {}),
                    "encode": encode,
                    "finetune": finetune if isinstance(finetune, FinetuneSettings) else dict(finetune or {}),
                }
            )
        except ValidationError as error:
            problem = error.errors()[0]
            if problem["type"] == "value_error":
                raise UnsupportedError(str(problem["ctx"]["error"])) from error
            group, name = str(problem["loc"][0]), str(problem["loc"][-1])
            if problem["type"] == "extra_forbidden":
                known = ", ".join(dict.fromkeys([*GROUPS[group].__annotations__, *GROUPS[group].model_fields]))
                raise UnsupportedError(f"there is no setting {name!r} of {group}; there are {known}") from error
            reason = problem["msg"][:1].lower() + problem["msg"][1:]
            raise UnsupportedError(f"setting {name}: {reason}, not {problem['input']!r}") from error


def _filled(group: Any, preset: Mapping[str, Any]) -> Any:  # noqa: ANN401
    """Return the values given for a group, completed from the preset."""
    if isinstance(group, BaseModel):
        group = group.model_dump(include=group.model_fields_set)
    return {**preset, **group} if isinstance(group, dict) else group
