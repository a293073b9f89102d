"""Oracle: the bounds that the descriptions name, and pydantic's own round trip."""

import pytest
from helpers.examples import examples
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from kissgs import EncodeSettings, KissgsError, Preset, Settings, UnsupportedError
from kissgs.settings import PRESETS

NUMBERS = [name for name, field in EncodeSettings.model_fields.items() if field.annotation in (int, float)]


@pytest.mark.parametrize("preset", list(Preset))
def test_presets_are_valid_and_named(preset):
    chosen = Settings.from_preset(preset)
    assert chosen.preset == preset
    assert chosen == Settings.from_preset(str(preset)) == Settings(preset=preset)
    for group, values in PRESETS[preset].items():
        for name, value in values.items():
            assert getattr(getattr(chosen, group), name) == value


def test_the_default_is_balanced_and_balanced_is_the_defaults():
    assert Settings() == Settings.from_preset() == Settings.from_preset("balanced") == Settings(encode={})
    assert Settings().encode == EncodeSettings()


def test_presets_differ():
    assert len({Settings.from_preset(preset).encode.model_dump_json() for preset in Preset}) == len(Preset)


@pytest.mark.parametrize("preset", list(Preset))
def test_single_settings_replace_those_of_the_preset(preset):
    changed = Settings.from_preset(preset, gaussians_per_codebook_entry=33, sh_step=2)
    plain = Settings.from_preset(preset)
    assert (changed.encode.gaussians_per_codebook_entry, changed.encode.sh_step) == (33, 2)
    assert changed.encode == plain.encode.model_copy(update={"gaussians_per_codebook_entry": 33, "sh_step": 2})
    assert changed == Settings.model_validate(
        {"preset": preset, "encode": {"gaussians_per_codebook_entry": 33, "sh_step": 2}}
    )


@pytest.mark.parametrize("preset", list(Preset))
def test_settings_survive_json(preset):
    """Reports and containers carry them; they must give the same settings again."""
    chosen = Settings.from_preset(preset, seed=7)
    assert Settings.model_validate_json(chosen.model_dump_json()) == chosen
    assert Settings.model_validate(chosen.model_dump()) == chosen


def test_a_group_changes_only_what_was_given_to_it():
    """Unset values come from the given preset, not from the default one."""
    settings = Settings(preset="paper", encode=EncodeSettings(gaussians_per_codebook_entry=99))
    assert settings == Settings.from_preset("paper", gaussians_per_codebook_entry=99)


def test_settings_cannot_be_changed_afterwards():
    with pytest.raises(ValidationError, match="frozen"):
        Settings().encode.seed = 1


@pytest.mark.parametrize("preset", ["quick", "", None, 3, ["fast"], {"fast": 1}])
def test_an_unknown_preset_is_refused_with_the_list_of_presets(preset):
    """A list once raised TypeError, because it cannot be looked up in a set."""
    with pytest.raises(UnsupportedError) as caught:
        Settings.from_preset(preset)
    assert str(caught.value) == f"there is no preset {preset!r}; choose one of fast, balanced, small, paper"
    with pytest.raises(ValidationError):
        Settings.model_validate({"preset": preset})


def test_an_unknown_setting_is_refused_with_the_list_of_settings():
    with pytest.raises(UnsupportedError) as caught:
        Settings.from_preset("fast", speed=11)
    known = ", ".join(EncodeSettings.model_fields)
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
        Settings.from_preset("fast", **{name: value})
    assert str(caught.value) == sentence


@pytest.mark.parametrize("name", NUMBERS)
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1, 1e9, "much", None])
def test_no_number_is_unbounded(name, value):
    if name == "seed" and value == 1e9:
        value = 2**31
    if name == "quality_offset_db" and value == -1:
        value = -31
    with pytest.raises(UnsupportedError, match=f"setting {name}: "):
        Settings.from_preset("balanced", **{name: value})


@pytest.mark.parametrize("name", EncodeSettings.model_fields)
def test_every_setting_has_a_description(name):
    assert len(EncodeSettings.model_fields[name].description) > 20


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


@pytest.mark.parametrize("preset", list(Preset))
def test_a_default_that_is_spelled_out_is_written_the_same(preset):
    """A default of 7 where others write 7.0 made two containers of one scene differ by two bytes of metadata."""
    chosen = Settings.from_preset(preset)
    assert Settings.model_validate_json(chosen.model_dump_json()).model_dump_json() == chosen.model_dump_json()
