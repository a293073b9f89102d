"""Damaged and odd zips: JavaScript and Python read or refuse the same ones, with equal values; oracle: each other."""

import zipfile
from dataclasses import replace

import numpy as np
import pytest
from helpers.codec_scenes import random_scene
from helpers.reference_sog import zip_of
from helpers.web_scenes import array_of, container, in_node, job, ulps

from kissgs import KissgsError, Settings, compress, decompress
from kissgs.io.containers import zip_bytes

FILES = container("fast", 1, 20)
YAML, JSON = "container_meta.yaml", "meta.json"
MARKED = dict(
    compress(
        replace(random_scene(20, 1), antialiased=True, origin=(5000000.0, -2.5, 0.0)),
        settings=Settings.from_preset("fast"),
    ).files
)
ATTRIBUTES = ("means", "quats", "scales", "opacities", "sh0", "shN")


def in_python(data):
    """Return the scene, or the message with which it is refused."""
    try:
        return decompress(data)
    except KissgsError as error:
        return str(error)


def check_agreement(zips):
    """Check that both accept or refuse each zip, and that accepted scenes are equal; return which are accepted.

    Only Python reads containers without ``meta.json``, by their YAML.
    """
    answers = in_node(*(job(data) for data in zips))
    found = [in_python(data) for data in zips]
    for data, answer, scene in zip(zips, answers, found, strict=True):
        if "has no meta.json" in answer.get("error", {}).get("message", ""):
            continue
        assert ("error" in answer) == isinstance(scene, str), (answer.get("error"), scene, data)
        if not isinstance(scene, str):
            values = {name: np.ravel(getattr(scene, name)) for name in ATTRIBUTES}
            assert max(ulps(array_of(answer["arrays"][name], name), value) for name, value in values.items()) <= 1
    return ["error" not in answer for answer in answers]


def with_text(name, old, new, files=FILES):
    assert old in files[name]
    return zip_bytes({**files, name: files[name].replace(old, new, 1)})


def flagged(data, at, value):
    """Set a byte of each entry of the directory, and of its local header, which is four bytes shorter before it."""
    changed, start = bytearray(data), 0
    while (start := data.find(b"PK\1\2", start)) >= 0:
        changed[start + at] |= value
        start += 4
    return bytes(changed)


ENTRIES = [*FILES.items()]
ZIP = zip_bytes(FILES)
END = ZIP.rindex(b"PK\5\6")


def nested(depth):
    """Return metadata with a list in a list, as deep as that."""
    return zip_bytes({**FILES, JSON: b'{"nested":' + b"[" * depth + b"]" * depth + b"," + FILES[JSON][1:]})


ACCEPTED = {
    "as written": ZIP,
    "streamed": zip_of(ENTRIES, zipfile.ZIP_DEFLATED, streamed=True),
    "in a folder, with a note": zip_of([("a/note", b""), *((f"a/{name}", data) for name, data in ENTRIES)]),
    "data before": b"#!/bin/sh\n" * 9 + ZIP,
    "a comment": zip_of(FILES, comment=b"hello"),
    "bytes after the end": ZIP + b"\r\n",
    "no YAML": zip_of(pair for pair in ENTRIES if pair[0] != YAML),
    "another style of YAML": with_text(YAML, b"input_fields: [means]", b"input_fields:\n  - 'means'"),
    "with an origin, antialiased": zip_bytes(MARKED),
    "the origin of the world written out": with_text(YAML, b"kissgs:", b"kissgs:\n  origin: [0, 0.0, -0.0]"),
    "another case of the mark": with_text(YAML, b"model: antialiased", b"model: 'Antialiased'", MARKED),
    "nested as deep as allowed": nested(200),
    "another spelling of a number": with_text(YAML, b"grid_side: 8", b"grid_side: 8.0e+0"),
}
REFUSED = {
    "nested deeper": nested(201),
    "nested deeper than Python's parser": nested(50_000),
    "bzip2": zip_of(ENTRIES, zipfile.ZIP_BZIP2),
    "lzma": zip_of(ENTRIES, zipfile.ZIP_LZMA),
    "encrypted": flagged(ZIP, 8, 1),
    "a file twice": zip_of([*ENTRIES, ("other/meta.json", FILES[JSON])]),
    "a local header of another name": ZIP.replace(b"meta.json", b"metA.json", 1),
    "zip64": ZIP[:END] + b"PK\6\7".ljust(20, b"\0") + ZIP[END:],
    "fewer entries than the directory holds": ZIP[: END + 10] + bytes([11, 0]) + ZIP[END + 12 :],
    "a directory that starts too late": ZIP[: END + 12] + bytes([ZIP[END + 12] ^ 1]) + ZIP[END + 13 :],
    "a directory that starts before the file": ZIP[: END + 18] + b"\x10" + ZIP[END + 19 :],
    "a name that ends at a NUL": ZIP.replace(b"f_dc.webp", b"f_dc\0webp"),
    "another grid in the YAML": with_text(YAML, b"grid_side: 8", b"grid_side: 16"),
    "another count in the YAML": with_text(YAML, b"  count: ", b"  count: 1"),
    "another range in the YAML": with_text(YAML, b"max_values: ", b"max_values: 1"),
    "another checksum in the YAML": with_text(YAML, b"kissgs_crc32: ", b"kissgs_crc32: 1"),
    "no origin in the YAML": with_text(YAML, b"  origin: [5000000.0, -2.5, 0.0]\n", b"", MARKED),
    "another origin in the YAML": with_text(YAML, b"[5000000.0, -2.5", b"[5000000.0, 2.5", MARKED),
    "an origin in the YAML alone": with_text(YAML, b"kissgs:", b"kissgs:\n  origin: [0, 0, 1]"),
    "no mark in the YAML": with_text(YAML, b"model: antialiased\n", b"", MARKED),
    "another mark in the YAML": with_text(YAML, b"model: antialiased", b"model: 2dgs", MARKED),
    "a mark in the YAML alone": with_text(YAML, b"kissgs:", b"model: antialiased\nkissgs:"),
    "no mark in the JSON": with_text(JSON, b'"model":"antialiased",', b"", MARKED),
    "no point as origin": zip_bytes(
        {**MARKED, JSON: MARKED[JSON].replace(b'"origin":[5000000.0,-2.5,0.0]', b'"origin":[5000000.0,-2.5]')}
    ),
    "a cut YAML": zip_bytes({**FILES, YAML: FILES[YAML][:600]}),
    "no YAML inside": zip_bytes({**FILES, YAML: b"\xff\xfe\0"}),
}


@pytest.mark.parametrize(("zips", "accepted"), [(ACCEPTED, True), (REFUSED, False)], ids=["accepted", "refused"])
def test_odd_zips(zips, accepted):
    found = dict(zip(zips, check_agreement([*zips.values()]), strict=True))
    assert found == dict.fromkeys(zips, accepted)


def mutants(count, seed):
    """Yield zips with some damaged bytes, mostly in headers and directory, and packed again with damaged metadata."""
    rng = np.random.default_rng(seed)
    zips = [ZIP, ACCEPTED["streamed"], ACCEPTED["data before"]]
    for number in range(count):
        if number % 3 == 0:
            name = (YAML, JSON)[number % 2]
            text = bytearray(FILES[name])
            text[rng.integers(len(text))] = rng.choice(list(b"019 -.eE:#'\"[{,\n\tx\0\xff"))
            yield zip_bytes({**FILES, name: bytes(text)})
            continue
        data = bytearray(zips[number % 7 % 3])
        marks = [data.find(b"PK", at) for at in rng.integers(len(data), size=3)]
        start = max(*marks, data.find(b"PK\1\2") if number % 2 else 0)
        at = min(start + int(rng.integers(60)), len(data) - 1)
        data[at : at + 1] = [bytes([data[at] ^ 1 << rng.integers(8)]), rng.bytes(1), b"\xff", b""][rng.integers(4)]
        yield bytes(data)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.quick(1)
def test_damaged_zips(seed):
    accepted = check_agreement([*mutants(120, seed)])
    assert 5 < sum(accepted) < 115
