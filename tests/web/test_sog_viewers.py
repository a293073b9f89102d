"""Our files in Spark and the PlayCanvas engine; reference: ``kissgs.render``, and their own reading of a ``.ply``."""

import io

import numpy as np
import pytest
from helpers.viewers import opened, psnr, scattered, seen_from, skewed

import kissgs
from kissgs.io.ply import write_ply
from kissgs.pipeline.scene_files import write_scene

# To kissgs.render, dB. Spark rounds colours and sizes, and reaches 46. PlayCanvas draws exp(-x) less a constant, so
# that every Gaussian ends at 2.8 standard deviations, and reaches 37, from a .ply too. One SH band of wrong sign, or
# the parts of quaternions in another order, give less than 28.
TO_RASTERISER = {"spark": 44, "playcanvas": 35}
TO_ITS_PLY = 46  # the same values from a .ply: other roundings within the viewer, and ties in its sorting


@pytest.fixture(scope="module", params=["spark", "playcanvas"])
def viewer(request, browser):
    with opened(request.param, browser) as (viewer, _):
        yield viewer


CAMERAS = [seen_from((1.2, -1.2, -4.2), (300, 200)), skewed(seen_from((-3.5, -2.6, 2.0), (200, 180)))]


def ply(splats):
    file = io.BytesIO()
    write_ply(file, splats)
    return file.getvalue()


def reference(splats, camera):
    return np.clip(kissgs.render(splats, camera)[0], 0, 1)


def assert_alike(viewer, splats, drawn, same):
    """Compare images to the rasteriser's and to those of the .ply. Return each one's PSNR to the former."""
    found = []
    for camera, image, beside in zip(CAMERAS, drawn, same, strict=True):
        wanted = reference(splats, camera)
        found.append(psnr(image, wanted))
        assert found[-1] > TO_RASTERISER[viewer.name]
        assert psnr(image, beside) > TO_ITS_PLY
        for mirrored in (image[:, ::-1], image[::-1], image[..., ::-1]):
            assert psnr(mirrored, wanted) < found[-1] - 12
    return found


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.quick(1)  # two of each viewer
def test_sog_in_a_viewer(viewer, degree):
    scene = scattered(400, degree)
    sog = kissgs.compress(scene, container="sog").to_zip()
    decoded = kissgs.decompress(sog)
    count, drawn = viewer.draw(sog, "sog", CAMERAS)
    assert count == len(decoded)
    _, same = viewer.draw(ply(decoded), "ply", CAMERAS)
    _, original = viewer.draw(ply(scene), "ply", CAMERAS)
    for camera, before, reached in zip(CAMERAS, original, assert_alike(viewer, decoded, drawn, same), strict=True):
        assert reached > psnr(before, reference(scene, camera)) - 1.5


OTHERS = [
    *(("spark", ending, degree) for degree in (3, 0) for ending in ("spz", "compressed.ply")),
    ("spark", "splat", 0),
    *(("playcanvas", ending, degree) for degree in (3, 0) for ending in ("compressed.ply", "glb")),
]


@pytest.mark.parametrize(("viewer", "ending", "degree"), OTHERS, indirect=["viewer"])
@pytest.mark.quick(3)
def test_other_formats_in_a_viewer(viewer, ending, degree, tmp_path):
    """The axes too are those that the format has: a scene turned by half about one of them differs by more."""
    scene, file = scattered(400, degree), io.BytesIO()
    write_scene(file, scene, ending)
    (tmp_path / f"a.{ending}").write_bytes(file.getvalue())
    read = kissgs.load(tmp_path / f"a.{ending}")
    count, drawn = viewer.draw(file.getvalue(), ending, CAMERAS)
    assert count == len(read)
    _, same = viewer.draw(ply(read), "ply", CAMERAS)
    assert_alike(viewer, read, drawn, same)
