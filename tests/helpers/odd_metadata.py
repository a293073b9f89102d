"""Unusual ``meta.json`` files, and whether all decoders of this project must accept them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

DELETED = object()


@dataclass(frozen=True)
class Odd:
    """Change of the value at a dotted path, and whether a decoder accepts the result."""

    name: str
    change: Callable[[dict[str, Any]], None]
    accepted: bool


def put(path: str, value: Any, *, accepted: bool = False) -> Odd:
    """Return a change that sets the value at a path, or removes it."""

    def change(meta: dict[str, Any]) -> None:
        *parents, last = path.split(".")
        for key in parents:
            meta = meta[key]
        if value is DELETED:
            del meta[last]
        else:
            meta[last] = value

    return Odd(f"{path} {value!r:.40}", change, accepted)


NO_NUMBER = ("7", "", True, False, None, {}, [], [[7.0]], ["7"], [True], [None], [{}], 1e39, -1e39, 10**400)
NO_WHOLE_NUMBER = ("65", "8", True, False, None, {}, [], [8], [65], 1.5, -1, 1e300, 10**400, DELETED)
NO_OBJECT = (None, 5, True, "text", [], {}, [1, 2], DELETED)
FIELDS = ("means", "opacities", "scales", "quats", "sh0")
RANGES = (*(f"{field}.{end}" for field in FIELDS for end in ("mins", "maxs")), "shN.centroidsMins", "shN.centroidsMaxs")

ODD = [
    # Ranges
    *(put(path, value) for path in RANGES for value in (*NO_NUMBER, DELETED)),
    *(put(path, value, accepted=True) for path in RANGES for value in (1, [1.5], [1, "x"] * 30)),
    *(put(path, value, accepted=True) for path in ("means.mins", "sh0.mins") for value in (0, -0.0, 1.5)),
    *(put(path, [1.5] * 3, accepted=True) for path in RANGES),
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
    *(put("version", value, accepted=True) for value in (3.0, DELETED)),
    *(put("format", value) for value in ("sog", None, ["sog-xt"], "SOG-XT", "")),
    put("format", DELETED, accepted=True),
    *(put("quats.encoding", value) for value in ("smallest-three", None, ["direct"], "")),
    put("quats.encoding", DELETED, accepted=True),
    *(put("shN.layout", value) for value in ("palette", None, ["uv-codebook"], "")),
    put("shN.layout", DELETED, accepted=True),
    *(
        put(f"shN.{key}", value)
        for key in ("coeffs", "tileRows", "tileCols")
        for value in (None, "15", "3", 4, [3], True)
    ),
    *(put(f"shN.{key}", DELETED, accepted=True) for key in ("coeffs", "tileRows", "tileCols")),
    # Keys of kissgs
    *(put("kissgs", value) for value in (None, 5, True, "text", [], {}, {"sh_degree": 3}, {"version": "0.1.0"})),
    put("kissgs", DELETED, accepted=True),
    put("kissgs", {"sh_degree": 3, "version": "99.0", "mood": [1]}, accepted=True),
    *(put("kissgs.version", value) for value in (None, 1, "", "a b", "x" * 41, ["1"], "é", "1\n", DELETED)),
    *(put("kissgs.crc32", value) for value in (None, 5, True, "text", [], [1])),
    *(put("kissgs.crc32", value, accepted=True) for value in ({}, DELETED, {"note.txt": 7}, {"note.txt": 7.0})),
    *(put("kissgs.crc32", {"note.txt": value}) for value in ("7", None, True, 1.5, -1, 2**32, [7], {})),
    *(put("kissgs.crc32", {"f_dc.webp": value}) for value in ("7", None, True, 7)),
    *(put("kissgs_crc32", value) for value in (None, 0, "x", True, [], {}, 1.5)),
    # Ignored keys
    *(put("profile", value, accepted=True) for value in (None, 5, {}, DELETED)),
    *(put("extra", value, accepted=True) for value in (None, {"__proto__": 1}, 10**400)),
    *(put("means.files", value, accepted=True) for value in (None, "x", DELETED)),
    put("__proto__", {"count": 1}, accepted=True),
    put("constructor", 7, accepted=True),
]


def _text(meta: dict[str, Any]) -> str:
    return json.dumps(meta)


SPELLINGS: list[tuple[Callable[[dict[str, Any]], bytes], bool]] = [
    (lambda meta: _text(meta).encode(), True),
    (lambda meta: json.dumps(meta, indent=2).encode(), True),
    (lambda meta: b"\xef\xbb\xbf" + _text(meta).encode(), True),
    (lambda meta: b"\r\n\t " + _text(meta).encode() + b"\n\n", True),
    (lambda meta: _text(dict(reversed(list(meta.items())))).encode(), True),
    (lambda meta: _text({**meta, "note": "grüße ☃ 🙂"}).encode(), True),
    (lambda meta: json.dumps({**meta, "note": "grüße"}, ensure_ascii=False).encode(), True),
    (lambda meta: json.dumps({**meta, "note": "grüße"}, ensure_ascii=False).encode("latin-1"), False),
    (lambda meta: _text(meta).encode("utf-16"), False),
    (lambda meta: _text(meta).encode("utf-32"), False),
    (lambda meta: b"\0" + _text(meta).encode(), False),
    (lambda meta: _text(meta).encode() + b"\0", False),
    (lambda meta: _text(meta).encode() + b"x", False),
    (lambda meta: _text({**meta, "note": float("nan")}).encode(), False),
    (lambda meta: _text({**meta, "note": float("inf")}).encode(), False),
    (lambda meta: _text({**meta, "note": "a\nb"}).replace("\\n", "\n").encode(), False),
    (lambda meta: _text(meta).replace("{", "{,", 1).encode(), False),
    (lambda meta: (_text(meta)[:-1] + ",}").encode(), False),
    (lambda meta: (_text(meta)[:-1] + "/* */}").encode(), False),
    (lambda meta: _text(meta).replace('"count": 65', '"count": 065').encode(), False),
    (lambda meta: _text(meta).replace('"count": 65', '"count": +65').encode(), False),
    (lambda meta: _text(meta).replace('"count": 65', '"count": 6.5e1').encode(), True),
    (lambda meta: _text(meta).replace('"count": 65', '"count": 64, "count": 65').encode(), True),
    (lambda meta: _text(meta).replace('"count": 65', '"count": 65, "count": 64').encode(), False),
    (lambda meta: _text(meta).replace('"count": 65', "'count': 65").encode(), False),
    (lambda meta: _text(meta).replace('"count": 65', '"coun\\u0074": 65').encode(), True),
]
