"""Photographs on the web page in Chromium; oracle: kissgs.compress with the same photographs."""

import io
import json
import zipfile

import pytest
from helpers.captured_scene import SCENE, write_capture
from helpers.page_browser import sent_options
from helpers.service import SLOW, ply_bytes

import kissgs


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_capture(tmp_path_factory.mktemp("capture") / "statue", names=[f"{n}.png" for n in range(9)])


@pytest.fixture(scope="module")
def archive(folder):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as packed:
        for path in folder.rglob("*.*"):
            packed.write(path, f"statue/{path.relative_to(folder)}")
    return {"name": f"{'photographs_' * 10}.zip", "mimeType": "", "buffer": buffer.getvalue()}


SCENE_FILE = {"name": "statue.ply", "mimeType": "", "buffer": ply_bytes(SCENE)}


@pytest.fixture
def page(visit):
    page = visit()
    page.locator("#drop").wait_for()
    page.set_input_files("#file", SCENE_FILE)
    return page


def compress(page):
    page.get_by_role("button", name="Compress").click()
    page.locator("#job .ratio").wait_for()


def try_again(page, service, reference):
    """Begin to repeat a job that has named photographs."""
    cancelled = service.submit(SCENE_FILE["buffer"], json.dumps({**json.loads(SLOW), "capture": reference}))
    service.cancel(cancelled)
    page.goto(f"{service.url}/#{cancelled['id']}")
    page.get_by_role("button", name="Try again").click()
    page.locator("#capture-title", has_text="The photographs of the earlier job").wait_for()
    page.set_input_files("#file", SCENE_FILE)


def test_photographs_from_the_first_job_to_the_next_scene(page, service, folder, archive, tmp_path):
    """Regression: they stayed chosen for the next scene."""
    page.set_input_files("#capture", archive)
    page.locator("#capture-title", has_text=".zip").wait_for()
    page.get_by_text("More options").click()
    page.get_by_label("Also measure quality").check()
    compress(page)
    local = kissgs.compress(SCENE_FILE["buffer"], views=kissgs.load_views(folder), evaluate=True)
    with page.expect_download() as download:
        page.get_by_role("link", name="Download (").click()
    download.value.save_as(tmp_path / "x.zip")
    assert (tmp_path / "x.zip").read_bytes() == local.to_zip()
    shown = page.locator("#job .facts > div", has_text="PSNR to photographs").inner_text()
    mean = local.report.evaluation.mean
    assert f"{mean.candidate.psnr:.2f} dB" in shown
    assert f"{mean.reference.psnr:.2f} dB" in shown

    page.get_by_role("link", name="Another scene").click()
    page.locator("#capture-title", has_text="Add its photographs").wait_for()
    assert page.locator("#capture-remove").is_hidden()

    reference = service.newest()["options"]["capture"]
    try_again(page, service, reference)
    page.get_by_label("Quick").check()
    compress(page)
    repeated = service.newest()
    assert (repeated["state"], repeated["options"]["capture"]) == ("succeeded", reference)

    try_again(page, service, reference)
    gone = {"title": "Gone", "detail": "send its archive in the field 'capture'", "code": "gone", "status": 410}
    page.route("**/v1/jobs?**", lambda route: route.fulfill(status=410, json={**gone, "retryable": False}))
    page.get_by_role("button", name="Compress").click()
    page.locator("#upload .problem", has_text="choose their archive again").wait_for()
    assert "field" not in page.locator("#upload .problem").inner_text(), "the words are those of the page"


def test_a_goal_trains_on_the_photographs(page, service, archive):
    """The page leaves to the service what the command line does, too."""
    pytest.importorskip("torch")
    page.get_by_label("Quality", exact=True).select_option("at most 0.1 dB PSNR loss")
    page.set_input_files("#capture", archive)
    options = sent_options(page)
    assert (options["encode"], "compact" in options, "finetune" in options) == ({"max_psnr_drop": 0.1}, False, False)
    page.get_by_text("The connection failed or was interrupted").wait_for()
    page.unroute("**/v1/jobs?**")
    page.get_by_role("button", name="Try again").click()
    page.locator("#job-title").wait_for()
    job = service.newest()
    service.cancel(job)
    assert job["options"]["capture"].startswith("sha256:")
    assert (job["options"]["compact"]["auto_count"], job["options"]["finetune"]["enabled"]) == (True, True)


def test_what_is_no_archive_is_refused_before_the_upload(page, archive):
    page.set_input_files("#capture", {"name": "photos.rar", "mimeType": "", "buffer": b"x"})
    assert page.locator("#capture-error").inner_text() == (
        "photos.rar is not an archive: pack the photographs as .zip or .tar."
    )
    page.set_input_files("#capture", archive)
    assert page.locator("#capture-error").inner_text() == ""
    for width in (360, 375, 1280):
        page.set_viewport_size({"width": width, "height": 800})
        assert page.evaluate("document.documentElement.scrollWidth") <= width


def test_a_scene_and_its_photographs_are_dropped_anywhere(page):
    page.evaluate(
        """(names) => {
            const data = new DataTransfer();
            for (const name of names) data.items.add(new File([new Uint8Array(9)], name));
            window.dispatchEvent(new DragEvent("drop", { dataTransfer: data, bubbles: true, cancelable: true }));
        }""",
        ["photos.tar.xz", "scene.spz"],
    )
    page.locator("#capture-title", has_text="photos.tar.xz, 9 bytes").wait_for()
    page.locator("#file-title", has_text="scene.spz").wait_for()
