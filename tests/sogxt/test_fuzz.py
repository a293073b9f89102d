"""Oracle: whatever the bytes, decoding gives a finite scene or a KissgsError, and takes little memory."""

import io
import json
import zipfile

import numpy as np
import pytest
import yaml
from helpers.codec_scenes import random_scene
from helpers.examples import examples
from helpers.hostile import check_all
from helpers.memory import takes_less_than
from hypothesis import given
from hypothesis import strategies as st

from kissgs import KissgsError, Settings, compress, decompress
from kissgs.core.splats import ATTRIBUTES
from kissgs.sogxt.container import CHECKSUM

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
WITHOUT_YAML = {name: data for name, data in FILES.items() if name != "container_meta.yaml"}
ZIP = COMPRESSED.to_zip()


def finite(source):
    """Return the scene, whose numbers must be finite."""
    found = decompress(source)
    assert all(np.isfinite(getattr(found, name)).all() for name in ATTRIBUTES)
    return found


def check(source):
    """The scene, or None if it was refused in one sentence. Anything else that is raised fails the test."""
    outcome = []

    def run():
        try:
            outcome.append(finite(source))
        except KissgsError as error:
            outcome.append(str(error))

    assert takes_less_than(MEMORY, run)
    if isinstance(outcome[0], str):
        assert outcome[0]
        assert "\n" not in outcome[0]
        return None
    return outcome[0]


@pytest.mark.parametrize("name", [name for name in FILES if name != "scene.json"])
def test_damaged_files(name):
    others = WITHOUT_YAML if name == "meta.json" else WITHOUT_JSON
    check_all(FILES[name], lambda damaged: finite({**others, name: damaged}))


def test_damaged_zips():
    """Anywhere, and in the directory, which has names, sizes and offsets."""
    directory = ZIP.index(b"PK\x01\x02")
    check_all(ZIP, finite)
    check_all(ZIP[directory:], lambda damaged: finite(ZIP[:directory] + damaged))


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
    check({**WITHOUT_YAML, "meta.json": json.dumps(document).encode()})


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
