"""Rendering by Spark; reference: ``kissgs.render``."""

import base64
from dataclasses import replace

import numpy as np
import pytest
from helpers.viewers import opened, pinhole, psnr, seen_from, skewed

import kissgs
from kissgs.core.splats import SH_REST_COUNTS


@pytest.fixture(scope="module")
def page(browser):
    with opened("preview", browser) as (viewer, _):
        yield viewer.page


def encoded(array):
    return base64.b64encode(np.ascontiguousarray(array)).decode()


def scene_of(splats):
    """Return the scene in the form of the decoder, with codebook entries in random order."""
    rng = np.random.default_rng(0)
    order = rng.permutation(len(splats)).astype(np.uint16)
    return {
        "count": len(splats),
        "meta": {"model": "antialiased"} if splats.antialiased else {},
        "degree": SH_REST_COUNTS.index(splats.shN.shape[1]),
        "centroids": encoded(splats.shN[order]),
        "labels": encoded(np.argsort(order).astype(np.uint16)),
        **{name: encoded(getattr(splats, name)) for name in ("means", "quats", "scales", "opacities", "sh0")},
    }


def draw(page, splats, cameras, **options):
    """Return images by the page, 0 to 1; with ``file``, also those of its viewer of originals and the count."""
    job = {"scene": scene_of(splats), "cameras": list(map(pinhole, cameras)), **options}
    found = page.evaluate("job => draw(job)", job)

    def pixels(text, camera):
        return np.frombuffer(base64.b64decode(text), np.uint8).reshape(camera.height, camera.width, 4)[..., :3] / 255

    drawn, beside = (
        [pixels(text, camera) for text, camera in zip(found.get(kind, []), cameras, strict=False)]
        for kind in ("drawn", "beside")
    )
    return (drawn, beside, found["read"]) if "file" in options else drawn


def expected(splats, camera, background=(0, 0, 0)):
    return np.clip(kissgs.render(splats, camera, background=background)[0], 0, 1)


FRONT = seen_from((1.2, -2.2, -5.2), target=(0, -0.8, 0))
SIDE = skewed(seen_from((-4.5, -2.6, 2.0), target=(0, -0.8, 0)), 0.17, 0.12)


@pytest.mark.parametrize("degree", [3, 1])
@pytest.mark.quick(1)
def test_images_agree_with_the_rasteriser(page, degree):
    splats = kissgs.sample_scene(5000, sh_degree=degree)
    for camera, drawn in zip((FRONT, SIDE), draw(page, splats, [FRONT, SIDE]), strict=True):
        reference = expected(splats, camera)
        reached = psnr(drawn, reference)
        assert reached > 40
        assert np.abs((drawn - reference).mean(axis=(0, 1))).max() < 2 / 255
        for mirrored in (drawn[:, ::-1], drawn[::-1], drawn[..., ::-1]):
            assert psnr(mirrored, reference) < reached - 15


def test_a_white_background(page):
    scene = kissgs.sample_scene(3000, sh_degree=1)
    splats = scene.select(np.linalg.norm(scene.means, axis=1) < 2)  # no sky
    (drawn,) = draw(page, splats, [FRONT], background="#ffffff")
    assert psnr(drawn, expected(splats, FRONT, background=(1, 1, 1))) > 40
    assert psnr(drawn, expected(splats, FRONT)) < 30


def test_far_from_the_origin(page):
    """Spark stores positions as half floats."""
    splats = kissgs.sample_scene(5000, sh_degree=1)
    far = replace(splats, means=splats.means + np.float32(1000))
    camera = seen_from((1001.2, 997.8, 994.8), target=(1000, 999.2, 1000))
    (drawn,) = draw(page, far, [camera])
    reached = psnr(drawn, expected(far, camera))
    assert reached > 40


@pytest.mark.parametrize("beside", [True, False])
@pytest.mark.parametrize("ending", ["ply", "spz", "splat"])
@pytest.mark.quick(1)
def test_a_file_read_by_spark_and_a_decoded_scene_agree(page, ending, beside, tmp_path):
    """Beside the decoded scene, whose frame it takes, or in a frame of its own."""
    path = tmp_path / f"scene.{ending}"
    kissgs.save(kissgs.sample_scene(5000, sh_degree=0 if ending == "splat" else 3), path)
    splats = kissgs.load(path)
    file = {"type": ending, "bytes": base64.b64encode(path.read_bytes()).decode(), "beside": beside}
    drawn, read, count = draw(page, splats, [FRONT, SIDE], file=file)
    assert count == len(splats)
    for camera, one, other in zip((FRONT, SIDE), drawn, read, strict=True):
        to_decoded, to_reference = psnr(one, other), psnr(other, expected(splats, camera))
        assert to_decoded > (45 if beside and ending != "spz" else 38)
        assert to_reference > 38


@pytest.mark.parametrize("ending", ["ply", "spz"])
@pytest.mark.quick(1)
def test_an_antialiased_scene_is_drawn_with_compensated_opacities(page, ending, tmp_path):
    """Decoded, and read from a marked file beside it; a classic scene after it is drawn as such."""
    scene = kissgs.sample_scene(5000, sh_degree=1)
    small = replace(scene, scales=scene.scales - np.float32(1.5), antialiased=True)
    kissgs.save(small, tmp_path / f"scene.{ending}")
    splats = kissgs.load(tmp_path / f"scene.{ending}")
    file = {"type": ending, "bytes": encoded(np.fromfile(tmp_path / f"scene.{ending}", np.uint8)), "beside": True}
    (drawn,), (read,), _ = draw(page, splats, [FRONT], file=file)
    classic = replace(splats, antialiased=False)
    assert psnr(drawn, expected(splats, FRONT)) > 40
    assert psnr(read, expected(splats, FRONT)) > 38
    assert psnr(expected(splats, FRONT), expected(classic, FRONT)) < 30
    (again,) = draw(page, classic, [FRONT])
    assert psnr(again, expected(classic, FRONT)) > 40


@pytest.mark.parametrize("count", [0, 1])
@pytest.mark.parametrize("degree", [0, 3])
def test_scenes_of_no_and_one_gaussian(page, count, degree):
    splats = kissgs.sample_scene(count, sh_degree=degree)
    middle = splats.means.mean(axis=0) if count else np.zeros(3)
    camera = seen_from(middle - [0, 0, 4], (40, 30), middle)
    (drawn,) = draw(page, splats, [camera], background="#204060")
    assert np.abs(drawn - expected(splats, camera, (0x20 / 255, 0x40 / 255, 0x60 / 255))).max() < 3 / 255
