"""The web page in Chromium; oracle: the API's status of the job."""

import hashlib
import json

import pytest
from helpers.preview_browser import VENDOR
from helpers.service import FAST, SLOW, SMALL, Service
from helpers.viewers import NO_GPU, chromium


@pytest.fixture(scope="module")
def browser():
    with chromium(NO_GPU) as browser:
        yield browser


@pytest.fixture(scope="module")
def busy(tmp_path_factory):
    """Service whose worker is busy, so that jobs wait until they are cancelled."""
    with Service(tmp_path_factory.mktemp("busy") / "data", KISSGS_WORKERS=1) as service:
        service.hold()
        yield service


@pytest.fixture
def visit(browser, service):
    """``visit(at=service)`` opens the page; errors and requests to other hosts fail the test."""
    contexts, errors = [], []

    def begin(at=service, **options):
        context = browser.new_context(**options)
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(20_000)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda line: errors.append(line.text) if "Content Security Policy" in line.text else None)
        page.on("request", lambda sent: errors.append(sent.url) if not sent.url.startswith((at.url, "blob:")) else None)
        page.goto(at.url)
        return page

    yield begin
    for context in contexts:
        context.close()
    assert errors == []


def choose(page, data=SMALL, name="my scene.ply"):
    page.locator("#drop").wait_for()
    page.set_input_files("#file", {"name": name, "mimeType": "application/octet-stream", "buffer": data})


def newest(service):
    return service.http.get("/v1/jobs", params={"limit": 1}).json()["jobs"][0]


def test_upload_compression_and_download(visit, service, local, tmp_path):
    """Everything by the keyboard."""
    page = visit()
    choose(page)
    page.get_by_text("300 Gaussians").wait_for()
    page.locator("#file").focus()
    page.keyboard.press("Tab")
    page.keyboard.press("Tab")  # past the photographs
    page.keyboard.press("ArrowUp")  # from balanced to fast
    for _ in range(4):
        page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    page.get_by_text("smaller").first.wait_for()
    job = newest(service)
    assert (job["name"], job["options"]["preset"], job["state"]) == ("my scene", "fast", "succeeded")
    assert f"{job['sizes']['ratio']:#.3g}×" in page.locator("#job").inner_text()
    preview = page.get_by_role("link", name="Preview")
    assert (preview.get_attribute("href"), preview.get_attribute("target")) == (job["links"]["preview"], None)
    with page.expect_download() as download:
        page.get_by_role("link", name="Download container").click()
    download.value.save_as(tmp_path / "x.zip")
    assert download.value.suggested_filename == "my scene.zip"
    assert (tmp_path / "x.zip").read_bytes() == local.to_zip()
    with page.expect_download() as download:
        page.get_by_role("link", name="Decoded .ply").click()
    assert download.value.suggested_filename == "my scene.decoded.ply"
    page.goto(service.url)
    choose(page)
    page.get_by_label("Fast").check()
    formats = page.get_by_label("Format", exact=True)
    assert formats.locator("option").all_inner_texts() == ["SOG-XT (.zip)", "SOG (.sog)"]
    assert "kissgs" in page.locator("#format-note").inner_text()
    formats.select_option("SOG (.sog)")
    assert "other viewers" in page.locator("#format-note").inner_text()
    page.get_by_role("button", name="Compress").click()
    page.get_by_role("link", name="Download container (.sog)").wait_for()
    assert newest(service)["options"]["format"] == "sog"
    assert page.locator(".facts > div", has_text="Format").inner_text().split("\n")[-1] == "SOG (.sog)"
    rows = page.locator("table.planes tbody th").all_inner_texts()
    assert {"Colours, opacities", "Rotations", "SH codebook", "SH labels", "Metadata"} <= set(rows)
    assert not [row for row in rows if "webp" in row]
    with page.expect_download() as download:
        page.get_by_role("link", name="Download container (.sog)").click()
    assert download.value.suggested_filename == "my scene.sog"


def test_goals_and_a_time_limit(visit, busy):
    page = visit(busy)
    choose(page)
    page.get_by_text("300 Gaussians").wait_for()
    goal, keep = page.get_by_label("Goal"), page.get_by_label("Gaussians", exact=True)
    auto = keep.get_by_role("option", name="As many")
    page.get_by_label("Fast").check()
    assert goal.is_disabled()  # this preset has no rate-distortion planning
    page.get_by_label("Balanced").check()
    assert auto.is_disabled()
    goal.select_option("Maximum size")
    assert (page.locator("#amount").input_value(), page.locator("#unit").inner_text()) == ("3", "MB")
    assert auto.is_enabled()
    keep.select_option("As many as the goal needs")
    goal.select_option("Maximum PSNR loss")
    assert (page.locator("#amount").input_value(), page.locator("#unit").inner_text()) == ("0.1", "dB")
    goal.select_option("Preset default")
    assert keep.input_value() == ""
    limit, note = page.get_by_label("Time limit"), page.locator("#time-note")
    assert limit.locator("option").all_inner_texts() == ["None", "30 s", "1 min", "2 min", "5 min", "10 min", "30 min"]
    keep.select_option("Keep half")
    assert limit.is_disabled()
    assert note.inner_text() == "Possible only if all Gaussians are kept, or as many as the goal needs."
    keep.select_option("Keep all")
    limit.select_option("30 s")
    assert keep.get_by_role("option", name="half").is_disabled()
    assert "left is used for fine-tuning. If the preset takes longer, Fast is used" in note.inner_text()
    goal.select_option("Maximum size")
    assert "not before the goal is met" in note.inner_text()
    page.locator("#amount").fill("0.008")
    keep.select_option("As many as the goal needs")
    assert note.inner_text() == "It does not limit the search for the number of Gaussians."
    page.get_by_label("Fine-tune").check()
    assert "not before the goal is met" in note.inner_text()
    page.get_by_label("Fine-tune").uncheck()
    keep.select_option("Keep all")
    page.get_by_role("button", name="Compress").click()
    page.locator("#job-title").wait_for()
    job = newest(busy)
    busy.cancel(job)
    assert (job["options"]["time_limit"], job["options"]["encode"]["target_size"]) == (30, 8000)
    assert (job["options"]["compact"]["auto_count"], job["options"]["finetune"]["enabled"]) == (False, False)


def test_a_result_shows_its_goal_and_what_time_has_changed(visit, service):
    job = service.ended(service.submit(options=json.dumps({"time_limit": 0.01})))
    assert "encoded with the preset fast" in job["note"]
    few = {"target_size": 8000, "sensitivity_views": 4, "sensitivity_view_size": 48}
    options = {"time_limit": 30, "encode": few, "finetune": {"enabled": False}, "for_research": True}
    limited = service.ended(service.submit(options=json.dumps(options)))
    page = visit()
    page.goto(f"{service.url}/#{job['id']}")
    page.get_by_text("Encoded with the preset fast: balanced would take about").wait_for()
    page.goto(f"{service.url}/#{limited['id']}")
    page.locator("#job .facts > div", has_text="At most 8.00 kB").wait_for()
    facts = dict(text.split("\n", 1) for text in page.locator("#job .facts > div").all_inner_texts())
    assert facts["Goal"] == "At most 8.00 kB"
    assert "limit 30 s" in facts["Time"]


SEVERAL_GOALS = {
    "encode": {"target_size": "9kB", "max_psnr_drop": 0.5, "max_ssim_drop": 0.01},
    "compact": {"auto_count": True},
    "time_limit": "90s",
    "format": "sog",
    "evaluate": True,
}
REPEATED = {
    "psnr": {"encode": {"psnr": 38}, "finetune": {"enabled": True}},
    "quality": {"encode": {"quality": "same"}},
    "loss and time": {"encode": {"max_psnr_drop": 0.25}, "time_limit": "1min"},
    "share": {"preset": "fast", "compact": {"ratio": 0.125}},
    "count": {"preset": "paper", "compact": {"count": 120}},
    "loss by pruning": {"compact": {"max_psnr_drop": 0.3}},
    "time": {"time_limit": 45},
}


@pytest.fixture
def repeat(visit, busy):
    """``repeat(options)`` cancels a job with options and prefers them on the page; returns the job and the page."""

    def begin(options):
        job = busy.submit(options=json.dumps(options))
        busy.cancel(job)
        page = visit(busy)
        page.goto(f"{busy.url}/#{job['id']}")
        page.get_by_role("button", name="Try again").click()
        return job, page

    return begin


@pytest.mark.parametrize("name", REPEATED)
@pytest.mark.quick(1)
def test_a_repeated_job_has_the_same_options(repeat, busy, name):
    assert_options_are_kept(busy, *repeat(REPEATED[name]))


def assert_options_are_kept(busy, job, page):
    choose(page)
    page.get_by_text("300 Gaussians").wait_for()
    page.get_by_role("button", name="Compress").click()
    page.locator("#job-title").wait_for()
    again = newest(busy)
    busy.cancel(again)
    assert (again["id"] != job["id"], again["options"]) == (True, job["options"])


def test_goals_that_the_form_lacks_are_described_and_can_be_replaced(repeat, busy):
    job, page = repeat(SEVERAL_GOALS)
    goal, limit = page.locator("#goal"), page.locator("#time")
    label = "As in the earlier job"
    assert goal.evaluate("field => field.selectedOptions[0].text") == label
    described = (
        "At most 9.00 kB, at most 0.5 dB PSNR loss, at most 0.01 SSIM loss: the smallest container that meets this."
    )
    assert page.locator("#goal-note").inner_text() == described
    assert limit.evaluate("field => field.selectedOptions[0].text") == "1 min 30 s"
    goal.select_option("Maximum PSNR loss")
    assert page.locator("#amount").input_value() == "0.1"
    goal.select_option(label)
    assert page.locator("#amount").is_hidden()
    assert_options_are_kept(busy, job, page)


def test_unsuitable_files_are_rejected(visit, service):
    page = visit()
    sent = []
    page.on("request", lambda request: sent.append(request.method) if "/v1/jobs" in request.url else None)
    for data, message in ((b"hello " * 99, "ply"), (SMALL.replace(b"vertex 300\n", b"vertex 99999\n"), "99,999")):
        choose(page, data)
        page.locator("#file-error", has_text=message).wait_for()
        page.get_by_role("button", name="Compress").click()
        assert "POST" not in sent
    choose(page, SMALL.replace(b"opacity", b"opaqity"))  # found by the service
    page.get_by_role("button", name="Compress").click()
    page.get_by_role("alert").filter(has_text="opacity").wait_for()


def test_reload_and_cancel(visit, start):
    service = start()
    page = visit(service)
    job = service.submit(options=SLOW)
    page.goto(f"{service.url}/#{job['id']}")
    page.get_by_role("button", name="Cancel job").wait_for()
    page.reload()
    page.get_by_role("button", name="Cancel job").click()
    page.locator("#job", has_text="ancelled").wait_for()
    assert service.status(job)["state"] == "cancelled"


@pytest.mark.quick(0)
def test_training_notes_are_shown(visit, start):
    service = start()
    page = visit(service)
    changes = {
        "method": "prune",
        "count": 100,
        "sparsify_steps": 1000,
        "refine_steps": 1000,
        "views": 24,
        "view_size": 48,
    }
    job = service.submit(options=json.dumps({"preset": "fast", "compact": changes, "for_research": True}))
    page.goto(f"{service.url}/#{job['id']}")
    page.locator("#job summary", has_text="Training").click()  # stages are folded away
    page.locator("#job .note", has_text="Gaussians, loss").wait_for()
    page.locator("#live", has_text="Training").wait_for(state="attached")
    assert "loss" not in page.locator("#live").inner_text()  # screen readers announce only the stage


def test_deletion_must_be_confirmed_and_names_are_text(visit, start):
    service = start()
    name = "<img src=x onerror=alert(1)>"
    job = service.ended(service.http.post("/v1/jobs", content=SMALL, params={"name": name, "options": FAST}).json())
    page = visit(service)
    page.locator("#recent-list li").first.wait_for()
    assert page.locator("#recent-list img").count() == 0
    assert "img src=x" in page.locator("#recent-list").inner_text()
    page.get_by_role("button", name="Delete").first.click()
    page.get_by_role("button", name="Keep it").click()
    assert service.status(job)["state"] == "succeeded"
    page.locator("#recent-list").get_by_role("button", name="Delete").first.click()
    page.locator("#confirm-yes").click()
    page.locator("#recent-list li").first.wait_for(state="detached")
    assert service.http.get("/v1/jobs").json() == {"jobs": []}


def test_key_form(visit, start):
    service = start(KISSGS_KEYS=f"alice:{hashlib.sha256(b'secret').hexdigest()}", KISSGS_JOB_SECONDS=100)
    page = visit(service)
    page.get_by_role("textbox", name="Key").fill("wrong")
    page.get_by_role("button", name="Continue").click()
    page.locator("#gate-error").filter(has_text="key").wait_for()
    page.get_by_role("textbox", name="Key").fill("secret")
    page.get_by_role("button", name="Continue").click()
    choose(page)
    times = page.get_by_label("Time limit").locator("option").all_inner_texts()
    assert times == ["None", "30 s", "1 min"]  # none is longer than jobs may take
    page.get_by_label("Fast").check()
    page.get_by_role("button", name="Compress").click()
    page.get_by_text("smaller").first.wait_for()
    assert page.get_by_role("link", name="Preview").count() == 1  # the preview finds the key in the session storage
    with page.expect_download() as download:
        page.get_by_role("button", name="Download container").click()
    assert download.value.suggested_filename == "my scene.zip"


def test_no_horizontal_overflow(visit, service, job):
    page = visit()
    for address in ("", f"#{job['id']}"):
        page.goto(f"{service.url}/{address}")
        page.locator("#recent-list li").first.wait_for()
        for width, scheme in ((360, "light"), (768, "dark"), (1400, "light")):
            page.emulate_media(color_scheme=scheme)
            page.set_viewport_size({"width": width, "height": 800})
            assert page.evaluate("document.documentElement.scrollWidth") <= width


@pytest.mark.skipif(not VENDOR.exists(), reason="scripts/vendor has not run")
def test_the_api_explorer_needs_no_other_host(visit, service):
    """It was once blank without the internet, and ran a script of another site."""
    page = visit()
    policy = page.goto(f"{service.url}/docs").headers["content-security-policy"]
    assert "script-src 'self';" in policy
    page.locator("#operations-facts-limits").click()
    page.get_by_role("button", name="Try it out").click()
    page.get_by_role("button", name="Execute").click()
    page.locator(".live-responses-table .response-col_status", has_text="200").first.wait_for()
