"""Damaged metadata: refused in a sentence, or decoded to exactly the same scene; oracle: the undamaged file."""

import json
import struct
import zlib

import numpy as np
import pytest
import yaml
from helpers.codec_scenes import random_scene, replaced
from helpers.metadata_files import FILES, document

from kissgs import InvalidContainerError, Settings, UnsupportedError, compress, decompress
from kissgs.io.containers import MemorySource
from kissgs.sogxt import CHECKSUM, JSON_NAME, YAML_NAME
from kissgs.sogxt.metadata import CHANNELS, read_layout

STEP = 11
REFUSED = (InvalidContainerError, UnsupportedError)
WAYS = {
    **{f"bit {bit}": lambda byte, at, bit=bit: byte ^ 1 << bit for bit in range(8)},
    "all bits": lambda byte, at: byte ^ 255,
    "zero": lambda byte, at: 0,
    "blank": lambda byte, at: ord(" "),
    "digit": lambda byte, at: ord("0") + at % 10,
}


def meaning(name, text):
    """All that decoding takes from the metadata; None if it refuses them."""
    try:
        layout = read_layout(MemorySource({name: text}))
    except REFUSED:
        return None
    ranges = [end.tobytes() for field in CHANNELS for end in layout.limits(field)]
    return layout.count, layout.grid_side, layout.codebook_side, layout.sh_degree, *ranges


def changed_everywhere(text, change, step=1, first=0):
    """Every text in which one byte is another."""
    for at in range(first, len(text), step):
        byte = change(text[at], at) & 255
        if byte != text[at]:
            yield text[:at] + bytes([byte]) + text[at + 1 :]


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(("name", "step"), [(YAML_NAME, STEP), (JSON_NAME, 1)])
@pytest.mark.quick(6)
def test_no_changed_byte_makes_another_scene(name, step, way):
    """Every byte, in every way; of the YAML, which takes longer to read, one in eleven, and others in each way."""
    text = FILES[name]
    right = meaning(name, text)
    texts = list(changed_everywhere(text, WAYS[way], step, [*WAYS].index(way) % step))
    found = [meaning(name, some) for some in texts]
    assert {None, right} >= set(found), texts[next(i for i, some in enumerate(found) if some not in (None, right))]
    assert found.count(None) > len(found) / 4


def test_the_checksum_is_the_one_that_the_format_describes():
    meta = json.loads(FILES[JSON_NAME])
    numbers = [meta["count"], meta["gridSide"], meta["shN"]["centroidSide"], meta["kissgs"]["sh_degree"]]
    for key, *ends in (
        *((key, "mins", "maxs") for key in ("sh0", "opacities", "scales", "quats", "means")),
        ("shN", "centroidsMins", "centroidsMaxs"),
    ):
        low, high = (np.ravel(meta[key][end]).astype(np.float32) for end in ends)
        numbers += [end for channel in zip(low, high, strict=True) for end in channel]
    assert len(numbers) == 4 + 2 * sum(CHANNELS.values())
    wanted = zlib.crc32(struct.pack(f"<{len(numbers)}d", *numbers))
    assert meta[CHECKSUM] == document()[CHECKSUM] == wanted


def test_a_lost_block_of_ours_is_noticed():
    """It says the degree of the spherical harmonics, which nothing else says where the last band is zero."""
    splats = random_scene(20, 3)
    files = compress(replaced(splats, shN=splats.shN * 0), settings=Settings.from_preset("fast")).files
    for name in (YAML_NAME, JSON_NAME):
        damaged = files[name].replace(b"kissgs:", b"kisses:").replace(b'"kissgs":', b'"kisses":')
        assert damaged != files[name]
        with pytest.raises(InvalidContainerError, match=f"{name} is damaged: its numbers do not give its"):
            decompress({name: damaged, **{key: data for key, data in files.items() if key.endswith(".webp")}})


@pytest.mark.parametrize("name", [YAML_NAME, JSON_NAME])
def test_another_checksum_is_refused_and_none_is_read(name):
    """Early versions of kissgs and other encoders wrote none. Another spelling of the same numbers does not matter."""
    right, metadata = meaning(name, FILES[name]), yaml.safe_load(FILES[name])
    for checksum in (0, None, "x", -1, 1.5, [], {}):
        assert meaning(name, json.dumps(metadata | {CHECKSUM: checksum}).encode()) is None
    changed = dict(reversed(metadata.items()))
    assert meaning(name, json.dumps(changed, indent=3).encode()) == right
    del changed[CHECKSUM]
    assert meaning(name, json.dumps(changed).encode()) == right
    del changed["kissgs"]
    assert meaning(name, json.dumps(changed).encode())[1:] == right[1:]
