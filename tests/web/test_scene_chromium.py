"""Containers in pages and workers of Chromium; reference: Pillow for levels, kissgs' Python decoder for values."""

import json

import pytest
from helpers.reference_sog import zip_of
from helpers.web_scenes import IMAGES, assert_progress, assert_scene, container, job, without_checksums
from helpers.web_tools import Site

MAX_ULPS = 1
PAGE = b"<!doctype html><title>test</title>"
# Counts calls of the browser's own decoder, makes it errors or fail, and counts workers.
SPY = """
globalThis.native = {made: 0, copied: 0, closed: 0};
globalThis.workers = {made: 0, ended: 0};
if ("ImageDecoder" in globalThis) {
  const Real = ImageDecoder;
  globalThis.ImageDecoder = class extends Real {
    constructor(init) { super(init); native.made++; }
    close() { native.closed++; return super.close(); }
    async decode(options) {
      if (globalThis.fault === "throw") throw new DOMException("out of order", "EncodingError");
      const result = await super.decode(options);
      const {image} = result;
      const copyTo = image.copyTo.bind(image);
      image.copyTo = async (target, ...rest) => {
        const layout = await copyTo(target, ...rest);
        native.copied++;
        if (globalThis.fault === "bit") target[5] ^= 1;
        return layout;
      };
      return result;
    }
  };
}
if ("Worker" in globalThis) {
  const Real = Worker;
  globalThis.Worker = class extends Real {
    constructor(...rest) { super(...rest); workers.made++; }
    terminate() { workers.ended++; return super.terminate(); }
  };
}
"""
LATE = "new Promise((_, reject) => setTimeout(() => reject(new Error('does not end')), 15000))"
IN_PAGE = """async (job) => {
  const {perform} = await import("/tests/web/scene_jobs.mjs");
  return JSON.stringify({...await perform(job), native, workers});
}"""
IN_WORKER = """(job) => new Promise((resolve, reject) => {
  const worker = new Worker("/tests/web/scene_worker.mjs", {type: "module"});
  worker.onerror = (event) => reject(new Error(event.message));
  worker.onmessage = ({data}) => {
    if (data === "ready") return worker.postMessage(job);
    worker.terminate();
    resolve(JSON.stringify(data));
  };
})"""


@pytest.fixture
def do(browser, site):
    """Return a function that performs a job in a page or a worker."""
    site.files["/page.html"] = PAGE
    context = browser.new_context()
    context.add_init_script(SPY)
    page = context.new_page()
    page.set_default_timeout(20_000)
    errors = []
    page.on("pageerror", lambda error: errors.append(str(error)))

    def run(job, within=IN_PAGE, at="/page.html", before=None):
        page.goto(site.url + at)
        if before:
            page.evaluate(before)
        return json.loads(page.evaluate(f"(job) => Promise.race([({within})(job), {LATE}])", job))

    yield run
    context.close()
    assert errors == []


@pytest.fixture(scope="module")
def large():
    """Return a container of 128 x 128 pixels, large enough for workers."""
    return container("fast", 1, 128 * 128)


@pytest.mark.parametrize(
    ("within", "options"),
    [(IN_PAGE, {}), (IN_PAGE, {"workers": 0}), (IN_WORKER, {"native": False}), (IN_WORKER, {"workers": 3})],
    ids=["page", "page without workers", "worker without native", "worker"],
)
@pytest.mark.quick(2)
def test_all_options_of_decoding(do, site, options, within, large):
    small = container("paper", 3, 65)
    for files, source, keep in ((small, site.put("small", small), True), (large, site.put("large", large), False)):
        report = do(job(source, options={**options, "keepPlanes": keep}), within)
        assert assert_scene(report, files) <= MAX_ULPS
        assert_progress(report)


def test_the_browser_decodes_all_but_rotations_exactly(do, large):
    """Eight images, verified by checksums; without workers, calls of the page's own decoder can be counted."""
    report = do(job(large, options={"workers": 0}))
    assert assert_scene(report, large) <= MAX_ULPS
    assert report["native"] == {"made": 8, "copied": 8, "closed": 8}
    assert report["workers"]["made"] == 0
    report = do(job(large, options={"workers": 0, "native": False}))
    assert report["native"]["made"] == 0
    report = do(job(without_checksums(large), options={"workers": 0, "native": True}))
    assert assert_scene(report, without_checksums(large)) <= MAX_ULPS
    assert report["native"]["made"] == 0


@pytest.mark.parametrize("fault", ["bit", "throw"])
def test_wrong_results_of_the_browser_are_detected(do, large, fault):
    """Some browsers change pixels on purpose, against fingerprinting."""
    report = do(job(large, options={"workers": 0, "keepPlanes": True}), before=f"globalThis.fault = '{fault}'")
    assert assert_scene(report, large) <= MAX_ULPS
    assert report["native"]["made"] == report["native"]["closed"] == 8


def test_workers_end_with_decoding(do, large):
    report = do(job(large, options={"workers": 3, "native": False}))
    assert assert_scene(report, large) <= MAX_ULPS
    assert report["workers"] == {"made": 3, "ended": 3}
    report = do(job(large))  # the browser decodes all but the rotations
    assert report["workers"] == {"made": 1, "ended": 1}
    damaged = {**large, "f_dc.webp": large["f_dc.webp"][:-50]}
    report = do(job(damaged, options={"workers": 2, "native": False}))
    assert report["error"]["message"].startswith("f_dc.webp: ")
    assert report["workers"] == {"made": 2, "ended": 2}
    report = do(job(large, options={"workers": 2, "native": False}, abort={"at": "active_mask.webp"}))
    assert report["error"]["name"] == "AbortError"
    assert report["workers"] == {"made": 2, "ended": 2}


def test_a_worker_that_does_not_load_does_not_delay_an_abort(do, site, large):
    site.late["/web_decoder/worker.js"] = 20
    try:
        report = do(job(large, options={"workers": 1, "native": False}, abort={"after": 300}))
    finally:
        del site.late["/web_decoder/worker.js"]
    assert report["error"]["name"] == "AbortError"
    assert report["ms"] < 15_000


def test_images_of_a_coarse_rendering_are_requested_first(do, site):
    """Otherwise they would share the bandwidth with all others."""
    site.late["/first/f_dc.webp"] = 0.5
    site.asked.clear()
    report = do(job(site.put("first", container())))
    asked = [path.removeprefix("/first/") for path in site.asked if path.startswith("/first/")]
    assert assert_scene(report, container()) <= MAX_ULPS
    assert asked[0] == "meta.json"
    assert set(asked[1:4]) == {"active_mask.webp", "means_bytes_1.webp", "f_dc.webp"}
    assert set(report["order"][:3]) == set(asked[1:4])


@pytest.mark.parametrize("wait", [0, 0.5], ids=["at once", "later"])
@pytest.mark.quick(1)
def test_workers_that_cannot_be_loaded(do, site, large, wait):
    """The page's own thread decodes if a bundler omitted the file or a policy forbids it, also after a delay."""
    site.files["/web_decoder/worker.js"] = None
    address = site.put("slow", large)
    for name in IMAGES:
        site.late[f"/slow/{name}"] = wait
    try:
        report = do(job(address, options={"workers": 2}))
    finally:
        del site.files["/web_decoder/worker.js"]
    assert assert_scene(report, large) <= MAX_ULPS


def test_a_policy_that_forbids_workers(do, site, large):
    site.files["/strict.html"] = PAGE
    site.headers["/strict.html"] = {"Content-Security-Policy": "worker-src 'none'; script-src 'self' 'unsafe-eval'"}
    report = do(job(site.put("forbidden", large), options={"workers": 2}), at="/strict.html")
    assert assert_scene(report, large) <= MAX_ULPS


def test_from_another_origin(do, site, large):
    """Pages may import the decoder from another origin, but not start its workers."""
    other = Site()
    try:
        report = do(job(other.put("scene", large)), IN_PAGE.replace('"/tests', f'"{other.url}/tests'))
    finally:
        other.close()
    assert assert_scene(report, large) <= MAX_ULPS


def test_an_image_of_another_size_is_refused(do, large):
    """The result does not depend on which decoder reads it."""
    files = {**large, "f_dc.webp": container("fast", 0, 1)["f_dc.webp"]}
    report = do(job(files, options={"workers": 0}))
    assert report["error"]["message"].startswith("f_dc.webp: 8 x 8 pixels, not ")


def test_relative_addresses(do, site):
    files = container()
    site.put("beside", files)
    site.files["/beside.zip"] = zip_of(files)
    for address in ("beside/", "/beside/meta.json", "beside.zip"):
        assert assert_scene(do(job(address)), files) <= MAX_ULPS
