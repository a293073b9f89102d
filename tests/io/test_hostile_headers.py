"""Headers that describe far more than they hold; oracle: the memory that reading takes, as tracemalloc counts it."""

import io
import struct
import zipfile

import pytest
from helpers.memory import takes_less_than

import kissgs

MOST_BYTES = 32 << 20


def glb(text):
    text += b" " * (-len(text) % 4)
    return struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text), len(text), b"JSON") + text


def packed(count, **files):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for i in range(count):
            archive.writestr(f"{i:x}", b"")
        for name, data in files.items():
            archive.writestr(name.replace("_", "."), data)
    return buffer.getvalue()


def behind_its_end(data):
    """Put bytes like those of another end, 6 bytes before the last, into the end of a zip: where its list begins."""
    return data[:-6] + b"PK\5\6" + data[-2:]


KSPLAT = struct.pack("<BBxxIIIIH", 0, 1, 100_000, 100_000, 0, 0, 0).ljust(4096, b"\0") + bytes(1024 * 100_000)

FILES = {
    "children.glb": lambda: glb(b'{"nodes": [{"children": [' + b"1," * 2_000_000 + b"1]}]}"),
    "texts.glb": lambda: glb(b'{"nodes": [' + b'"a",' * 1_000_000 + b"0]}"),
    "lists.glb": lambda: glb(b'{"nodes": ' + b"[[]," * 1_000_000 + b"0" + b"]" * 1_000_000 + b"}"),
    "objects.glb": lambda: glb(b'{"nodes": [' + b'{"a":0},' * 120_000 + b"{}]}"),
    "meta.sog": lambda: packed(0, meta_json=b'{"version": 2, "means": [' + b'{"a":0},' * 125_000 + b"0]}"),
    "entries.sog": lambda: packed(40_000),
    "hidden.sog": lambda: behind_its_end(packed(40_000)),
    "sections.ksplat": lambda: KSPLAT,
}


@pytest.mark.parametrize("name", FILES)
@pytest.mark.quick(5)
def test_a_hostile_header_takes_little_memory(name, tmp_path):
    """Sixteen GLBs of two million child indices once took a server from 76 to 2,443 MiB."""
    (tmp_path / name).write_bytes(FILES[name]())

    def refused():
        with pytest.raises(kissgs.KissgsError):
            kissgs.read_scene_info(tmp_path / name)

    assert takes_less_than(MOST_BYTES, refused)
