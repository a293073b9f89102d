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
from kissgs.io.containers import MAX_METADATA_BYTES, MemorySource
from kissgs.sogxt.metadata import CHANNELS, read_layout

JSON_ERRORS = [
    (lambda meta: meta.pop("means"), "meta.json lacks something that a SOG-XT container has: 'means'"),
    (lambda meta: meta.pop("shN"), "meta.json lacks something that a SOG-XT container has: 'shN'"),
    (lambda meta: meta.pop("gridSide"), "meta.json lacks something that a SOG-XT container has: 'gridSide'"),
    (lambda meta: meta["sh0"].update(mins=[]), "meta.json: the range of f_dc has 0 numbers, not 3"),
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


@pytest.mark.parametrize("data", [b"", b"{", b"\xff\xfe\xfd", b'{"a": ' * 5000, b"NaN", b"[" * 100_000])
def test_what_is_no_json_is_refused(data):
    assert refusal({"meta.json": data}) == "meta.json is not readable JSON; export the scene again"


@pytest.mark.parametrize("data", [b"[]", b"null", b"3", b'"text"', b"1" * 5000])
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
        "container_meta.yaml: ranges.opacities.1.0: input should be less than",
    ),
    (
        lambda d: quantize_of(d, "opacities").update(max_values="high"),
        "container_meta.yaml: ranges.opacities.1.0: input should be a valid number",
    ),
    (
        lambda d: quantize_of(d, "means").update(min_values=True),
        "container_meta.yaml: ranges.means.0.0: input should be a valid number, not true or false",
    ),
    (
        lambda d: d["meta"].update(f_rest_centroids_side=True),
        "container_meta.yaml: codebook_side: input should be a valid number, not true or false",
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
    sentence = f"has {len(text)} bytes; the limit for this file is {MAX_METADATA_BYTES}"
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
