"""Containers that declare more than they should; oracle: how much memory there is to take."""

import dataclasses

import numpy as np
import pytest
from helpers.codec_scenes import random_scene
from helpers.memory import takes_less_than

import kissgs
from kissgs.core.errors import UnsupportedError
from kissgs.io.images import encode_plane
from kissgs.settings import EncodeSettings
from kissgs.sogxt.container import PLANES
from kissgs.sogxt.encode import encode


def bomb(side):
    """A small container of a large scene: all planes constant."""
    scene = random_scene(1, 3)
    files = dict(encode(scene, EncodeSettings(prune_invisible=False)).files)
    for name in PLANES:
        if "centroids" not in name:
            channels = {"quaternions.webp": 4, "active_mask.webp": 1, "opacities.webp": 1}.get(name, 3)
            files[name] = encode_plane(np.ones((side, side, channels), np.uint8), quality=0, method=0)
    del files["meta.json"]
    text = files["container_meta.yaml"].decode().split("kissgs:")[0]
    files["container_meta.yaml"] = text.replace("grid_side: 8", f"grid_side: {side}").encode()
    return files


def test_more_gaussians_than_the_limit_are_refused_before_memory_is_taken():
    files = bomb(512)
    assert sum(map(len, files.values())) < 20_000

    def refused():
        with pytest.raises(UnsupportedError, match=r"262,144 Gaussians; the limit is 200,000: raise it"):
            kissgs.decompress(files, max_gaussians=200_000)

    assert takes_less_than(30e6, refused)
    assert len(kissgs.decompress(files, max_gaussians=262_144)) == 262_144


def test_a_grid_far_beyond_the_limit_is_refused_before_its_images_are_read():
    files = bomb(512)
    with pytest.raises(UnsupportedError, match="262,144 cells"):
        kissgs.decompress({**files, "active_mask.webp": b"not even an image"}, max_gaussians=1000)


def test_one_outlier_does_not_spoil_the_colours_of_all_others():
    """One colour of 1000 among thousands once made the step of all others a hundred times coarser."""
    scene, fast = kissgs.sample_scene(12_000), kissgs.Settings(preset="fast")

    def error(result, field):
        others = result.order != 7
        found = getattr(kissgs.decompress(result.files), field)[others]
        return np.sqrt(np.mean((found - getattr(scene, field)[result.order[others]]) ** 2))

    clean = kissgs.compress(scene, settings=fast)
    for field, value in (("sh0", 1000), ("shN", 1000), ("shN", 30)):
        spoilt = getattr(scene, field).copy()
        spoilt[7].flat[0] = value
        dirty = kissgs.compress(dataclasses.replace(scene, **{field: spoilt}), settings=fast)
        assert error(dirty, field) < 1.05 * error(clean, field)
        assert dirty.report.clipped_colors == (1 if field == "sh0" else 0)


@pytest.mark.parametrize("count", [1, 5, 64, 65, 100, 256, 257])
def test_a_limit_of_as_many_gaussians_as_there_are_is_enough(count):
    """The grids of few Gaussians have more padding than Gaussians."""
    files = encode(random_scene(count, 0), EncodeSettings(prune_invisible=False)).files
    assert len(kissgs.decompress(files, max_gaussians=count)) == count
