"""``Settings``: one group per stage, filled from a preset."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from typing import Any, Self

from pydantic import BaseModel, Field, TypeAdapter, ValidationError, model_validator

from kissgs.core.errors import UnsupportedError
from kissgs.settings.compact import CompactSettings
from kissgs.settings.duration import Duration
from kissgs.settings.encode import EncodeSettings
from kissgs.settings.finetune import FinetuneSettings
from kissgs.settings.presets import PRESETS, Preset
from kissgs.settings.stage import Seed, StageSettings, of_preset
from kissgs.settings.training import SSIM_GOAL_WEIGHT

GROUPS: dict[str, type[StageSettings]] = {
    "compact": CompactSettings,
    "encode": EncodeSettings,
    "finetune": FinetuneSettings,
}

AIMED_DROP = 0.1
"""Loss of PSNR, decibels, that a search aims at where only its time is limited: few people see it."""


class Settings(StageSettings):
    """All settings of a compression: one group per stage."""

    preset: Preset = Field(Preset.BALANCED, description="Preset that settings which are not given come from.")
    time_limit: Duration | None = Field(
        None,
        gt=0,
        le=1e6,
        description="Seconds that a compression may take, or 30s, 2min, 1h. A goal comes first: then time bounds the "
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
    def aims(self) -> bool:
        """Whether only the time is limited, so that training may choose the quality."""
        encode = self.encode
        return self.time_limit is not None and encode.rate_distortion and not encode.has_goal and not encode.rd_lambda

    def decided(self, *, photographs: bool | None, torch: bool) -> Self:
        """Return settings with what they leave open decided: whether training serves the goal.

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
        groups = {name: _given_values(given.get(name, {})) for name in GROUPS}
        chosen = PRESETS[Preset(given.get("preset", Preset.BALANCED))]
        shared = _shared_by_trainings(groups["encode"])
        for name, values in groups.items():
            if isinstance(values, dict):
                preset = chosen[name] if name == "encode" else {**shared, **chosen[name]}
                if not given.get("for_research"):
                    _refuse_values_of_preset(name, values, preset)
                groups[name] = {**preset, **values}
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
        return _validated(preset, {"compact": compact, "finetune": finetune, "time_limit": time_limit, **encode})

    @classmethod
    def research(cls, preset: Preset | str = Preset.BALANCED, **changes: Any) -> Settings:  # noqa: ANN401
        """Return settings as :meth:`from_preset` does, where values that belong to the preset may be replaced too.

        docs/reference/research.md lists them. They may change with any version.
        """
        return _validated(preset, changes, for_research=True)


def _validated(preset: Preset | str, changes: dict[str, Any], **marks: bool) -> Settings:
    """Validate settings; an error becomes one sentence."""
    if preset not in list(Preset):
        raise UnsupportedError(f"there is no preset {preset!r}; choose one of {', '.join(Preset)}")
    others = {name: changes.pop(name, None) for name in ("compact", "finetune", "time_limit")}
    compact, finetune = others["compact"] or {}, others["finetune"] or {}
    given = {**others, **marks, "preset": preset, "compact": compact, "finetune": finetune, "encode": changes}
    try:
        return Settings.model_validate(given)
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
        return group.model_dump(include=group.model_fields_set)
    return dict(group) if isinstance(group, Mapping) else group


def _shared_by_trainings(encode: Any) -> dict[str, Any]:  # noqa: ANN401
    """Return values of compaction and fine-tuning that settings of the encoder decide: the seed and the loss."""
    if not isinstance(encode, dict):
        return {}
    shared = dict[str, Any]()
    with contextlib.suppress(ValidationError):  # reported once, for the encoder
        shared["seed"] = _SEED.validate_python(encode.get("seed", 0))
    if encode.get("max_ssim_drop") is not None:
        shared["ssim_weight"] = SSIM_GOAL_WEIGHT
    return shared


_SEED = TypeAdapter(Seed)


def _refuse_values_of_preset(group: str, values: Mapping[str, Any], preset: Mapping[str, Any]) -> None:
    """Raise ValueError for a value that belongs to the preset and differs from it; settings as JSON repeat them."""
    model = GROUPS[group]
    fields, public = model.model_fields, model.public()
    for name, value in values.items():
        if name in fields and name not in public and value != preset.get(name, fields[name].default):
            raise ValueError(
                f"{name} of {group} belongs to the preset; choose another preset, or change it for research "
                "(Settings.research, docs/reference/research.md)"
            )
