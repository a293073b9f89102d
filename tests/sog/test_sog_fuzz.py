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
SOURCES = {version: sog_files(made_scene(20, 1), version=version) for version in (1, 2)}
STREAMED = {
    name: kind.files([[made_scene(10, 1)], [made_scene(3, 0)]], environment=made_scene(2, 1))
    for name, kind in KINDS.items()
}


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("name", ["meta.json", "quats.webp", "means_u.webp", "shN_centroids.webp", "shN_labels.webp"])
@pytest.mark.quick(5)
def test_damaged_files(version, name):
    files = SOURCES[version]
    check_all(files[name], lambda damaged: decode({**files, name: damaged}, max_gaussians=LIMIT, threads=1))


def png(webp):
    """Return an image as PNG."""
    file = io.BytesIO()
    Image.open(io.BytesIO(webp)).save(file, "PNG")
    return file.getvalue()


@pytest.mark.parametrize("name", ["quats.webp", "sh0.webp", "means_u.webp", "shN_centroids.webp", "shN_labels.webp"])
@pytest.mark.quick(2)
def test_damaged_png(name):
    files = SOURCES[2]
    check_all(png(files[name]), lambda damaged: decode({**files, name: damaged}, max_gaussians=LIMIT, threads=1))


def test_damage_inside_png():
    """Flipped bits end at the checksums of the chunks; here the damage is in what is compressed."""
    files = SOURCES[2]
    data = png(files["quats.webp"])
    start = data.index(b"IDAT") + 4
    size = int.from_bytes(data[start - 8 : start - 4], "big")
    rows = zlib.decompress(data[start : start + size])

    def read(damaged):
        packed = zlib.compress(damaged, 1)
        chunk = b"IDAT" + packed
        middle = len(packed).to_bytes(4, "big") + chunk + zlib.crc32(chunk).to_bytes(4, "big")
        image = data[: start - 8] + middle + data[start + size + 4 :]
        return decode({**files, "quats.webp": image}, max_gaussians=LIMIT, threads=1)

    check_all(rows, read)


@pytest.mark.parametrize("source", [SOURCES[2], *STREAMED.values()], ids=["one scene", *STREAMED])
def test_damaged_zips(source):
    check_all(zip_of(source), lambda damaged: read_scene(damaged, LIMITED, threads=1))


@pytest.mark.parametrize("level", [0, 1])
@pytest.mark.parametrize("name", STREAMED)
@pytest.mark.quick(2)
def test_damaged_trees(name, level):
    kind, files = KINDS[name], STREAMED[name]

    def read(damaged):
        return kind.decode({**files, kind.manifest: damaged}, level=level, max_gaussians=LIMIT, threads=1)

    check_all(files[kind.manifest], read)


def test_damaged_zips_of_a_streamed_scene():
    files = STREAMED["streamed-sogxt"]
    check_all(files["0_0.zip"], lambda damaged: read_scene({**files, "0_0.zip": damaged}, LIMITED, threads=1))
