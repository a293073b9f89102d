"""Oracle: whatever the bytes, reading gives a scene or one sentence, within time and memory (helpers/hostile.py)."""

import pytest
from helpers.format_scenes import made_scene
from helpers.hostile import check_all
from helpers.reference_sog import sog_files, streamed_files, zip_of

from kissgs.pipeline.scene_files import read_scene
from kissgs.sog import streamed
from kissgs.sog.decode import decode

LIMIT = 100_000
SOURCES = {version: sog_files(made_scene(20, 1), version=version) for version in (1, 2)}
STREAMED = streamed_files([[made_scene(10, 1)], [made_scene(3, 0)]], environment=made_scene(2, 1))


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("name", ["meta.json", "quats.webp", "means_u.webp", "shN_centroids.webp", "shN_labels.webp"])
def test_damaged_files(version, name):
    files = SOURCES[version]
    check_all(files[name], lambda damaged: decode({**files, name: damaged}, max_gaussians=LIMIT, threads=1))


@pytest.mark.parametrize("source", [SOURCES[2], STREAMED], ids=["one scene", "streamed"])
def test_damaged_zips(source):
    check_all(zip_of(source), lambda damaged: read_scene(damaged, max_gaussians=LIMIT, threads=1))


@pytest.mark.parametrize("level", [0, 1])
def test_damaged_trees(level):
    def read(damaged):
        return streamed.decode({**STREAMED, "lod-meta.json": damaged}, level=level, max_gaussians=LIMIT, threads=1)

    check_all(STREAMED["lod-meta.json"], read)
