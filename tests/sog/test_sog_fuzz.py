"""Oracle: whatever the bytes, reading gives a scene or one sentence, within time and memory (helpers/hostile.py)."""

import io
import zlib

import pytest
from helpers.format_scenes import made_scene
from helpers.hostile import check_all
from helpers.reference_sog import sog_files, zip_of
from helpers.streamed_scenes import KINDS
from PIL import Image

from kissgs.io.scene_format import ReadOptions
from kissgs.pipeline.scene_files import read_scene
from kissgs.sog.decode import decode

LIMIT = 100_000
LIMITED = ReadOptions(max_gaussians=LIMIT)
FILES = sog_files(made_scene(20, 1))
FIRST_VERSION = sog_files(made_scene(20, 1), version=1)
STREAMED = {
    name: kind.files([[made_scene(10, 1)], [made_scene(3, 0)]], environment=made_scene(2, 1))
    for name, kind in KINDS.items()
}


def png(webp):
    """Return an image as PNG."""
    file = io.BytesIO()
    Image.open(io.BytesIO(webp)).save(file, "PNG")
    return file.getvalue()


PNG = {name: png(FILES[name]) for name in ("quats.webp", "shN_labels.webp")}
DAMAGED = {
    **{f"{name} of version 2": (FILES, name, FILES[name]) for name in FILES if name != "means_l.webp"},
    **{f"{name} of version 1": (FIRST_VERSION, name, FIRST_VERSION[name]) for name in ("meta.json", "scales.webp")},
    **{f"{name} as PNG": (FILES, name, data) for name, data in PNG.items()},
}


@pytest.mark.parametrize(("files", "name", "data"), DAMAGED.values(), ids=DAMAGED)
def test_damaged_files(files, name, data):
    check_all(data, lambda damaged: decode({**files, name: damaged}, max_gaussians=LIMIT, threads=1))


def test_damage_inside_png():
    """Flipped bits end at the checksums of the chunks; here the damage is in what is compressed."""
    data = PNG["quats.webp"]
    start = data.index(b"IDAT") + 4
    size = int.from_bytes(data[start - 8 : start - 4], "big")
    rows = zlib.decompress(data[start : start + size])

    def read(damaged):
        packed = zlib.compress(damaged, 1)
        chunk = b"IDAT" + packed
        middle = len(packed).to_bytes(4, "big") + chunk + zlib.crc32(chunk).to_bytes(4, "big")
        image = data[: start - 8] + middle + data[start + size + 4 :]
        return decode({**FILES, "quats.webp": image}, max_gaussians=LIMIT, threads=1)

    check_all(rows, read)


@pytest.mark.parametrize("source", [FILES, *STREAMED.values()], ids=["one scene", *STREAMED])
def test_damaged_zips(source):
    check_all(zip_of(source), lambda damaged: read_scene(damaged, LIMITED, threads=1))


@pytest.mark.parametrize(("name", "level"), [("streamed-sog", 0), ("streamed-sogxt", 1)])
def test_damaged_trees(name, level):
    kind, files = KINDS[name], STREAMED[name]

    def read(damaged):
        return kind.decode({**files, kind.manifest: damaged}, level=level, max_gaussians=LIMIT, threads=1)

    check_all(files[kind.manifest], read)


def test_damaged_zips_of_a_streamed_scene():
    files = STREAMED["streamed-sogxt"]
    check_all(files["0_0.zip"], lambda damaged: read_scene({**files, "0_0.zip": damaged}, LIMITED, threads=1))
