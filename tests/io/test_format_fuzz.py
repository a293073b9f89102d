"""Oracle: whatever the bytes, reading gives a scene or one sentence, within time and memory (helpers/hostile.py)."""

import gzip
import struct

import pytest
from helpers.format_scenes import made_scene
from helpers.hostile import check_all
from helpers.reference_compressed_ply import header_bytes as compressed_header
from helpers.reference_gltf import attributes, document, glb_bytes, spz_document
from helpers.reference_ply import ENCODINGS, ply_bytes, random_columns
from helpers.reference_splat import ksplat_bytes, splat_bytes
from helpers.reference_spz import spz_bytes

from kissgs.io.gltf import read_gltf
from kissgs.io.ksplat import read_ksplat
from kissgs.io.ply import read_ply
from kissgs.io.scene_format import ReadOptions
from kissgs.io.splat import read_splat
from kissgs.io.spz import read_spz
from kissgs.pipeline.scene_files import read_scene

LIMIT = 100_000
LIMITED = ReadOptions(max_gaussians=LIMIT)
SCENE = made_scene(20, 1)
EXTENSION = struct.pack("<III", 0xADBE0003, 4, 6)

READERS = {"ply": read_ply, "splat": read_splat, "ksplat": read_ksplat, "spz": read_spz, "gltf": read_gltf}
FILES = {
    **{f"ply, {encoding}": ("ply", ply_bytes(random_columns(3, 1), encoding)) for encoding in ENCODINGS},
    "compressed.ply": ("ply", compressed_header(3, 9) + bytes(range(72)) + bytes(range(75))),
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
    """Headers of .ply files that are damaged line by line are in test_ply_fuzz.py."""
    kind, data = FILES[name]
    check_all(data, lambda damaged: READERS[kind](damaged, max_gaussians=LIMIT))


def test_damage_inside_gzip():
    """Flipped bits in gzip end at its checksum; here the damage is in what it holds."""
    plain = gzip.decompress(spz_bytes(SCENE, 3, extensions=EXTENSION))
    check_all(plain, lambda damaged: read_spz(gzip.compress(damaged, 1), max_gaussians=LIMIT))


def test_headers_of_ksplat():
    """The headers are mostly zeros, which random damage hits: keep only what has a meaning."""
    data = ksplat_bytes([made_scene(300, 1)], 1)
    main, section, body = data[:48], data[4096 : 4096 + 48], data[4096 + 1024 :]

    def read(damaged):
        head = damaged[:48].ljust(4096, b"\0") + damaged[48:96].ljust(1024, b"\0")
        return read_ksplat(head + damaged[96:], max_gaussians=LIMIT)

    check_all(main + section + body, read)


def test_damaged_files_without_a_name():
    """Formats are recognised in damaged bytes, or the reader of .ply refuses them."""
    for _, data in FILES.values():
        check_all(data, lambda damaged: read_scene(damaged, LIMITED), seed=1)
