"""Oracle: PyYAML and json as other readers use them, jsonschema, and the rules of the paper's decoder on odd YAML."""

import json
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import yaml
from helpers import reference_decoder
from helpers.codec_scenes import GLANCE, random_scene
from helpers.examples import examples
from helpers.metadata_files import FILES, assert_same, document, quantize_of, with_document, with_json, with_yaml
from hypothesis import given
from hypothesis import strategies as st

from kissgs import Settings, compress, decompress
from kissgs.io.containers import MemorySource
from kissgs.sogxt.metadata import CHANNELS, Layout, read_layout

SCHEMA = json.loads((Path(__file__).parents[2] / "docs/reference/container_meta.schema.json").read_text())


@pytest.mark.parametrize(("preset", "count", "degree"), [("fast", 1, 0), ("balanced", 100, 3), ("paper", 100, 3)])
def test_what_we_write_follows_the_schema(preset, count, degree):
    files = compress(random_scene(count, degree), settings=Settings.research(preset, **GLANCE)).files
    jsonschema.validate(yaml.safe_load(files["container_meta.yaml"]), SCHEMA)


float32s = st.floats(width=32, allow_nan=False, allow_infinity=False, max_value=2.0**127, min_value=-(2.0**127))


@examples(60)
@given(st.lists(float32s, min_size=56, max_size=56), st.floats(-88, 88, width=32))
def test_every_float32_survives_both_spellings(numbers, mean):
    """YAML 1.1 reads 1e-05 as a string and 1.0e-05 as a number; PyYAML and json must both see the same float32."""
    numbers.insert(1, mean)
    first = np.cumsum([0, *CHANNELS.values()])
    exact = {field: np.float32(numbers[i : i + n]) for i, (field, n) in zip(first, CHANNELS.items(), strict=False)}
    spelled = {field: [float(str(number)) for number in values] for field, values in exact.items()}
    layout = Layout(count=0, grid_side=8, codebook_side=8, ranges={field: (low, low) for field, low in spelled.items()})
    document = yaml.safe_load(layout.to_yaml())
    for field, (low, _) in reference_decoder.ranges_of(document).items():
        found = np.ravel(low).tolist()
        assert all(type(number) is float for number in found)
        assert (np.float32(found) == exact[field]).all()
    for name, text in (("container_meta.yaml", layout.to_yaml()), ("meta.json", layout.to_meta_json())):
        text.decode("ascii")
        read = read_layout(MemorySource({name: text}))
        assert all((read.limits(field)[1] == values).all() for field, values in exact.items())


def test_infinities_cannot_be_written():
    with pytest.raises(ValueError, match="finite"):
        Layout(grid_side=8, codebook_side=8, ranges={"means": ([float("inf")], [1.0])})


def extra_keys(changed):
    del changed["kissgs"]
    changed |= {"packer": "another 1.0", "scene": {"primitives": "3DGS-INRIA"}, "profile": None}
    changed["meta"]["colour"] = "unknown"
    for op in changed["ops"]:
        op["transforms"][0]["simple_quantize"]["dim"] = 0
        op["comment"] = "hello"


def ops_of_other_kinds(changed):
    changed["ops"] += [
        {"input_fields": ["means", "scales"], "transforms": [{"simple_quantize": {"min_values": 7, "max_values": 9}}]},
        {"input_fields": [], "transforms": []},
        {"input_fields": ["means"]},
        {"input_fields": ["means"], "transforms": [{"simple_quantize": {"min": 7, "max": 9}}, {"sort": {"by": "x"}}]},
        {"input_fields": ["means"], "transforms": [{"simple_quantize": None}, {"simple_quantize": {}}]},
        {"input_fields": {"from_fields_with_prefix": "f_rest"}, "transforms": [{"combine": {}}]},
        {
            "input_fields": ["flavour"],
            "transforms": [{"simple_quantize": {"min_values": [1, 2], "max_values": [3, 4]}}],
        },
    ]


def fields_we_do_not_need(changed):
    """Unused fields may have any range: no decoder reads it."""
    quantize = {"min_values": ["sweet", None], "max_values": {"sour": ".inf"}}
    changed["ops"] += [{"input_fields": ["flavour"], "transforms": [{"simple_quantize": quantize}]}]


def nested_lists(changed):
    quantize = quantize_of(changed, "f_rest_centroids")
    for key in ("min_values", "max_values"):
        quantize[key] = [quantize[key][:15], quantize[key][15:30], quantize[key][30:]]


def numbers_as_strings(changed):
    for field in CHANNELS:
        quantize = quantize_of(changed, field)
        for key in ("min_values", "max_values"):
            values = quantize[key]
            quantize[key] = [f"{value:.12e}" for value in values] if isinstance(values, list) else f"{values:.12e}"
    changed["meta"] |= {"grid_side": "16", "f_rest_centroids_side": "8"}


def lists_of_one_number(changed):
    for field in ("means", "opacities"):
        quantize = quantize_of(changed, field)
        quantize |= {key: [value] for key, value in quantize.items()}


def later_ones_replace_earlier_ones(changed):
    wrong = {"simple_quantize": {"min_values": 5.0, "max_values": 6.0}}
    op = next(op for op in changed["ops"] if op["input_fields"] == ["means"])
    op["transforms"].insert(0, wrong)
    changed["ops"].insert(0, {"input_fields": ["means"], "transforms": [wrong]})


ODD_BUT_VALID = [
    extra_keys,
    ops_of_other_kinds,
    fields_we_do_not_need,
    nested_lists,
    numbers_as_strings,
    lists_of_one_number,
    later_ones_replace_earlier_ones,
    lambda changed: changed["ops"].reverse(),
    lambda changed: changed["kissgs"].update(version="99.0", mood={"bright": [1, 2]}),  # of a later version
]


@pytest.mark.parametrize("change", ODD_BUT_VALID, ids=lambda change: change.__name__)
def test_odd_but_valid_yaml(change):
    changed = document()
    change(changed)
    files = with_document(changed)
    found = decompress(files)
    assert_same(found)
    if change is not lists_of_one_number:  # the paper's decoder wants a scalar; older encoders write lists
        reference_decoder.assert_equal_scenes(found, reference_decoder.decode(files), FILES)


def spellings():
    text = FILES["container_meta.yaml"].decode()
    values = document()
    again = [1.5, 2.5, 3.5]
    quantize_of(values, "scales")["min_values"] = quantize_of(values, "f_dc")["min_values"] = again
    yield "json", json.dumps(document())
    yield "crlf", text.replace("\n", "\r\n")
    yield "byte order mark", b"\xef\xbb\xbf" + text.encode()
    yield "utf-16", text.encode("utf-16")
    yield "comments", "%YAML 1.1\n---\n# grüße\n" + text + "...\n"
    yield "flow", yaml.safe_dump(document(), default_flow_style=True)


@pytest.mark.parametrize(("name", "text"), list(spellings()))
def test_spellings_of_the_same_yaml(name, text):
    assert_same(decompress(with_yaml(text)))


@pytest.mark.parametrize(
    ("text", "wanted"),
    [("1e-05", 1e-05), ("1.0e-05", 1e-05), ("-0.5", -0.5), ("+.5", 0.5), ("7", 7.0), ("'7'", 7.0), ("1E+1", 10.0)],
)
def test_numbers_of_yaml(text, wanted):
    """YAML 1.1 reads the first as text; older encoders wrote it."""
    files = with_document(document())
    low = f"min_values: {quantize_of(document(), 'opacities')['min_values']}".encode()
    changed = files["container_meta.yaml"].replace(low, f"min_values: {text}".encode(), 1)
    assert changed != files["container_meta.yaml"]
    layout = read_layout(MemorySource({"container_meta.yaml": changed}))
    assert layout.limits("opacities")[0][0] == np.float32(wanted)


def test_aliases_as_dumpers_write_them():
    """PyYAML writes a list that occurs twice as an alias: nothing hostile about that."""
    changed = document()
    shared = [0.25, 0.5, 0.75]
    for field in ("scales", "f_dc"):
        quantize_of(changed, field)["max_values"] = shared
    files = with_document(changed)
    assert b"*id001" in files["container_meta.yaml"]
    layout = read_layout(MemorySource(files))
    assert layout.limits("scales")[1].tolist() == layout.limits("f_dc")[1].tolist() == shared


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_degree_of_foreign_containers_is_that_of_their_highest_band(degree):
    files = dict(compress(random_scene(30, degree), settings=Settings.from_preset("fast")).files)
    changed = yaml.safe_load(files["container_meta.yaml"])
    del changed["kissgs"], changed["kissgs_crc32"]
    files["container_meta.yaml"] = yaml.safe_dump(changed).encode()
    assert decompress(files).sh_degree == degree


@pytest.mark.parametrize("degree", [0, 3])
def test_meta_json_alone_gives_the_same_scene(degree):
    files = dict(compress(random_scene(40, degree), settings=Settings.from_preset("fast")).files)
    wanted = decompress(files)
    del files["container_meta.yaml"]
    assert_same(decompress(files), wanted)
    del files["scene.json"]
    assert_same(decompress(files), wanted)


def test_a_scalar_range_in_meta_json_stands_for_all_channels():
    """A number stands for all channels, as in viewers, and so does the first number of a list of another length."""
    low, high = -2.0, 3.0

    def scalar(meta):
        meta["sh0"] |= {"mins": low, "maxs": [high, 99]}

    def full(meta):
        meta["sh0"] |= {"mins": [low] * 3, "maxs": [high] * 3}

    assert_same(decompress(with_json(scalar)), decompress(with_json(full)))
