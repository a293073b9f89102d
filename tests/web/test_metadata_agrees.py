"""Damaged or odd ``meta.json``: JavaScript and Python refuse the same texts, and read the others alike."""

import copy
import json

import pytest
from helpers.web_scenes import assert_scene, container, in_node, job
from helpers.web_tools import put_value, run_node

from kissgs import KissgsError, decompress
from kissgs.sogxt import CHECKSUM

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


def put(path, value, *, accepted=False):
    """Return a row: path, value and whether decoders accept metadata with this value; ``del`` deletes it."""
    return path, value, accepted


NO_NUMBER = ("7", "", True, False, None, {}, [], [[7.0]], ["7"], [True], [None], [{}], 1e39, -1e39, 10**400)
NO_WHOLE_NUMBER = ("65", "8", True, False, None, {}, [], [8], [65], 1.5, -1, 1e300, 10**400, "del")
NO_OBJECT = (None, 5, True, "text", [], {}, [1, 2], "del")
FIELDS = ("means", "opacities", "scales", "quats", "sh0")
RANGES = (*(f"{field}.{end}" for field in FIELDS for end in ("mins", "maxs")), "shN.centroidsMins", "shN.centroidsMaxs")

ODD = [
    # Ranges
    *(put(path, value) for path in RANGES for value in ("7", [[7.0]], "del")),
    *(put(path, value) for path in ("means.mins", "sh0.maxs", "shN.centroidsMins") for value in NO_NUMBER),
    *(put(path, value, accepted=True) for path in ("quats.maxs", "shN.centroidsMaxs") for value in (1, [1.5])),
    *(put(path, [1, "x"] * 30, accepted=True) for path in RANGES),
    *(put(path, value, accepted=True) for path in ("means.mins", "sh0.mins") for value in (0, -0.0, 1.5)),
    *(put(path, [1.5, 2, bad]) for path in ("scales.mins", "sh0.maxs") for bad in NO_NUMBER if bad is not False),
    *(put(path, [[1.5, 2, 3]]) for path in ("scales.mins", "sh0.maxs", "means.mins")),
    put("sh0.maxs", 3.4028235677973362e38, accepted=True),
    put("sh0.maxs", 3.4028235677973366e38),
    put("means.maxs", 88.7, accepted=True),
    put("means.maxs", 88.8),
    put("means.mins", -88.8),
    # Whole numbers
    *(put(path, value) for path in ("count", "gridSide", "shN.centroidSide") for value in NO_WHOLE_NUMBER),
    *(put("kissgs.sh_degree", value) for value in NO_WHOLE_NUMBER),
    *(put("kissgs.sh_degree", value, accepted=True) for value in (0, 1, 3, 3.0)),
    put("kissgs.sh_degree", 4),
    put("count", 65.0, accepted=True),
    put("count", 64),
    put("gridSide", 16.0, accepted=True),
    put("gridSide", 0),
    put("gridSide", 13377),
    put("shN.centroidSide", 257),
    # Parts
    *(put(field, value) for field in (*FIELDS, "shN", "mask") for value in NO_OBJECT),
    *(put("mask.files", value) for value in (*NO_OBJECT, ["active_mask.png"], ["a.webp.png"], [["active_mask.webp"]])),
    *(put("mask.files", value, accepted=True) for value in (["active_mask.webp", 5], ["./active_mask.webp"], ["webp"])),
    put("mask.files", "active_mask.webp"),
    put("mask.files", {"0": "active_mask.webp"}),
    # Version, format and encodings
    *(put("version", value) for value in ("3", None, True, [3], 2, 4, {})),
    *(put("version", value, accepted=True) for value in (3.0, "del")),
    *(put("format", value) for value in ("sog", None, ["sog-xt"], "SOG-XT", "")),
    put("format", "del", accepted=True),
    *(put("quats.encoding", value) for value in ("smallest-three", None, ["direct"], "")),
    put("quats.encoding", "del", accepted=True),
    *(put("shN.layout", value) for value in ("palette", None, ["uv-codebook"], "")),
    put("shN.layout", "del", accepted=True),
    *(
        put(f"shN.{key}", value)
        for key in ("coeffs", "tileRows", "tileCols")
        for value in (None, "15", "3", 4, [3], True)
    ),
    *(put(f"shN.{key}", "del", accepted=True) for key in ("coeffs", "tileRows", "tileCols")),
    # Keys of kissgs
    *(put("kissgs", value) for value in (None, 5, True, "text", [], {}, {"sh_degree": 3}, {"version": "0.1.0"})),
    put("kissgs", "del", accepted=True),
    put("kissgs", {"sh_degree": 3, "version": "99.0", "mood": [1]}, accepted=True),
    *(put("kissgs.version", value) for value in (None, 1, "", "a b", "x" * 41, ["1"], "é", "1\n", "del")),
    *(put("kissgs.crc32", value) for value in (None, 5, True, "text", [], [1])),
    *(put("kissgs.crc32", value, accepted=True) for value in ({}, "del", {"note.txt": 7}, {"note.txt": 7.0})),
    *(put("kissgs.crc32", {"note.txt": value}) for value in ("7", None, True, 1.5, -1, 2**32, [7], {})),
    *(put("kissgs.crc32", {"f_dc.webp": value}) for value in ("7", None, True, 7)),
    *(put("kissgs_crc32", value) for value in (None, 0, "x", True, [], {}, 1.5)),
    # Ignored keys
    *(put("profile", value, accepted=True) for value in (None, 5, {}, "del")),
    *(put("extra", value, accepted=True) for value in (None, {"__proto__": 1}, 10**400)),
    *(put("means.files", value, accepted=True) for value in (None, "x", "del")),
    put("__proto__", {"count": 1}, accepted=True),
    put("constructor", 7, accepted=True),
]


def odd(path, value):
    meta = json.loads(FILES["meta.json"])
    del meta[CHECKSUM]
    put_value(path, value)(meta)
    return json.dumps(meta).encode()


@pytest.mark.parametrize("accepted", [True, False])
def test_odd_metadata(accepted):
    rows = [row for row in ODD if row[-1] == accepted]
    messages = check_agreement([odd(path, value) for path, value, _ in rows])
    for row, message in zip(rows, messages, strict=True):
        assert (message is None) == accepted, (row, message)


SPELLINGS = [
    (lambda meta: json.dumps(meta).encode(), True),
    (lambda meta: json.dumps(meta, indent=2).encode(), True),
    (lambda meta: b"\xef\xbb\xbf" + json.dumps(meta).encode(), True),
    (lambda meta: b"\r\n\t " + json.dumps(meta).encode() + b"\n\n", True),
    (lambda meta: json.dumps(dict(reversed(list(meta.items())))).encode(), True),
    (lambda meta: json.dumps({**meta, "note": "grüße ☃ 🙂"}).encode(), True),
    (lambda meta: json.dumps({**meta, "note": "grüße"}, ensure_ascii=False).encode(), True),
    (lambda meta: json.dumps({**meta, "note": "grüße"}, ensure_ascii=False).encode("latin-1"), False),
    (lambda meta: json.dumps(meta).encode("utf-16"), False),
    (lambda meta: json.dumps(meta).encode("utf-32"), False),
    (lambda meta: b"\0" + json.dumps(meta).encode(), False),
    (lambda meta: json.dumps(meta).encode() + b"\0", False),
    (lambda meta: json.dumps(meta).encode() + b"x", False),
    (lambda meta: json.dumps(meta).encode() + b" " * (1 << 20), False),
    (lambda meta: b"[]", False),
    (lambda meta: b"", False),
    (lambda meta: json.dumps({**meta, "note": float("nan")}).encode(), False),
    (lambda meta: json.dumps({**meta, "note": float("inf")}).encode(), False),
    (lambda meta: json.dumps({**meta, "note": "a\nb"}).replace("\\n", "\n").encode(), False),
    (lambda meta: json.dumps(meta).replace("{", "{,", 1).encode(), False),
    (lambda meta: (json.dumps(meta)[:-1] + ",}").encode(), False),
    (lambda meta: (json.dumps(meta)[:-1] + "/* */}").encode(), False),
    (lambda meta: json.dumps(meta).replace('"count": 65', '"count": 065').encode(), False),
    (lambda meta: json.dumps(meta).replace('"count": 65', '"count": +65').encode(), False),
    (lambda meta: json.dumps(meta).replace('"count": 65', '"count": 6.5e1').encode(), True),
    (lambda meta: json.dumps(meta).replace('"count": 65', '"count": 64, "count": 65').encode(), True),
    (lambda meta: json.dumps(meta).replace('"count": 65', '"count": 65, "count": 64').encode(), False),
    (lambda meta: json.dumps(meta).replace('"count": 65', "'count': 65").encode(), False),
    (lambda meta: json.dumps(meta).replace('"count": 65', '"coun\\u0074": 65').encode(), True),
]


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
