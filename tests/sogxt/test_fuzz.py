"""Oracle: whatever the bytes, decoding gives a finite scene or a KissgsError, and takes little memory."""

import io
import json
import zipfile

import numpy as np
import pytest
import yaml
from helpers.codec_scenes import random_scene
from helpers.examples import examples
from helpers.memory import takes_less_than
from hypothesis import given
from hypothesis import strategies as st

from kissgs import KissgsError, Settings, compress, decompress
from kissgs.core.splats import ATTRIBUTES
from kissgs.sogxt.names import CHECKSUM

MEMORY = 30_000_000
"""Bytes; the containers here hold a few dozen Gaussians, so anything near this came from trusting a number."""

COMPRESSED = compress(random_scene(30, 1, seed=2), settings=Settings.from_preset("fast"))


def without_checksums(files):
    """Damage must then be found by what decodes, not by its hash."""
    document = yaml.safe_load(files["container_meta.yaml"])
    del document["kissgs"]["sha256"], document[CHECKSUM]
    meta = json.loads(files["meta.json"])
    del meta["kissgs"]["crc32"], meta[CHECKSUM]
    texts = {"container_meta.yaml": yaml.safe_dump(document), "meta.json": json.dumps(meta, separators=(",", ":"))}
    return {**files, **{name: text.encode() for name, text in texts.items()}}


FILES = without_checksums(COMPRESSED.files)
WITHOUT_JSON = {name: data for name, data in FILES.items() if name != "meta.json"}
ZIP = COMPRESSED.to_zip()
NUMBERS = [b"\0", b"\xff", b"\x7f", b"\xff\xff\xff\xff", b"9999999", b"-1", b".inf", b"nan"]


def check(source):
    """The scene, or None if it was refused in one sentence. Anything else that is raised fails the test."""
    outcome = []

    def run():
        try:
            outcome.append(decompress(source))
        except KissgsError as error:
            outcome.append(str(error))

    assert takes_less_than(MEMORY, run)
    if isinstance(outcome[0], str):
        assert outcome[0]
        assert "\n" not in outcome[0]
        return None
    assert all(np.isfinite(getattr(outcome[0], name)).all() for name in ATTRIBUTES)
    return outcome[0]


@st.composite
def mutated(draw, data):
    """Some bytes overwritten, cut out, doubled, or cut off."""
    data = bytearray(data)
    for _ in range(draw(st.integers(1, 4))):
        start = draw(st.integers(0, len(data)))
        stop = min(len(data), start + draw(st.sampled_from([0, 1, 2, 8, 100, 10_000])))
        change = draw(st.sampled_from(["overwrite", "number", "cut out", "double", "flip"]))
        if change == "overwrite":
            data[start:stop] = draw(st.binary(max_size=20))
        elif change == "number":
            number = draw(st.sampled_from(NUMBERS))
            data[start : start + len(number)] = number
        elif change == "cut out":
            del data[start:stop]
        elif change == "double":
            data[start:start] = data[start:stop][:500]
        elif start < len(data):
            data[start] ^= 1 << draw(st.integers(0, 7))
    return bytes(data)


@examples(150)
@given(mutated(ZIP))
def test_mutated_zips(data):
    check(data)


@examples(60)
@given(mutated(ZIP[ZIP.index(b"PK\x01\x02") :]))
def test_mutated_zip_directories(directory):
    """Return the positions of names, sizes and offsets."""
    check(ZIP[: ZIP.index(b"PK\x01\x02")] + directory)


@examples(150)
@given(st.data(), st.sampled_from([name for name in FILES if name != "scene.json"]))
def test_mutated_files(data, name):
    files = {**(FILES if name == "meta.json" else WITHOUT_JSON), name: data.draw(mutated(FILES[name]))}
    if name == "meta.json":
        del files["container_meta.yaml"]
    check(files)


@examples(60)
@given(st.integers(12, 60), st.sampled_from([name for name in FILES if name.endswith(".webp")]), st.binary(max_size=12))
def test_mutated_webp_headers(start, name, new):
    """Sizes, chunk names and lengths, the transforms: what is trusted before the pixels."""
    data = FILES[name]
    check({**FILES, name: data[:start] + new + data[start + len(new) :]})


@examples(60)
@given(
    st.dictionaries(st.sampled_from([*FILES, "other"]), st.binary(max_size=300) | st.sampled_from([*FILES.values()]))
)
def test_files_in_the_wrong_places(files):
    check(files)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)


@examples(60)
@given(JSON, st.sampled_from([*json.loads(FILES["meta.json"]), None]), st.booleans())
def test_any_json_of_the_right_outline(value, key, inside):
    document = json.loads(FILES["meta.json"])
    if key is None:
        document = value
    elif inside and isinstance(document[key], dict):
        document[key][next(iter(document[key]))] = value
    else:
        document[key] = value
    files = {**FILES, "meta.json": json.dumps(document).encode()}
    del files["container_meta.yaml"]
    check(files)


@pytest.mark.parametrize("side", [13376, 13377, 2**31, 2**63])
@pytest.mark.parametrize("name", ["container_meta.yaml", "meta.json"])
def test_a_large_declared_side_takes_no_memory(side, name):
    """13376 x 13376 cells are 5 GB of arrays; the images here are 8 x 8, so nothing may be set aside for them."""
    text = (
        FILES[name].replace(b"grid_side: 8", b"grid_side: %d" % side).replace(b'"gridSide":8', b'"gridSide":%d' % side)
    )
    assert text != FILES[name]
    files = {key: data for key, data in FILES.items() if not key.endswith((".yaml", ".json"))}
    assert check({**files, name: text}) is None


def test_a_webp_that_announces_more_than_the_metadata_takes_no_memory():
    """16383 x 16383 pixels in the header of the image itself: its size is compared before Pillow sees it."""
    data = bytearray(FILES["f_dc.webp"])
    assert data[12:16] == b"VP8L"
    data[21:25] = (0xFFFFFFF | int.from_bytes(data[21:25], "little") & 0xF0000000).to_bytes(4, "little")
    assert check({**FILES, "f_dc.webp": bytes(data)}) is None


def test_the_seeds_themselves_are_valid():
    assert len(check(ZIP)) == len(check(FILES)) == 30
    with zipfile.ZipFile(io.BytesIO(ZIP)) as archive:
        assert len(archive.namelist()) == 12
