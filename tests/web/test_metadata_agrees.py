"""``meta.json``, damaged or odd: JavaScript and Python refuse the same, and read the rest alike."""

import copy
import json

import pytest
from helpers.odd_metadata import ODD, SPELLINGS
from helpers.web_scenes import assert_scene, container, in_node, job
from helpers.web_tools import run_node

from kissgs import KissgsError, decompress
from kissgs.sogxt.names import CHECKSUM

FILES = container("fast", 3, 65)
IMAGES = {name: data for name, data in FILES.items() if name.endswith(".webp")}


def in_python(text):
    """The sentence of the refusal, or None."""
    try:
        decompress({**IMAGES, "meta.json": text})
    except KissgsError as error:
        return str(error)
    return None


def agree(texts):
    """What each decoder says of each text; asserts that they agree. Returns Python's sentences."""
    found = in_node(*(job({**IMAGES, "meta.json": text}) for text in texts))
    sentences = [in_python(text) for text in texts]
    for text, said, sentence in zip(texts, found, sentences, strict=True):
        assert said.get("error", {"name": "SogxtError"})["name"] == "SogxtError"
        assert ("error" in said) == (sentence is not None), (text[:300], said.get("error"), sentence)
        if sentence is None:
            assert assert_scene(said, {**IMAGES, "meta.json": text}) <= 1
    return sentences


def odd(change):
    meta = json.loads(FILES["meta.json"])
    del meta[CHECKSUM]
    change(meta)
    return json.dumps(meta).encode()


@pytest.mark.parametrize("accepted", [True, False])
def test_odd_metadata(accepted):
    rows = [row for row in ODD if row.accepted == accepted]
    sentences = agree([odd(row.change) for row in rows])
    for row, sentence in zip(rows, sentences, strict=True):
        assert (sentence is None) == accepted, (row.name, sentence)


def test_odd_spellings():
    meta = json.loads(FILES["meta.json"])
    sentences = agree([spell(copy.deepcopy(meta)) for spell, _ in SPELLINGS])
    assert [sentence is None for sentence in sentences] == [accepted for _, accepted in SPELLINGS]


def test_no_changed_byte_makes_another_scene():
    """Every bit of every byte, and some bytes instead."""
    text = FILES["meta.json"].decode("ascii")
    found = json.loads(run_node("damage_metadata.mjs", text))
    assert found["other"] == []
    assert found["refused"] > found["same"] > 1000
    assert found["refused"] + found["same"] == 12 * len(text)
