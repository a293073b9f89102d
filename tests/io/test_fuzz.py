"""Oracle: whatever the bytes, reading gives a scene or one sentence, within time and memory; as little for headers
that describe far more than they hold."""

import gzip
import io
import json
import random
import struct
import time
import zipfile
import zlib

import numpy as np
import pytest
import yaml
from helpers.codec_scenes import random_scene
from helpers.examples import examples, thorough
from helpers.format_scenes import made_scene
from helpers.memory import takes_less_than
from helpers.reference_compressed_ply import header_bytes as compressed_header
from helpers.reference_gltf import attributes, document, glb_bytes, spz_document
from helpers.reference_ply import ENCODINGS, STRUCT_CODES, assert_identical, ply_bytes, random_columns
from helpers.reference_sog import sog_files, zip_of
from helpers.reference_splat import ksplat_bytes, splat_bytes
from helpers.reference_spz import spz_bytes
from helpers.streamed_scenes import KINDS
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

import kissgs
from kissgs import Settings, compress, decompress
from kissgs.core.context import silent
from kissgs.core.errors import KissgsError
from kissgs.core.splats import ATTRIBUTES, clean
from kissgs.formats import FORMATS
from kissgs.io.ply import read_ply, read_ply_info, write_ply
from kissgs.io.scene_format import ReadOptions
from kissgs.pipeline.scene_files import read_scene
from kissgs.sog.decode import decode as decode_sog
from kissgs.sogxt import CHECKSUM

DEFAULT_MUTATIONS, THOROUGH_MUTATIONS = 15, 1000

MEMORY = 40_000_000
"""Bytes; the files here hold some dozen Gaussians, so anything near this came from trusting a number."""

SECONDS = 5.0
"""Longest time of one reading on a busy machine; one takes some milliseconds."""

OVERWRITTEN = [0, 1, 0xFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 1 << 20, 3_000_000]
MEMORY_EVERY = 10
"""Memory is measured at every so many mutations, because tracing makes a call ten times slower."""


def mutations(data, seed):
    """Yield damaged copies: cut off, bits flipped, bytes and numbers overwritten, parts removed or doubled."""
    draw = random.Random(seed)
    for _ in range(THOROUGH_MUTATIONS if thorough() else DEFAULT_MUTATIONS):
        damaged = bytearray(data)
        for _ in range(draw.choice([1, 1, 1, 2, 4])):
            # Headers are at the beginning, where most of the decisions are.
            at = draw.randrange(min(len(damaged), 64) if draw.random() < 0.5 else len(damaged) or 1)
            kind = draw.choice(["cut off", "flip", "byte", "number", "remove", "double", "append"])
            if kind == "cut off":
                del damaged[at:]
            elif kind == "flip" and damaged:
                damaged[at] ^= 1 << draw.randrange(8)
            elif kind == "byte" and damaged:
                damaged[at] = draw.randrange(256)
            elif kind == "number":
                damaged[at : at + 4] = draw.choice(OVERWRITTEN).to_bytes(4, "little")
            elif kind == "remove":
                del damaged[at : at + draw.randrange(1, 40)]
            elif kind == "double":
                damaged[at:at] = damaged[at : at + draw.randrange(1, 40)]
            elif kind == "append":
                damaged += draw.randbytes(draw.randrange(1, 40))
            if not damaged:
                break
        yield bytes(damaged)


def check(read):
    """Call ``read``: it returns a scene or raises a KissgsError of one sentence. Return whether it was a scene."""
    problem = ""
    try:
        splats = read()
        assert splats.means.dtype == np.float32
        return True
    except KissgsError as error:
        problem = str(error)
    assert problem
    assert "\n" not in problem
    assert len(problem) < 400, problem
    return False


def check_all(data, read, seed=0):
    """Check ``read`` with damaged copies of ``data``, and that at least one was refused."""
    refused = 0
    for i, damaged in enumerate(mutations(data, seed)):
        begin = time.perf_counter()
        refused += not check(lambda damaged=damaged: read(damaged))
        assert time.perf_counter() - begin < SECONDS
        if i % MEMORY_EVERY == 0:
            assert takes_less_than(MEMORY, lambda damaged=damaged: check(lambda: read(damaged)))
    assert refused


LIMITED = ReadOptions(max_gaussians=100_000)
SCENE = made_scene(20, 1)
EXTENSION = struct.pack("<III", 0xADBE0003, 4, 6)
PLY = {f"ply, {encoding}": ply_bytes(random_columns(3, 1), encoding) for encoding in ENCODINGS}
PLY["compressed.ply"] = compressed_header(3, 9) + bytes(range(72)) + bytes(range(75))

FILES = {
    **{name: ("ply", data) for name, data in PLY.items()},
    "splat": ("splat", splat_bytes(SCENE)),
    "ksplat level 0": ("ksplat", ksplat_bytes([SCENE, made_scene(3, 0)], 0)),
    "ksplat level 1": ("ksplat", ksplat_bytes([made_scene(300, 1)], 1)),
    "ksplat level 2": ("ksplat", ksplat_bytes([SCENE], 2, unused=1)),
    **{f"spz {v}": ("spz", spz_bytes(SCENE, v, extensions=EXTENSION)) for v in (1, 2, 3, 4)},
    "glb": ("gltf", glb_bytes(*document(attributes(made_scene(2, 1))))),
    "glb with spz": ("gltf", glb_bytes(*spz_document(spz_bytes(SCENE, 3), 20))),
}


@pytest.mark.parametrize("name", FILES)
def test_damaged_files(name):
    kind, data = FILES[name]
    check_all(data, lambda damaged: FORMATS[kind].codec.read(damaged, LIMITED, 1, silent))


def test_damage_inside_gzip():
    """Flipped bits in gzip end at its checksum; here the damage is in what it holds."""
    plain = gzip.decompress(FILES["spz 3"][1])
    check_all(plain, lambda damaged: read_scene(gzip.compress(damaged, 1), LIMITED))


def test_headers_of_ksplat():
    """The headers are mostly zeros, which random damage hits: keep only what has a meaning."""
    data = FILES["ksplat level 1"][1]

    def read(damaged):
        head = damaged[:48].ljust(4096, b"\0") + damaged[48:96].ljust(1024, b"\0")
        return FORMATS["ksplat"].codec.read(head + damaged[96:], LIMITED, 1, silent)

    check_all(data[:48] + data[4096 : 4096 + 48] + data[4096 + 1024 :], read)


@pytest.mark.parametrize("name", ["ply, ascii", "splat", "ksplat level 1", "spz 3", "spz 4", "glb"])
def test_damaged_files_without_a_name(name):
    """Formats are recognised in damaged bytes, or the reader of .ply refuses them."""
    check_all(FILES[name][1], lambda damaged: read_scene(damaged, LIMITED), seed=1)


KEYWORDS = ["ply", "format", "element", "property", "list", "comment", "end_header", "vertex", "chunk", "sh"]
NUMBERS = ["0", "1", "2", "-1", "1.0", "99999999999999999"]
ODDITIES = ["packed_position", "red", "\0", "é", "\r", ""]
WORDS = st.sampled_from([*KEYWORDS, *NUMBERS, *ODDITIES, *STRUCT_CODES, *ENCODINGS, *random_columns(1, 1)])
LINES = st.lists(WORDS, max_size=5).map(" ".join)


@st.composite
def mutated_header(draw):
    """A valid .ply, some of its header lines replaced, removed, or out of place."""
    header, _, body = draw(st.sampled_from([*PLY.values()])).partition(b"end_header\n")
    lines = header.decode().splitlines()
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(1, len(lines)))
        lines[at : at + draw(st.integers(0, 2))] = draw(st.lists(LINES | st.sampled_from(lines), max_size=2))
    return "\n".join([*lines, "end_header", ""]).encode() + body


@examples(300)
@given(mutated_header())
def test_mutated_headers_of_ply(data):
    """A scene that can be read agrees with its header, and can be written and read again."""

    def read():
        splats = read_ply(data)
        info = read_ply_info(data)
        assert (info.count, info.sh_degree) == (len(splats), splats.sh_degree)
        stream = io.BytesIO()
        write_ply(stream, splats)
        assert_identical(read_ply(stream.getvalue()), splats)
        clean(splats)
        return splats

    assert takes_less_than(MEMORY, lambda: check(read))


# Containers.


def png(webp):
    """Return an image as PNG."""
    file = io.BytesIO()
    Image.open(io.BytesIO(webp)).save(file, "PNG")
    return file.getvalue()


SOG, SOG1 = sog_files(SCENE), sog_files(SCENE, version=1)
STREAMED = {
    name: kind.files([[made_scene(10, 1)], [made_scene(3, 0)]], environment=made_scene(2, 1))
    for name, kind in KINDS.items()
}
IN_SOG = {
    **{f"{name} of version 2": (SOG, name, SOG[name]) for name in SOG if name != "means_l.webp"},
    **{f"{name} of version 1": (SOG1, name, SOG1[name]) for name in ("meta.json", "scales.webp")},
    **{f"{name} as PNG": (SOG, name, png(SOG[name])) for name in ("quats.webp", "shN_labels.webp")},
}


@pytest.mark.parametrize(("files", "name", "data"), IN_SOG.values(), ids=IN_SOG)
def test_damaged_files_of_sog(files, name, data):
    check_all(data, lambda damaged: decode_sog({**files, name: damaged}, LIMITED, threads=1))


def test_damage_inside_png():
    """Flipped bits end at the checksums of the chunks; here the damage is in what is compressed."""
    data = png(SOG["quats.webp"])
    start = data.index(b"IDAT") + 4
    size = int.from_bytes(data[start - 8 : start - 4], "big")

    def read(damaged):
        packed = zlib.compress(damaged, 1)
        chunk = b"IDAT" + packed
        middle = len(packed).to_bytes(4, "big") + chunk + zlib.crc32(chunk).to_bytes(4, "big")
        return decode_sog({**SOG, "quats.webp": data[: start - 8] + middle + data[start + size + 4 :]}, threads=1)

    check_all(zlib.decompress(data[start : start + size]), read)


@pytest.mark.parametrize("source", [SOG, *STREAMED.values()], ids=["sog", *STREAMED])
def test_damaged_zips(source):
    check_all(zip_of(source), lambda damaged: read_scene(damaged, LIMITED, threads=1))


@pytest.mark.parametrize(
    ("kind", "name"),
    [("streamed-sog", "lod-meta.json"), ("streamed-sogxt", "levels.json"), ("streamed-sogxt", "0_0.zip")],
)
def test_damaged_files_of_streamed_scenes(kind, name):
    files = STREAMED[kind]
    check_all(files[name], lambda damaged: read_scene({**files, name: damaged}, LIMITED, threads=1))


COMPRESSED = compress(random_scene(30, 1, seed=2), settings=Settings.from_preset("fast"))


def without_checksums(files):
    """Damage must then be found by what decodes, not by a checksum."""
    document = yaml.safe_load(files["container_meta.yaml"])
    del document[CHECKSUM]
    meta = json.loads(files["meta.json"])
    del meta["kissgs"]["crc32"], meta[CHECKSUM]
    texts = {"container_meta.yaml": yaml.safe_dump(document), "meta.json": json.dumps(meta, separators=(",", ":"))}
    return {**files, **{name: text.encode() for name, text in texts.items()}}


SOGXT = without_checksums(COMPRESSED.files)
WITHOUT_JSON = {name: data for name, data in SOGXT.items() if name != "meta.json"}
WITHOUT_YAML = {name: data for name, data in SOGXT.items() if name != "container_meta.yaml"}
ZIP = COMPRESSED.to_zip()


def finite(source):
    """Return the scene, whose numbers must be finite."""
    found = decompress(source)
    assert all(np.isfinite(getattr(found, name)).all() for name in ATTRIBUTES)
    return found


def is_read(source):
    """Whether a source is read, and not refused in one sentence; reading must take little memory."""
    outcomes = []
    assert takes_less_than(MEMORY, lambda: outcomes.append(check(lambda: finite(source))))
    return outcomes[0]


@pytest.mark.parametrize("name", [name for name in SOGXT if name != "scene.json"])
def test_damaged_files_of_sogxt(name):
    others = WITHOUT_YAML if name == "meta.json" else WITHOUT_JSON
    check_all(SOGXT[name], lambda damaged: finite({**others, name: damaged}))


def test_damaged_zips_of_sogxt():
    """Anywhere, and in the directory, which has names, sizes and offsets."""
    directory = ZIP.index(b"PK\x01\x02")
    check_all(ZIP, finite)
    check_all(ZIP[directory:], lambda damaged: finite(ZIP[:directory] + damaged))


@examples(60)
@given(
    st.dictionaries(st.sampled_from([*SOGXT, "other"]), st.binary(max_size=300) | st.sampled_from([*SOGXT.values()]))
)
def test_files_in_the_wrong_places(files):
    is_read(files)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)


@examples(60)
@given(JSON, st.sampled_from([*json.loads(SOGXT["meta.json"]), None]), st.booleans())
def test_any_json_of_the_right_outline(value, key, inside):
    meta = json.loads(SOGXT["meta.json"])
    if key is None:
        meta = value
    elif inside and isinstance(meta[key], dict):
        meta[key][next(iter(meta[key]))] = value
    else:
        meta[key] = value
    is_read({**WITHOUT_YAML, "meta.json": json.dumps(meta).encode()})


@pytest.mark.parametrize("side", [13376, 2**63])
@pytest.mark.parametrize("name", ["container_meta.yaml", "meta.json"])
def test_a_large_declared_side_takes_no_memory(side, name):
    """13376 x 13376 cells are 5 GB of arrays; the images here are 8 x 8, so nothing may be set aside for them."""
    text = (
        SOGXT[name].replace(b"grid_side: 8", b"grid_side: %d" % side).replace(b'"gridSide":8', b'"gridSide":%d' % side)
    )
    assert text != SOGXT[name]
    assert not is_read({**{key: data for key, data in SOGXT.items() if key.endswith(".webp")}, name: text})


def test_a_webp_that_announces_more_than_the_metadata_takes_no_memory():
    """16383 x 16383 pixels in the header of the image itself: its size is compared before Pillow sees it."""
    data = bytearray(SOGXT["f_dc.webp"])
    assert data[12:16] == b"VP8L"
    data[21:25] = (0xFFFFFFF | int.from_bytes(data[21:25], "little") & 0xF0000000).to_bytes(4, "little")
    assert not is_read({**SOGXT, "f_dc.webp": bytes(data)})


def test_the_undamaged_sources_are_read():
    assert is_read(ZIP)
    assert is_read(SOGXT)


MOST_BYTES = 32 << 20


def glb(text):
    text += b" " * (-len(text) % 4)
    return struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text), len(text), b"JSON") + text


def with_entries(count):
    """Return a zip of so many empty files."""
    local = struct.pack("<4s22xHH5s", b"PK\3\4", 5, 0, b"empty")
    entry = struct.pack("<4s24xHHH8xI5s", b"PK\1\2", 5, 0, 0, 0, b"empty")
    return local + count * entry + struct.pack("<4s4xHHIIH", b"PK\5\6", count, count, count * len(entry), len(local), 0)


def behind_its_end(data):
    """Put bytes like those of another end, 6 bytes before the last, into the end of a zip: where its list begins."""
    return data[:-6] + b"PK\5\6" + data[-2:]


KSPLAT = struct.pack("<BBxxIIIIH", 0, 1, 100_000, 100_000, 0, 0, 0).ljust(4096, b"\0") + bytes(1024 * 100_000)
HEADERS = {
    "children.glb": lambda: glb(b'{"nodes": [{"children": [' + b"1," * 2_000_000 + b"1]}]}"),
    "texts.glb": lambda: glb(b'{"nodes": [' + b'"a",' * 1_000_000 + b"0]}"),
    "lists.glb": lambda: glb(b'{"nodes": ' + b"[[]," * 1_000_000 + b"0" + b"]" * 1_000_000 + b"}"),
    "objects.glb": lambda: glb(b'{"nodes": [' + b'{"a":0},' * 120_000 + b"{}]}"),
    "meta.sog": lambda: zip_of(
        {"meta.json": b'{"version": 2, "means": [' + b'{"a":0},' * 125_000 + b"0]}"}, zipfile.ZIP_DEFLATED
    ),
    "entries.sog": lambda: with_entries(40_000),
    "hidden.sog": lambda: behind_its_end(with_entries(40_000)),
    "sections.ksplat": lambda: KSPLAT,
}


@pytest.mark.parametrize("name", HEADERS)
@pytest.mark.quick(5)
def test_a_hostile_header_takes_little_memory(name, tmp_path):
    """Sixteen GLBs of two million child indices once took a server from 76 to 2,443 MiB."""
    (tmp_path / name).write_bytes(HEADERS[name]())

    def refused():
        with pytest.raises(kissgs.KissgsError):
            kissgs.read_scene_info(tmp_path / name)

    assert takes_less_than(MOST_BYTES, refused)
