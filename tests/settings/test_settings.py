"""Oracle: the bounds that the descriptions name, and pydantic's own round trip."""

import pytest
from helpers.examples import examples
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from kissgs import CompactSettings, EncodeSettings, FinetuneSettings, KissgsError, Preset, Settings, UnsupportedError
from kissgs.settings import PRESETS

NUMBERS = [name for name, field in EncodeSettings.model_fields.items() if field.annotation in (int, float)]
GROUPS = {"compact": CompactSettings, "encode": EncodeSettings, "finetune": FinetuneSettings}
OF_PRESET = [
    (group, name) for group, model in GROUPS.items() for name in model.model_fields if name not in model.public()
]
SCHEMA = Settings.model_json_schema()["$defs"]


@pytest.mark.parametrize("preset", list(Preset))
def test_presets_are_valid_and_named(preset):
    chosen = Settings.from_preset(preset)
    assert chosen.preset == preset
    assert chosen == Settings.from_preset(str(preset)) == Settings(preset=preset)
    for group, values in PRESETS[preset].items():
        for name, value in values.items():
            assert getattr(getattr(chosen, group), name) == value
    changed = Settings.from_preset(preset, max_encodes=3, seed=2)
    assert changed.encode == chosen.encode.model_copy(update={"max_encodes": 3, "seed": 2})
    assert changed == Settings.model_validate({"preset": preset, "encode": {"max_encodes": 3, "seed": 2}})
    assert changed == Settings(preset=preset, encode=EncodeSettings(max_encodes=3, seed=2))


def test_the_default_is_balanced_and_presets_differ():
    assert Settings() == Settings.from_preset() == Settings.from_preset("balanced") == Settings(encode={})
    assert Settings().encode == EncodeSettings()
    assert len({Settings.from_preset(preset).encode.model_dump_json() for preset in Preset}) == len(Preset)


@pytest.mark.parametrize("made", [Settings.from_preset, Settings.research])
@pytest.mark.parametrize("preset", list(Preset))
def test_settings_survive_json(preset, made):
    """A default of 7 where others write 7.0 made two containers of one scene differ by two bytes of metadata."""
    changes = {"sh_step": 2, "compact": {"views": 5}} if made == Settings.research else {"compact": {"ratio": 0.5}}
    chosen = made(preset, seed=7, **changes)
    for again in (chosen.model_dump(mode="json"), chosen.model_dump(mode="json", exclude_unset=True)):
        assert Settings.model_validate(again) == chosen
    for plain in (chosen, Settings.from_preset(preset)):
        assert Settings.model_validate_json(plain.model_dump_json()).model_dump_json() == plain.model_dump_json()
    if preset != "paper" and made == Settings.from_preset:
        chosen = made("balanced", max_ssim_drop=0.1).resolved(photographs=True, torch=True)
        assert Settings.model_validate_json(chosen.model_dump_json()) == chosen


def test_what_a_search_has_changed_is_valid_again():
    """A report states the values of the last container, such as another threshold for pruning."""
    plain = Settings()
    used = plain.model_copy(update={"encode": plain.encode.model_copy(update={"prune_threshold_bits": 50.0})})
    assert Settings.model_validate(used.as_json()).encode == used.encode
    assert plain.as_json() == plain.model_dump(mode="json")


def test_one_seed_is_for_everything():
    chosen = Settings.from_preset("balanced", seed=7)
    assert (chosen.encode.seed, chosen.compact.seed, chosen.finetune.seed) == (7, 7, 7)
    assert Settings.research("balanced", seed=7, compact={"seed": 3}).compact.seed == 3


@pytest.mark.parametrize("preset", list(Preset))
def test_the_loss_of_trainings_follows_the_goal(preset):
    """A limit of SSIM gives it more weight, unless the preset says how much."""
    wanted = {"paper": 0.2}.get(preset, 0.4)
    goal = {} if preset in ("fast", "paper") else {"max_ssim_drop": 0.1}
    chosen = Settings.from_preset(preset, **goal)
    assert {chosen.compact.ssim_weight, chosen.finetune.ssim_weight} == {wanted if goal or preset == "paper" else 0.3}


OTHER = {
    "pras_at": [0.5],
    "lr_offset": 9,
    "order": "hilbert",
    "rotation_form": "pras",
    "codebook_order": "axes",
    "plas_radius_decay": 0.9,
    "means_bits": 9,
    "plas_start_radius": 9,
    "sensitivity_views": 9,
    "view_uncertainty": 0.3,
}
"""Another value where half of the preset's is none."""


@pytest.mark.parametrize(("group", "name"), OF_PRESET)
def test_what_belongs_to_a_preset_changes_only_by_research(group, name):
    """Otherwise it is refused, hidden from the schema, and yet may be repeated as the preset has it."""
    own = getattr(getattr(Settings(), group), name)
    if isinstance(own, bool):
        values = {name: not own}
    else:
        values = {name: OTHER.get(name) or (own // 2 or 2 if isinstance(own, int) else own / 2 or 1)}
    if group == "encode":
        values["rate_distortion"] = False
    given = values if group == "encode" else {group: values}
    with pytest.raises(UnsupportedError, match=rf"{'|'.join(values)} of {group} belongs to the preset; .*research"):
        Settings.from_preset("balanced", **given)
    assert Settings.model_validate({group: {name: own}}) == Settings()
    assert getattr(getattr(Settings.research("balanced", **given), group), name) == values[name]
    assert name not in SCHEMA[GROUPS[group].__name__]["properties"]


@pytest.mark.parametrize(("text", "found"), [("0.5", [0.5]), ("0.6,0.8", [0.6, 0.8]), ("", [])])
def test_fractions_can_be_given_as_text(text, found):
    """The command line gives them so: --set finetune.pras_at=0.6,0.8."""
    assert Settings.research("paper", finetune={"pras_at": text}).finetune.pras_at == found


def test_at_most_twenty_settings_are_public():
    others = [name for name in Settings.public() if name not in GROUPS]
    assert len(others) + sum(len(model.public()) for model in GROUPS.values()) <= 20


def test_settings_cannot_be_changed_afterwards():
    with pytest.raises(ValidationError, match="frozen"):
        Settings().encode.seed = 1


@pytest.mark.parametrize("preset", ["quick", "", None, 3, ["fast"], {"fast": 1}])
def test_an_unknown_preset_is_refused_with_the_list_of_presets(preset):
    """A list once raised TypeError, because it cannot be looked up in a set."""
    with pytest.raises(UnsupportedError) as caught:
        Settings.from_preset(preset)
    assert str(caught.value) == f"there is no preset {preset!r}; choose one of fast, balanced, paper"
    with pytest.raises(ValidationError):
        Settings.model_validate({"preset": preset})


def test_an_unknown_setting_is_refused_with_the_list_of_settings():
    with pytest.raises(UnsupportedError) as caught:
        Settings.from_preset("fast", speed=11)
    known = ", ".join(EncodeSettings.public())
    assert str(caught.value) == f"there is no setting 'speed' of encode; there are {known}"
    with pytest.raises(ValidationError, match="speed"):
        Settings.model_validate({"encode": {"speed": 11}})
    with pytest.raises(ValidationError, match="speed"):
        Settings.model_validate({"speed": 11})


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("means_bits", 17, "setting means_bits: input should be less than or equal to 16, not 17"),
        ("means_bits", 7, "setting means_bits: input should be greater than or equal to 8, not 7"),
        ("opacity_step", 0, "setting opacity_step: input should be greater than or equal to 0.0001, not 0"),
        ("order", "random", "setting order: input should be 'hilbert', 'refined' or 'plas', not 'random'"),
        ("seed", "x", "setting seed: input should be a valid integer, unable to parse string as an integer, not 'x'"),
    ],
)
def test_impossible_values_are_refused_by_name(name, value, sentence):
    with pytest.raises(UnsupportedError) as caught:
        Settings.research("fast", **{name: value})
    assert str(caught.value) == sentence


@pytest.mark.parametrize("name", NUMBERS)
def test_no_number_is_unbounded(name):
    low, high = {"seed": (-1, 2**31), "quality_offset_db": (-31, 31)}.get(name, (-1, 1e9))
    for value in (float("nan"), float("inf"), low, high, "much", None):
        with pytest.raises(UnsupportedError, match=f"setting {name}: "):
            Settings.research("balanced", **{name: value})


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.sampled_from(list(Preset)),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["preset", "encode", "seed"]), inner),
    max_leaves=6,
)


@examples(200)
@given(JSON)
def test_any_json_is_valid_or_refused(value):
    """A client of the service may send any JSON."""
    try:
        chosen = Settings.model_validate(value)
    except (ValidationError, KissgsError):
        return
    assert isinstance(chosen.encode, EncodeSettings)
