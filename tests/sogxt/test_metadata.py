"""Oracle: PyYAML and json as other readers use them, jsonschema, and the rules of the paper's decoder on odd YAML."""

import json
import os
import subprocess
import sys
from pathlib import Path

import jsonschema
import numpy as np
import oracle
import pytest
import yaml
from codec_scenes import PRESETS, random_scene, replaced
from hypothesis import given, settings
from hypothesis import strategies as st

import kissgs
from kissgs import InvalidContainerError, KissgsError, Settings, UnsupportedError, compress, decompress
from kissgs.sogxt.container import MemorySource
from kissgs.sogxt.metadata import CHANNELS, ContainerMeta, Layout
from kissgs.sogxt.metadata_reader import MAX_METADATA_BYTES, read_layout
from kissgs.splats import ATTRIBUTES

FILES = compress(random_scene(70, 2, seed=4), settings=Settings.from_preset("fast")).files


def document():
    return yaml.safe_load(FILES["container_meta.yaml"])


def with_yaml(text):
    return {**FILES, "container_meta.yaml": text if isinstance(text, bytes) else text.encode()}


def with_document(changed):
    return with_yaml(yaml.safe_dump(changed))


def with_json(change):
    """Files without the YAML, ``meta.json`` changed by a function."""
    meta = json.loads(FILES["meta.json"])
    change(meta)
    files = {**FILES, "meta.json": json.dumps(meta).encode()}
    del files["container_meta.yaml"]
    return files


def quantize_of(changed, field):
    """The part of a document that holds the range of ``field``."""
    op = next(op for op in changed["ops"] if op["input_fields"] == [field])
    return op["transforms"][0]["simple_quantize"]


def refusal(files, kind=InvalidContainerError):
    with pytest.raises(kind) as caught:
        decompress(files)
    return str(caught.value)


def assert_same(found, wanted=None):
    wanted = wanted or decompress(FILES)
    assert all(np.array_equal(getattr(found, name), getattr(wanted, name)) for name in ATTRIBUTES)


# --- What we write --------------------------------------------------------------------------------


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize(("count", "degree"), [(1, 0), (100, 3)])
def test_what_we_write_follows_the_schema(preset, count, degree):
    files = compress(random_scene(count, degree), settings=Settings.from_preset(preset)).files
    jsonschema.validate(yaml.safe_load(files["container_meta.yaml"]), ContainerMeta.model_json_schema())


@pytest.mark.parametrize("broken", ["meta", "ops", "codec", "side", "range"])
def test_the_schema_can_fail(broken):
    changed = document()
    if broken in ("meta", "ops"):
        del changed[broken]
    elif broken == "range":
        quantize_of(changed, "means")["min_values"] = "low"
    else:
        changed["meta"]["image_codec" if broken == "codec" else "grid_side"] = 0
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(changed, ContainerMeta.model_json_schema())


float32s = st.floats(width=32, allow_nan=False, allow_infinity=False, max_value=2.0**127, min_value=-(2.0**127))


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.lists(float32s, min_size=56, max_size=56), st.floats(-88, 88, width=32))
def test_every_float32_survives_both_spellings(numbers, mean):
    """YAML 1.1 reads 1e-05 as a string and 1.0e-05 as a number; PyYAML and json must both see the same float32."""
    numbers.insert(1, mean)
    first = np.cumsum([0, *CHANNELS.values()])
    exact = {field: np.float32(numbers[i : i + n]) for i, (field, n) in zip(first, CHANNELS.items(), strict=False)}
    spelled = {field: [float(str(number)) for number in values] for field, values in exact.items()}
    layout = Layout(grid_side=8, codebook_side=8, ranges={field: (low, low) for field, low in spelled.items()})
    document = yaml.safe_load(layout.to_yaml())
    for field, (low, _) in oracle.ranges_of(document).items():
        found = np.ravel(low).tolist()
        assert all(type(number) is float for number in found)
        assert (np.float32(found) == exact[field]).all()
    for name, text in (("container_meta.yaml", layout.to_yaml()), ("meta.json", layout.to_meta_json())):
        text.decode("ascii")
        read = read_layout(MemorySource({name: text}))
        assert all((read.limits(field)[1] == values).all() for field, values in exact.items())


def test_tiny_numbers_are_spelled_so_that_yaml_sees_numbers():
    splats = random_scene(50, 0)
    files = compress(replaced(splats, sh0=splats.sh0 * 1e-7, means=splats.means * 1e-6)).files
    low, high = oracle.ranges_of(yaml.safe_load(files["container_meta.yaml"]))["f_dc"]
    assert {type(number) for number in low + high} == {float}
    assert b"e-0" in files["container_meta.yaml"]


def test_infinities_cannot_be_written():
    with pytest.raises(ValueError, match="finite"):
        Layout(grid_side=8, codebook_side=8, ranges={"means": ([float("inf")], [1.0])})


# --- Foreign YAML that the paper's decoder reads --------------------------------------------------


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
    """Their ranges may be anything: nobody looks at them."""
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


def later_op_replaces_earlier(changed):
    wrong = [{"simple_quantize": {"min_values": 5.0, "max_values": 6.0}}]
    changed["ops"].insert(0, {"input_fields": ["means"], "transforms": wrong})


def later_transform_replaces_earlier(changed):
    op = next(op for op in changed["ops"] if op["input_fields"] == ["means"])
    op["transforms"].insert(0, {"simple_quantize": {"min_values": 5.0, "max_values": 6.0}})


def other_order(changed):
    changed["ops"].reverse()


def provenance_of_a_later_version(changed):
    changed["kissgs"] |= {"version": "99.0", "mood": {"bright": [1, 2]}}


ODD_BUT_VALID = [
    extra_keys,
    ops_of_other_kinds,
    fields_we_do_not_need,
    nested_lists,
    numbers_as_strings,
    lists_of_one_number,
    later_op_replaces_earlier,
    later_transform_replaces_earlier,
    other_order,
    provenance_of_a_later_version,
]


@pytest.mark.parametrize("change", ODD_BUT_VALID, ids=lambda change: change.__name__)
def test_odd_but_valid_yaml(change):
    changed = document()
    change(changed)
    files = with_document(changed)
    found = decompress(files)
    assert_same(found)
    if change is not lists_of_one_number:  # the paper's decoder wants a scalar; older encoders write lists
        oracle.assert_equal_scenes(found, oracle.decode(files), FILES)


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
    files = dict(compress(random_scene(30, degree)).files)
    changed = yaml.safe_load(files["container_meta.yaml"])
    del changed["kissgs"]
    files["container_meta.yaml"] = yaml.safe_dump(changed).encode()
    assert decompress(files).sh_degree == degree


# --- meta.json alone ------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_meta_json_alone_gives_the_same_scene(degree):
    files = dict(compress(random_scene(40, degree)).files)
    wanted = decompress(files)
    del files["container_meta.yaml"]
    assert_same(decompress(files), wanted)
    del files["scene.json"]
    assert_same(decompress(files), wanted)


def test_a_scalar_range_in_meta_json_stands_for_all_channels():
    """As viewers do; and a list of another length by its first number."""
    low, high = -2.0, 3.0

    def scalar(meta):
        meta["sh0"] |= {"mins": low, "maxs": [high, 99]}

    def full(meta):
        meta["sh0"] |= {"mins": [low] * 3, "maxs": [high] * 3}

    assert_same(decompress(with_json(scalar)), decompress(with_json(full)))


JSON_ERRORS = [
    (lambda meta: meta.pop("means"), "meta.json lacks something that a SOG-XT container has: 'means'"),
    (lambda meta: meta.pop("shN"), "meta.json lacks something that a SOG-XT container has: 'shN'"),
    (lambda meta: meta.pop("gridSide"), "meta.json lacks something that a SOG-XT container has: 'gridSide'"),
    (lambda meta: meta["sh0"].update(mins=[]), "meta.json lacks something that a SOG-XT container has"),
    (lambda meta: meta["sh0"].update(mins="low"), "meta.json: ranges.f_dc.0.0: input should be a valid number"),
    (lambda meta: meta.update(gridSide=0), "meta.json: grid_side: input should be greater than or equal to 1"),
    (lambda meta: meta.update(gridSide=13377), "meta.json: grid_side: input should be less than or equal to 13376"),
]

DIALECTS = [
    (lambda meta: meta.update(format="sog"), "meta.json: format is 'sog'; only 'sog-xt' is read"),
    (lambda meta: meta.update(version=99), "meta.json: version is 99; only 3 is read"),
    (lambda meta: meta["quats"].update(encoding="x"), "meta.json: quats.encoding is 'x'; only 'direct' is read"),
    (lambda meta: meta["shN"].update(layout="x"), "meta.json: shN.layout is 'x'; only 'uv-codebook' is read"),
]


@pytest.mark.parametrize(("change", "sentence"), DIALECTS)
def test_other_dialects_are_not_decoded_to_nonsense(change, sentence):
    with pytest.raises(UnsupportedError) as caught:
        read_layout(MemorySource(with_json(change)))
    assert str(caught.value) == sentence


@pytest.mark.parametrize(("change", "sentence"), JSON_ERRORS)
def test_impossible_meta_json_is_refused(change, sentence):
    assert refusal(with_json(change)).startswith(sentence)


@pytest.mark.parametrize("data", [b"", b"{", b"\xff\xfe\xfd", b'{"a": ' * 5000, b"1" * 5000, b"[" * 100_000])
def test_what_is_no_json_is_refused(data):
    assert refusal({"meta.json": data}) == "meta.json is not readable JSON"


@pytest.mark.parametrize("data", [b"[]", b"null", b"3", b'"text"'])
def test_json_that_is_no_object_is_refused(data):
    assert refusal({"meta.json": data}).startswith("meta.json lacks something that a SOG-XT container has")


def test_images_other_than_webp_are_unsupported_by_name():
    def png(meta):
        meta["mask"]["files"] = ["active_mask.png"]

    assert refusal(with_json(png), UnsupportedError) == "the container's images are 'png' files; only 'webp' is read"
    changed = document()
    changed["meta"]["image_codec"] = "avif"
    sentence = "the container's images are 'avif' files; only 'webp' is read"
    assert refusal(with_document(changed), UnsupportedError) == sentence


# --- YAML that is refused -------------------------------------------------------------------------


def test_no_metadata_at_all():
    sentence = "this is no SOG-XT container: it has neither container_meta.yaml nor meta.json"
    assert refusal({"active_mask.webp": FILES["active_mask.webp"]}) == sentence
    assert refusal({}) == sentence


@pytest.mark.parametrize(
    "text", [b"a: [", b"\t- x", b"a: b: c", b"\x00", b"!!python/object/apply:os.system [ls]", b"\xff\xff"]
)
def test_what_is_no_yaml_is_refused(text):
    assert refusal(with_yaml(text)) == "container_meta.yaml is not readable YAML"


def mapping_of_fields(changed):
    changed["ops"][0]["input_fields"] = {"from_fields_with_prefix": "opa"}


FORM = "container_meta.yaml lacks 'meta' or 'ops', or they are not of the expected form"
YAML_ERRORS = [
    (lambda d: d.pop("meta"), FORM),
    (lambda d: d.pop("ops"), FORM),
    (lambda d: d.update(ops=3), FORM),
    (lambda d: d.update(ops=["means"]), FORM),
    (lambda d: d["ops"][0].pop("input_fields"), FORM),
    (lambda d: d["ops"][0].update(transforms=None), FORM),
    (lambda d: d["ops"][0].update(input_fields=[["opacities"]]), FORM),
    (lambda d: quantize_of(d, "means").pop("max_values"), FORM),
    (mapping_of_fields, FORM),
    (lambda d: d["ops"].pop(0), "container_meta.yaml gives no range for opacities"),
    (lambda d: d["ops"].pop(-1), "container_meta.yaml gives no range for f_rest_centroids"),
    (
        lambda d: quantize_of(d, "scales").update(min_values=[1.0, 2.0]),
        "container_meta.yaml: the range of scales has 2 numbers, not 3",
    ),
    (
        lambda d: quantize_of(d, "means").update(max_values=[1.0, 2.0, 3.0]),
        "container_meta.yaml: the range of means has 3 numbers, not 1",
    ),
    (
        lambda d: quantize_of(d, "f_rest_centroids").update(max_values=[0.0] * 24),
        "container_meta.yaml: the range of f_rest_centroids has 24 numbers, not 45",
    ),
    (
        lambda d: quantize_of(d, "means").update(max_values=88.8),
        "container_meta.yaml: the range of means ends beyond ±88.7, which float32 cannot hold",
    ),
    (
        lambda d: quantize_of(d, "means").update(min_values=-1000),
        "container_meta.yaml: the range of means ends beyond ±88.7, which float32 cannot hold",
    ),
    (
        lambda d: quantize_of(d, "f_dc").update(min_values=[0.0, float("inf"), 0.0]),
        "container_meta.yaml: ranges.f_dc.0.1: input should be a finite number",
    ),
    (
        lambda d: quantize_of(d, "opacities").update(max_values=float("nan")),
        "container_meta.yaml: ranges.opacities.1.0: input should be a finite number",
    ),
    (
        lambda d: quantize_of(d, "opacities").update(max_values=1e39),
        "container_meta.yaml: ranges.opacities.1.0: input should be less than or equal to",
    ),
    (
        lambda d: quantize_of(d, "opacities").update(max_values="high"),
        "container_meta.yaml: ranges.opacities.1.0: input should be a valid number",
    ),
    (
        lambda d: d["meta"].update(grid_side=0),
        "container_meta.yaml: grid_side: input should be greater than or equal to 1",
    ),
    (
        lambda d: d["meta"].update(grid_side=13377),
        "container_meta.yaml: grid_side: input should be less than or equal to 13376",
    ),
    (lambda d: d["meta"].pop("grid_side"), "container_meta.yaml: grid_side: input should be a valid integer"),
    (lambda d: d["meta"].update(grid_side="eight"), "container_meta.yaml: grid_side: input should be a valid integer"),
    (
        lambda d: d["meta"].update(f_rest_centroids_side=257),
        "container_meta.yaml: codebook_side: input should be less than or equal to 256",
    ),
    (
        lambda d: d["kissgs"].update(sh_degree=4),
        "container_meta.yaml: provenance.sh_degree: input should be less than or equal to 3",
    ),
    (lambda d: d["kissgs"].update(count=-1), "container_meta.yaml: count: input should be greater than"),
    (lambda d: d.update(kissgs="yes"), "container_meta.yaml: provenance: input should be a valid dictionary"),
]


@pytest.mark.parametrize(("change", "sentence"), YAML_ERRORS)
def test_impossible_yaml_is_refused(change, sentence):
    changed = document()
    change(changed)
    assert refusal(with_document(changed)).startswith(sentence)


def test_metadata_of_megabytes_is_refused_unread():
    text = b"# " + b"x" * MAX_METADATA_BYTES
    sentence = f"has {len(text)} bytes; at most {MAX_METADATA_BYTES} are possible here"
    assert refusal({"container_meta.yaml": text}) == f"container_meta.yaml {sentence}"
    assert refusal({"meta.json": text}) == f"meta.json {sentence}"


# --- Bombs: a few bytes that would grow without bounds --------------------------------------------


def laughs(depth):
    """Lists of nine aliases to lists of nine aliases …, ``depth`` times."""
    lines = ["x0: &x0 [1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0]"]
    lines += [f"x{i + 1}: &x{i + 1} [{', '.join([f'*x{i}'] * 9)}]" for i in range(depth)]
    return "\n".join(lines) + f"\nlaughs: &laughs {{a: *x{depth}}}\n"


@pytest.mark.parametrize("where", ["min_values: *x12", "min_values: 0.0, simple: *x12"])
def test_a_billion_laughs_are_not_laughed(where):
    text = laughs(12) + yaml.safe_dump({"meta": document()["meta"]})
    text += f"ops:\n- input_fields: [means]\n  transforms: [{{simple_quantize: {{{where}, max_values: 1.0}}}}]\n"
    assert refusal(with_yaml(text)).startswith("container_meta.yaml")


HOSTILE = {
    # Every merge doubles the number of keys: 2^40 of them.
    "merges": "a0: &a0 {x: 1}\n" + "".join(f"a{i + 1}: &a{i + 1} {{<<: [*a{i}, *a{i}]}}\n" for i in range(40)),
    # Composing is a recursion in C, which no limit of Python's stops before the stack ends.
    "dashes": "- " * 400_000,
    "brackets": "[" * 400_000,
    "questions": "? " * 400_000,
}


@pytest.mark.parametrize("bomb", HOSTILE)
def test_hostile_yaml_neither_crashes_nor_hangs_the_process(bomb):
    """Run apart, because it once killed the interpreter (segmentation fault) or kept it busy for hours."""
    program = """
import sys, kissgs
try:
    kissgs.decompress({"container_meta.yaml": sys.stdin.buffer.read()})
except kissgs.InvalidContainerError as error:
    print(error)
"""
    home = str(Path(kissgs.__file__).parents[1])
    run = subprocess.run(
        [sys.executable, "-P", "-c", program],
        env=os.environ | {"PYTHONPATH": home},
        input=HOSTILE[bomb].encode(),
        capture_output=True,
        timeout=10,
        check=False,
    )
    assert (run.returncode, run.stderr) == (0, b"")
    assert run.stdout.startswith(b"container_meta.yaml")


LEAVES = st.none() | st.booleans() | st.floats() | st.text(max_size=5) | st.integers()


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.recursive(LEAVES, st.lists, max_leaves=8), st.data())
def test_any_value_in_any_place_is_read_or_refused(value, data):
    changed = document()
    place, key = data.draw(
        st.sampled_from(
            [
                *((part, key) for part in (changed, changed["meta"], changed["kissgs"]) for key in part),
                *((changed["ops"], i) for i in range(6)),
                *((op, key) for op in changed["ops"] for key in op),
                *((quantize_of(changed, field), key) for field in CHANNELS for key in ("min_values", "max_values")),
            ]
        )
    )
    place[key] = value
    try:
        found = decompress(with_document(changed))
    except KissgsError:
        return
    assert all(np.isfinite(getattr(found, name)).all() for name in ATTRIBUTES)
