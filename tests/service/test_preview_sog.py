"""The preview of SOG in Chromium; oracles: the container decoded in Python, and Spark's rendering of it as a .ply."""

import io
import json

import numpy as np
import pytest
from helpers.format_scenes import made_scene
from helpers.preview_browser import assert_readout, colours, psnr
from helpers.reference_sog import sog_files, zip_of
from helpers.service import scene_bytes
from PIL import Image

import kissgs

GAUSSIANS = 1500
SOG = json.dumps({"preset": "fast", "format": "sog"})


@pytest.fixture(scope="module")
def job(service):
    return service.ended(service.submit(scene_bytes(GAUSSIANS, 3), options=SOG))


@pytest.fixture(scope="module")
def container(service, job):
    return service.http.get(job["links"]["result"]).content


@pytest.fixture(scope="module")
def decoded(container):
    return kissgs.decompress(container)


def ply_of(splats, folder):
    kissgs.save(splats, folder / "scene.ply")
    return (folder / "scene.ply").read_bytes()


def test_a_job(preview, service, job, container, decoded, tmp_path):
    tab = preview().open(service, job["id"])
    page = tab.page
    image = tab.shown(len(decoded))
    assert colours(image) > 5000
    facts = page.locator("#statistics .facts").inner_text()
    assert f"{job['sizes']['container']:,}" in facts
    assert f"{job['sizes']['ratio']:.3g}×" in facts
    rows = page.locator(".bytes tbody th").all_inner_texts()
    assert {"Colours, opacities", "Rotations", "SH codebook", "SH labels", "Metadata"} <= set(rows)
    thumbs = page.locator(".thumb span").all_inner_texts()
    assert len(thumbs) == 7
    assert "Positions, high bytes" in thumbs
    page.get_by_role("button", name="Compare with original").click()
    page.get_by_role("slider", name="original").wait_for()
    page.get_by_role("button", name="End comparison").click()

    read = preview().open(service)
    read.drop(("scene.ply", ply_of(decoded, tmp_path)))
    assert psnr(read.shown(len(decoded))[:-80], tab.still_image()[:-80]) > 40  # below are the buttons, which differ


@pytest.mark.quick(0)
def test_pointing_at_planes(preview, service, job, decoded):
    tab = preview(viewport={"width": 820, "height": 760}).open(service, job["id"])
    page = tab.page
    tab.shown(len(decoded))

    def file(name):
        return service.http.get(job["links"]["files"].replace("{name}", name)).content

    meta = json.loads(file("meta.json"))
    planes = {name: np.asarray(Image.open(io.BytesIO(file(name)))) for name in job["sizes"]["files"] if "webp" in name}
    page.get_by_role("button", name="Scales").click()
    height, width = planes["scales.webp"].shape[:2]

    def point_at(x, y, columns):
        canvas = page.locator(".plane canvas")
        size = canvas.bounding_box()["width"] / columns
        canvas.hover(position={"x": (x + 0.5) * size, "y": (y + 0.5) * size})
        return page.locator(".readout")

    for index in (0, 700, len(decoded) - 1):
        x, y = index % width, index // width
        readout = point_at(x, y, width)
        readout.get_by_text(f"Column {x}, row {y}: Gaussian {index:,}").wait_for()
        label = planes["shN_labels.webp"][y, x].astype(int)
        entry = assert_readout(readout, decoded, index, planes["scales.webp"][y, x], rotation=2e-3)
        assert entry == [label[0] + 256 * label[1]]
    if width * height > len(decoded):
        assert "padding" in point_at(width - 1, height - 1, width).inner_text()
    page.get_by_role("button", name="SH codebook").click()
    canvas = page.locator(".plane canvas")
    canvas.focus()
    for _ in range(16):
        canvas.press("ArrowRight")
    text = page.locator(".readout").inner_text()
    assert "Entry 1, coefficient 2: " in text  # 15 pixels of entry 0 come first
    assert "levels " + " ".join(map(str, planes["shN_centroids.webp"][0, 16])) in text
    labels = planes["shN_labels.webp"].reshape(-1, 3)[: meta["count"]].astype(int)
    assert f"used by {(labels[:, 0] + 256 * labels[:, 1] == 1).sum():,} Gaussians" in text


@pytest.mark.parametrize("damaged", ["shN_centroids.webp", "quats.webp", "sh0.webp", "meta.json"])
@pytest.mark.quick(1)
def test_the_message_names_a_damaged_file(preview, service, job, decoded, damaged):
    """The rest of the scene is drawn, if there are positions."""
    tab = preview()

    def respond(route):
        body = route.fetch().body()
        route.fulfill(body=body[: len(body) // 2])

    tab.page.route(f"**/files/{damaged}", respond)
    tab.open(service, job["id"])
    tab.error_message(damaged)
    tab.page.locator("#loading").wait_for(state="hidden")
    if damaged == "meta.json":
        assert tab.page.locator("#empty").is_visible()
    else:
        tab.shown(len(decoded))
        tab.fact("Loaded in", "cut short")


FILES = sog_files(made_scene(65, 1, extremes=False))
FILES_V1 = sog_files(made_scene(65, 1, extremes=False), version=1)


def as_png(files):
    """Return files whose images are PNG, under names of their own."""
    meta, changed = files["meta.json"].decode(), {}
    for name in [name for name in files if name != "meta.json"]:
        buffer, renamed = io.BytesIO(), f"plane{len(changed)}.png"
        Image.open(io.BytesIO(files[name])).save(buffer, "PNG")
        changed[renamed] = buffer.getvalue()
        meta = meta.replace(name, renamed)
    return {"meta.json": meta.encode(), **changed}


@pytest.mark.quick(0)
def test_files_of_other_encoders(preview, service):
    """Version 1, and PNG under other names, give the same image as version 2 does."""
    tab = preview().open(service)
    images = []
    for name, files in (("two", FILES), ("png", as_png(FILES)), ("one", FILES_V1)):
        tab.drop((f"{name}.sog", zip_of(files)))
        tab.page.get_by_role("heading", name=name, exact=True).wait_for()
        images.append(tab.shown(65))
    assert colours(images[0]) > 500
    assert psnr(images[1], images[0]) > 60
    assert psnr(images[2], images[0]) > 35  # other levels


def test_an_unsuitable_file(preview, service):
    tab = preview().open(service)
    tab.drop(("other.sog", zip_of({"notes.txt": b"hello"})))
    tab.error_message("no SOG-XT or SOG container", "meta.json")
    tab.drop(("garden.glb", b"anything"))
    tab.error_message("does not open glTF", '"kissgs view garden.glb"')
    assert tab.page.locator("#empty").is_visible()
