"""Our streamed SOG in the PlayCanvas engine. Oracle: ``kissgs.render`` of what ``kissgs.load`` reads of each level."""

import numpy as np
import pytest
from helpers.streamed_scenes import small_sizes
from helpers.viewers import opened, psnr, scattered, seen_from

import kissgs
from kissgs import Settings
from kissgs.core.splats import concatenate
from kissgs.streaming import levels
from kissgs.streaming.compress import compress_streamed

FIRST_IMAGE_BYTES = 1_000_000
TO_RASTERISER = 35  # dB; PlayCanvas ends Gaussians at 2.8 standard deviations


@pytest.fixture(scope="module")
def playcanvas(browser):
    with opened("playcanvas", browser) as opened_viewer:
        yield opened_viewer


def streamed(scene, folder, site):
    """Compress a scene, and return its folder and its address on the site."""
    kissgs.save(scene, folder / "scene.ply")
    compress_streamed(folder / "scene.ply", folder / "city" / "lod-meta.json", settings=Settings.from_preset("fast"))
    files = {str(path.relative_to(folder)): path.read_bytes() for path in (folder / "city").rglob("*.*")}
    return folder / "city" / "lod-meta.json", site.put(folder.name, files) + "city/lod-meta.json"


@pytest.mark.quick(0)
def test_each_level_is_drawn_whole(playcanvas, tmp_path, monkeypatch):
    small_sizes(monkeypatch, chunk=400, leaf=80, coarsest=200)
    viewer, site = playcanvas
    source, url = streamed(scattered(1200, 2), tmp_path, site)
    cameras = [seen_from((1.2, -1.2, -4.2), (300, 200)), seen_from((-3.5, -2.6, 2.0), (200, 180))]
    for level in range(4):
        wanted = [np.clip(kissgs.render(kissgs.load(source, level=level), each)[0], 0, 1) for each in cameras]
        drawn = viewer.draw_level(url, level, cameras)
        reached = [psnr(*both) for both in zip(drawn, wanted, strict=True)]
        assert min(reached) > TO_RASTERISER
        assert all(psnr(image[:, ::-1], image) < 30 for image in wanted)


def with_sky(scene):
    """Return a scene with 300 large Gaussians all around it, far away."""
    sky = scattered(300, 2)
    sky.means[:] = 20 * sky.means / np.linalg.norm(sky.means, axis=1, keepdims=True)
    sky.scales[:] += 3
    return concatenate([scene, sky])


@pytest.mark.quick(0)
def test_the_environment_is_drawn_at_every_level(playcanvas, tmp_path, monkeypatch):
    small_sizes(monkeypatch, chunk=400, leaf=80, coarsest=200)
    monkeypatch.setattr(levels, "FEWEST", 100)
    viewer, site = playcanvas
    source, url = streamed(with_sky(scattered(1000, 2)), tmp_path, site)
    assert any(path.endswith("environment/meta.json") for path in site.files)
    view = seen_from((1.2, -1.2, -4.2), (300, 200))
    for level in (0, 2):
        scene = kissgs.load(source, level=level)
        town = scene.select(np.linalg.norm(scene.means, axis=1) < 5)
        whole, without = (np.clip(kissgs.render(each, view)[0], 0, 1) for each in (scene, town))
        (drawn,) = viewer.draw_level(url, level, [view])
        assert psnr(drawn, whole) > TO_RASTERISER
        assert psnr(whole, without) < 20


@pytest.mark.quick(0)
def test_the_first_image_needs_less_than_a_megabyte(playcanvas, tmp_path):
    """Manifest and coarsest level show the whole scene, with the sizes that users get; finer levels are late."""
    viewer, site = playcanvas
    source, url = streamed(scattered(140_000, 3), tmp_path, site)
    site.late.update({path: 5.0 for path in site.files if "/city/2_0/" not in path and "/city/lod" not in path})
    view = seen_from((1.2, -1.2, -4.2), (300, 200))
    image, files = viewer.first_image(url, view)
    assert 0 < sum(size for _, size in files) <= FIRST_IMAGE_BYTES
    coarsest = np.clip(kissgs.render(kissgs.load(source, level=2), view)[0], 0, 1)
    assert psnr(image, coarsest) > 28  # thousands of Gaussians overlap in each pixel, and the viewer sorts coarsely
