"""Metadata that must be refused in a sentence; oracles: docs/reference/format.md, the reference decoder's rules."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from helpers.examples import examples
from helpers.metadata_files import FILES, document, quantize_of, refusal, with_document, with_json, with_yaml
from hypothesis import given
from hypothesis import strategies as st

import kissgs
from kissgs import KissgsError, UnsupportedError, decompress
from kissgs.core.splats import ATTRIBUTES
from kissgs.io.containers import MAX_METADATA_BYTES
from kissgs.sogxt.metadata import CHANNELS

GONE = object()
LACKS = "lacks something that a SOG-XT container has:"
NUMBER, FINITE = "input should be a valid number", "input should be a finite number"
AT_LEAST_1, AT_MOST = "input should be greater than or equal to 1", "input should be less than or equal to"
FORM = "lacks 'meta' or 'ops', or they are not of the expected form"
BEYOND = "the range of means ends beyond ±88.7, which float32 cannot hold"

JSON_ERRORS = [
    ("means", GONE, f"{LACKS} 'means'"),
    ("shN", GONE, f"{LACKS} 'shN'"),
    ("gridSide", GONE, f"{LACKS} 'gridSide'"),
    ("sh0 mins", [], "the range of f_dc has 0 numbers, not 3"),
    ("sh0 mins", "low", f"ranges.f_dc.0.0: {NUMBER}"),
    ("gridSide", 0, f"grid_side: {AT_LEAST_1}"),
    ("gridSide", 13377, f"grid_side: {AT_MOST} 13376"),
]

UNSUPPORTED_JSON = [
    ("format", "sog", "meta.json: format is 'sog'; only 'sog-xt' is read"),
    ("version", 99, "meta.json: version is 99; only 3 is read"),
    ("quats encoding", "x", "meta.json: quats.encoding is 'x'; only 'direct' is read"),
    ("shN layout", "x", "meta.json: shN.layout is 'x'; only 'uv-codebook' is read"),
    ("mask files", ["active_mask.png"], "the container's images are 'png' files; only 'webp' is read"),
]

YAML_ERRORS = [
    ("meta", GONE, FORM),
    ("ops", GONE, FORM),
    ("ops", 3, FORM),
    ("ops 0 input_fields", GONE, FORM),
    ("ops 0 input_fields", {"from_fields_with_prefix": "opa"}, FORM),
    ("ops 0 transforms", None, FORM),
    ("ops 0", GONE, "gives no range for opacities"),
    ("ops -1", GONE, "gives no range for f_rest_centroids"),
    ("means max_values", GONE, FORM),
    ("scales min_values", [1.0, 2.0], "the range of scales has 2 numbers, not 3"),
    ("means max_values", [1.0, 2.0, 3.0], "the range of means has 3 numbers, not 1"),
    ("f_rest_centroids max_values", [0.0] * 24, "the range of f_rest_centroids has 24 numbers, not 45"),
    ("means max_values", 88.8, BEYOND),
    ("means min_values", -1000, BEYOND),
    ("f_dc min_values", [0.0, float("inf"), 0.0], f"ranges.f_dc.0.1: {FINITE}"),
    ("opacities max_values", float("nan"), f"ranges.opacities.1.0: {FINITE}"),
    ("opacities max_values", 1e39, "ranges.opacities.1.0: input should be less than"),
    ("means min_values", True, f"ranges.means.0.0: {NUMBER}, not true or false"),
    ("meta f_rest_centroids_side", True, f"codebook_side: {NUMBER}, not true or false"),
    ("meta f_rest_centroids_side", 257, f"codebook_side: {AT_MOST} 256"),
    ("meta grid_side", GONE, "grid_side: input should be a valid integer"),
    ("kissgs sh_degree", 4, f"provenance.sh_degree: {AT_MOST} 3"),
    ("kissgs count", -1, "count: input should be greater than"),
    ("kissgs", "yes", "provenance: input should be a valid dictionary"),
]


def put(metadata, path, value):
    """Set or remove a value of metadata; the name of a field stands for its range in the YAML."""
    *parents, last = path.split()
    for key in parents:
        if key not in metadata and key in CHANNELS:
            metadata = quantize_of(metadata, key)
        else:
            metadata = metadata[int(key) if isinstance(metadata, list) else key]
    last = int(last) if isinstance(metadata, list) else last
    if value is GONE:
        del metadata[last]
    else:
        metadata[last] = value


@pytest.mark.parametrize(("path", "value", "sentence"), UNSUPPORTED_JSON)
def test_other_dialects_are_not_decoded_to_nonsense(path, value, sentence):
    assert refusal(with_json(lambda meta: put(meta, path, value)), UnsupportedError) == sentence


@pytest.mark.parametrize(("path", "value", "sentence"), JSON_ERRORS)
def test_impossible_meta_json_is_refused(path, value, sentence):
    found = refusal(with_json(lambda meta: put(meta, path, value)))
    assert found.startswith(("meta.json " if sentence.startswith("lacks") else "meta.json: ") + sentence)


@pytest.mark.parametrize(("path", "value", "sentence"), YAML_ERRORS)
def test_impossible_yaml_is_refused(path, value, sentence):
    changed = document()
    put(changed, path, value)
    name = "container_meta.yaml"
    found = refusal(with_document(changed))
    assert found.startswith((f"{name} " if sentence.startswith(("lacks", "gives")) else f"{name}: ") + sentence)


@pytest.mark.parametrize("data", [b"", b"{", b"\xff\xfe\xfd", b'{"a": ' * 5000, b"NaN", b"[" * 100_000])
def test_what_is_no_json_is_refused(data):
    assert refusal({"meta.json": data}) == "meta.json is not readable JSON; export the scene again"


@pytest.mark.parametrize("data", [b"[]", b"null", b"3", b'"text"', b"1" * 5000])
def test_json_that_is_no_object_is_refused(data):
    assert refusal({"meta.json": data}).startswith("meta.json lacks something that a SOG-XT container has")


def test_images_other_than_webp_are_unsupported_by_name():
    changed = document()
    changed["meta"]["image_codec"] = "avif"
    sentence = "the container's images are 'avif' files; only 'webp' is read"
    assert refusal(with_document(changed), UnsupportedError) == sentence


def test_no_metadata_at_all():
    sentence = (
        "this is no container: it has neither container_meta.yaml nor meta.json, and no lod-meta.json or "
        "levels.json of a streamed scene; name the folder or the zip that has one"
    )
    assert refusal({"active_mask.webp": FILES["active_mask.webp"]}) == sentence
    assert refusal({}) == sentence


@pytest.mark.parametrize(
    "text", [b"a: [", b"\t- x", b"a: b: c", b"\x00", b"!!python/object/apply:os.system [ls]", b"\xff\xff"]
)
def test_what_is_no_yaml_is_refused(text):
    assert refusal(with_yaml(text)) == "container_meta.yaml is not readable YAML"


def test_metadata_of_megabytes_is_refused_unread():
    text = b"# " + b"x" * MAX_METADATA_BYTES
    sentence = f"has {len(text)} bytes; the limit for this file is {MAX_METADATA_BYTES}"
    assert refusal({"container_meta.yaml": text}) == f"container_meta.yaml {sentence}"
    assert refusal({"meta.json": text}) == f"meta.json {sentence}"


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
    # Numbers of base 60 in YAML 1.1, which take minutes, or overflow.
    "base 60": "x: " + ":".join(["1"] * 200_000),
    "base 60, a float": "x: " + "1:" * 5_000 + "1.5",
    "base 60, a tag": "x: !!float '" + "1:" * 200_000 + "1.5'",
    # Multiples of a modulus, whose hashes are all 0, so that Python would compare each key with all before it.
    "equal hashes": "{" + ", ".join(str(i * (2**61 - 1)) for i in range(1, 30_000)) + "}",
    "many values": "[" + "1," * 500_000 + "]",
}


def test_hostile_yaml_neither_crashes_nor_hangs_the_process():
    """Run apart, because each once killed the interpreter (segmentation fault) or kept it busy for hours."""
    program = """
import json, sys, kissgs
for name, text in json.load(sys.stdin).items():
    try:
        kissgs.decompress({"container_meta.yaml": text.encode()})
    except kissgs.InvalidContainerError as error:
        print(name, error, sep=": ", flush=True)
"""
    home = str(Path(kissgs.__file__).parents[1])
    run = subprocess.run(
        [sys.executable, "-P", "-c", program],
        env=os.environ | {"PYTHONPATH": home},
        input=json.dumps(HOSTILE),
        text=True,
        capture_output=True,
        timeout=300,
        check=False,
    )
    assert (run.returncode, run.stderr) == (0, ""), run.stdout
    for name, line in zip(HOSTILE, run.stdout.splitlines(), strict=True):
        assert line.startswith(f"{name}: container_meta.yaml")


LEAVES = st.none() | st.booleans() | st.floats() | st.text(max_size=5) | st.integers()


@examples(60)
@given(st.recursive(LEAVES, st.lists, max_leaves=8), st.data())
def test_any_value_in_any_place_is_read_or_refused(value, data):
    whole = {"document": document()}
    changed = whole["document"]
    place, key = data.draw(
        st.sampled_from(
            [
                *((part, key) for part in (whole, changed, changed["meta"], changed["kissgs"]) for key in part),
                *((changed["ops"], i) for i in range(6)),
                *((op, key) for op in changed["ops"] for key in op),
                *((quantize_of(changed, field), key) for field in CHANNELS for key in ("min_values", "max_values")),
            ]
        )
    )
    place[key] = value
    try:
        found = decompress(with_document(changed) if whole["document"] is changed else with_yaml(yaml.safe_dump(value)))
    except KissgsError:
        return
    assert all(np.isfinite(getattr(found, name)).all() for name in ATTRIBUTES)
