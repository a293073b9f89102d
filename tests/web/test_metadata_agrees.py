"""Damaged or odd ``meta.json``: JavaScript and Python refuse the same texts, and read the others alike."""

import copy
import json

import pytest
from helpers.odd_metadata import ODD, SPELLINGS
from helpers.web_scenes import assert_scene, container, in_node, job
from helpers.web_tools import run_node

from kissgs import KissgsError, decompress
from kissgs.sogxt.container import CHECKSUM

FILES = container("fast", 3, 65)
IMAGES = {name: data for name, data in FILES.items() if name.endswith(".webp")}


def in_python(text):
    """Return the error message of Python's decoder, or None."""
    try:
        decompress({**IMAGES, "meta.json": text})
    except KissgsError as error:
        return str(error)
    return None


def check_agreement(texts):
    """Check that both decoders accept and refuse the same texts; return Python's error messages."""
    found = in_node(*(job({**IMAGES, "meta.json": text}) for text in texts))
    messages = [in_python(text) for text in texts]
    for text, report, message in zip(texts, found, messages, strict=True):
        assert report.get("error", {"name": "SogxtError"})["name"] == "SogxtError"
        assert ("error" in report) == (message is not None), (text[:300], report.get("error"), message)
        if message is None:
            assert assert_scene(report, {**IMAGES, "meta.json": text}) <= 1
    return messages


def odd(change):
    meta = json.loads(FILES["meta.json"])
    del meta[CHECKSUM]
    change(meta)
    return json.dumps(meta).encode()


@pytest.mark.parametrize("accepted", [True, False])
@pytest.mark.quick(1)
def test_odd_metadata(accepted):
    rows = [row for row in ODD if row.accepted == accepted]
    messages = check_agreement([odd(row.change) for row in rows])
    for row, message in zip(rows, messages, strict=True):
        assert (message is None) == accepted, (row.name, message)


def test_odd_spellings():
    meta = json.loads(FILES["meta.json"])
    messages = check_agreement([spell(copy.deepcopy(meta)) for spell, _ in SPELLINGS])
    assert [message is None for message in messages] == [accepted for _, accepted in SPELLINGS]


def test_no_changed_byte_changes_the_scene():
    """Each byte has some of its bits flipped, and is replaced by some others."""
    text = FILES["meta.json"].decode("ascii")
    found = json.loads(run_node("damage_metadata.mjs", text))
    assert found["other"] == []
    assert found["refused"] > found["same"] > 300
    assert found["refused"] + found["same"] == 4 * len(text)
