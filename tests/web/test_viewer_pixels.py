"""Rendering by Spark; reference: ``kissgs.render``."""

import base64
from dataclasses import replace

import numpy as np
import pytest
from helpers.viewers import pinhole, psnr, seen_from, skewed
from helpers.web_tools import DECODER

import kissgs
from kissgs.core.splats import SH_REST_COUNTS

pytestmark = pytest.mark.skipif(not (DECODER / "vendor").exists(), reason="scripts/vendor has not run")


PAGE = """<!doctype html><meta charset="utf-8"><link rel="icon" href="data:,">
<script type="importmap">{"imports": {
  "three": "/web_decoder/vendor/three/build/three.module.min.js",
  "three/addons/": "/web_decoder/vendor/three/examples/jsm/",
  "@sparkjsdev/spark": "/web_decoder/vendor/spark/dist/spark.module.min.js"}}</script>
<script type="module" src="/page.js"></script>"""

PROGRAM = """
import { Viewer } from "/web_decoder/preview/viewer.js";

const bytesOf = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
const floats = (text) => new Float32Array(bytesOf(text).buffer);
const textOf = (bytes) => {
  let text = "";
  for (let at = 0; at < bytes.length; at += 32768) text += String.fromCharCode(...bytes.subarray(at, at + 32768));
  return btoa(text);
};
const newViewer = () => new Viewer(document.body.appendChild(document.createElement("canvas")));
const [one, other] = [newViewer(), newViewer()];

function sceneOf({ count, degree, labels, meta, ...fields }) {
  const arrays = Object.fromEntries(Object.entries(fields).map(([name, text]) => [name, floats(text)]));
  return { count, degree, meta, labels: new Uint16Array(bytesOf(labels).buffer), ...arrays };
}

async function imagesOf(viewer, cameras) {
  const images = [];
  for (const camera of cameras) {
    viewer.setCamera(camera);
    await viewer.render();
    images.push(textOf(viewer.readPixels().data));
  }
  return images;
}

window.draw = async ({ scene, cameras, background = "#000000", file = null }) => {
  one.setScene(sceneOf(scene));
  one.setBackground(background);
  const found = { drawn: await imagesOf(one, cameras) };
  if (file !== null) {
    found.read = await other.setFile(file.type, bytesOf(file.bytes), one);
    if (!file.beside) await other.setFile(file.type, bytesOf(file.bytes));
    found.beside = await imagesOf(other, cameras);
  }
  return found;
};
"""


@pytest.fixture(scope="module")
def page(browser, site):
    errors = []
    site.files |= {"/page.html": PAGE.encode(), "/page.js": PROGRAM.encode()}
    page = browser.new_page()
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    page.goto(f"{site.url}/page.html")
    yield page
    page.close()
    assert errors == []


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
