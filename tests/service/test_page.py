"""The web page in Chromium; oracle: the API's status of the job."""

import io
import json

import pytest
from helpers.page_browser import sent_options
from helpers.preview_browser import VENDOR
from helpers.service import FAST, MESH, SLOW, SMALL, Service, keys_of, problem, scene_bytes
from PIL import Image


@pytest.fixture(scope="module")
def busy(tmp_path_factory):
    """Service whose worker is busy, so that jobs wait until they are cancelled."""
    with Service(tmp_path_factory.mktemp("busy") / "data", KISSGS_WORKERS=1) as service:
        service.hold()
        yield service


def choose(page, data=SMALL, name="my scene.ply"):
    page.locator("#drop").wait_for()
    page.set_input_files("#file", {"name": name, "mimeType": "application/octet-stream", "buffer": data})


def test_upload_compression_and_download(visit, service, local, tmp_path):
    """Everything by the keyboard."""
    page = visit()
    choose(page)
    page.get_by_text("300 Gaussians").wait_for()
    page.locator("#file").focus()
    page.keyboard.press("Tab")
    page.keyboard.press("Tab")  # past the photographs
    page.keyboard.press("ArrowUp")  # from balanced to the last one, as fast as possible
    for _ in range(4):
        page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    page.get_by_text("smaller").first.wait_for()
    job = service.newest()
    assert (job["name"], job["options"]["preset"], job["state"]) == ("my scene", "fast", "succeeded")
    assert f"{job['sizes']['ratio']:#.3g}×" in page.locator("#job").inner_text()
    preview = page.get_by_role("link", name="Preview")
    assert (preview.get_attribute("href"), preview.get_attribute("target")) == (job["links"]["preview"], None)
    with page.expect_download() as download:
        page.get_by_role("link", name="Download (").click()
    download.value.save_as(tmp_path / "x.zip")
    assert download.value.suggested_filename == "my scene.zip"
    assert (tmp_path / "x.zip").read_bytes() == local.to_zip()
    with page.expect_download() as download:
        page.get_by_role("link", name="Decoded .ply").click()
    assert download.value.suggested_filename == "my scene.decoded.ply"


def compress_for(page, service, ending):
    """Compress as fast as possible for what opens an ending; return the job, and the facts that the page shows."""
    page.goto(service.url)
    choose(page)
    page.get_by_label("Quick").check()
    formats = page.get_by_label("Opens in")
    formats.select_option(next(text for text in formats.locator("option").all_inner_texts() if text.startswith(ending)))
    page.get_by_role("button", name="Compress").click()
    with page.expect_download() as download:
        page.get_by_role("link", name=f"Download ({ending})").click()
    assert download.value.suggested_filename == f"my scene{ending}"
    facts = dict(text.split("\n", 1) for text in page.locator("#job .facts > div").all_inner_texts())
    return service.newest(), facts


def test_formats_by_what_opens_them(visit, service):
    page = visit()
    job, facts = compress_for(page, service, ".sog")
    assert (job["options"]["format"], facts["Format"]) == ("sog", "SOG (.sog)")
    rows = page.locator("table.planes tbody th").all_inner_texts()
    assert {"Colours, opacities", "Rotations", "SH codebook", "SH labels", "Metadata"} <= set(rows)
    assert not [row for row in rows if "webp" in row]
    job, facts = compress_for(page, service, ".compressed.ply")
    assert (job["state"], facts["Format"]) == ("succeeded", "compressed PLY (.compressed.ply)")
    assert page.locator("table.planes").count() == 0


def figures(page, title):
    """Return size, quality and time that the page expects of a choice, by its title."""
    row = page.locator(".choice").filter(has=page.get_by_label(title, exact=True))
    return row.locator("dd").all_inner_texts()


def test_what_to_expect_follows_the_scene(visit, service):
    """Oracles: the presets of the service; tables of docs/benchmarks.md and docs/method/rate-distortion.md, and the
    sizes of files that kissgs wrote of fox."""
    fast, balanced = service.http.get("/v1/presets").json()["presets"][:2]
    page = visit()
    page.locator("#drop").wait_for()
    assert figures(page, "Quick")[:2] == ["13.0 MB", f"−{-fast['psnr_change']} dB"]  # of a million Gaussians
    large = scene_bytes(10_000, 3)
    choose(page, large)
    page.get_by_text("10,000 Gaussians").wait_for()
    size = f"{balanced['bytes_per_gaussian'] * 10:.0f} kB"
    assert figures(page, "Balanced")[:2] == [size, f"−{-balanced['psnr_change']} dB"]
    assert "fox, 79,451 Gaussians" in page.locator("#choice-note").inner_text()
    page.get_by_label("Quality", exact=True).select_option("good quality")
    assert figures(page, "Good")[:2] == ["72.4 kB", "−0.93 dB"]
    page.get_by_label("Megabytes").fill("0.1")
    assert figures(page, "Small")[0] == "100 kB"
    assert -0.45 < float(figures(page, "Small")[1].split()[0].replace("−", "-")) < -0.28
    page.get_by_label("Megabytes").fill("0.01")
    assert figures(page, "Small")[1] == "< −1.39 dB"
    page.set_input_files("#capture", {"name": "photos.zip", "mimeType": "", "buffer": b"x"})
    assert figures(page, "Balanced")[:2] == ["84.4 kB", "−0.22 dB"]
    choose(page, scene_bytes(10_000, 0))
    page.get_by_text("SH degree 0").wait_for()
    assert figures(page, "Balanced")[0] == "70.1 kB"
    page.get_by_label("Opens in").select_option("spz")
    page.get_by_text("in fixed steps: expect 172 kB and −0.45 dB").wait_for()
    assert page.get_by_label("Balanced").is_disabled()


def test_goals_and_a_time_limit(visit, busy):
    """Regression: the size proposed for few Gaussians was below the least one, which prevented the submission."""
    page = visit(busy)
    choose(page, scene_bytes(60, 0))
    page.get_by_text("60 Gaussians").wait_for()
    assert changed_options(page) == {}
    choose(page)
    page.get_by_text("300 Gaussians").wait_for()
    keep, time = page.get_by_label("Gaussians", exact=True), page.get_by_label("Time", exact=True)
    page.get_by_text("More options").click()
    keep.select_option("Keep half")
    texts = time.locator("option").all_inner_texts()
    assert texts == [
        "as fast as possible",
        *(f"in {text}" for text in ("30 s", "1 min", "2 min", "5 min", "10 min", "30 min")),
    ]
    time.select_option("in 30 s")
    assert page.get_by_label("Quick").is_checked()  # whoever uses a control means its row
    assert (keep.is_disabled(), keep.input_value()) == (True, "")
    assert changed_options(page) == {"time_limit": 30}
    page.get_by_label("Megabytes").fill("")
    page.get_by_role("button", name="Compress").click()
    assert page.get_by_label("Megabytes").evaluate("field => field.matches(':focus:invalid')")  # nothing was sent
    page.get_by_label("Megabytes").fill("0.008")
    goal = {"encode": {"target_size": 8000}}
    assert changed_options(page) == {**goal, "compact": {"auto_count": False}, "finetune": {"enabled": False}}
    page.get_by_label("Fine-tune").check()
    assert figures(page, "Balanced")[2] == "minutes"
    assert changed_options(page) == {**goal, "finetune": {"enabled": True}}
    keep.select_option("Keep half")
    assert figures(page, "Balanced") == ["–", "–", "–"]  # nothing was measured of fewer Gaussians
    page.get_by_label("Move to the origin").check()
    page.get_by_label("Opens in").select_option("spz")
    assert page.get_by_label("Fine-tune").is_disabled()
    assert keep.is_disabled()
    assert changed_options(page) == {"origin": "auto", "format": "spz"}


def changed_options(page):
    """Send the form in vain; return the options that differ from those of balanced."""
    usual = {"preset": "balanced", "format": "sogxt", "evaluate": False, "origin": None, "capture": None}
    options = sent_options(page)
    page.get_by_role("button", name="Back").click()
    return {name: value for name, value in options.items() if (name, value) not in usual.items()}


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
    again = busy.newest()
    busy.cancel(again)
    assert (again["id"] != job["id"], again["options"]) == (True, job["options"])


def test_options_that_the_form_lacks_are_described_and_can_be_replaced(repeat, busy):
    job, page = repeat(SEVERAL_GOALS)
    described = (
        "balanced preset, SOG, at most 9.00 kB, at most 0.5 dB PSNR loss, at most 0.01 SSIM loss, "
        "keep as many as the goal needs, fine-tuning, at most 1 min 30 s"
    )
    assert page.locator(".choice", has_text="As before").inner_text().split("\n")[-1] == described
    page.get_by_label("Good", exact=True).check()
    assert page.get_by_label("Fine-tune").is_enabled()
    page.get_by_label("As before").check()
    assert_options_are_kept(busy, job, page)


def test_unsuitable_files_are_rejected(visit, service):
    """Regression: "3 Gaussians, estimated 39 bytes" of a mesh. Oracle: the service refuses it, too."""
    page = visit()
    sent = []
    page.on("request", lambda request: sent.append(request.method) if "/v1/jobs" in request.url else None)
    many = SMALL.replace(b"vertex 300\n", b"vertex 99999\n")
    for data, message in ((MESH, "my scene.ply is a mesh or a point cloud"), (b"hello " * 99, "ply"), (many, "99,999")):
        choose(page, data)
        page.locator("#file-error", has_text=message).wait_for()
        assert "a million Gaussians" in page.locator("#choice-note").inner_text()
        assert page.locator("#file-facts").is_hidden()
        page.get_by_role("button", name="Compress").click()
        assert "POST" not in sent
    assert "mesh" in problem(service.http.post("/v1/jobs", content=MESH), 422, "invalid-scene")["detail"]
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
    assert page.locator("#recent-list img[src=x]").count() == 0
    assert "img src=x" in page.locator("#recent-list").inner_text()
    page.get_by_role("button", name="Delete").first.click()
    page.get_by_role("button", name="Keep it").click()
    assert service.status(job)["state"] == "succeeded"
    page.locator("#recent-list").get_by_role("button", name="Delete").first.click()
    page.locator("#confirm-yes").click()
    page.locator("#recent-list li").first.wait_for(state="detached")
    assert service.http.get("/v1/jobs").json() == {"jobs": []}


def test_a_service_with_keys(visit, start):
    """Images need the key, too, which links cannot send. Oracle: the thumbnail over HTTP."""
    service = start(KISSGS_KEYS=keys_of(alice="secret"), KISSGS_JOB_SECONDS=100)
    page = visit(service)
    page.get_by_role("textbox", name="Key").fill("wrong")
    page.get_by_role("button", name="Continue").click()
    page.locator("#gate-error").filter(has_text="key").wait_for()
    page.get_by_role("textbox", name="Key").fill("secret")
    page.get_by_role("button", name="Continue").click()
    choose(page)
    times = page.get_by_label("Time", exact=True).locator("option").all_inner_texts()
    assert times == ["as fast as possible", "in 30 s", "in 1 min"]  # none is longer than jobs may take
    page.get_by_label("Quick").check()
    page.get_by_role("button", name="Compress").click()
    page.get_by_text("smaller").first.wait_for()
    assert page.get_by_role("link", name="Preview").count() == 1  # the preview finds the key in the session storage
    with page.expect_download() as download:
        page.get_by_role("button", name="Download (").click()
    assert download.value.suggested_filename == "my scene.zip"
    page.goto(service.url)
    page.wait_for_function("() => document.querySelector('#recent-list img')?.naturalWidth > 0")
    service.http.headers["Authorization"] = "Bearer secret"
    thumbnail = service.http.get(service.newest()["links"]["thumbnail"])
    size = page.locator("#recent-list img").evaluate("image => [image.naturalWidth, image.naturalHeight]")
    assert size == list(Image.open(io.BytesIO(thumbnail.content)).size)


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
